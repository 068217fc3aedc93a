"""Messages of the scanner link that carry columns, ask for them, or say that they are gone."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from protocol.checksum import crc32
from protocol.errors import LocalWireError
from protocol.grid import ImageArray, StepArray
from protocol.scanner_fields import Channel, Payload, check, unpack

RUNS_MAX = 160

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
        return crc32(self.data, crc32(self.name_bytes()))

    def name_bytes(self) -> bytes:
        """What stands before the samples in the table RANGE_COLUMN."""
        return _column_name(self)

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
        return crc32(self.data, crc32(self.name_bytes()))

    def name_bytes(self) -> bytes:
        """What stands before the samples in the table TEXTURE_COLUMN."""
        return _column_name(self)

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


def _column_to_bytes(column: Column) -> bytes:
    return _column_name(column) + column.data


def _column_name(column: Column) -> bytes:
    """What stands before the samples."""
    name = (column.time_us, column.encoder, column.sweep, column.column, column.row0, column.pass_index)
    return _COLUMN.pack(*name)


def _column_fields(payload: Payload, sample_bytes: int) -> tuple[int, int, int, int, int, int, Payload]:
    size = len(payload) - COLUMN_OVERHEAD
    if size <= 0 or size % sample_bytes:
        raise ValueError(f"{size} bytes are no whole samples")
    time_us, encoder, sweep, column, row0, pass_index = _COLUMN.unpack_from(payload)
    data = payload[COLUMN_OVERHEAD:]
    return sweep, pass_index, column, row0, encoder, time_us, data


_RUNS = struct.Struct("<HH")
_RUN = struct.Struct("<BBHH")


def _runs_to_bytes(sweep: int, runs: tuple[ColumnRun, ...]) -> bytes:
    if not 1 <= len(runs) <= RUNS_MAX:
        raise LocalWireError(f"{len(runs)} runs, between 1 and {RUNS_MAX} travel")
    packed = (_RUN.pack(run.channel, run.pass_index, run.first, run.count) for run in runs)
    return _RUNS.pack(sweep, len(runs)) + b"".join(packed)


def _runs_from_bytes(payload: Payload) -> tuple[int, tuple[ColumnRun, ...]]:
    sweep, count = unpack(_RUNS, payload)
    end = _RUNS.size + count * _RUN.size
    check(1 <= count <= RUNS_MAX and len(payload) >= end, f"{count} runs do not fit")
    return sweep, tuple(_run(*fields) for fields in _RUN.iter_unpack(payload[_RUNS.size : end]))


def _run(channel: int, pass_index: int, first: int, count: int) -> ColumnRun:
    check(channel in (1, 2), f"channel {channel}")
    check(count > 0, "empty run")
    return ColumnRun(Channel(channel), pass_index, first, count)
