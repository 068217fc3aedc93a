"""Columns of a sweep that is still running, thinned out: what the `live` stream carries beside its few messages.

They travel as they are, ready for a typed array, and are never part of a model. Layout: PROTOCOL.md, "Live view".
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np

from protocol.errors import LocalWireError, RemoteWireError, WireError
from protocol.grid import HEIGHT_MAX, WIDTH_MAX, ImageArray, StepArray
from protocol.lattice import Channel

MAGIC = 0x4C46
VERSION = 1
HEADER = struct.Struct("<HBBIHH")
COLUMN_BYTES = 2
SAMPLE_BYTES: dict[int, int] = {Channel.RANGE: 2, Channel.TEXTURE: 3}


@dataclass(frozen=True, slots=True)
class LiveColumns:
    """Whole columns of the thinned grid, in any order; one that comes again replaces what it was.

    sweep : as in LiveStarted.      columns : which ones, at least one.     rows : samples in each.
    payload : their samples, column after column, little-endian.
    """

    channel: Channel
    sweep: int
    columns: tuple[int, ...]
    rows: int
    payload: bytes = field(repr=False)

    @property
    def samples(self) -> StepArray | ImageArray:
        """Range (n, rows) uint16 steps, 0 where nothing is measured or known yet; texture (n, rows, 3) uint8 RGB."""
        if self.channel is Channel.RANGE:
            return np.frombuffer(self.payload, "<u2").reshape(-1, self.rows)
        return np.frombuffer(self.payload, np.uint8).reshape(-1, self.rows, 3)

    def to_bytes(self) -> bytes:
        """Wire form. Raises LocalWireError when it does not fit."""
        count = len(self.columns)
        _check_sizes(self.channel, count, self.rows, len(self.payload), LocalWireError)
        try:
            header = HEADER.pack(MAGIC, VERSION, self.channel, self.sweep, count, self.rows)
            return header + struct.pack(f"<{count}H", *self.columns) + self.payload
        except struct.error as error:
            raise LocalWireError(f"live columns out of bounds: {error}") from None

    @classmethod
    def from_bytes(cls, data: bytes) -> LiveColumns:
        """Inverse of to_bytes. Raises RemoteWireError when the bytes are not one whole message."""
        if len(data) < HEADER.size:
            raise RemoteWireError(f"live columns cut short: {len(data)} bytes")
        magic, version, channel, sweep, count, rows = HEADER.unpack_from(data)
        if (magic, version) != (MAGIC, VERSION) or channel not in SAMPLE_BYTES:
            raise RemoteWireError(f"no live columns: magic {magic:#06x}, version {version}, channel {channel}")
        body = HEADER.size + COLUMN_BYTES * count
        _check_sizes(channel, count, rows, len(data) - body, RemoteWireError)
        columns = struct.unpack_from(f"<{count}H", data, HEADER.size)
        return cls(Channel(channel), sweep, columns, rows, bytes(data[body:]))


def _check_sizes(channel: Channel, count: int, rows: int, payload_bytes: int, error: type[WireError]) -> None:
    if not (0 < count <= WIDTH_MAX and 0 < rows <= HEIGHT_MAX):
        raise error(f"live columns out of bounds: {count} columns of {rows} samples")
    if payload_bytes != count * rows * SAMPLE_BYTES[channel]:
        raise error(f"{count} live columns of {rows} samples do not make {payload_bytes} bytes")


def is_live(data: bytes) -> bool:
    """Whether a binary message begins as live columns do; else it is a refinement."""
    return data[:2] == MAGIC.to_bytes(2, "little")
