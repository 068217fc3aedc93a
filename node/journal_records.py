"""The records of a sweep's journal, as bytes: magic, length, checksum, and as payload messages of the scanner link.

The first record has BEGIN (our own: format and time), HELLO_ACK and SWEEP_HEADER. A record stands for itself: what lies
between two whole ones is passed over. PROTOCOL.md has the tables.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator

from protocol.checksum import crc32
from protocol.errors import LibraryError, RemoteWireError
from protocol.scanner_messages import (
    COLUMN_OVERHEAD,
    Column,
    DeviceInfo,
    Message,
    Payload,
    RangeColumn,
    SweepHeader,
    TextureColumn,
    decode_message,
    is_known,
)

FORMAT = 1
PAYLOAD_BYTES_MAX = 2 * 65536

_MAGIC = b"FSj\x01"
_RECORD = struct.Struct("<4sII")  # magic, length of the payload, CRC-32 of the payload begun at its length
_MESSAGE = struct.Struct("<BH")  # type, length
_BEGIN_TYPE = 0x00  # no message of the link
_BEGIN = struct.Struct("<Hd")  # format, start by the node's clock
RECORD_OVERHEAD, ENTRY_OVERHEAD = _RECORD.size, _MESSAGE.size


def encode_opening(info: DeviceInfo, header: SweepHeader, started_unix_s: float) -> bytes:
    """The first record of a journal."""
    begin = _BEGIN.pack(FORMAT, started_unix_s)
    return encode_record(_MESSAGE.pack(_BEGIN_TYPE, len(begin)) + begin + encode_entry(info) + encode_entry(header))


def encode_entry(message: Message) -> bytes:
    """A message of the link as it stands in a record."""
    data = message.to_bytes()
    return _MESSAGE.pack(message.TYPE, len(data)) + data


def column_parts(column: Column) -> tuple[bytes, Payload]:
    """As encode_entry, in two parts: thousands come in a second, and their samples are copied only into the record."""
    return _MESSAGE.pack(column.TYPE, COLUMN_OVERHEAD + len(column.data)) + column.name_bytes(), column.data


def encode_record(payload: bytes) -> bytes:
    """A record; read_records is the inverse."""
    return b"".join((_RECORD.pack(_MAGIC, len(payload), _checksum(payload)), payload))


def read_records(data: bytes | mmap.mmap) -> Iterator[tuple[int, memoryview]]:
    """(place behind it, payload) of every whole record; what lies between them is passed over."""
    at = 0
    while at >= 0:
        payload = _record_at(data, at)
        if payload is None:
            at = data.find(_MAGIC, at + 1)
        else:
            at += _RECORD.size + len(payload)
            yield at, payload


def _record_at(data: bytes | mmap.mmap, at: int) -> memoryview | None:
    """The payload of the record that begins here, if a whole one does."""
    if len(data) - at < _RECORD.size:
        return None
    magic, size, checksum = _RECORD.unpack_from(data, at)
    begin = at + _RECORD.size
    if magic != _MAGIC or size > min(PAYLOAD_BYTES_MAX, len(data) - begin):
        return None
    payload = memoryview(data)[begin : begin + size]
    return payload if _checksum(payload) == checksum else None


def _checksum(payload: bytes | memoryview) -> int:
    return crc32(payload, len(payload))


def _entries(payload: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(type, bytes) of every message in a record. Raises LibraryError."""
    at = 0
    while at < len(payload):
        begin = at + _MESSAGE.size
        kind, size = _MESSAGE.unpack_from(payload, at) if begin <= len(payload) else (0, len(payload))
        at = begin + size
        if at > len(payload):
            raise LibraryError("a record ends in the middle of a message")
        yield kind, payload[begin:at]


def messages_in(payload: memoryview) -> Iterator[Message]:
    """The messages of a record. Raises LibraryError."""
    for kind, data in _entries(payload):
        if not is_known(kind):
            raise LibraryError(f"it holds a message of type {kind:#04x}, which this version does not know")
        try:
            yield decode_message(kind, data)
        except RemoteWireError as error:
            raise LibraryError(f"it holds a message that makes no sense: {error}") from error


def columns_in(payload: memoryview) -> Iterator[Column]:
    """The columns of a record behind the first; that has none, and BEGIN, which is no message of the link."""
    if payload[:1] != bytes([_BEGIN_TYPE]):
        yield from (m for m in messages_in(payload) if isinstance(m, RangeColumn | TextureColumn))


def decode_opening(payload: memoryview) -> tuple[float, DeviceInfo, SweepHeader]:
    """The first record: start by the node's clock, scanner, sweep; inverse of encode_opening. Raises LibraryError."""
    (kind, begin), *_ = _entries(payload)
    if kind != _BEGIN_TYPE or len(begin) < _BEGIN.size:
        raise LibraryError("its beginning is damaged")
    format, started_unix_s = _BEGIN.unpack_from(begin)
    if format != FORMAT:
        raise LibraryError("written in a format that this version does not know")
    match list(messages_in(payload[_MESSAGE.size + len(begin) :])):
        case [DeviceInfo() as info, SweepHeader() as header]:
            return started_unix_s, info, header
    raise LibraryError("its beginning is damaged")
