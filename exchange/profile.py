"""A grid's columns as profiles: what a grid of the other geometry sees of them, from the same axis.

A column is a line through its samples, from the top down, in the half plane at its angle. A cylinder and a sphere round
the same axis with the same columns look along the same half planes, so one is made of the other column by column:
nothing is searched, and nothing interpolated across columns. A profile has a hole where a sample is void; a ray that
meets it several times has the outermost of them, one that passes through holes meets nothing.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from exchange.rays import Rays
from protocol.grid import VOID, FloatArray, GridSpec, ImageArray, IntArray, StepArray

STRIP_POINTS = 1 << 19  # of the profiles that are worked on at a time
ON_RAY = 1e-9  # rows: a point on a ray stays on it when rounded


def strips(columns: int, points: int) -> list[slice]:
    """Columns in runs whose profiles, of so many points each, have about STRIP_POINTS together."""
    wide = max(1, STRIP_POINTS // points)
    return [slice(first, min(first + wide, columns)) for first in range(0, columns, wide)]


def profiles(spec: GridSpec, range_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Where the samples of columns (H, n) stand in their half planes: (H, n) out from the axis, (H, n) up. [mm]"""
    row = np.arange(spec.height)[:, None]
    if spec.geometry == "sphere":
        polar = np.pi * (row + 0.5) / spec.height
        return range_mm * np.sin(polar), spec.z_max_mm + range_mm * np.cos(polar)
    return range_mm, np.where(np.isnan(range_mm), np.nan, spec.height_mm(row))


def columns_mm(spec: GridSpec, range_steps: StepArray, width: int, columns: slice) -> FloatArray:
    """Range in some columns of a grid that has `width` of them instead of W. (H, n) [mm], NaN = void

    Between two measured samples it is interpolated; where either is void the nearer one decides.
    """
    place = (np.arange(columns.start, columns.stop) + 0.5) * (spec.width / width) - 0.5
    left = np.floor(place).astype(np.int64)
    share = place - left
    before, after = range_steps[:, left % spec.width], range_steps[:, (left + 1) % spec.width]
    mixed = before + share * (after.astype(np.float64) - before)
    nearer = np.where(share < 0.5, before, after)
    steps = np.where((before != VOID) & (after != VOID), mixed, nearer)
    return np.where(steps > 0, steps * spec.step_mm, np.nan)


def meet(out_mm: FloatArray, z_mm: FloatArray, rays: Rays) -> tuple[FloatArray, FloatArray]:
    """Where the rays of each half plane meet its profile, outermost. out_mm, z_mm : (k, n) points, NaN = void.

    Returns (rows, n) how far along the ray [mm], and (rows, n) at which point of the profile: its number and the share
    of the way to the next. NaN where a ray meets nothing.
    """
    n = out_mm.shape[1]
    at = rays.row_at(out_mm, z_mm)
    first = np.maximum(np.ceil(np.minimum(at[:-1], at[1:]) - ON_RAY), 0)
    last = np.minimum(np.floor(np.maximum(at[:-1], at[1:]) + ON_RAY), rays.rows - 1)
    trials = np.where(np.isnan(first + last), 0, np.maximum(last - first + 1, 0)).astype(np.int64).ravel()
    piece, row = _spread(trials, np.nan_to_num(first).astype(np.int64).ravel())
    off, along = zip(*(rays.from_ray(out_mm.ravel()[p], z_mm.ravel()[p], row) for p in (piece, piece + n)), strict=True)
    across = off[0] - off[1]
    share = np.clip(np.divide(off[0], across, out=np.zeros_like(across), where=across != 0), 0, 1)
    reached = along[0] + share * (along[1] - along[0])
    ray = row * n + piece % n
    outermost = np.zeros(rays.rows * n)
    np.maximum.at(outermost, ray, reached)
    place = np.full(rays.rows * n, np.nan)
    won = (reached == outermost[ray]) & (reached > 0)
    place[ray[won]] = piece[won] // n + share[won]
    range_mm = np.where(np.isnan(place), np.nan, outermost)
    return range_mm.reshape(rays.rows, n), place.reshape(rays.rows, n)


def sample_rows(texture: ImageArray, row: FloatArray) -> ImageArray:
    """A texture (Ht, n, 3) at rows (rows, n) of its own columns, bilinear, clamped. (rows, n, 3) uint8"""
    across = np.broadcast_to(np.arange(row.shape[1], dtype=np.float32), row.shape)
    sampled = cv2.remap(
        np.ascontiguousarray(texture), np.ascontiguousarray(across), row.astype(np.float32), cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(sampled, np.uint8)


def _spread(counts: IntArray, first: IntArray) -> tuple[IntArray, IntArray]:
    """Each piece as often as it counts, and the numbers from its first on."""
    piece: NDArray[np.int64] = np.repeat(np.arange(counts.size), counts)
    starts = np.cumsum(counts) - counts
    return piece, np.arange(piece.size) - starts[piece] + first[piece]
