"""Messages of the scanner link about a sweep: how it shall be, what it is about to be, and that it is over."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from protocol.grid import FloatArray, GridSpec, IntArray
from protocol.scanner_fields import (
    Channel,
    Outcome,
    Payload,
    Plain,
    channels_from,
    check,
    passes_from,
    unpack,
    unpack_appended,
)

OVERLAP_TURN = 256  # an overlap is told in this part of a turn


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
        channels, passes, width, height, texture_width, texture_height = unpack(cls._LAYOUT, payload)
        overlap, stride = unpack_appended(cls._SINCE_1_1, payload, cls._LAYOUT.size, (0, 1))
        check(stride > 0, "stride is 0")
        return cls(
            channels_from(channels), passes_from(passes), width, height, texture_width, texture_height, overlap, stride
        )


@dataclass(frozen=True, slots=True)
class Calibrate(Plain):
    """Host to device, CAL: home the table and report the calibration."""

    TYPE: ClassVar[int] = 0x11
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("")


@dataclass(frozen=True, slots=True)
class Calibration(Plain):
    """Device to host, CAL_REPORT: the table stands at home; `calibration` names the settings in use there."""

    TYPE: ClassVar[int] = 0x12
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<Qi")
    calibration: int
    home_encoder: int


@dataclass(frozen=True, slots=True)
class SweepStart(Plain):
    """Host to device: begin the configured sweep under this number."""

    TYPE: ClassVar[int] = 0x20
    _LAYOUT: ClassVar[struct.Struct] = struct.Struct("<H")
    sweep: int


@dataclass(frozen=True, slots=True)
class SweepStop(Plain):
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
        fields = unpack(cls._LAYOUT, payload)
        geometry, (calibration, counts, start, sweep) = fields[:4], fields[4:8]
        shape, (range_rows, texture_rows, channels, passes, direction) = fields[8:12], fields[12:]
        check(counts > 0 and range_rows > 0 and texture_rows > 0, "counts_per_turn and rows must be positive")
        check(direction in (1, -1), "direction must be 1 or -1")
        (overlap,) = unpack_appended(cls._SINCE_1_1, payload, cls._LAYOUT.size, (0,))
        spec = GridSpec(*shape, *geometry)
        return cls(
            sweep, spec, counts, range_rows, texture_rows, channels_from(channels), passes_from(passes), start,
            direction, calibration, overlap,
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
        pieces, digest, sweep, outcome = unpack(cls._LAYOUT, payload)
        return cls(sweep, Outcome(outcome), pieces, digest)
