"""What a sensor sees of an object whose table turns about another axis than the sensor believes in.

Every sample is a ray that is followed into the true surface. So this knows where a ray runs, and nothing of how a node
corrects what it sees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from protocol.errors import UsageError
from protocol.grid import VOID, BoolArray, FloatArray, Grid, ImageArray, IntArray, mm_to_steps

_STRIDE_MM = 0.5
_HALVINGS = 24
_OFFSET_MAX_MM = 50.0
_TILT_MAX_DEG = 3.0


@dataclass(frozen=True, slots=True)
class OffAxis:
    """Where the table's axis is, as the sensor sees it.

    lateral_mm : its line of sight passes the axis this far on the side that the columns go to.  radial_mm : its range
    is too short by this much.  lean_deg, side_deg : the axis is tilted: radial and lateral grow with height above 0.
    """

    lateral_mm: float = 0.0
    radial_mm: float = 0.0
    lean_deg: float = 0.0
    side_deg: float = 0.0


def parse_off_axis(text: str) -> OffAxis:
    """What "0.8,-0.5" or "0.8,-0.5,0.1,0.2" asks for, in mm and degrees. Raises UsageError."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (2, 4):
        raise UsageError(f"axis: expected LATERAL,RADIAL or LATERAL,RADIAL,LEAN,SIDE in mm and degrees, got {text!r}")
    bounds = (_OFFSET_MAX_MM, _OFFSET_MAX_MM, _TILT_MAX_DEG, _TILT_MAX_DEG)
    for value, most in zip(values, bounds, strict=False):
        if not abs(value) <= most:
            raise UsageError(f"axis: {value:g} is not between -{most:g} and {most:g}")
    return OffAxis(*values)


def seen_off_axis(grid: Grid, axis: OffAxis) -> Grid:
    """What the sensor makes of an object. grid : the truth. Texture is what stands where each ray ends."""
    spec = grid.spec
    heights, columns = np.divmod(np.arange(spec.height * spec.width), spec.width)
    x_mm = _followed(grid, axis, heights, columns)
    range_mm = (x_mm - axis.radial_mm).reshape(spec.height, spec.width)
    range_mm[~(range_mm > spec.step_mm)] = np.nan
    return Grid(spec, mm_to_steps(range_mm, spec.step_mm), _coloured(grid, axis, x_mm.reshape(range_mm.shape)))


def _followed(grid: Grid, axis: OffAxis, rows: IntArray, columns: IntArray) -> FloatArray:
    """How far from the axis each ray ends, along it; NaN where it meets nothing. (n,) [mm]"""
    x_mm = np.full(rows.shape, (int(grid.range_steps.max()) + 1) * grid.spec.step_mm)
    flying = np.arange(rows.size)
    while flying.size:  # from outside, in strides, to the first place that lies within
        x_mm[flying] -= _STRIDE_MM
        x_mm[flying[x_mm[flying] <= 0]] = np.nan
        flying = flying[~np.isnan(x_mm[flying])]
        flying = flying[~_within(grid, axis, x_mm[flying], rows[flying], columns[flying])]
    far, near = x_mm + _STRIDE_MM, x_mm
    for _ in range(_HALVINGS):
        middle = (far + near) / 2
        is_within = _within(grid, axis, middle, rows, columns)
        far, near = np.where(is_within, far, middle), np.where(is_within, middle, near)
    return near


def _within(grid: Grid, axis: OffAxis, x_mm: FloatArray, rows: IntArray, columns: IntArray) -> BoolArray:
    """Whether places on rays lie within the object."""
    radius_mm, row, column = _place(grid, axis, x_mm, rows, columns)
    return np.asarray(radius_mm <= _surface_mm(grid, row, column))


def _place(
    grid: Grid, axis: OffAxis, x_mm: FloatArray, rows: FloatArray | IntArray, columns: FloatArray | IntArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Places on rays as the table knows them: distance from its axis [mm], row and column (not whole) of the truth."""
    spec = grid.spec
    lean, side = math.radians(axis.lean_deg), math.radians(axis.side_deg)
    over_x = np.array([[1, 0, 0], [0, math.cos(side), math.sin(side)], [0, -math.sin(side), math.cos(side)]])
    over_y = np.array([[math.cos(lean), 0, math.sin(lean)], [0, 1, 0], [-math.sin(lean), 0, math.cos(lean)]])
    x, y, z = over_x @ over_y @ np.stack([x_mm, np.full_like(x_mm, axis.lateral_mm), spec.height_mm(rows)])
    column = columns + np.arctan2(y, x) * spec.width / (2 * math.pi)
    return np.hypot(x, y), (spec.z_max_mm - z) / spec.pitch_mm - 0.5, column


def _surface_mm(grid: Grid, row: FloatArray, column: FloatArray) -> FloatArray:
    """The true surface's distance from the axis between its samples; -1 where it is void. (n,) [mm]"""
    spec = grid.spec
    row, column = np.nan_to_num(row, nan=-1.0), np.nan_to_num(column)  # of rays that met nothing
    left, upper = np.floor(column).astype(np.int64), np.floor(row).astype(np.int64)
    across, down = column - left, row - upper
    corners, weights = [], []
    for right, lower in ((0, 0), (0, 1), (1, 0), (1, 1)):
        at = np.clip(upper + lower, 0, spec.height - 1), (left + right) % spec.width
        corners.append(grid.range_steps[at] * spec.step_mm)
        weights.append((across if right else 1 - across) * (down if lower else 1 - down))
    values, weight = np.array(corners), np.array(weights)
    mixed = (values * weight).sum(axis=0)
    nearest = np.take_along_axis(values, weight.argmax(axis=0)[None], axis=0)[0]
    surface = np.where((values == VOID).any(axis=0), nearest, mixed)
    outside = (row < -0.5) | (row > spec.height - 0.5) | (surface == VOID)
    return np.where(outside, -1.0, surface)


def _coloured(grid: Grid, axis: OffAxis, x_mm: FloatArray) -> ImageArray:
    """The texture that a camera on the same line sees. x_mm : (H, W) where the rays of the range end."""
    spec = grid.spec
    down, across = spec.height / spec.texture_height, spec.width / spec.texture_width
    usual_mm = np.nanmedian(x_mm) if np.isfinite(x_mm).any() else 1.0
    ends = np.where(np.isnan(x_mm), usual_mm, x_mm)
    rows = np.repeat((np.arange(spec.texture_height) + 0.5) * down - 0.5, spec.texture_width)
    columns = np.tile((np.arange(spec.texture_width) + 0.5) * across - 0.5, spec.texture_height)
    near = np.clip(np.rint(rows), 0, spec.height - 1).astype(np.int64), np.rint(columns).astype(np.int64) % spec.width
    _, row, column = _place(grid, axis, ends[near], rows, columns)
    shape = spec.texture_height, spec.texture_width
    at_x = ((column + 0.5) / across - 0.5).reshape(shape) % spec.texture_width
    at_y = np.clip((row + 0.5) / down - 0.5, 0, spec.texture_height - 1).reshape(shape)
    wide = cv2.copyMakeBorder(np.asarray(grid.texture), 0, 0, 0, 1, cv2.BORDER_WRAP)
    return np.asarray(cv2.remap(wide, at_x.astype(np.float32), at_y.astype(np.float32), cv2.INTER_LINEAR), np.uint8)
