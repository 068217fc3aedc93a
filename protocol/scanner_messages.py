"""Messages of the scanner link, one class each: typed fields on this side, the byte tables of PROTOCOL.md on the other.

A message knows its layout and its bounds, and nothing of numbering, retries or credits (see scanner_link).
A newer minor version may append fields to any message but the columns: bytes behind the known fields are ignored.
Here stand those between the two ends as such, and the table of all; scanner_sweep and scanner_columns have the others.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Self

from protocol.errors import LocalWireError, RemoteWireError
from protocol.framing import SERIAL_PAYLOAD_MAX
from protocol.scanner_columns import (
    COLUMN_OVERHEAD,
    RUNS_MAX,
    Column,
    ColumnRun,
    ColumnsGone,
    RangeColumn,
    RequestColumns,
    TextureColumn,
)
from protocol.scanner_fields import (
    PASSES_MAX,
    TEXT_MAX,
    Channel,
    NakCode,
    Order,
    Outcome,
    Payload,
    Plain,
    State,
    check,
    text_from_bytes,
    text_to_bytes,
    unpack,
)
from protocol.scanner_sweep import (
    OVERLAP_TURN,
    Calibrate,
    Calibration,
    SweepEnd,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
)

__all__ = [
    "COLUMN_OVERHEAD", "MAJOR", "MINOR", "OVERLAP_TURN", "PASSES_MAX", "RUNS_MAX", "TEXT_MAX",
    "Ack", "Calibrate", "Calibration", "Channel", "Column", "ColumnRun", "ColumnsGone", "Credit", "DeviceInfo",
    "DeviceMessage", "Fault", "Hello", "HostMessage", "Message", "Nak", "NakCode", "Order", "Outcome", "Payload",
    "RangeColumn", "RequestColumns", "Reset", "State", "Status", "SweepEnd", "SweepHeader", "SweepRequest",
    "SweepStart", "SweepStop", "TextureColumn", "decode_message", "encode_message", "is_known",
]  # fmt: skip

MAJOR = 1
MINOR = 1


@dataclass(frozen=True, slots=True)
class Hello(Plain):
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
        return self._LAYOUT.pack(*fixed, self.order) + text_to_bytes(self.serial_number) + text_to_bytes(self.model)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        major, minor, payload_max, counts, retention, boot_id, order = unpack(cls._LAYOUT, payload)
        serial_number, end = text_from_bytes(payload, cls._LAYOUT.size)
        model, _ = text_from_bytes(payload, end)
        check(counts > 0, "counts_per_turn is 0")
        return cls(serial_number, boot_id, counts, retention, model, Order(order), payload_max, major, minor)


@dataclass(frozen=True, slots=True)
class Ack(Plain):
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
        return self._LAYOUT.pack(self.refused_seq, self.code) + text_to_bytes(self.text)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        seq, code = unpack(cls._LAYOUT, payload)
        return cls(seq, NakCode(code), text_from_bytes(payload, cls._LAYOUT.size)[0])


@dataclass(frozen=True, slots=True)
class Reset(Plain):
    """Host to device: drop the sweep, its columns and the configuration, and be idle."""

    TYPE: ClassVar[int] = 0x05
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("")


@dataclass(frozen=True, slots=True)
class Credit(Plain):
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
        sent_bytes, encoder, sweep, state, out_of_credit = unpack(cls._LAYOUT, payload)
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
        return self._LAYOUT.pack(self.code) + text_to_bytes(self.text)

    @classmethod
    def from_bytes(cls, payload: Payload) -> Self:
        """Inverse of to_bytes."""
        (code,) = unpack(cls._LAYOUT, payload)
        return cls(code, text_from_bytes(payload, cls._LAYOUT.size)[0])


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
