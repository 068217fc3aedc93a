"""How a second sweep of an object stands to the first: found from the shape both have seen.

Nobody lays an object down to a tenth of a millimetre, so where it lay is only a start. From there the sweep's points
are moved onto the first one's surface: each has a distance to it along the normal there, known at once, since the
surface is a grid over angle and height; and the rigid motion that makes the squares of these least is solved for, again
and again, with points that lie far off left out. What cannot be told from the shape (a ball has no turn) is left as it
was.

Source: Chen and Medioni 1992 (point to plane), with Tukey's weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from exchange.errors import ExchangeError
from protocol.grid import VOID, FloatArray, Grid

POINTS_MAX = 20_000
ROUNDS = 60
REACH = 0.12  # of the object's size: points further off do not count, at first
REACH_SHRINKS = 0.85  # from round to round
REACH_MIN_SIGMAS = 4.0
STEEP_MAX = 3.0  # a surface that leans more from its row or column says little of where it is
DAMPING = 1e-6
STILL_MM = 1e-4  # a round that moves nothing further ends it
REACH_MIN = 0.01  # of the object's size
NEAR = 0.004  # of the object's size: a point so near the surface fits
SEEN_SHARE_MIN = 0.3  # of the points, that the surface is known where they are, else too little was seen twice
NEAR_SHARE_MIN = 0.6  # of those: in a wrong pose it is a tenth


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A rigid motion: place @ turn.T + shift_mm. turn : (3, 3).  shift_mm : (3,)."""

    turn: FloatArray
    shift_mm: FloatArray

    def move(self, places: FloatArray) -> FloatArray:
        """Places (..., 3), moved."""
        return np.asarray(places @ self.turn.T + self.shift_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose that was found. misfit_mm : root of the mean square distance of the points that fit."""

    pose: Pose
    misfit_mm: float


def tipped_back(tip_deg: float) -> FloatArray:
    """The turn that sets an object upright that was tipped over its front, its top towards the angle 0. (3, 3)

    tip_deg : how far; negative: over its back, so that its bottom lies there.
    """
    cos, sin = math.cos(math.radians(tip_deg)), math.sin(math.radians(tip_deg))
    return np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]])


def fit(points_mm: FloatArray, base: Grid, turn: FloatArray) -> Fit:
    """The pose that lays points (n, 3) of a sweep on a cylinder's surface. turn : where to begin, (3, 3).

    Raises ExchangeError when too few of them come to lie on it: then it is another object, or a wrong start.
    """
    surface = _Surface.of(base)
    points = points_mm[:: max(1, len(points_mm) // POINTS_MAX)]
    size_mm = float(np.ptp(surface.extent, axis=0).max())
    pose = Pose(turn, surface.extent.mean(axis=0) - _middle(points @ turn.T))
    reach = REACH * size_mm
    for _ in range(ROUNDS):
        places = pose.move(points)
        away, normal = surface.distance(places)
        counts = np.abs(away) < reach
        if np.count_nonzero(counts) < 6:
            break
        sigma = 1.4826 * float(np.median(np.abs(away[counts])))
        weight = (1 - (away[counts] / reach) ** 2) ** 2
        middle = places[counts].mean(axis=0)
        lever = np.concatenate([normal[counts], np.cross(places[counts] - middle, normal[counts]) / size_mm], axis=1)
        square = (lever * weight[:, None]).T @ lever
        step = np.linalg.solve(
            square + DAMPING * np.trace(square) * np.eye(6), -(lever * weight[:, None]).T @ away[counts]
        )
        turned = _turn(step[3:] / size_mm)
        pose = Pose(turned @ pose.turn, turned @ (pose.shift_mm - middle) + middle + step[:3])
        at_end = reach <= max(REACH_MIN_SIGMAS * sigma, REACH_MIN * size_mm)
        reach = max(reach * REACH_SHRINKS, REACH_MIN_SIGMAS * sigma, REACH_MIN * size_mm)
        if at_end and np.abs(step).max() < STILL_MM:
            break
    return _judged(pose, surface, points, NEAR * size_mm)


def _judged(pose: Pose, surface: _Surface, points: FloatArray, near_mm: float) -> Fit:
    away, _ = surface.distance(pose.move(points))
    seen, fits = np.isfinite(away), np.abs(away) < near_mm
    if seen.mean() < SEEN_SHARE_MIN or fits.sum() < NEAR_SHARE_MIN * seen.sum():
        raise ExchangeError(
            f"sweep: only {fits.mean():.0%} of it lies on the scan's surface; is it the same object, tipped as said?"
        )
    return Fit(pose, float(np.sqrt(np.mean(away[fits] ** 2))))


@dataclass(frozen=True, slots=True, eq=False)
class _Surface:
    """A cylinder's range with its slopes, each (H, W), NaN where they are not known. extent : (2, 3) of its bounds."""

    base: Grid
    range_mm: FloatArray
    across: FloatArray
    down: FloatArray
    extent: FloatArray

    @classmethod
    def of(cls, base: Grid) -> _Surface:
        spec = base.spec
        range_mm = np.where(base.range_steps == VOID, np.nan, base.range_steps * spec.step_mm)
        turn = 2 * np.pi / spec.width
        across = (np.roll(range_mm, -1, 1) - np.roll(range_mm, 1, 1)) / (2 * turn)
        down = np.full_like(range_mm, np.nan)
        down[1:-1] = (range_mm[:-2] - range_mm[2:]) / (2 * spec.pitch_mm)  # by height, upwards
        angle, rows = spec.angle_rad(np.arange(spec.width)), np.flatnonzero(np.isfinite(range_mm).any(axis=1))
        if not rows.size:
            raise ExchangeError("scan: nothing is measured")
        x, y = range_mm * np.cos(angle), range_mm * np.sin(angle)
        z = spec.height_mm(rows[[-1, 0]])
        extent = np.array([[np.nanmin(x), np.nanmin(y), z[0]], [np.nanmax(x), np.nanmax(y), z[1]]])
        return cls(base, range_mm, across, down, extent)

    def distance(self, places: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far places (n, 3) lie outside the surface, inf where that is not known, and its normals there."""
        spec = self.base.spec
        x, y, z = places.T
        out, angle = np.hypot(x, y), np.arctan2(y, x)
        column = (angle - spec.theta0_rad) * spec.width / (2 * np.pi) - 0.5
        row = (spec.z_max_mm - z) / spec.pitch_mm - 0.5
        known = (row >= 0) & (row < spec.height - 1)
        range_mm, across, down = (
            _between(of, np.where(known, row, 0), column) for of in (self.range_mm, self.across, self.down)
        )
        lean = across / range_mm
        steep = np.sqrt(1 + lean**2 + down**2)
        cos, sin = np.cos(angle), np.sin(angle)
        normal = np.stack([cos + lean * sin, sin - lean * cos, -down], axis=1) / steep[:, None]
        away = (out - range_mm) / steep
        known &= np.isfinite(away) & (steep <= STEEP_MAX)
        return np.where(known, away, np.inf), np.where(known[:, None], normal, 0.0)


def _between(values: FloatArray, row: FloatArray, column: FloatArray) -> FloatArray:
    """Bilinear, cyclic across; NaN beside a NaN. (n,)"""
    top, left = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    down, across = row - top, column - left
    width = values.shape[1]
    columns = left % width, (left + 1) % width
    upper, lower = (values[r, columns[0]] * (1 - across) + values[r, columns[1]] * across for r in (top, top + 1))
    return np.asarray(upper * (1 - down) + lower * down)


def _middle(places: FloatArray) -> FloatArray:
    return np.asarray((places.min(axis=0) + places.max(axis=0)) / 2)


def _turn(vector: FloatArray) -> FloatArray:
    """The rotation by a vector's length about it. (3, 3) Source: Rodrigues."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross)
