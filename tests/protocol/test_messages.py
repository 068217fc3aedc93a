import json
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError
from protocol.grid import GridSpec
from protocol.lattice import Channel, ChannelShape

SCAN = m.ScanInfo("ab12", 360, 100, 1024, 256, 20, 10, 256, 64, 0.01, 1.5, 150.0, 0.25)
STATEMENT = m.Statement([[585, 9, 0]], [[1000, 4, 0], [24, 0, 61]])
EVERY: list[m.Message] = [
    m.ServerInfo("foveascan.v1", "n1", "node", "0.1.0"),
    m.Welcome("view"),
    m.Opened(1, 2, SCAN),
    m.Updated(1, 5, "complete"),
    m.Resync(2, "digest"),
    m.Published("ab12"),
    m.Published("ab12", 3),
    m.Published("ab12", 0, ("cd34", "ef56")),
    m.LiveStarted(1, msgspec.structs.replace(SCAN, id="")),
    m.LiveProgress(1, 41.5, 2.5),
    m.LiveEnded(1, "interrupted", why="the port is gone"),
    m.Refused(1, "busy", "later"),
    m.Goodbye("shutting down"),
    m.Hello("foveascan.v1"),
    m.Open(1, "latest", STATEMENT),
    m.Look(1, 0.5, 0.25, parameters=m.LookParameters(m.RangeParameters(), m.TextureParameters(p=1.5))),
    m.Open(1, "latest", profile="classic"),
    m.Look(1, 0.5, 0.25, profile="classic", classic=m.ClassicLookParameters(m.ClassicRange(s=2.0), m.ClassicTexture())),
    m.Ack(2, 5, "0123456789abcdef"),
    m.State(2, 5, STATEMENT),
    m.Cancel(1),
    m.Watch(True),
    m.Envelope(1),
    m.Enveloped(1, 2, b"\x03\x00"),
]


@pytest.mark.parametrize("message", EVERY, ids=lambda message: type(message).__name__)
def test_text_is_inverse(message: m.Message) -> None:
    text = m.encode_message(message)
    assert m.decode_message(text) == message == m.decode_message(text.encode())
    name = type(message).__name__
    assert json.loads(text)["type"] == name[0].lower() + name[1:]
    assert text.startswith('{"type":')


def test_every_message_is_tried_here() -> None:
    assert {type(message) for message in EVERY} == set(m.Message.__args__)


@pytest.mark.parametrize("message", EVERY, ids=lambda message: type(message).__name__)
def test_fields_nobody_knows_are_ignored(message: m.Message) -> None:
    extended = json.loads(m.encode_message(message)) | {"addedInALaterVersion": [1, {"a": None}]}
    assert m.decode_message(json.dumps(extended)) == message


@pytest.mark.parametrize("message", EVERY, ids=lambda message: type(message).__name__)
def test_required_fields_may_not_be_missing(message: m.Message) -> None:
    fields = json.loads(m.encode_message(message))
    for field in msgspec.structs.fields(message):
        if field.required:
            with pytest.raises(RemoteWireError):
                m.decode_message(json.dumps({k: v for k, v in fields.items() if k != field.encode_name}))


LOOK = {"type": "look", "request": 1, "u": 0.5, "v": 0.5}
ACK = {"type": "ack", "epoch": 1, "nextSeq": 1, "digest": "0" * 16}
STATE = {"type": "state", "epoch": 1, "nextSeq": 0, "holdings": {"range": [], "texture": []}}
OUT_OF_BOUNDS: list[dict[str, Any]] = [
    LOOK | {"u": 1},
    LOOK | {"u": -0.01},
    LOOK | {"v": "0.5"},
    LOOK | {"v": None},
    LOOK | {"window": 0},
    LOOK | {"window": 1.01},
    LOOK | {"maxWaitS": 0.01},
    LOOK | {"maxWaitS": 31},
    LOOK | {"maxBytes": -1},
    LOOK | {"maxBytes": 2**41},
    *(LOOK | {"alpha": alpha} for alpha in (0, 0.004, 4.1, -1)),
    *(LOOK | {"scale": scale} for scale in (0, 1.01)),
    *(LOOK | {"textureDb": db} for db in (9, 101)),
    *(LOOK | {"rangeMm": error} for error in (-0.1, 1001)),
    LOOK | {"request": -1},
    LOOK | {"request": 2**32},
    LOOK | {"request": 1.5},
    LOOK | {"profile": "other"},
    LOOK | {"parameters": {"range": {"p": 3}}},
    LOOK | {"parameters": {"range": {"quantum": 0}}},
    LOOK | {"parameters": {"range": {"s": 0}}},
    LOOK | {"parameters": {"texture": {"p": 0.5}}},
    LOOK | {"parameters": {"texture": {"p": 9}}},
    LOOK | {"parameters": {"texture": {"quality": 256}}},
    LOOK | {"parameters": {"texture": {"codec": "png"}}},
    ACK | {"digest": "0" * 15},
    ACK | {"digest": "0" * 17},
    ACK | {"digest": "G" * 16},
    ACK | {"digest": "A" * 16},
    ACK | {"epoch": 65536},
    ACK | {"applyMs": -1},
    STATE | {"holdings": {"range": [[1, 2]], "texture": []}},
    STATE | {"holdings": {"range": [[1, 2, 3, 4]], "texture": []}},
    STATE | {"holdings": {"range": [[-1, 0, 0]], "texture": []}},
    STATE | {"holdings": {"range": [[2**32, 0, 0]], "texture": []}},
    STATE | {"holdings": {"range": [[10**30, 0, 0]], "texture": []}},
    {"type": "hello", "protocol": "p" * 201},
    {"type": "hello", "protocol": "p", "codecs": []},
    {"type": "hello", "protocol": "p", "codecs": ["jpeg"] * 9},
    {"type": "open", "request": 1, "scan": "s" * 201},
    {"type": "liveProgress", "sweep": 1, "percent": 101},
    {"type": "liveProgress", "sweep": 1, "percent": 1, "secondsLeft": -1},
    {"type": "liveEnded", "sweep": 1, "reason": "bored"},
    {"type": "shout"},
    {"request": 1},
    {},
]


@pytest.mark.parametrize("fields", OUT_OF_BOUNDS, ids=repr)
def test_values_out_of_bounds_are_refused(fields: dict[str, Any]) -> None:
    with pytest.raises(RemoteWireError):
        m.decode_message(json.dumps(fields))


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "null", "1", '"look"', "[" * 100_000, '{"a":' * 100_000, "\ud800", b"\xff\xfe", "{}{}", "NaN",
     '{"type":"look","request":1,"u":NaN,"v":0}', '{"type":"look","request":1,"u":0,"v":0,"textureDb":1e999}'],
)  # fmt: skip
def test_what_is_no_message_is_refused(text: str | bytes) -> None:
    with pytest.raises(RemoteWireError):
        m.decode_message(text)


def test_what_is_refused_is_not_quoted_at_length() -> None:
    for text in ('{"type":"%s"}', '{"type":"look","request":1,"u":0,"v":0,"profile":"%s"}'):
        with pytest.raises(RemoteWireError) as refused:
            m.decode_message(text % ("x" * 1_000_000))
        reply = m.Refused(0, "bad request", str(refused.value))
        assert m.decode_message(m.encode_message(reply)) == reply


def test_long_texts_are_refused_both_ways() -> None:
    with pytest.raises(RemoteWireError):
        m.decode_message(" " * (m.TEXT_MAX + 1))
    with pytest.raises(LocalWireError):
        m.encode_message(m.Goodbye("x" * m.TEXT_MAX))


def test_the_longest_statement_fits_a_message() -> None:
    runs = [[1, 9 + i % 2, 65000 + i % 7] for i in range(m.RUNS_MAX)]
    assert m.decode_message(m.encode_message(m.State(1, 2, m.Statement(runs, [])))).holdings.range == runs  # type: ignore[union-attr]
    with pytest.raises(RemoteWireError):
        m.decode_message(m.encode_message(m.State(1, 2, m.Statement([*[[1, 9, 0]] * m.RUNS_MAX, [1, 9, 0]], []))))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=300)
@given(st.sampled_from(EVERY), st.data())
def test_a_field_of_any_kind_is_understood_or_refused(message: m.Message, data: st.DataObject) -> None:
    fields = json.loads(m.encode_message(message))
    fields[data.draw(st.sampled_from(sorted(fields)))] = data.draw(json_values)
    try:
        understood = m.decode_message(json.dumps(fields))
    except RemoteWireError as error:
        assert len(str(error)) < 300
        return
    assert m.decode_message(m.encode_message(understood)) == understood


@settings(max_examples=300)
@given(st.sampled_from(EVERY), st.data())
def test_damaged_text_is_understood_or_refused(message: m.Message, data: st.DataObject) -> None:
    text = bytearray(m.encode_message(message).encode())
    for _ in range(data.draw(st.integers(1, 3))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    try:
        m.decode_message(bytes(text))
    except RemoteWireError as error:
        assert len(str(error)) < 300


def test_a_scan_tells_its_geometry_and_shapes() -> None:
    assert SCAN.spec() == GridSpec(360, 100, 1024, 256, 0.01, 1.5, 150.0, 0.25)
    assert SCAN.shapes() == {
        Channel.RANGE: ChannelShape(Channel.RANGE, 360, 100, 20, 10),
        Channel.TEXTURE: ChannelShape(Channel.TEXTURE, 1024, 256, 256, 64),
    }


@pytest.mark.parametrize("change", [{"step_mm": 0.0}, {"pitch_mm": -1.0}, {"coarse_width": 361}, {"theta0_rad": 1e9}])
def test_a_scan_that_makes_no_sense_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(RemoteWireError):
        msgspec.structs.replace(SCAN, **change).shapes()


@pytest.mark.parametrize("key", ["width", "height", "textureWidth", "coarseHeight"])
@pytest.mark.parametrize("value", [0, -1, 16385, 2**70, 1.5])
def test_a_scans_sizes_are_bounded(key: str, value: float) -> None:
    fields = json.loads(m.encode_message(m.Opened(1, 2, SCAN)))
    fields["scan"][key] = value
    with pytest.raises(RemoteWireError):
        m.decode_message(json.dumps(fields))
