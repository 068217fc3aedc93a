"""Points without triangles, as a scanner or a range grid has them, binned to a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from exchange.cast import to_steps
from protocol.grid import FloatArray, Grid, GridSpec, ImageArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points in the turntable's frame. positions : (n, 3) float64 [mm], z up.  colours : (n, 3) uint8 RGB."""

    positions: FloatArray
    colours: ImageArray


def bin_points(points: Points, spec: GridSpec) -> Grid:
    """The outermost point in each cell, with its colour in each texel; void and black where there is none.

    Raises ExchangeError for a range that does not fit the grid's steps.
    """
    x, y, _ = points.positions.T
    radius_mm = np.hypot(x, y)
    order = np.argsort(radius_mm, kind="stable")  # of several in one cell the last is kept
    held_mm = np.full((spec.height, spec.width), np.nan)
    held_mm[_cells(points, spec, spec.height, spec.width, order)] = radius_mm[order]
    texture = np.zeros((spec.texture_height, spec.texture_width, 3), np.uint8)
    texture[_cells(points, spec, spec.texture_height, spec.texture_width, order)] = points.colours[order]
    return Grid(spec, to_steps(held_mm, spec.step_mm), texture)


def _cells(points: Points, spec: GridSpec, height: int, width: int, order: IntArray) -> tuple[IntArray, IntArray]:
    """Row and column of each point on a lattice of this size over the grid."""
    x, y, z = points.positions[order].T
    turns = (np.arctan2(y, x) - spec.theta0_rad) / (2 * np.pi)
    down = (spec.z_max_mm - z) / (spec.height * spec.pitch_mm)
    row = np.floor(down * height).astype(np.int64)
    return np.clip(row, 0, height - 1), np.floor(turns * width).astype(np.int64) % width
