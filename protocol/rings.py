"""How many samples a spherical scan has on each ring: rows near a pole are shorter, so they hold fewer.

All rows of a direction grid have W columns, but at polar angle v they stand sin v closer together than on the equator.
There, only every t-th column is a sample of its own, t = 2, 4, 8, for texture also 16, so that samples are everywhere
about as dense; what lies between two of them is interpolated, in the scan itself and in what travels of it. t is one
number for a row of blocks, and at most as many as these have columns. So a click costs the same wherever it falls,
holdings count arc length, and the full scan is still reached to the bit.

Source: REQUIREMENTS F-17, "spacing along a ring matches spacing between rings".
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TypeVar

import numpy as np

from protocol.grid import RANGE_BLOCK, TEXTURE_BLOCK, VOID, Grid, ImageArray, IntArray, StepArray

SLACK = 1e-9  # so that no machine's sine decides
Cells = TypeVar("Cells", StepArray, ImageArray)


@lru_cache(maxsize=64)
def ring_strides(width: int, height: int, side: int = RANGE_BLOCK, half_spacing: int = 2) -> IntArray:
    """The stride t of each row of blocks, `side` rows high: the largest of 1, 2, 4 .. side with t sin v <= sqrt(2).

    half_spacing : 2 p, p the spacing of a lattice in own samples; t divides the width and p what is left of it. Own
    samples are then 0.7 to 1.4 times as far apart as on the equator, if t is not at its end. Returns (blocks,) int64.
    """
    sine = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    largest = np.maximum.reduceat(sine, np.arange(0, height, side))
    stride = np.ones(largest.size, np.int64)
    t = 2
    while t <= side and width % t == 0 and 2 * width // t % half_spacing == 0:
        stride[t * largest <= math.sqrt(2) * (1 + SLACK)] = t
        t *= 2
    stride.flags.writeable = False
    return stride


def limited_strides(own: IntArray, allowed: tuple[int, ...]) -> IntArray:
    """Of each stride the largest one allowed that is no larger. own : (n,) int64.  allowed : ascending, from 1."""
    strides = np.array(allowed, np.int64)
    return np.asarray(strides[np.searchsorted(strides, own, side="right") - 1])


def widened(own: Cells, stride: int) -> Cells:
    """Own samples and the cells between them: (rows, n + 1, ...) to (rows, n stride, ...), the last one only looked at.

    Between a and b, k of t columns on: (2 (a (t - k) + b k) + t) // (2 t). Range is void where either end is.
    """
    if stride == 1:
        return own
    rows, n = own.shape[0], own.shape[1] - 1
    whole = own.astype(np.int32)
    at_start, rising = (2 * whole[:, :-1] + 1) * stride, 2 * np.diff(whole, axis=1)
    cells = np.empty((rows, n, stride, *own.shape[2:]), own.dtype)
    for k in range(stride):
        cells[:, :, k] = (at_start + k * rising) // (2 * stride)
    if own.ndim == 2:
        cells[:, :, 1:][(own[:, :-1] == VOID) | (own[:, 1:] == VOID)] = VOID
    return cells.reshape(rows, n * stride, *own.shape[2:])


def thin_rings(range_steps: StepArray) -> StepArray:
    """Range with the columns between a row's own samples interpolated, cyclic. (H, W) uint16; twice is once."""
    return _thinned(range_steps, RANGE_BLOCK)


def thin_texture(texture: ImageArray) -> ImageArray:
    """The same of texture. (Ht, Wt, 3) uint8"""
    return _thinned(texture, TEXTURE_BLOCK)


def thin_grid(grid: Grid) -> Grid:
    """A spherical scan with only as many samples of its own on each ring as it shall have. Twice is once."""
    return replace(grid, range_steps=thin_rings(grid.range_steps), texture=thin_texture(grid.texture))


def _thinned(cells: Cells, side: int) -> Cells:
    thinned = np.array(cells)
    height, width = cells.shape[:2]
    stride = np.repeat(ring_strides(width, height, side), side)[:height]
    for t in np.unique(stride[stride > 1]).tolist():
        rows = np.flatnonzero(stride == t)
        own = cells[rows, ::t]
        thinned[rows] = widened(np.concatenate([own, own[:, :1]], axis=1), t)
    return thinned
