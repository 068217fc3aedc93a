"""Messages of the scanner link, one class each: typed fields on this side, the byte tables of PROTOCOL.md on the other.

A message knows its layout and its bounds, and nothing of numbering, retries or credits (see scanner_link).
A newer minor version may append fields to any message but the columns: bytes behind the known fields are ignored.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any, ClassVar, Self

import numpy as np

from protocol.checksum import crc32
from protocol.errors import LocalWireError, RemoteWireError
from protocol.framing import SERIAL_PAYLOAD_MAX
from protocol.grid import FloatArray, GridSpec, ImageArray, IntArray, StepArray

MAJOR = 1
MINOR = 1
TEXT_MAX = 200  # bytes of UTF-8 in any text field
PASSES_MAX = 64
RUNS_MAX = 160
OVERLAP_TURN = 256  # an overlap is told in this part of a turn

Payload = bytes | memoryview


class Channel(IntFlag):
    """What a sweep measures."""

    RANGE = 1
    TEXTURE = 2
    BOTH = 3


class Order(IntEnum):
    """In which order a scanner sends its columns."""

    LIVE = 0  # by angle, as the table turns
    BUFFERED = 1  # from its memory, coarse to fine


class State(IntEnum):
    """What a scanner is doing."""

    IDLE = 0
    HOMING = 1
    SWEEPING = 2
    HOLDING = 3  # the sweep is over and its columns are still held for requests
    FAULT = 4


class Outcome(IntEnum):
    """How a sweep ended."""

    COMPLETE = 0
    STOPPED = 1
    FAULT = 2


class NakCode(IntEnum):
    """Why a command was refused."""

    VERSION = 1
    UNKNOWN = 2
    MALFORMED = 3
    BUSY = 4
    UNSUPPORTED = 5
    NOT_NOW = 6
    FAULT = 7


class _Plain:
    """A message whose fields lie on the line one after the other, each with its place in the layout."""

    __slots__ = ()
    _LAYOUT: ClassVar[struct.Struct]
    __match_args__: ClassVar[tuple[str, ...]]

    def to_bytes(self) -> bytes:
        """As the message's table."""
        return self._LAYOUT.pack(*(getattr(self, name) for name in self.__match_args__))

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        return cls(*_unpack(cls._LAYOUT, payload))


@dataclass(frozen=True, slots=True)
class Hello(_Plain):
    """Host to device: who asks, how long a payload it reads, and how many bytes of columns it takes unasked."""

    TYPE: ClassVar[int] = 0x01
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBHI")
    major: int = MAJOR
    minor: int = MINOR
    payload_max: int = SERIAL_PAYLOAD_MAX
    window_bytes: int = 65536


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Device to host, HELLO_ACK: what this scanner is.

    boot_id : drawn anew at every start of the device.   retention_columns : how many past columns it can send again.
    counts_per_turn : encoder counts of a full turn.     serial_number, model : at most 200 bytes of UTF-8 each.
    """

    TYPE: ClassVar[int] = 0x02
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBHIIQB")
    serial_number: str
    boot_id: int
    counts_per_turn: int
    retention_columns: int
    model: str = ""
    order: Order = Order.LIVE
    payload_max: int = SERIAL_PAYLOAD_MAX
    major: int = MAJOR
    minor: int = MINOR

    def to_bytes(self) -> bytes:
        """As the table HELLO_ACK."""
        fixed = (self.major, self.minor, self.payload_max, self.counts_per_turn, self.retention_columns, self.boot_id)
        return self._LAYOUT.pack(*fixed, self.order) + _text_to_bytes(self.serial_number) + _text_to_bytes(self.model)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        major, minor, payload_max, counts, retention, boot_id, order = _unpack(cls._LAYOUT, payload)
        serial_number, end = _text_from_bytes(payload, cls._LAYOUT.size)
        model, _ = _text_from_bytes(payload, end)
        _check(counts > 0, "counts_per_turn is 0")
        return cls(serial_number, boot_id, counts, retention, model, Order(order), payload_max, major, minor)


@dataclass(frozen=True, slots=True)
class Ack(_Plain):
    """The command numbered `acked_seq` is accepted."""

    TYPE: ClassVar[int] = 0x03
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<I")
    acked_seq: int


@dataclass(frozen=True, slots=True)
class Nak:
    """The command numbered `refused_seq` is refused, and why."""

    TYPE: ClassVar[int] = 0x04
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IB")
    refused_seq: int
    code: NakCode
    text: str = ""

    def to_bytes(self) -> bytes:
        """As the table NAK."""
        return self._LAYOUT.pack(self.refused_seq, self.code) + _text_to_bytes(self.text)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        seq, code = _unpack(cls._LAYOUT, payload)
        return cls(seq, NakCode(code), _text_from_bytes(payload, cls._LAYOUT.size)[0])


@dataclass(frozen=True, slots=True)
class Reset(_Plain):
    """Host to device: drop the sweep, its columns and the configuration, and be idle."""

    TYPE: ClassVar[int] = 0x05
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("")


@dataclass(frozen=True, slots=True)
class Credit(_Plain):
    """Host to device: column frames may be sent until they add up to `total_bytes` since the session began."""

    TYPE: ClassVar[int] = 0x06
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Q")
    total_bytes: int


@dataclass(frozen=True, slots=True)
class Status:
    """Device to host, while it is not idle: what it does, and how many bytes of column frames it has sent so far."""

    TYPE: ClassVar[int] = 0x07
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<QiHBB")
    state: State
    sweep: int
    encoder: int
    sent_bytes: int
    out_of_credit: bool = False

    def to_bytes(self) -> bytes:
        """As the table STATUS."""
        return self._LAYOUT.pack(self.sent_bytes, self.encoder, self.sweep, self.state, self.out_of_credit)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        sent_bytes, encoder, sweep, state, out_of_credit = _unpack(cls._LAYOUT, payload)
        return cls(State(state), sweep, encoder, sent_bytes, bool(out_of_credit))


@dataclass(frozen=True, slots=True)
class Fault:
    """Device to host, ERROR: something stopped it; a sweep that was running is over."""

    TYPE: ClassVar[int] = 0x08
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<H")
    code: int
    text: str = ""

    def to_bytes(self) -> bytes:
        """As the table ERROR."""
        return self._LAYOUT.pack(self.code) + _text_to_bytes(self.text)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        (code,) = _unpack(cls._LAYOUT, payload)
        return cls(code, _text_from_bytes(payload, cls._LAYOUT.size)[0])


@dataclass(frozen=True, slots=True)
class SweepRequest:
    """Host to device, CONFIG: what the next sweep shall measure; a size of 0 leaves that size to the scanner.

    overlap : how far beyond the passes to go on, in 1/256 turn.   stride : take every so many-th column of the first
    pass in a fast turn ahead of the others, so that the whole object shows early; 1 does not. Both since 1.1.
    """

    TYPE: ClassVar[int] = 0x10
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<BBHHHH")
    _SINCE_1_1: ClassVar[struct.Struct] = struct.Struct("<BB")
    channels: Channel = Channel.BOTH
    passes: int = 1
    width: int = 0
    height: int = 0
    texture_width: int = 0
    texture_height: int = 0
    overlap: int = 0
    stride: int = 1

    def to_bytes(self) -> bytes:
        """As the table CONFIG."""
        sizes = (self.width, self.height, self.texture_width, self.texture_height)
        appended = self._SINCE_1_1.pack(self.overlap, self.stride)
        return self._LAYOUT.pack(self.channels, self.passes, *sizes) + appended

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        channels, passes, width, height, texture_width, texture_height = _unpack(cls._LAYOUT, payload)
        overlap, stride = _unpack_appended(cls._SINCE_1_1, payload, cls._LAYOUT.size, (0, 1))
        _check(stride > 0, "stride is 0")
        return cls(
            _channels(channels), _passes(passes), width, height, texture_width, texture_height, overlap, stride
        )


@dataclass(frozen=True, slots=True)
class Calibrate(_Plain):
    """Host to device, CAL: home the table and report the calibration."""

    TYPE: ClassVar[int] = 0x11
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("")


@dataclass(frozen=True, slots=True)
class Calibration(_Plain):
    """Device to host, CAL_REPORT: the table stands at home; `calibration` names the settings in use there."""

    TYPE: ClassVar[int] = 0x12
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Qi")
    calibration: int
    home_encoder: int


@dataclass(frozen=True, slots=True)
class SweepStart(_Plain):
    """Host to device: begin the configured sweep under this number."""

    TYPE: ClassVar[int] = 0x20
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<H")
    sweep: int


@dataclass(frozen=True, slots=True)
class SweepStop(_Plain):
    """Host to device: end this sweep early."""

    TYPE: ClassVar[int] = 0x21
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<H")
    sweep: int


@dataclass(frozen=True, slots=True)
class SweepHeader:
    """Device to host: what is about to be swept.

    spec : shapes and geometry.  encoder_start : count at the angle spec.theta0_rad.  direction : +1 when counts grow
    counter-clockwise seen from above, -1 otherwise.  range_rows, texture_rows : samples in every piece of a column but
    its last.  calibration : as in Calibration.  overlap : columns of that part of a turn (in 1/256) follow the last
    pass, under the pass number `passes` (since 1.1).
    """

    TYPE: ClassVar[int] = 0x22
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<ddddQIiHHHHHHHBBb")
    _SINCE_1_1: ClassVar[struct.Struct] = struct.Struct("<B")
    sweep: int
    spec: GridSpec
    counts_per_turn: int
    range_rows: int
    texture_rows: int
    channels: Channel = Channel.BOTH
    passes: int = 1
    encoder_start: int = 0
    direction: int = 1
    calibration: int = 0
    overlap: int = 0

    def to_bytes(self) -> bytes:
        """As the table SWEEP_HEADER."""
        s = self.spec
        return self._LAYOUT.pack(
            s.step_mm, s.pitch_mm, s.z_max_mm, s.theta0_rad,
            self.calibration, self.counts_per_turn, self.encoder_start,
            self.sweep, s.width, s.height, s.texture_width, s.texture_height, self.range_rows, self.texture_rows,
            self.channels, self.passes, self.direction,
        ) + self._SINCE_1_1.pack(self.overlap)  # fmt: skip

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        fields = _unpack(cls._LAYOUT, payload)
        geometry, (calibration, counts, start, sweep) = fields[:4], fields[4:8]
        shape, (range_rows, texture_rows, channels, passes, direction) = fields[8:12], fields[12:]
        _check(counts > 0 and range_rows > 0 and texture_rows > 0, "counts_per_turn and rows must be positive")
        _check(direction in (1, -1), "direction must be 1 or -1")
        (overlap,) = _unpack_appended(cls._SINCE_1_1, payload, cls._LAYOUT.size, (0,))
        spec = GridSpec(*shape, *geometry)
        return cls(
            sweep, spec, counts, range_rows, texture_rows, _channels(channels), _passes(passes), start, direction,
            calibration, overlap,
        )  # fmt: skip

    def angle_rad(self, encoder: IntArray | int) -> FloatArray:
        """Angle at encoder counts (any shape), counter-clockwise seen from above, not wrapped. [rad]"""
        turns = self.direction * (np.asarray(encoder, np.int64) - self.encoder_start) / self.counts_per_turn
        return np.asarray(self.spec.theta0_rad + 2 * math.pi * turns)

    def shape(self, channel: Channel) -> tuple[int, int, int]:
        """(columns, samples in a column, samples in a piece) of one channel."""
        if channel is Channel.RANGE:
            return self.spec.width, self.spec.height, self.range_rows
        return self.spec.texture_width, self.spec.texture_height, self.texture_rows

    def columns_in(self, channel: Channel) -> tuple[int, ...]:
        """How many columns of one channel each pass has; the overlap, if there is one, comes as a last, short pass."""
        if channel not in self.channels:
            return ()
        width = self.shape(channel)[0]
        beyond = width * self.overlap // OVERLAP_TURN
        return (width,) * self.passes + ((beyond,) if beyond else ())


@dataclass(frozen=True, slots=True)
class SweepEnd:
    """Device to host: everything exposed or asked for has been sent.

    pieces : how many different column messages the sweep has.
    digest : sum of the CRC-32 of their payloads, modulo 2**32; in whatever order they came, it is the same.
    """

    TYPE: ClassVar[int] = 0x23
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<IIHB")
    sweep: int
    outcome: Outcome
    pieces: int
    digest: int

    def to_bytes(self) -> bytes:
        """As the table SWEEP_END."""
        return self._LAYOUT.pack(self.pieces, self.digest, self.sweep, self.outcome)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        pieces, digest, sweep, outcome = _unpack(cls._LAYOUT, payload)
        return cls(sweep, Outcome(outcome), pieces, digest)


_COLUMN = struct.Struct("<QiHHHBx")
COLUMN_OVERHEAD = _COLUMN.size


@dataclass(frozen=True, slots=True)
class RangeColumn:
    """Device to host: samples row0, row0+1, ... of one range column, top down, as seen at `encoder` and `time_us`."""

    TYPE: ClassVar[int] = 0x24
    CHANNEL: ClassVar[Channel] = Channel.RANGE
    SAMPLE_BYTES: ClassVar[int] = 2
    sweep: int
    pass_index: int
    column: int
    row0: int
    encoder: int
    time_us: int
    data: Payload

    @property
    def samples(self) -> StepArray:
        """(n,) uint16 steps, 0 = void; a read-only view of the received bytes."""
        return np.frombuffer(self.data, "<u2")

    @property
    def rows(self) -> int:
        """Number of samples."""
        return len(self.data) // self.SAMPLE_BYTES

    @property
    def checksum(self) -> int:
        """CRC-32 of its payload, as SWEEP_END adds it up."""
        return crc32(self.data, crc32(_column_name(self)))

    def to_bytes(self) -> bytes:
        """As the table RANGE_COLUMN."""
        return _column_to_bytes(self)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        return cls(*_column_fields(payload, cls.SAMPLE_BYTES))


@dataclass(frozen=True, slots=True)
class TextureColumn:
    """Device to host: texels row0, row0+1, ... of one texture column, top down, as seen at `encoder` and `time_us`."""

    TYPE: ClassVar[int] = 0x25
    CHANNEL: ClassVar[Channel] = Channel.TEXTURE
    SAMPLE_BYTES: ClassVar[int] = 3
    sweep: int
    pass_index: int
    column: int
    row0: int
    encoder: int
    time_us: int
    data: Payload

    @property
    def samples(self) -> ImageArray:
        """(n, 3) uint8 RGB; a read-only view of the received bytes."""
        return np.frombuffer(self.data, np.uint8).reshape(-1, 3)

    @property
    def rows(self) -> int:
        """Number of texels."""
        return len(self.data) // self.SAMPLE_BYTES

    @property
    def checksum(self) -> int:
        """CRC-32 of its payload, as SWEEP_END adds it up."""
        return crc32(self.data, crc32(_column_name(self)))

    def to_bytes(self) -> bytes:
        """As the table TEXTURE_COLUMN."""
        return _column_to_bytes(self)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        return cls(*_column_fields(payload, cls.SAMPLE_BYTES))


Column = RangeColumn | TextureColumn


@dataclass(frozen=True, slots=True)
class ColumnRun:
    """Whole columns first, first+1, ... of one channel and pass."""

    channel: Channel
    pass_index: int
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class RequestColumns:
    """Host to device: send these columns again."""

    TYPE: ClassVar[int] = 0x26
    sweep: int
    runs: tuple[ColumnRun, ...]

    def to_bytes(self) -> bytes:
        """As the table REQUEST_COLUMNS."""
        return _runs_to_bytes(self.sweep, self.runs)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        return cls(*_runs_from_bytes(payload))


@dataclass(frozen=True, slots=True)
class ColumnsGone:
    """Device to host: these columns were asked for and are no longer held."""

    TYPE: ClassVar[int] = 0x27
    sweep: int
    runs: tuple[ColumnRun, ...]

    def to_bytes(self) -> bytes:
        """As the table COLUMNS_GONE."""
        return _runs_to_bytes(self.sweep, self.runs)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        return cls(*_runs_from_bytes(payload))


HostMessage = Hello | Ack | Nak | Reset | Credit | SweepRequest | Calibrate | SweepStart | SweepStop | RequestColumns
DeviceMessage = (
    DeviceInfo | Ack | Nak | Status | Fault | Calibration | SweepHeader | SweepEnd | Column | ColumnsGone
)  # fmt: skip
Message = HostMessage | DeviceMessage

_CLASSES = (
    Hello, DeviceInfo, Ack, Nak, Reset, Credit, Status, Fault, SweepRequest, Calibrate, Calibration,
    SweepStart, SweepStop, SweepHeader, SweepEnd, RangeColumn, TextureColumn, RequestColumns, ColumnsGone,
)  # fmt: skip
_FROM_BYTES: dict[int, Callable[[Payload], Message]] = {cls.TYPE: cls.from_bytes for cls in _CLASSES}


def is_known(type: int) -> bool:
    """Whether this version of the link has a message of that type."""
    return type in _FROM_BYTES


def encode_message(message: Message) -> bytes:
    """The payload of a message. Raises LocalWireError when a field does not fit its place."""
    try:
        return message.to_bytes()
    except struct.error as error:
        raise LocalWireError(f"{type(message).__name__}: {error}") from error


def decode_message(type: int, payload: Payload) -> Message:
    """The message of a known type. Raises RemoteWireError when the payload does not follow its table."""
    try:
        return _FROM_BYTES[type](payload)
    except ValueError as error:
        raise RemoteWireError(f"message type {type:#04x}: {error}") from error


def _check(good: bool, complaint: str) -> None:
    if not good:
        raise ValueError(complaint)


def _unpack(layout: struct.Struct, payload: Payload) -> tuple[Any, ...]:
    _check(len(payload) >= layout.size, f"{len(payload)} bytes, needs {layout.size}")
    return layout.unpack_from(payload)


def _unpack_appended(
    layout: struct.Struct, payload: Payload, at: int, absent: tuple[int, ...]
) -> tuple[Any, ...]:
    """Fields that a newer minor version appended, or what their absence means."""
    return layout.unpack_from(payload, at) if len(payload) >= at + layout.size else absent


def _channels(value: int) -> Channel:
    _check(value in (1, 2, 3), f"channels {value}")
    return Channel(value)


def _passes(value: int) -> int:
    _check(1 <= value <= PASSES_MAX, f"passes {value}")
    return value


def _text_to_bytes(text: str) -> bytes:
    data = text.encode()
    if len(data) > TEXT_MAX:
        raise LocalWireError(f"text of {len(data)} bytes, at most {TEXT_MAX} travel")
    return bytes([len(data)]) + data


def _text_from_bytes(payload: Payload, at: int) -> tuple[str, int]:
    """The text at this place, and the place behind it."""
    _check(len(payload) > at, "text is missing")
    size = payload[at]
    end = at + 1 + size
    _check(size <= TEXT_MAX and len(payload) >= end, f"text of {size} bytes does not fit")
    return bytes(payload[at + 1 : end]).decode(), end


def _column_to_bytes(column: Column) -> bytes:
    return _column_name(column) + column.data


def _column_name(column: Column) -> bytes:
    """What stands before the samples."""
    name = (column.time_us, column.encoder, column.sweep, column.column, column.row0, column.pass_index)
    return _COLUMN.pack(*name)


def _column_fields(payload: Payload, sample_bytes: int) -> tuple[int, int, int, int, int, int, Payload]:
    time_us, encoder, sweep, column, row0, pass_index = _unpack(_COLUMN, payload)
    data = payload[_COLUMN.size :]
    _check(len(data) > 0 and len(data) % sample_bytes == 0, f"{len(data)} bytes are no whole samples")
    return sweep, pass_index, column, row0, encoder, time_us, data


_RUNS = struct.Struct("<HH")
_RUN = struct.Struct("<BBHH")


def _runs_to_bytes(sweep: int, runs: tuple[ColumnRun, ...]) -> bytes:
    if not 1 <= len(runs) <= RUNS_MAX:
        raise LocalWireError(f"{len(runs)} runs, between 1 and {RUNS_MAX} travel")
    packed = (_RUN.pack(run.channel, run.pass_index, run.first, run.count) for run in runs)
    return _RUNS.pack(sweep, len(runs)) + b"".join(packed)


def _runs_from_bytes(payload: Payload) -> tuple[int, tuple[ColumnRun, ...]]:
    sweep, count = _unpack(_RUNS, payload)
    end = _RUNS.size + count * _RUN.size
    _check(1 <= count <= RUNS_MAX and len(payload) >= end, f"{count} runs do not fit")
    return sweep, tuple(_run(*fields) for fields in _RUN.iter_unpack(payload[_RUNS.size : end]))


def _run(channel: int, pass_index: int, first: int, count: int) -> ColumnRun:
    _check(channel in (1, 2), f"channel {channel}")
    _check(count > 0, "empty run")
    return ColumnRun(Channel(channel), pass_index, first, count)
