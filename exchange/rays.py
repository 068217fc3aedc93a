"""The rays along which a grid sees: level ones towards the axis, or those from one point on it.

Every ray lies in the vertical half plane of its column. A place in that half plane is (out, z): so far from the axis,
at that height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.grid import FloatArray, GridSpec, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Columns:
    """Rays at column centres, all round the axis."""

    columns: int
    rows: int
    theta0_rad: float

    def angle_rad(self, column: IntArray) -> FloatArray:
        """Angle of columns round the axis (any shape)."""
        return self.theta0_rad + 2 * np.pi * (column + 0.5) / self.columns


@dataclass(frozen=True, slots=True, eq=False)
class LevelRays(_Columns):
    """Rays at column centres and row centres, all round, level."""

    z_max_mm: float
    pitch_mm: float

    def row_at(self, out: FloatArray, z: FloatArray) -> FloatArray:
        """Of places (any shape): which row's ray passes through them, in rows and parts of one, row 0's ray at 0."""
        return np.broadcast_to((self.z_max_mm - z) / self.pitch_mm - 0.5, np.broadcast_shapes(out.shape, z.shape))

    def from_ray(self, out: FloatArray, z: FloatArray, row: IntArray) -> tuple[FloatArray, FloatArray]:
        """Of places (any shape): how far off a row's ray, and how far along it. [mm]"""
        return z - (self.z_max_mm - (row.astype(np.float64) + 0.5) * self.pitch_mm), out


@dataclass(frozen=True, slots=True, eq=False)
class StarRays(_Columns):
    """Rays at column centres and at the polar angles of row centres, all from one point on the axis."""

    centre_mm: float

    def row_at(self, out: FloatArray, z: FloatArray) -> FloatArray:
        """As that of level rays."""
        return np.asarray(np.arctan2(out, z - self.centre_mm) * (self.rows / np.pi) - 0.5)

    def from_ray(self, out: FloatArray, z: FloatArray, row: IntArray) -> tuple[FloatArray, FloatArray]:
        """As that of level rays."""
        polar = np.pi * (row.astype(np.float64) + 0.5) / self.rows
        sin, cos, up = np.sin(polar), np.cos(polar), z - self.centre_mm
        return out * cos - up * sin, out * sin + up * cos


Rays = LevelRays | StarRays


def rays_of(spec: GridSpec, columns: int, rows: int) -> Rays:
    """The rays of one channel, of so many samples."""
    if spec.geometry == "sphere":
        return StarRays(columns, rows, spec.theta0_rad, spec.z_max_mm)
    return LevelRays(columns, rows, spec.theta0_rad, spec.z_max_mm, spec.height * spec.pitch_mm / rows)
