"""The two ends of a cylindrical scan: whether its last row closes it, and what stands there if not.

The axis sees the sides of an object, not the places where it passes through it. A round top comes within a row of the
axis: where the next row saw nothing, the surface must cross the axis in between, and a paraboloid through the last two
rows does, exactly for a ball's top. A flat top, a rim or a neck that goes on below the scan does not close; a cap over
it is made up, and whoever asks for one is told.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from protocol.grid import BoolArray, FloatArray, Grid, GridSpec, ImageArray, IntArray, StepArray

Side = Literal["top", "bottom"]
SIDES: tuple[Side, Side] = ("top", "bottom")
POINTS = 9  # of a profile over an end
GAP_MAX = 1.05 / (math.sqrt(2) - 1)  # a round end's last row is no further from the axis, in steps between its last two
ROUND_MIN = 0.9  # of the columns that must end so
LEVELS = 65  # circles at which a lid's colours are computed


@dataclass(frozen=True, slots=True)
class End:
    """How profiles go on to the axis at one end. apex_mm : height where they meet it.

    capped : made up; the profile is straight. Else it is round, and stands only over columns whose own last rows are.
    """

    apex_mm: float
    capped: bool


def find_end(spec: GridSpec, range_steps: StepArray, side: Side, cap: bool) -> End | None:
    """How a cylinder ends there; None where it is left open. cap : make up a lid if it does not close."""
    last, before, row = _last_two(range_steps, side)
    measured = last > 0
    if not measured.any():
        return None
    rounded, beyond = _rounded(last, before)
    seen_beyond = row > 0 if side == "top" else row < spec.height - 1
    if (rounded & seen_beyond).mean() >= ROUND_MIN:
        up = spec.pitch_mm * (1 if side == "top" else -1)
        return End(float(np.median(spec.height_mm(row[rounded]) + up * beyond[rounded])), False)
    return End(float(spec.height_mm(row[measured]).mean()), True) if cap else None


def with_end(spec: GridSpec, range_mm: FloatArray, side: Side, end: End | None) -> tuple[FloatArray, FloatArray]:
    """The profile from the axis to the last sample of each column (H, n): (POINTS, n) out and up, NaN where none is.

    Point 0 is on the axis, point POINTS - 1 is the sample.
    """
    last, before, row = _last_two(np.nan_to_num(range_mm), side)
    share = np.linspace(0, 1, POINTS)[:, None]
    if end is None:
        return np.full((POINTS, last.size), np.nan), np.full((POINTS, last.size), np.nan)
    stands = last > 0 if end.capped else _rounded(last, before)[0]
    z = end.apex_mm + (spec.height_mm(row) - end.apex_mm) * share ** (1 if end.capped else 2)
    return np.where(stands, share * last, np.nan), np.where(stands, z, np.nan)


def lid_colours(grid: Grid, side: Side) -> FloatArray:
    """Colours between the last row and the axis, on LEVELS circles: 0 the axis. (LEVELS, Wt, 3) float32

    As smooth as they can be with the last row's at the rim: a wave of k turns fades with the k-th power of the way.
    """
    spec = grid.spec
    last, _, row = _last_two(grid.range_steps, side)
    column = (np.arange(spec.texture_width) * spec.width) // spec.texture_width
    texel = np.clip(((row + 0.5) * (spec.texture_height / spec.height)).astype(np.int64), 0, spec.texture_height - 1)
    rim = grid.texture[texel[column], np.arange(spec.texture_width)].astype(np.float64)
    measured = last[column] > 0
    rim[~measured] = rim[measured].mean(axis=0) if measured.any() else 0
    waves = np.fft.rfft(rim, axis=0)
    fading = np.linspace(0, 1, LEVELS)[:, None] ** np.arange(len(waves))
    return np.fft.irfft(waves * fading[..., None], spec.texture_width, axis=1).astype(np.float32)


def paint_lid(colours: FloatArray, share: FloatArray, columns: slice) -> ImageArray:
    """Colours at shares (rows, n) of the way from the axis to the rim, in columns of the texture. (rows, n, 3) uint8"""
    level = share * (LEVELS - 1)
    inner = np.clip(np.floor(np.nan_to_num(level)).astype(np.int64), 0, LEVELS - 2)
    column = np.arange(columns.start, columns.stop)
    part = np.nan_to_num(level - inner)[..., None].astype(np.float32)
    mixed = colours[inner, column] * (1 - part) + colours[inner + 1, column] * part
    return np.clip(np.rint(mixed), 0, 255).astype(np.uint8)


def _last_two(range_of: FloatArray | StepArray, side: Side) -> tuple[FloatArray, FloatArray, IntArray]:
    """Of each column (H, n), at one end: its last measured sample, the one before that, and its row; 0 = void. (n,)"""
    order = 1 if side == "top" else -1
    from_end = range_of[::order]
    first = (from_end > 0).argmax(axis=0)
    column = np.arange(range_of.shape[1])
    last = from_end[first, column].astype(np.float64)
    before = from_end[np.minimum(first + 1, len(from_end) - 1), column].astype(np.float64)
    return last, before, first if order > 0 else len(from_end) - 1 - first


def _rounded(last: FloatArray, before: FloatArray) -> tuple[BoolArray, FloatArray]:
    """Which columns end as something round does, and how far beyond the last row, in rows, each meets the axis."""
    step = before - last
    rounded = (last > 0) & (step > 0) & (last <= GAP_MAX * step)
    squares = before**2 - last**2
    return rounded, np.divide(last**2, squares, out=np.zeros_like(last), where=squares > 0)
