"""Frames of the scanner link: bytes of a serial or USB line become checked frames, and back.

    magic u16 | version u8 | type u8 | flags u8 | reserved u8 | session u16 | seq u32 | length u16 | header CRC-16
    payload, `length` bytes
    CRC-32 over header and payload

Little-endian throughout. This header never changes, whatever the version says, so an old program can still read who
is speaking. Corruption is routine on a serial line: what cannot be read is reported as `Dropped`, never raised, and the
search for the next frame goes on directly behind the damaged magic, so that a frame following a truncated one is found.
The same bytes give the same events however they are cut.
"""

from __future__ import annotations

import binascii
import struct
from dataclasses import dataclass
from enum import IntFlag, StrEnum
from typing import NamedTuple

from protocol.checksum import crc32
from protocol.errors import LocalWireError

MAGIC = b"\xf5\xca"
SERIAL_PAYLOAD_MAX = 1024
USB_PAYLOAD_MAX = 8192
DROPPED_MAX = 65536  # a longer run of unreadable bytes is reported in pieces of this size

_HEADER = struct.Struct("<2sBBBBHIHH")
_HEADER_CHECKED = _HEADER.size - 2
_TRAILER = struct.Struct("<I")
_HEADER_BYTES, _TRAILER_BYTES = _HEADER.size, _TRAILER.size
_CRC16_START = 0xFFFF
FRAME_OVERHEAD = _HEADER.size + _TRAILER.size


class Flag(IntFlag):
    """Bits of the header's flags; a receiver ignores those it does not know."""

    NONE = 0
    ANSWER_WANTED = 1
    RESENT = 2


class DropReason(StrEnum):
    """Why bytes or frames were set aside."""

    NOISE = "no frame starts here"
    HEADER = "header checksum is wrong"
    LENGTH = "length is over the limit of this link"
    PAYLOAD = "frame checksum is wrong"
    TRUNCATED = "frame stopped in the middle"
    SESSION = "frame belongs to another session"
    UNKNOWN = "message type is unknown"
    STRAY = "message is not for this end of the link"
    MALFORMED = "message does not follow its table"


class Frame(NamedTuple):
    """One checked frame; `payload` is a view of the received bytes, not a copy."""

    type: int
    payload: memoryview
    seq: int
    session: int
    flags: int
    version: int

    @property
    def size_bytes(self) -> int:
        """What the frame took on the line. [bytes]"""
        return FRAME_OVERHEAD + len(self.payload)


@dataclass(frozen=True, slots=True)
class Dropped:
    """A run of `count` bytes that held no readable frame; `reason` is what was wrong with the first of them."""

    reason: DropReason
    count: int


def encode_frame(
    type: int, payload: bytes | memoryview, *, seq: int, session: int, flags: int = 0, version: int = 1
) -> bytes:
    """One frame as bytes. Raises LocalWireError when a field does not fit its place."""
    try:
        head = _HEADER.pack(MAGIC, version, type, flags, 0, session, seq, len(payload), 0)[:_HEADER_CHECKED]
    except struct.error as error:
        raise LocalWireError(f"frame header: {error}") from error
    head += binascii.crc_hqx(head, _CRC16_START).to_bytes(2, "little")
    return b"".join((head, payload, _TRAILER.pack(crc32(payload, crc32(head)))))


class FrameReader:
    """Finds frames in a stream of bytes; does no I/O.

    payload_max : longest payload believed [bytes]; it bounds both the memory held and how far a lying length can delay
    the frames behind it.
    """

    def __init__(self, payload_max: int = SERIAL_PAYLOAD_MAX) -> None:
        self._payload_max = payload_max
        self._data = b""
        self._view = memoryview(b"")
        self._at = 0
        self._dropped_bytes = 0
        self._dropped_reason: DropReason | None = None

    def receive_data(self, data: bytes) -> None:
        """Take the next bytes of the line, in any portions."""
        self._data = self._data[self._at :] + data if self._at < len(self._data) else data
        self._view = memoryview(self._data)
        self._at = 0

    def next_event(self) -> Frame | Dropped | None:
        """The next frame or dropped run, or None until more data is received."""
        while True:
            found = self._frame_here()
            if found is None:
                return None
            if isinstance(found, Frame):
                if self._dropped_bytes:
                    return self._report(self._dropped_bytes)
                self._dropped_reason = None
                self._at += FRAME_OVERHEAD + len(found.payload)
                return found
            self._skip(found)
            if self._dropped_bytes >= DROPPED_MAX:
                return self._report(DROPPED_MAX)

    @property
    def waits_inside_frame(self) -> bool:
        """Whether the bytes held so far are the start of a frame that is not whole yet."""
        return self._at < len(self._data)

    def abandon_partial(self) -> None:
        """The line has been quiet too long for the rest of this frame to come: look for others behind its start."""
        if self.waits_inside_frame:
            self._skip(DropReason.TRUNCATED)

    def _frame_here(self) -> Frame | DropReason | None:
        """The frame at the reading position, or what is wrong with it, or None while it is too short to tell."""
        at, data, view = self._at, self._data, self._view
        start = at + _HEADER_BYTES
        if len(data) < start:
            return None
        magic, version, type_, flags, _, session, seq, length, check = _HEADER.unpack_from(data, at)
        if magic != MAGIC:
            return DropReason.NOISE
        if check != binascii.crc_hqx(view[at : at + _HEADER_CHECKED], _CRC16_START):
            return DropReason.HEADER
        if length > self._payload_max:
            return DropReason.LENGTH
        end = start + length
        if len(data) < end + _TRAILER_BYTES:
            return None
        if crc32(view[at:end]) != _TRAILER.unpack_from(data, end)[0]:
            return DropReason.PAYLOAD
        return Frame(type_, view[start:end], seq, session, flags, version)

    def _skip(self, reason: DropReason) -> None:
        """Go to the next magic, or keep a last byte that may be its first half."""
        found = self._data.find(MAGIC, self._at + 1)
        if found < 0:
            keeps_half = self._data.endswith(MAGIC[:1]) and self._at < len(self._data) - 1
            found = len(self._data) - keeps_half
        self._dropped_bytes += found - self._at
        self._dropped_reason = self._dropped_reason or reason
        self._at = found

    def _report(self, count: int) -> Dropped:
        """Take `count` bytes off the current run; its reason stays until a good frame ends the run."""
        assert self._dropped_reason is not None
        self._dropped_bytes -= count
        return Dropped(self._dropped_reason, count)
