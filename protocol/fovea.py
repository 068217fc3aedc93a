"""The paper's radial foveation of one axis: transforms, scales, clipping, lookup tables (the `classic` profile).

An axis is sampled densely near the fovea and ever more sparsely away from it. Sample k lies at distance
`r_k = (exp(k/s) - 1) / alpha` in source samples, and neighbouring spacings grow by exactly exp(1/s). Two axes make a
lattice by product; the cylinder's x axis is cyclic, its y axis is not.

Source: Cheng, Basu, Pan 2003, Eqs. (1)-(12); alpha is the paper's α, s its scaling factor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from protocol.errors import LatticeError
from protocol.grid import FloatArray, IntArray

RINGS_MAX = 64 * 1024 // 24 - 1  # so that a table stays below 64 KiB


def radius_to_view(radius: FloatArray, alpha: float, s: float) -> FloatArray:
    """Distance in the source to distance in the foveated view. [samples, any shape]

    alpha = 0 is the linear limit, where s is the density and v = s r.
    Raises LatticeError when alpha or s is not usable or a radius is negative or NaN.
    Source: Eq. (1), v = s ln(alpha r + 1).
    """
    _check_transform(alpha, s)
    r = _distances(radius)
    return s * r if alpha == 0 else s * np.log1p(alpha * r)


def view_to_radius(view: FloatArray, alpha: float, s: float) -> FloatArray:
    """Distance in the foveated view back to distance in the source; the inverse of radius_to_view.

    Raises LatticeError also where the result would overflow.
    Source: Eq. (2), r = (exp(v/s) - 1) / alpha.
    """
    _check_transform(alpha, s)
    v = _distances(view)
    if alpha == 0:
        return v / s
    if v.size and v.max() / s > 700:
        raise LatticeError("view distance overflows: bound it by the largest radius first")
    return np.expm1(v / s) / alpha


def scale_from_extent(view_max: float, radius_max: float, alpha: float) -> float:
    """Scaling factor s that maps radius_max onto view_max. Source: Eq. (3), s = v_max / ln(alpha r_max + 1)."""
    if not (alpha > 0 and radius_max > 0 and view_max > 0):
        raise LatticeError("alpha, radius_max and view_max must be above 0")
    return view_max / math.log1p(alpha * radius_max)


def spacing_at(radius: FloatArray, alpha: float, s: float) -> FloatArray:
    """Local sample spacing g(r) = (1 + alpha r) / (s alpha). [source samples, any shape]"""
    _check_transform(alpha, s)
    r = _distances(radius)
    return np.full_like(r, 1 / s) if alpha == 0 else (1 + alpha * r) / (s * alpha)


def cartesian_to_view(x: FloatArray, fovea: float, alpha: float, s: float) -> FloatArray:
    """Foveate one open axis round its fovea, which stays where it is. [source samples, any shape]

    Odd about the fovea and order-preserving. Source: Eqs. (4)-(9) with the sign and absolute value they omit.
    """
    offset = np.asarray(x, np.float64) - fovea
    return fovea + np.copysign(radius_to_view(np.abs(offset), alpha, s), offset)


def view_to_cartesian(view: FloatArray, fovea: float, alpha: float, s: float) -> FloatArray:
    """Inverse of cartesian_to_view. [source samples, any shape]"""
    offset = np.asarray(view, np.float64) - fovea
    return fovea + np.copysign(view_to_radius(np.abs(offset), alpha, s), offset)


def cyclic_offset(x: FloatArray, fovea: float, width: int) -> FloatArray:
    """Signed offset (any shape) from the fovea round a cycle of `width`, in [-width/2, width/2)."""
    return _wrapped(np.asarray(x, np.float64) - fovea + width / 2, width) - width / 2


def cylinder_to_view(x: FloatArray, fovea: float, width: int, alpha: float, sigma: float) -> FloatArray:
    """Foveate the cyclic axis: sigma is the share of it that is kept. Returns positions in [0, width), same shape.

    Source: Eqs. (10), (11) with r_max = width/2, the largest cyclic distance.
    """
    offset = cyclic_offset(x, fovea, width)
    s = scale_from_sigma(sigma, width / 2, alpha)
    return _wrapped(fovea + np.copysign(radius_to_view(np.abs(offset), alpha, s), offset), width)


def scale_from_sigma(sigma: float, radius_max: float, alpha: float) -> float:
    """Scaling factor that keeps the share sigma of an axis reaching radius_max (the paper's "scale" is 1 - sigma)."""
    if not 0 < sigma <= 1:
        raise LatticeError(f"sigma must be in (0, 1], got {sigma}")
    return scale_from_extent(sigma * radius_max, radius_max, alpha)


def finest_scale(alpha: float) -> float:
    """Largest s whose first spacing is still a whole source sample: s_max = 1 / ln(1 + alpha) (F-06)."""
    if not (math.isfinite(alpha) and alpha > 0):
        raise LatticeError(f"alpha must be above 0, got {alpha}")
    return 1 / math.log1p(alpha)


def clip_ring(alpha: float, s: float, coarse_spacing: float) -> int:
    """Outermost ring K whose spacing from its inner neighbour is at most the coarse spacing; 0 when none is.

    Source: Eq. (12) in closed form, K = floor(s ln(alpha R / (1 - exp(-1/s)))).
    """
    _check_transform(alpha, s)
    if alpha == 0:
        raise LatticeError("alpha must be above 0 to clip")
    argument = alpha * coarse_spacing / -math.expm1(-1 / s)
    return math.floor(s * math.log(argument)) if argument >= 1 else 0


@dataclass(frozen=True, slots=True, eq=False)
class FoveaTable:
    """Lookup table of one axis: offsets from any fovea, so that one table serves every click (F-05).

    offset : (K + 1,) float64 distances r_k, 0 first.     snapped : the same as whole samples, int64.
    spacing : (K + 1,) float64 local spacing g(r_k).      [source samples]
    """

    offset: FloatArray
    snapped: IntArray
    spacing: FloatArray


@lru_cache(maxsize=64)
def fovea_table(alpha: float, s: float, coarse_spacing: float, radius_max: float) -> FoveaTable:
    """Build the table for (alpha, s), clipped by Eq. (12) and capped at radius_max.

    Raises LatticeError also where it would not stay below 64 KiB.
    """
    last = clip_ring(alpha, s, coarse_spacing)
    last = min(last, math.floor(radius_to_view(np.array([radius_max]), alpha, s)[0] + 1e-9))
    if last > RINGS_MAX:
        raise LatticeError(f"alpha {alpha} and s {s} need {last} rings, more than {RINGS_MAX}")
    offset = np.minimum(view_to_radius(np.arange(last + 1, dtype=np.float64), alpha, s), radius_max)
    snapped = np.rint(offset).astype(np.int64)
    table = FoveaTable(offset, snapped, spacing_at(offset, alpha, s))
    for array in (table.offset, table.snapped, table.spacing):
        array.flags.writeable = False
    return table


def cyclic_positions(table: FoveaTable, fovea: float, width: int) -> FloatArray:
    """Sample positions of the x axis, ascending and not wrapped. (n,) float64, span at most `width`; antipode once."""
    left = table.offset[1:][::-1]
    if left.size and left[0] >= width / 2:
        left = left[1:]
    return np.concatenate([fovea - left, fovea + table.offset])


def open_positions(table: FoveaTable, fovea: float, height: int) -> FloatArray:
    """Sample positions of the y axis, ascending; rows outside the grid are dropped. (n,) float64."""
    positions = np.concatenate([fovea - table.offset[1:][::-1], fovea + table.offset])
    return positions[(positions >= 0) & (positions <= height - 1)]


def _wrapped(position: FloatArray, width: int) -> FloatArray:
    """Positions modulo width, in [0, width): the remainder of a tiny negative number rounds to width itself."""
    remainder = position % width
    return np.where(remainder == width, 0.0, remainder)


def _check_transform(alpha: float, s: float) -> None:
    if not (math.isfinite(alpha) and alpha >= 0):
        raise LatticeError(f"alpha must be at least 0, got {alpha}")
    if not (math.isfinite(s) and s > 0):
        raise LatticeError(f"s must be above 0, got {s}")


def _distances(values: FloatArray) -> FloatArray:
    distances = np.asarray(values, np.float64)
    if not np.all(distances >= 0):
        raise LatticeError("distances must be at least 0 and not NaN")
    return distances
