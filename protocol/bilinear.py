"""Bilinear interpolation on rectilinear positions, with holes: values that are NaN.

A value is a hole iff a corner with a weight other than 0 is one. So positions that coincide with samples take them as
they are, whatever stands beside them.

Source: REQUIREMENTS F-08, F-11.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from protocol.grid import VOID, FloatArray, ImageArray, IntArray, StepArray

BAND_ROWS = 256
LightArray = NDArray[np.float32]
Samples = TypeVar("Samples", FloatArray, LightArray)


@dataclass(frozen=True, slots=True, eq=False)
class Between:
    """Positions on one axis between samples: at samples[low], part of the way to samples[high]. (n,) each.

    part : float64 in [0, 1]; where it is 0, high is low.
    """

    low: IntArray
    high: IntArray
    part: FloatArray

    def of(self, rows: slice) -> Between:
        """Some of the positions."""
        return Between(self.low[rows], self.high[rows], self.part[rows])

    def moved(self, by: int) -> Between:
        """The same positions when the samples are counted from elsewhere."""
        return Between(self.low + by, self.high + by, self.part)


def between(at: FloatArray, position: FloatArray | IntArray) -> Between:
    """Places of positions (n,) among samples that stand `at` (m,), ascending. Beyond the ends the last one serves."""
    place = np.clip(np.asarray(position, np.float64), at[0], at[-1])
    low = np.searchsorted(at, place, side="right").astype(np.int64) - 1
    part = np.zeros(place.size)
    inside = place > at[low]
    part[inside] = (place - at[low])[inside] / (at[np.minimum(low + 1, at.size - 1)] - at[low])[inside]
    return Between(low, np.where(part > 0, low + 1, low), part)


def among_samples(position: FloatArray) -> Between:
    """Places of positions (n,) among samples that stand on whole numbers, as many as there are."""
    low = np.floor(position).astype(np.int64)
    part = position - low
    return Between(low, np.where(part > 0, low + 1, low), part)


def wrapped(place: Between, turn: int) -> Between:
    """The same places on a cyclic axis of `turn` samples."""
    return Between(place.low % turn, place.high % turn, place.part)


def blend(samples: NDArray[Any], y: Between, x: Between, kind: type[np.floating[Any]] = np.float64) -> NDArray[Any]:
    """Samples (m, k, ...) at places y by x: (rows, columns, ...) of the floating kind asked for."""
    top, bottom = int(y.low.min()), int(y.high.max()) + 1
    wide = _lerp(samples[top:bottom], x, 1, kind)
    return _lerp(wide, y.moved(-top), 0, kind)


def blend_colour(texels: ImageArray, y: Between, x: Between) -> ImageArray:
    """Texels (m, k, 3) at places y by x, rounded: (rows, columns, 3) uint8. In bands, so memory stays bounded."""
    image = np.empty((y.low.size, x.low.size, 3), np.uint8)
    for top in range(0, y.low.size, BAND_ROWS):
        rows = slice(top, top + BAND_ROWS)
        image[rows] = np.rint(blend(texels, y.of(rows), x, np.float32))
    return image


def steps_with_holes(range_steps: StepArray) -> FloatArray:
    """Range with NaN for void. Same shape, float64 [steps]"""
    return np.where(range_steps == VOID, np.nan, range_steps.astype(np.float64))


def whole_steps(range_steps: FloatArray) -> StepArray:
    """Nearest whole steps, void for NaN. Same shape, uint16."""
    return np.rint(np.where(np.isnan(range_steps), VOID, range_steps)).astype(np.uint16)


def _lerp(samples: NDArray[Any], place: Between, axis: int, kind: type[np.floating[Any]]) -> NDArray[Any]:
    start = np.take(samples, place.low, axis).astype(kind)
    if place.part.any():
        way = np.take(samples, place.high, axis).astype(kind)
        way -= start
        way *= place.part.astype(kind).reshape([-1 if index == axis else 1 for index in range(samples.ndim)])
        start += way
    return start
