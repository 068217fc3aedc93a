"""Directions from a centre: the grid of a closed object, meshes over it, and lattices round a direction.

A direction is (theta_v, theta_h): the polar angle from straight up, 0..pi, and the angle round the axis, 0..2 pi,
counter-clockwise from above. A spherical scan is a grid like any other (protocol.grid): row r looks along theta_v =
pi (r + 0.5) / H, column c along theta_h = theta0 + 2 pi (c + 0.5) / W, and its range is the distance from the centre.
No sample stands on a pole, so no pole needs a case of its own; where a mesh wants a pole vertex, that is the mean of
the row next to it.

Source: Cheng, Basu, Pan 2003, section 4, with REQUIREMENTS F-16, F-17.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from protocol.bilinear import among_samples, blend, steps_with_holes, wrapped
from protocol.errors import LatticeError
from protocol.fovea import view_to_radius
from protocol.grid import FloatArray, GridSpec, IntArray, StepArray
from protocol.lattice import RHO_MAX, RHO_ONE
from protocol.region import Cap, Region, region_round

ROUNDING_DIGITS = 9  # of directions that are compared, in decimals of a radian
PLACE_DIGITS = 6  # of a place on the dense grid before it is snapped, in decimals of a sample: 1e-9 rad and less
RINGS_MAX = 1 << 14
BEARINGS = 4  # divides the bearings of every ring, so that all quadrants get as many
Angles = FloatArray | float


# -- directions --------------------------------------------------------------------------------------------------------


def folded(theta_v: Angles, theta_h: Angles) -> tuple[FloatArray, FloatArray]:
    """Any pair of angles as a direction: theta_v in [0, pi], theta_h in [0, 2 pi). [rad, any shape]

    Going on past a pole leads down the opposite meridian. Raises LatticeError for angles that are not finite.
    """
    v, h = np.broadcast_arrays(np.asarray(theta_v, np.float64), np.asarray(theta_h, np.float64))
    if not (np.isfinite(v).all() and np.isfinite(h).all()):
        raise LatticeError("directions must be finite")
    v = np.remainder(v, 2 * np.pi)
    beyond = v > np.pi
    h = np.remainder(np.where(beyond, h + np.pi, h), 2 * np.pi)
    return np.where(beyond, 2 * np.pi - v, v), np.where(h >= 2 * np.pi, 0.0, h)


def vectors(theta_v: Angles, theta_h: Angles) -> FloatArray:
    """Unit vectors along directions, z up. (..., 3)"""
    sin_v = np.sin(theta_v)
    return np.stack(np.broadcast_arrays(sin_v * np.cos(theta_h), sin_v * np.sin(theta_h), np.cos(theta_v)), axis=-1)


def directions(towards: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Inverse of `vectors`, for vectors (..., 3) of any length above 0. Raises LatticeError for one that has none."""
    x, y, z = np.moveaxis(np.asarray(towards, np.float64), -1, 0)
    if not np.all(x * x + y * y + z * z > 0):
        raise LatticeError("a vector without length has no direction")
    return folded(np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))


def great_circle_rad(a: FloatArray, b: FloatArray) -> FloatArray:
    """Angle between unit vectors (..., 3); exact for small ones too. [rad]"""
    return np.asarray(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def click_of(theta_v: float, theta_h: float, theta0_rad: float = 0.0) -> tuple[float, float]:
    """The click (u, v) in [0, 1) that means a direction, on a grid whose column 0 begins at theta0_rad.

    Raises LatticeError unless both are finite and theta_v is in [0, pi].
    """
    if not (math.isfinite(theta_v) and math.isfinite(theta_h) and 0 <= theta_v <= math.pi):
        raise LatticeError(f"theta_v must be in [0, pi] and theta_h finite, got {theta_v}, {theta_h}")
    u = (theta_h - theta0_rad) / (2 * math.pi) % 1.0
    return (0.0 if u >= 1 else u), min(theta_v / math.pi, math.nextafter(1.0, 0.0))


# -- the dense grid ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class DirectionGrid:
    """The dense directions of one channel: width columns all round, height rows from the upper to the lower pole."""

    width: int
    height: int
    theta0_rad: float = 0.0

    @classmethod
    def of(cls, spec: GridSpec) -> DirectionGrid:
        """The directions of a scan's range."""
        return cls(spec.width, spec.height, spec.theta0_rad)

    def theta_v(self, row: Angles | IntArray) -> FloatArray:
        """Polar angle of rows (any shape). [rad]"""
        return np.pi * (np.asarray(row, np.float64) + 0.5) / self.height

    def theta_h(self, column: Angles | IntArray) -> FloatArray:
        """Angle of columns round the axis (any shape), not folded. [rad]"""
        return self.theta0_rad + 2 * np.pi * (np.asarray(column, np.float64) + 0.5) / self.width

    def snap(self, theta_v: Angles, theta_h: Angles) -> tuple[IntArray, IntArray]:
        """Row and column of the dense direction nearest in each angle. int64, any shape; LatticeError for NaN.

        Places are rounded first: sines of different machines may differ in the last bit, not there; and what stands
        between two samples goes to the later one in every quadrant alike.
        """
        v, h = folded(theta_v, np.asarray(theta_h, np.float64) - self.theta0_rad)
        down, across = (np.floor(np.round(place, PLACE_DIGITS)).astype(np.int64) for place in (
            v * (self.height / np.pi), h * (self.width / (2 * np.pi))
        ))  # fmt: skip
        return np.minimum(down, self.height - 1), across % self.width

    def snap_unique(self, theta_v: FloatArray, theta_h: FloatArray) -> tuple[IntArray, IntArray]:
        """Rows and columns (k,) of directions (n,), each dense one once, in the order of first appearance."""
        row, column = self.snap(theta_v, theta_h)
        _, first = np.unique(row * self.width + column, return_index=True)
        first.sort()
        return row[first], column[first]


def cap_region(u: float, v: float, share: float, width: int, height: int) -> Cap:
    """The cap of a click on a direction grid: `share` of the sphere, centred on the very direction.

    It holds the samples whose centres lie in it, and always the clicked one.
    """
    radius_rad = math.acos(max(1 - 2 * share, -1.0))
    polar_rad, column, row = math.pi * v, int(u * width), int(v * height)
    first, last = (math.floor((polar_rad + side * radius_rad) * height / math.pi) for side in (-1, 1))
    rows = np.arange(max(first - 1, 0), min(last + 2, height))
    rows = rows[(np.abs(np.pi * (rows + 0.5) / height - polar_rad) <= radius_rad) | (rows == row)]
    theta_v = np.pi * (rows + 0.5) / height
    sine = np.sin(theta_v)
    farthest = np.minimum(theta_v + polar_rad, 2 * np.pi - theta_v - polar_rad)
    cosine = (math.cos(radius_rad) - np.cos(theta_v) * math.cos(polar_rad)) / (sine * max(math.sin(polar_rad), 1e-12))
    half = np.where(farthest <= radius_rad, np.pi, np.arccos(np.clip(cosine, -1, 1))) * width / (2 * np.pi)
    left = np.ceil(u * width - half - 0.5).astype(np.int64)
    wide = np.minimum(np.floor(u * width + half - 0.5).astype(np.int64) - left + 1, width)
    left, wide = np.where(wide < 1, column, left), np.maximum(wide, 1)
    widest = int((left + wide).max() - left.min())
    bounds = (0, width) if widest >= width else (int(left.min()), widest)
    return Cap(bounds[0], int(rows[0]), bounds[1], rows.size, width, left, wide, sine)


def region_on(spec: GridSpec, u: float, v: float, share: float, width: int, height: int) -> Region:
    """The region of a click (u, v) on a channel of width x height samples, whatever the scan's geometry."""
    around = cap_region if spec.geometry == "sphere" else region_round
    return around(u, v, share, width, height)


# -- the default mesh --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, eq=False)
class DirectionMesh:
    """Vertices by direction, both poles once, and the triangles over them.

    theta_v, theta_h : (V,) float64 [rad]: the upper pole, the rings downwards, the lower pole.
    faces : (F, 3) int64, counter-clockwise seen from outside.
    """

    theta_v: FloatArray
    theta_h: FloatArray
    faces: IntArray


def default_mesh(intervals_v: int, intervals_h: int) -> DirectionMesh:
    """The paper's mesh: directions pi/intervals_v apart down, 2 pi/intervals_h round.

    (intervals_v - 1) intervals_h + 2 vertices, 2 intervals_h (intervals_v - 1) faces: 8 x 12 gives 86 and 168, 12 x 16
    gives 178 and 352 (Fig. 6). Raises LatticeError unless intervals_v >= 2 and intervals_h is even and >= 4.
    """
    if intervals_v < 2 or intervals_h < 4 or intervals_h % 2:
        raise LatticeError(f"{intervals_v} x {intervals_h} intervals make no sphere: at least 2, an even number from 4")
    ring = 2 * np.pi * np.arange(intervals_h) / intervals_h
    inner = np.pi * np.arange(1, intervals_v) / intervals_v
    theta_v = np.concatenate([[0.0], np.repeat(inner, intervals_h), [np.pi]])
    theta_h = np.concatenate([[0.0], np.tile(ring, intervals_v - 1), [0.0]])
    return DirectionMesh(theta_v, theta_h, sphere_faces(intervals_v - 1, intervals_h))


def ranges_on(mesh: DirectionMesh, range_steps: StepArray, spec: GridSpec) -> FloatArray:
    """Distance of a spherical scan's surface from its centre at each vertex, NaN where it has none. (V,) [mm]

    Bilinear between dense samples; a pole has the mean of the row next to it. Raises LatticeError for a cylinder.
    """
    if spec.geometry != "sphere":
        raise LatticeError(f"a {spec.geometry} has no directions")
    grid, steps = DirectionGrid.of(spec), steps_with_holes(range_steps)
    v, first = np.unique(mesh.theta_v[1:-1], return_index=True)
    h = mesh.theta_h[1:-1][first[0] : np.count_nonzero(mesh.theta_v == v[0])]
    y = np.clip(v * grid.height / np.pi - 0.5, 0, grid.height - 1)
    x = folded(v[:1], h - grid.theta0_rad)[1] * grid.width / (2 * np.pi) - 0.5
    inner = blend(steps, among_samples(y), wrapped(among_samples(x), grid.width))
    poles = [row[~np.isnan(row)] for row in (steps[0], steps[-1])]
    upper, lower = (row.mean() if row.size else np.nan for row in poles)
    return np.asarray(spec.step_mm * np.concatenate([[upper], inner.ravel(), [lower]]))


def sphere_faces(rings: int, columns: int) -> IntArray:
    """Triangles over rings of `columns` vertices and a vertex at each pole. (2 rings columns, 3) int64

    Vertices: 0 the upper pole, ring i from 1 + i columns, the lower pole last. Counter-clockwise seen from outside.
    """
    here = np.arange(columns)
    after = (here + 1) % columns
    first, last = 1, 1 + (rings - 1) * columns
    lower_pole = rings * columns + 1
    upper = np.stack([np.zeros_like(here), first + here, first + after], axis=1)
    lower = np.stack([np.full_like(here, lower_pole), last + after, last + here], axis=1)
    starts = first + columns * np.arange(rings - 1)[:, None]
    a, b = (starts + here).ravel(), (starts + after).ravel()
    c, d = a + columns, b + columns
    between = np.stack([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1)], axis=1).reshape(-1, 3)
    return np.concatenate([upper, between, lower]).astype(np.int64)


# -- lattices round a direction ----------------------------------------------------------------------------------------


def frame_at(theta_v: float, theta_h: float) -> FloatArray:
    """The rotation that carries straight up to a direction and theta_h = 0 to south of it. (3, 3), columns are axes"""
    sin_v, cos_v, sin_h, cos_h = math.sin(theta_v), math.cos(theta_v), math.sin(theta_h), math.cos(theta_h)
    south, east = (cos_v * cos_h, cos_v * sin_h, -sin_v), (-sin_h, cos_h, 0.0)
    return np.array([south, east, (sin_v * cos_h, sin_v * sin_h, cos_v)]).T


@dataclass(frozen=True, slots=True, eq=False)
class Rings:
    """Circles round a fovea. radius_rad : (n,) float64 ascending.  bearings : (n,) int64 directions on each."""

    radius_rad: FloatArray
    bearings: IntArray


def plateau_and_skirt(cap_rad: float, spacing_rad: float, rho: int, coarse_rad: float) -> Rings:
    """Rings at one spacing up to a cap's edge, then ever further apart until the spacing would pass coarse_rad.

    rho : growth of the skirt's steps in 1/65536, as on the cylinder; 0 for no skirt. Ring i at r_i, d_i from its inner
    neighbour, has 4 ceil(2 pi sin(r_i) / (4 d_i)) bearings: as dense along the ring as across. Ring 0 is the fovea.
    Raises LatticeError for lengths out of bounds.
    """
    if not (0 < spacing_rad <= math.pi and 0 <= cap_rad <= math.pi and math.isfinite(coarse_rad)):
        raise LatticeError(f"no rings: cap of {cap_rad} rad, {spacing_rad} rad apart")
    if rho and not RHO_ONE <= rho <= RHO_MAX:
        raise LatticeError(f"rho must be 0 or between {RHO_ONE} and {RHO_MAX}")
    inner = math.floor(cap_rad / spacing_rad + 1e-9)
    if inner >= RINGS_MAX:
        raise LatticeError(f"{inner} rings are more than {RINGS_MAX}")
    radius, spacing = [i * spacing_rad for i in range(inner + 1)], [spacing_rad] * (inner + 1)
    step = spacing_rad * rho / RHO_ONE
    while rho and step <= coarse_rad and radius[-1] + step <= math.pi and len(radius) < RINGS_MAX:
        radius.append(radius[-1] + step)
        spacing.append(step)
        step *= rho / RHO_ONE
    around = 2 * np.pi * np.sin(np.minimum(radius, math.pi)) / (BEARINGS * np.array(spacing))
    bearings = BEARINGS * np.ceil(np.round(around, ROUNDING_DIGITS)).astype(np.int64)
    return Rings(np.array(radius), np.maximum(np.where(np.array(radius) > 0, bearings, 1), 1))


def ring_vectors(frame: FloatArray, rings: Rings) -> FloatArray:
    """Directions on rings round the third axis of a frame, by ring, then by bearing from its first axis. (n, 3)

    Turning the frame turns every direction with it: nothing here knows of poles.
    """
    start = np.cumsum(rings.bearings) - rings.bearings
    ring = np.repeat(np.arange(rings.bearings.size), rings.bearings)
    bearing = 2 * np.pi * (np.arange(ring.size) - start[ring]) / rings.bearings[ring]
    return vectors(rings.radius_rad[ring], bearing) @ np.asarray(frame).T


def ring_lattice(grid: DirectionGrid, theta_v: float, theta_h: float, rings: Rings) -> tuple[IntArray, IntArray]:
    """Rings round a direction, snapped to the dense directions: rows and columns (n,), unique, by ring and bearing."""
    return grid.snap_unique(*directions(ring_vectors(frame_at(theta_v, theta_h), rings)))


@dataclass(frozen=True, slots=True)
class Spread:
    """The paper's offsets along one angle: f(i) = (exp(i / s) - 1) / alpha, i = 1..count. [rad] Source: Eq. (2)."""

    count: int
    alpha: float
    s: float

    def offsets(self) -> FloatArray:
        """f(0) = 0 to f(count). (count + 1,) Raises LatticeError when the last is beyond pi."""
        if not 0 <= self.count < RINGS_MAX:
            raise LatticeError(f"count must be between 0 and {RINGS_MAX - 1}, got {self.count}")
        offsets = view_to_radius(np.arange(self.count + 1, dtype=np.float64), self.alpha, self.s)
        if offsets[-1] > np.pi:
            raise LatticeError(f"f({self.count}) = {offsets[-1]:.3f} rad is beyond pi")
        return offsets

    def both_ways(self) -> FloatArray:
        """-f(count) .. 0 .. f(count), ascending. (2 count + 1,)"""
        offsets = self.offsets()
        return np.concatenate([-offsets[:0:-1], offsets])


def literal_nodes(theta_v: float, theta_h: float, down: Spread, across: Spread) -> tuple[FloatArray, FloatArray]:
    """The paper's set: (theta_v +- f(i), theta_h +- f(j)), i = 0..m, j = 0..n, folded; (2 m + 1)(2 n + 1) each.

    i = 0 and j = 0, which the paper leaves out, close the cross through the fovea. Source: section 4, with F-17.
    """
    v, h = np.meshgrid(theta_v + down.both_ways(), theta_h + across.both_ways(), indexing="ij")
    return folded(v.ravel(), h.ravel())


def rotated_nodes(theta_v: float, theta_h: float, down: Spread, across: Spread) -> tuple[FloatArray, FloatArray]:
    """The literal set of a fovea on the equator, turned with the sphere until that stands at the direction."""
    v, h = literal_nodes(np.pi / 2, 0.0, down, across)
    up = frame_at(np.pi / 2, 0.0)
    return directions(vectors(v, h) @ (frame_at(theta_v, theta_h) @ up.T).T)


def literal_lattice(theta_v: float, theta_h: float, down: Spread, across: Spread) -> tuple[FloatArray, FloatArray]:
    """The paper's set, equal directions once: as many away from the poles, fewer on them. (k,) each"""
    return _once(*literal_nodes(theta_v, theta_h, down, across))


def rotated_lattice(theta_v: float, theta_h: float, down: Spread, across: Spread) -> tuple[FloatArray, FloatArray]:
    """The same, turned."""
    return _once(*rotated_nodes(theta_v, theta_h, down, across))


def _once(theta_v: FloatArray, theta_h: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Directions without repetition, in order of first appearance; a pole is one direction whatever its theta_h."""
    towards = np.round(vectors(theta_v, theta_h), ROUNDING_DIGITS) + 0.0
    _, first = np.unique(towards, axis=0, return_index=True)
    first.sort()
    return theta_v[first], theta_h[first]
