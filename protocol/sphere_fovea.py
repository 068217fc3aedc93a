"""The `classic` profile on a sphere: the paper's lattices round a direction, snapped to the dense directions.

A fovea is a direction and a few numbers; both ends compute from them which dense directions it samples, and only the
radial values there travel. Three lattices: rings, F-17's polar form of Eqs. (1)-(2), alike on all sides wherever the
fovea stands; the paper's literal one, offsets f(i) in each angle; and that one turned with the sphere from the equator.
A sampled dense direction takes its value as it is; one between samples is interpolated in the lattice's own
coordinates. As on the cylinder, a dense direction belongs to the nearest fovea that delivers it.

Source: Cheng, Basu, Pan 2003, section 4, with REQUIREMENTS F-17.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from protocol.bilinear import Between, between
from protocol.errors import LatticeError, LocalWireError, RemoteWireError
from protocol.grid import BoolArray, FloatArray, IntArray
from protocol.lattice import ChannelShape
from protocol.sphere import (
    DirectionGrid,
    Rings,
    Spread,
    directions,
    frame_at,
    great_circle_rad,
    literal_nodes,
    plateau_and_skirt,
    ring_vectors,
    rotated_nodes,
    vectors,
)

PARAMETERS = struct.Struct("<HBIIIff")
TURN, POLAR_MAX = 1 << 32, (1 << 32) - 1
SAMPLES_MAX = 1 << 21
CELLS_MAX = 1 << 22
COUNT_MAX = 1023
ON_EDGE = 1e-9
DISTANCE_DIGITS = 6  # of a distance that is compared, in decimals of a radian
FAR_RAD = 10.0


class Kind(IntEnum):
    """Which lattice; the number is the one on the wire."""

    RINGS = 0
    LITERAL = 1
    ROTATED = 2


@dataclass(frozen=True, slots=True)
class SphereParameters:
    """What travels of a fovea in one channel.

    fovea : its number in the opening, from 1.
    polar, turned : its direction, theta_v in 2^32 - 1 parts of pi, theta_h in 2^32 of a turn from the grid's left edge.
    m, n, alpha, s : literal and rotated: f(i) = (exp(i / s) - 1) / alpha, i = 0..m down, 0..n across. [rad]
    alpha, s, rho : rings: the cap's radius and the plateau's spacing [rad], the skirt's growth in 1/65536, 0: none.
    alpha and s are exact in float32.
    """

    fovea: int
    kind: Kind
    polar: int
    turned: int
    alpha: float
    s: float
    m: int = 0
    n: int = 0
    rho: int = 0

    @property
    def theta_v(self) -> float:
        """Polar angle. [rad]"""
        return math.pi * (self.polar / POLAR_MAX)

    @property
    def theta_h(self) -> float:
        """Angle round the axis, from the grid's left edge. [rad]"""
        return 2 * math.pi * (self.turned / TURN)

    @property
    def spacing(self) -> float:
        """Distance of the first samples from the fovea. [rad]"""
        return self.s if self.kind is Kind.RINGS else math.expm1(1 / self.s) / self.alpha

    def to_bytes(self) -> bytes:
        """Wire form, 23 bytes. Raises LocalWireError when they do not fit it."""
        p, counts = self, self.rho if self.kind is Kind.RINGS else self.m | self.n << 16
        try:
            return PARAMETERS.pack(p.fovea, p.kind, p.polar, p.turned, counts, p.alpha, p.s)
        except (struct.error, OverflowError) as error:
            raise LocalWireError(f"parameters of a fovea out of bounds: {error}") from None

    @classmethod
    def from_bytes(cls, data: bytes) -> SphereParameters:
        """Inverse of to_bytes. Raises RemoteWireError when the bytes are not whole or of an unknown kind."""
        if len(data) != PARAMETERS.size:
            raise RemoteWireError(f"parameters of a fovea on a sphere take {PARAMETERS.size} bytes, got {len(data)}")
        fovea, kind, polar, turned, counts, alpha, s = PARAMETERS.unpack(data)
        if kind == Kind.RINGS:
            return cls(fovea, Kind.RINGS, polar, turned, alpha, s, rho=counts)
        if kind not in (Kind.LITERAL, Kind.ROTATED):
            raise RemoteWireError(f"no lattice {kind} on a sphere")
        return cls(fovea, Kind(kind), polar, turned, alpha, s, counts & 0xFFFF, counts >> 16)


@dataclass(frozen=True, slots=True, eq=False)
class SphereLattice:
    """A fovea's samples, and the dense directions among them, which it delivers.

    sample : (n,) int64 the dense directions sampled: flat indices, each once, in the lattice's order.
    node : (rows, columns) int64 the lattice as an image: the sample at each node; short rings repeat their last.
    cells : (k,) int64 the dense directions delivered, flat, ascending.  distance : (k,) from the fovea. [rad]
    corner, weight : (k, 4) the samples a delivered direction hangs on, and their shares of 1.
    spacing : (k,) how far apart samples are there. [rad]
    """

    shape: ChannelShape
    parameters: SphereParameters
    sample: IntArray
    node: IntArray
    cells: IntArray
    distance: FloatArray
    corner: IntArray
    weight: FloatArray
    spacing: FloatArray

    def blend(self, values: FloatArray) -> FloatArray:
        """Values of all samples (n, ...) at the delivered directions: (k, ...); NaN where a corner that counts is."""
        shape = (-1, *[1] * (values.ndim - 1))
        total = np.zeros((self.cells.size, *values.shape[1:]))
        for corner, weight in zip(self.corner.T, self.weight.T, strict=True):
            share = weight.reshape(shape)
            total += np.where(share > 0, share * values[corner], 0.0)
        return total


class _Places(NamedTuple):
    """Dense directions among nodes: cells (k,), corner and weight (k, 4), spacing (k,)."""

    cells: IntArray
    corner: IntArray
    weight: FloatArray
    spacing: FloatArray


@lru_cache(maxsize=8)
def build_sphere_lattice(shape: ChannelShape, parameters: SphereParameters) -> SphereLattice:
    """Compute a fovea's lattice from what travelled. Raises LatticeError when the parameters describe none."""
    if not shape.sphere:
        raise LatticeError("a cylinder has no directions")
    p, grid = parameters, DirectionGrid(shape.width, shape.height)
    _check(p)
    if p.kind is Kind.RINGS:
        rings = plateau_and_skirt(p.alpha, p.s, p.rho, math.pi / shape.coarse_height)
        _bounded(int(rings.bearings.sum()))
        theta_v, theta_h = directions(ring_vectors(frame_at(p.theta_v, p.theta_h), rings))
        node, reach = _ring_nodes(rings), float(rings.radius_rad[-1])
        places = _among_rings(grid, p, rings, _near(grid, p, reach))
    else:
        down, across = Spread(p.m, p.alpha, p.s), Spread(p.n, p.alpha, p.s)
        _bounded((2 * p.m + 1) * (2 * p.n + 1))
        nodes = literal_nodes if p.kind is Kind.LITERAL else rotated_nodes
        theta_v, theta_h = nodes(p.theta_v, p.theta_h, down, across)
        node = np.arange(theta_v.size).reshape(2 * p.m + 1, 2 * p.n + 1)
        reach = float(down.offsets()[-1] + (across.offsets()[-1] if p.kind is Kind.ROTATED else 0))
        places = _among_axes(grid, p, down, across, _near(grid, p, reach))
    sample, place = _once(grid, theta_v, theta_h, p.theta_h)
    cells, corner, weight, spacing = _with_samples(sample, places._replace(corner=place[places.corner]), p.spacing)
    away = great_circle_rad(_towards(grid, cells), vectors(p.theta_v, p.theta_h))
    distance = np.round(away, DISTANCE_DIGITS)
    return SphereLattice(shape, p, sample, place[node], cells, distance, corner, weight, spacing)


def claim(new: SphereLattice, older: Iterable[SphereLattice]) -> BoolArray:
    """Which of the directions a new fovea delivers are nearer to it than to all that delivered them before. (k,)

    Source: Eqs. (13), (14), with the angle between directions as distance.
    """
    held = np.full(new.cells.size, FAR_RAD)
    for fovea in older:
        at = np.minimum(np.searchsorted(fovea.cells, new.cells), fovea.cells.size - 1)
        held = np.minimum(held, np.where(fovea.cells[at] == new.cells, fovea.distance[at], FAR_RAD))
    claimed: BoolArray = new.distance < held
    return claimed


def kept_samples(lattice: SphereLattice, claimed: BoolArray) -> BoolArray:
    """Which of a lattice's samples travel: those that a claimed direction hangs on. (n,)"""
    kept = np.zeros(lattice.sample.size, np.bool_)
    kept[lattice.corner[claimed][lattice.weight[claimed] > 0]] = True
    return kept


def _check(p: SphereParameters) -> None:
    if p.fovea < 1:
        raise LatticeError("foveae count from 1")
    if not (math.isfinite(p.alpha) and p.alpha >= 0 and math.isfinite(p.s) and p.s > 0):
        raise LatticeError(f"a lattice needs lengths above 0, got {p.alpha}, {p.s}")
    if p.kind is not Kind.RINGS and not (p.m <= COUNT_MAX and p.n <= COUNT_MAX):
        raise LatticeError(f"m and n must be at most {COUNT_MAX}, got {p.m}, {p.n}")


def _bounded(samples: int) -> None:
    if samples > SAMPLES_MAX:
        raise LatticeError(f"{samples} samples are more than {SAMPLES_MAX}")


def _near(grid: DirectionGrid, p: SphereParameters, reach_rad: float) -> IntArray:
    """Dense directions, flat, of the rows within reach of the fovea."""
    away = np.abs(grid.theta_v(np.arange(grid.height)) - p.theta_v)
    rows = np.flatnonzero(away <= reach_rad + ON_EDGE)
    if rows.size * grid.width > CELLS_MAX:
        raise LatticeError(f"a fovea that reaches {reach_rad:.2f} rad far is too large here: {CELLS_MAX} cells at most")
    return (rows[:, None] * grid.width + np.arange(grid.width)).ravel()


def _towards(grid: DirectionGrid, cells: IntArray) -> FloatArray:
    row, column = np.divmod(cells, grid.width)
    return vectors(grid.theta_v(row), grid.theta_h(column))


def _once(
    grid: DirectionGrid, theta_v: FloatArray, theta_h: FloatArray, fovea_h: float
) -> tuple[IntArray, IntArray]:
    """The dense directions nearest to nodes (k,): each once, in order of first appearance, and which each node has."""
    on_pole = np.minimum(theta_v, np.pi - theta_v) < ON_EDGE  # one direction, whatever its theta_h: the fovea's then
    row, column = grid.snap(theta_v, np.where(on_pole, fovea_h, theta_h))
    cell, first, which = np.unique(row * grid.width + column, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(order.size)
    return cell[order], rank[which]


def _ring_nodes(rings: Rings) -> IntArray:
    start = np.cumsum(rings.bearings) - rings.bearings
    along = np.minimum(np.arange(rings.bearings.max()), rings.bearings[:, None] - 1)
    return np.asarray(start[:, None] + along)


def _among_rings(grid: DirectionGrid, p: SphereParameters, rings: Rings, cells: IntArray) -> _Places:
    x, y, z = np.moveaxis(_towards(grid, cells) @ frame_at(p.theta_v, p.theta_h), -1, 0)
    radius = np.arctan2(np.hypot(x, y), z)
    inside = radius <= rings.radius_rad[-1] + ON_EDGE
    bearing = np.remainder(np.arctan2(y, x), 2 * np.pi)[inside] / (2 * np.pi)
    ring = between(rings.radius_rad, radius[inside])
    start = np.cumsum(rings.bearings) - rings.bearings
    corner, weight = [], []
    for index, share in ((ring.low, 1 - ring.part), (ring.high, ring.part)):
        around = bearing * rings.bearings[index]
        low = np.floor(around).astype(np.int64)
        part = around - low
        for place, of in ((low, 1 - part), (low + 1, part)):
            corner.append(start[index] + place % rings.bearings[index])
            weight.append(share * of)
    steps = np.diff(rings.radius_rad, append=rings.radius_rad[-1] + p.s)
    return _Places(cells[inside], np.stack(corner, axis=1), np.stack(weight, axis=1), steps[ring.low])


def _among_axes(grid: DirectionGrid, p: SphereParameters, down: Spread, across: Spread, cells: IntArray) -> _Places:
    theta_v, theta_h, fovea_v, fovea_h = *_angles(grid, cells), p.theta_v, p.theta_h
    if p.kind is Kind.ROTATED:
        turn = frame_at(p.theta_v, p.theta_h) @ frame_at(np.pi / 2, 0.0).T
        theta_v, theta_h = directions(_towards(grid, cells) @ turn)
        fovea_v, fovea_h = math.pi / 2, 0.0
    rows, columns = down.both_ways(), across.both_ways()
    offset_v, offset_h = np.full(cells.size, np.nan), np.zeros(cells.size)
    for v, h in ((theta_v, theta_h), (-theta_v, theta_h + np.pi), (2 * np.pi - theta_v, theta_h + np.pi)):
        dv, dh = v - fovea_v, np.remainder(h - fovea_h + np.pi, 2 * np.pi) - np.pi
        here = np.isnan(offset_v) & (np.abs(dv) <= rows[-1] + ON_EDGE) & (np.abs(dh) <= columns[-1] + ON_EDGE)
        offset_v[here], offset_h[here] = dv[here], dh[here]
    inside = ~np.isnan(offset_v)
    y, x = between(rows, offset_v[inside]), between(columns, offset_h[inside])
    spacing = np.maximum(_gaps(rows, y), _gaps(columns, x))
    corner = [a * columns.size + b for a in (y.low, y.high) for b in (x.low, x.high)]
    weight = [a * b for a in (1 - y.part, y.part) for b in (1 - x.part, x.part)]
    return _Places(cells[inside], np.stack(corner, axis=1), np.stack(weight, axis=1), spacing)


def _angles(grid: DirectionGrid, cells: IntArray) -> tuple[FloatArray, FloatArray]:
    row, column = np.divmod(cells, grid.width)
    return grid.theta_v(row), grid.theta_h(column)


def _gaps(at: FloatArray, place: Between) -> FloatArray:
    """Distance of the samples beside each place."""
    gaps = np.diff(at) if at.size > 1 else np.zeros(1)
    return np.asarray(gaps[np.minimum(place.low, gaps.size - 1)])


def _with_samples(sample: IntArray, places: _Places, spacing: float) -> _Places:
    """The places, and all samples at themselves, in the order of their cells."""
    own = np.zeros((sample.size, 4))
    own[:, 0] = 1
    others = ~np.isin(places.cells, sample)
    at_samples = _Places(
        sample, np.repeat(np.arange(sample.size)[:, None], 4, axis=1), own, np.full(sample.size, spacing)
    )
    joined = [np.concatenate([one[others], two]) for one, two in zip(places, at_samples, strict=True)]
    order = np.argsort(joined[0])
    return _Places(*(part[order] for part in joined))
