import binascii
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LocalWireError
from protocol.framing import (
    DROPPED_MAX,
    FRAME_OVERHEAD,
    MAGIC,
    SERIAL_PAYLOAD_MAX,
    Dropped,
    DropReason,
    Frame,
    FrameReader,
    encode_frame,
)

payloads = st.binary(max_size=60)
frames = st.builds(
    encode_frame, st.integers(0, 255), payloads, seq=st.integers(0, 2**32 - 1), session=st.integers(0, 2**16 - 1)
)


def events(data: bytes, *, cuts: Iterable[int] = (), payload_max: int = SERIAL_PAYLOAD_MAX) -> list[Frame | Dropped]:
    """Everything a reader makes of `data`, fed in portions that end at `cuts`."""
    reader, found = FrameReader(payload_max), list[Frame | Dropped]()
    edges = sorted({0, len(data), *(cut % (len(data) + 1) for cut in cuts)})
    for start, end in zip(edges, edges[1:], strict=False):
        reader.receive_data(data[start:end])
        while (event := reader.next_event()) is not None:
            found.append(event)
    return found


def seqs(found: list[Frame | Dropped]) -> list[int]:
    return [event.seq for event in found if isinstance(event, Frame)]


def frame(seq: int, payload: bytes = b"0123456789") -> bytes:
    return encode_frame(0x24, payload, seq=seq, session=7)


def test_a_frame_has_the_bytes_of_the_table() -> None:
    data = encode_frame(0x06, b"\x01\x02", seq=0x0A0B0C0D, session=0x1122, flags=1, version=1)
    head = bytes.fromhex("f5ca 01 06 01 00 2211 0d0c0b0a 0200")
    assert data[:14] == head
    assert data[14:16] == binascii.crc_hqx(head, 0xFFFF).to_bytes(2, "little")
    assert data[16:18] == b"\x01\x02"
    assert data[18:] == binascii.crc32(data[:18]).to_bytes(4, "little")
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1  # the check value PROTOCOL.md names


@given(st.integers(0, 255), payloads, st.integers(0, 2**32 - 1), st.integers(0, 65535), st.integers(0, 255))
def test_reading_undoes_encoding(type_: int, payload: bytes, seq: int, session: int, flags: int) -> None:
    data = encode_frame(type_, payload, seq=seq, session=session, flags=flags, version=3)
    assert events(data) == [Frame(type_, memoryview(payload), seq, session, flags, 3)]


@given(st.lists(st.one_of(frames, st.binary(max_size=40), frames.map(lambda f: f[:-3])), max_size=8), st.data())
def test_any_chunking_gives_the_same_events(parts: list[bytes], data: st.DataObject) -> None:
    line = b"".join(parts)
    cuts = data.draw(st.lists(st.integers(0, 10_000), max_size=30))
    assert events(line, cuts=cuts) == events(line)
    assert events(line, cuts=range(len(line))) == events(line)


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_a_changed_byte_costs_only_its_own_frame(at: int, change: int) -> None:
    line = bytearray(frame(1) + frame(2) + frame(3) + frame(4) * 40)
    at %= 3 * len(frame(1))
    line[at] ^= change
    hit = 1 + at // len(frame(1))
    found = events(bytes(line))
    assert seqs(found)[:2] == [n for n in (1, 2, 3) if n != hit]
    assert sum(event.count for event in found if isinstance(event, Dropped)) == len(frame(1))


@given(st.integers(0, 29))
def test_a_frame_behind_a_truncated_one_is_found(kept: int) -> None:
    found = events(frame(1) + frame(2)[:kept] + frame(3) + frame(4))
    assert seqs(found) == [1, 3, 4]
    assert sum(event.count for event in found if isinstance(event, Dropped)) == kept


@given(st.binary(max_size=200))
def test_noise_is_counted_byte_by_byte(noise: bytes) -> None:
    line = noise.replace(MAGIC[:1], b"") + frame(9)
    found = events(line)
    assert seqs(found) == [9]
    assert sum(event.count for event in found if isinstance(event, Dropped)) == len(line) - len(frame(9))


def reason_of(line: bytes) -> DropReason:
    return next(event.reason for event in events(line + frame(2)) if isinstance(event, Dropped))


def test_each_damage_is_named() -> None:
    header, payload = bytearray(frame(1)), bytearray(frame(1))
    header[3] ^= 1
    payload[20] ^= 1
    assert reason_of(b"noise") is DropReason.NOISE
    assert reason_of(bytes(header)) is DropReason.HEADER
    assert reason_of(bytes(payload)) is DropReason.PAYLOAD
    assert reason_of(frame(1, bytes(SERIAL_PAYLOAD_MAX + 1))) is DropReason.LENGTH


def test_the_longest_payload_passes_and_one_byte_more_does_not() -> None:
    assert seqs(events(frame(1, bytes(8192)), payload_max=8192)) == [1]
    assert seqs(events(frame(1, bytes(8193)) + frame(2), payload_max=8192)) == [2]


def test_a_frame_that_stops_in_the_middle_gives_way_when_abandoned() -> None:
    reader = FrameReader()
    reader.receive_data(frame(1, bytes(900))[:100] + frame(2))
    assert reader.next_event() is None and reader.waits_inside_frame
    reader.abandon_partial()
    assert reader.next_event() == Dropped(DropReason.TRUNCATED, 100)
    behind = reader.next_event()
    assert isinstance(behind, Frame) and behind.seq == 2
    assert not reader.waits_inside_frame
    reader.abandon_partial()
    assert reader.next_event() is None


def test_endless_noise_is_reported_in_pieces_and_not_kept() -> None:
    reader = FrameReader()
    for _ in range(40):
        reader.receive_data(bytes(5000))
        event = reader.next_event()
        assert event in (None, Dropped(DropReason.NOISE, DROPPED_MAX))
    assert len(reader._data) - reader._at < FRAME_OVERHEAD


@given(st.lists(st.binary(min_size=1, max_size=300), max_size=20))
def test_garbage_never_raises(chunks: list[bytes]) -> None:
    reader = FrameReader()
    for chunk in chunks:
        reader.receive_data(MAGIC + chunk)
        while reader.next_event() is not None:
            pass
        reader.abandon_partial()


@pytest.mark.parametrize("field", [{"seq": 2**32}, {"session": 65536}, {"flags": 256}, {"version": -1}])
def test_a_field_that_does_not_fit_is_the_callers_fault(field: dict[str, int]) -> None:
    with pytest.raises(LocalWireError):
        encode_frame(1, b"", **({"seq": 0, "session": 0} | field))
