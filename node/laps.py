"""Several looks at the same angles made into one: averaged without outliers, and compared, which tells noise and slip.

A lap is one turn of the table, or the part of one that a sweep has; whole-array work on (P, n, ...) stacks of laps.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np

from protocol.grid import VOID, BoolArray, FloatArray, ImageArray, StepArray

OUTLIER_SIGMAS = 4.0
_SIGMA_OF_MAD = 1.4826  # of a normal distribution
_CONTRAST = 0.8  # a best fit worse than this share of the typical one tells nothing
_SLIP_COLUMNS_MIN = 8

Samples = TypeVar("Samples", StepArray, ImageArray)


def average(laps: Samples, measured: BoolArray, tolerance: float) -> tuple[Samples, BoolArray]:
    """The mean of what was measured, without what lies further than `tolerance` from the median.

    laps : (P, n, ...) uint16 or uint8.  measured : same shape.  Returns (n, ...) of the laps' kind, 0 where nothing was
    measured, and the samples set aside, (P, n, ...) bool. Two that disagree are both kept: none is known to be wrong.
    """
    passes = len(laps)
    mean: Samples = ((2 * laps.sum(axis=0, dtype=np.uint32) + passes) // (2 * passes)).astype(laps.dtype)
    doubtful = (laps.max(axis=0) - laps.min(axis=0) > tolerance) | ~measured.all(axis=0)
    left_out = np.zeros(laps.shape, np.bool_)
    if doubtful.any():
        mean[doubtful], left_out[:, doubtful] = _careful_average(laps[:, doubtful], measured[:, doubtful], tolerance)
    return mean, left_out


def _careful_average(laps: Samples, measured: BoolArray, tolerance: float) -> tuple[Samples, BoolArray]:
    """As average, for (P, k) samples that disagree or are not all measured."""
    middle = _median(laps.astype(np.float32), measured)
    near = measured & (np.abs(laps - middle) <= tolerance)
    near |= measured & ~near.any(axis=0)
    count = np.maximum(near.sum(axis=0, dtype=np.uint32), 1)
    total = np.where(near, laps, 0).sum(axis=0, dtype=np.uint32)
    mean: Samples = ((2 * total + count) // (2 * count)).astype(laps.dtype)
    return mean, measured & ~near


def difference_sigma(one: Samples, other: Samples, measured: BoolArray) -> float | None:
    """Standard deviation of the noise in each of two looks at the same, outliers left out; None if nothing is common.

    one, other, measured : same shape.  Quantisation alone shows as 0.
    """
    apart = np.abs(one.astype(np.int32) - other)[measured]
    return float(np.median(apart)) * _SIGMA_OF_MAD / math.sqrt(2) if apart.size else None


def shift_between(before: FloatArray, after: FloatArray, valid: BoolArray, reach: int) -> float | None:
    """By how many columns what was seen first has moved when it is seen again; None where that cannot be told.

    before, after : (n, m) columns at the same n angles, NaN where void.  valid : (n,) columns seen both times.
    reach : the furthest shift looked for; an object may well look alike every 60 degrees.
    The cost of a shift is the mean absolute difference, and a parabola through the three least tells parts of a column.
    """
    n = len(before)
    if valid.sum() < _SLIP_COLUMNS_MIN:
        return None
    reach = min(reach, n // 2)
    costs = np.array([_cost(before, after, valid, shift) for shift in range(-reach, reach + 1)])
    if np.isnan(costs).all():
        return None
    best = int(np.nanargmin(costs))
    typical = float(np.nanmedian(costs))
    if typical == 0 or costs[best] > _CONTRAST * typical:
        return None
    return best - reach + _vertex(costs, best)


def _cost(before: FloatArray, after: FloatArray, valid: BoolArray, shift: int) -> float:
    """Mean absolute difference when `after` is taken `shift` columns further on."""
    n = len(before)
    one, other = slice(max(0, -shift), min(n, n - shift)), slice(max(0, shift), min(n, n + shift))
    both = valid[one] & valid[other]
    apart = np.abs(before[other][both] - after[one][both])
    known = ~np.isnan(apart)
    return float(apart[known].mean()) if known.any() else math.nan


def _vertex(costs: FloatArray, best: int) -> float:
    """Where a parabola through the least cost and its neighbours has its least, relative to it, in -0.5..0.5."""
    if not 0 < best < len(costs) - 1:
        return 0.0
    left, here, right = costs[best - 1 : best + 2]
    bend = left - 2 * here + right
    return float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend > 0 and here > 0 else 0.0


def _median(values: FloatArray, measured: BoolArray) -> FloatArray:
    """(n, ...) median over the first axis of what was measured; 0 where nothing was."""
    ordered = np.sort(np.where(measured, values, np.inf), axis=0)
    count = measured.sum(axis=0)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    both = np.stack([low, np.minimum(high, len(values) - 1)])
    return np.where(count > 0, np.take_along_axis(ordered, both, 0).mean(axis=0), VOID)
