import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LocalWireError, RemoteWireError
from protocol.framing import SERIAL_PAYLOAD_MAX
from protocol.grid import GridSpec
from protocol.scanner_messages import (
    COLUMN_OVERHEAD,
    RUNS_MAX,
    TEXT_MAX,
    Ack,
    Calibrate,
    Calibration,
    Channel,
    ColumnRun,
    ColumnsGone,
    Credit,
    DeviceInfo,
    Fault,
    Hello,
    Message,
    Nak,
    NakCode,
    Order,
    Outcome,
    RangeColumn,
    RequestColumns,
    Reset,
    State,
    Status,
    SweepEnd,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
    TextureColumn,
    decode_message,
    encode_message,
    is_known,
)

SPEC = GridSpec(1440, 1024, 4096, 2048, 0.01, 0.25, 128.0, 0.5)
RUNS = (ColumnRun(Channel.RANGE, 0, 3, 2), ColumnRun(Channel.TEXTURE, 1, 900, 1))
NAME = (1, 2, 3, 4, -5, 6)  # sweep, pass, column, row0, encoder, time

# one row a message: the message, and its payload as the tables of PROTOCOL.md have it
TABLE: list[tuple[Message, str]] = [
    (Hello(1, 0, 1024, 65536), "01 00 0004 00000100"),
    (
        DeviceInfo("A7", 0x1122334455667788, 92160, 65535, "t", Order.BUFFERED, 1024),
        "01 01 0004 00680100 ffff0000 8877665544332211 01 02 4137 01 74",
    ),
    (Ack(0x01020304), "04030201"),
    (Nak(5, NakCode.BUSY, "no"), "05000000 04 02 6e6f"),
    (Reset(), ""),
    (Credit(1 << 40), "0000000000010000"),
    (Status(State.SWEEPING, 7, -1, 300, True), "2c01000000000000 ffffffff 0700 02 01"),
    (Fault(3, "jam"), "0300 03 6a616d"),
    (SweepRequest(Channel.TEXTURE, 2, 360, 100, 1024, 256, 8, 16), "02 02 6801 6400 0004 0001 08 10"),
    (Calibrate(), ""),
    (Calibration(9, -2), "0900000000000000 feffffff"),
    (SweepStart(0xABCD), "cdab"),
    (SweepStop(0xABCD), "cdab"),
    (
        SweepHeader(7, SPEC, 368640, 502, 334, Channel.BOTH, 2, -1, -1, 5, 8),
        "7b14ae47e17a843f 000000000000d03f 0000000000006040 000000000000e03f 0500000000000000"
        "00a00500 ffffffff 0700 a005 0004 0010 0008 f601 4e01 03 02 ff 08",
    ),
    (SweepEnd(7, Outcome.STOPPED, 1384, 0xDEADBEEF), "68050000 efbeadde 0700 01"),
    (RangeColumn(*NAME, b"\x01\x02"), "0600000000000000 fbffffff 0100 0300 0400 02 00 0102"),
    (TextureColumn(*NAME, b"RGB"), "0600000000000000 fbffffff 0100 0300 0400 02 00 524742"),
    (RequestColumns(7, RUNS), "0700 0200 01 00 0300 0200 02 01 8403 0100"),
    (ColumnsGone(7, RUNS), "0700 0200 01 00 0300 0200 02 01 8403 0100"),
]
APPENDED = {SweepRequest: 2, SweepHeader: 1}  # bytes that 1.1 appended
names = [type(message).__name__ for message, _ in TABLE]


@pytest.mark.parametrize(("message", "payload"), TABLE, ids=names)
def test_a_message_has_the_bytes_of_its_table(message: Message, payload: str) -> None:
    assert encode_message(message) == bytes.fromhex(payload)
    assert decode_message(message.TYPE, bytes.fromhex(payload)) == message
    assert is_known(message.TYPE)


@pytest.mark.parametrize(("message", "payload"), TABLE, ids=names)
def test_a_newer_minor_version_may_append_fields(message: Message, payload: str) -> None:
    if not isinstance(message, RangeColumn | TextureColumn):
        assert decode_message(message.TYPE, bytes.fromhex(payload) + b"new field") == message


@pytest.mark.parametrize(("message", "payload"), TABLE, ids=names)
def test_a_shortened_message_is_refused(message: Message, payload: str) -> None:
    whole = bytes.fromhex(payload)
    for size in range(len(whole) - APPENDED.get(type(message), 0)):
        with pytest.raises(RemoteWireError):
            decode_message(message.TYPE, whole[:size])


def test_what_an_older_minor_version_does_not_say_has_its_meaning_of_then() -> None:
    for message, payload in TABLE:
        if size := APPENDED.get(type(message)):
            older = decode_message(message.TYPE, bytes.fromhex(payload)[:-size])
            assert isinstance(older, SweepRequest | SweepHeader) and older.overlap == 0
            assert not isinstance(older, SweepRequest) or older.stride == 1


@given(st.sampled_from([message.TYPE for message, _ in TABLE]), st.binary(max_size=200))
def test_any_bytes_decode_or_are_the_other_ends_fault(type_: int, payload: bytes) -> None:
    try:
        message = decode_message(type_, payload)
    except RemoteWireError:
        return
    assert decode_message(type_, encode_message(message)) == message


@pytest.mark.parametrize(
    ("type_", "payload"),
    [
        (DeviceInfo.TYPE, "01 00 0004 00000000 00000000 0000000000000000 00 00 00"),  # no encoder counts
        (DeviceInfo.TYPE, "01 00 0004 01000000 00000000 0000000000000000 09 00 00"),  # no such order
        (DeviceInfo.TYPE, "01 00 0004 01000000 00000000 0000000000000000 00 01 ff 00"),  # text is not UTF-8
        (SweepRequest.TYPE, "00 01 0000 0000 0000 0000"),  # neither range nor texture
        (SweepRequest.TYPE, "03 00 0000 0000 0000 0000"),  # no pass
        (RequestColumns.TYPE, "0700 ffff"),  # runs that are not there
        (RequestColumns.TYPE, "0700 0100 03 00 0000 0100"),  # two channels in a run
        (RequestColumns.TYPE, "0700 0100 01 00 0000 0000"),  # an empty run
        (RangeColumn.TYPE, "0600000000000000 fbffffff 0100 0300 0400 02 00 010203"),  # half a sample
    ],
)
def test_values_out_of_bounds_are_refused(type_: int, payload: str) -> None:
    with pytest.raises(RemoteWireError):
        decode_message(type_, bytes.fromhex(payload))


@pytest.mark.parametrize("bad", [float("nan"), 0.0, -1.0, 1e9])
def test_a_header_with_an_impossible_step_is_refused(bad: float) -> None:
    payload = bytearray(encode_message(SweepHeader(7, SPEC, 368640, 502, 334)))
    payload[:8] = np.float64(bad).tobytes()
    with pytest.raises(RemoteWireError, match="step_mm"):
        decode_message(SweepHeader.TYPE, bytes(payload))


def test_fields_too_large_for_their_place_are_refused_before_they_travel() -> None:
    for message in (Credit(-1), Calibration(0, 2**31), Fault(1, "x" * (TEXT_MAX + 1)), RequestColumns(1, ())):
        with pytest.raises(LocalWireError):
            encode_message(message)


def test_the_longest_request_fits_a_serial_frame() -> None:
    assert len(encode_message(RequestColumns(1, RUNS[:1] * RUNS_MAX))) <= SERIAL_PAYLOAD_MAX


def test_columns_view_their_samples_without_copying() -> None:
    payload = encode_message(RangeColumn(*NAME, np.arange(5, dtype="<u2").tobytes()))
    samples = RangeColumn.from_bytes(memoryview(payload)).samples
    np.testing.assert_array_equal(samples, np.arange(5))
    assert np.shares_memory(samples, np.frombuffer(payload, np.uint8)) and not samples.flags.writeable
    texels = TextureColumn.from_bytes(memoryview(payload)[: COLUMN_OVERHEAD + 9]).samples
    assert texels.shape == (3, 3) and texels.dtype == np.uint8


@pytest.mark.parametrize("direction", [1, -1])
def test_the_angle_comes_from_the_encoder(direction: int) -> None:
    header = SweepHeader(1, SPEC, 1000, 502, 334, encoder_start=50, direction=direction)
    angles = header.angle_rad(np.array([50, 50 + direction * 250, 50 + direction * 1500]))
    np.testing.assert_allclose(angles, 0.5 + 2 * np.pi * np.array([0, 0.25, 1.5]))
