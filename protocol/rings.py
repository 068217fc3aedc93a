"""How many samples a spherical scan has on each ring: rows near a pole are shorter, so they hold fewer.

All rows of a direction grid have W columns, but at polar angle v they stand sin v closer together than on the equator.
There, only every s-th column is a sample of its own, s = 2, 4 or 8, so that samples are everywhere about as dense; what
lies between two of them is interpolated, in the scan itself and in what travels of it. So a click costs the same
wherever it falls, and the full scan is still reached to the bit. s never exceeds a block, so that blocks stay
independent of each other.

Source: REQUIREMENTS F-17, "spacing along a ring matches spacing between rings".
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from protocol.grid import VOID, IntArray, StepArray

LARGEST = 8
SLACK = 1e-9  # so that no machine's sine decides


@lru_cache(maxsize=64)
def ring_strides(width: int, height: int, half_spacing: int = 2) -> IntArray:
    """The stride s of each row: the largest of p, 2 p, 4 p, 8 p that divides the width with s sin v <= sqrt(2) p.

    half_spacing : 2 p, p the spacing of samples on the equator; the scan's own is 1. Samples on a ring are then 0.7 to
    1.4 times as far apart as there, if s is not at its end. Returns (H,) int64.
    """
    sine = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    p = max(half_spacing // 2, 1)
    stride = np.full(height, p, np.int64)
    times = 2
    while times <= LARGEST and width % (times * p) == 0:
        stride[times * sine <= math.sqrt(2) * (1 + SLACK)] = times * p
        times *= 2
    stride.flags.writeable = False
    return stride


def thin_rings(range_steps: StepArray) -> StepArray:
    """Range with the columns between a row's own samples interpolated, cyclic. (H, W) uint16; twice is once.

    Between a and b, k of s columns on: (2 (a (s - k) + b k) + s) // (2 s); void where either is.
    """
    thinned = np.array(range_steps)
    height, width = range_steps.shape
    stride = ring_strides(width, height)
    for s in np.unique(stride[stride > 1]).tolist():
        rows = np.flatnonzero(stride == s)
        own = range_steps[rows, ::s].astype(np.int64)[..., None]
        after = np.roll(own, -1, axis=1)
        k = np.arange(s)
        mixed = (2 * (own * (s - k) + after * k) + s) // (2 * s)
        void = (own == VOID) | ((after == VOID) & (k > 0))
        thinned[rows] = np.where(void, VOID, mixed).reshape(rows.size, width)
    return thinned
