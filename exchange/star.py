"""A closed mesh as distances from a centre inside it: the centre chosen and checked, and what it cannot see reported.

Every direction from the centre has one distance, to the outermost surface it meets. That is the whole object if it is
star-shaped about the centre; what else there is (behind an ear, under a brim) stays hidden, so a mesh that hides too
much of itself is refused, and so is one that is not closed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from exchange.cast import STEP_MIN_MM, Mesh, cast_mesh
from exchange.errors import ExchangeError
from protocol.grid import STEPS_MAX, VOID, BoolArray, FloatArray, Grid, GridSpec, StepArray
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid, directions

LOOK = (180, 90, 1, 1)  # rays that tell whether a mesh is closed
CANDIDATES = 17  # heights tried as centre
HIDDEN_MAX = 0.05  # of the surface
OPEN_MAX = 0.02  # of all directions
NEAR_ENOUGH = 0.01  # of the surface: so much more turned away does not speak against the middle
DEPTH_TOLERANCE = 0.02  # of its distance: what lies so little below the outermost surface is that surface
FACES_AT_ONCE = 1 << 18
INSIDE_MIN = 0.5  # turns of the surface round a point inside; a hole takes its share of 1 away


@dataclass(frozen=True, slots=True)
class Seen:
    """How an object looks from a centre on the axis. hidden : share of its surface.  open : share of directions."""

    centre_mm: float
    hidden: float
    open: float

    def __str__(self) -> str:
        parts = ((self.hidden, "of its surface hidden from there"), (self.open, "of all directions void"))
        said = "".join(f"; {share:.1%} {what}" for share, what in parts if share >= 0.0005)
        return f"a closed mesh seen from a centre at {self.centre_mm:.1f} mm{said}"


def star_centre(mesh: Mesh) -> float | None:
    """The height of a centre from which a closed mesh is seen whole, or nearly; None where there is none."""
    try:
        return close_mesh(mesh, LOOK)[1].centre_mm
    except ExchangeError:
        return None


def close_mesh(
    mesh: Mesh,
    size: tuple[int, int, int, int],
    theta0_rad: float = 0.0,
    centre_mm: float | None = None,
    progress: Callable[[float], object] = lambda share: None,
) -> tuple[Grid, Seen]:
    """A mesh as a spherical grid. size : W, H, Wt, Ht.  centre_mm : height of the centre on the axis; None: chosen.

    Raises ExchangeError for a centre that is not inside, a mesh that is open or that hides more than HIDDEN_MAX.
    """
    if not np.isfinite(mesh.corners).all():
        raise ExchangeError("vertices: a coordinate is not finite")
    if centre_mm is None:
        centre_mm = choose_centre(mesh.corners)
    elif turns_round(mesh.corners, centre_mm)[0] < INSIDE_MIN:
        raise ExchangeError(f"centre: {centre_mm:g} mm up the axis is not inside the object")
    spec = _fit(mesh.corners, size, theta0_rad, centre_mm)
    grid = cast_mesh(mesh, spec, progress)
    mean_mm = spec.step_mm * float(grid.range_steps[_measured(grid)].mean())
    spec = replace(spec, pitch_mm=math.pi * mean_mm / spec.height)
    grid = thin_grid(replace(grid, spec=spec))
    seen = Seen(centre_mm, _hidden(mesh.corners, grid), solid_share(~_measured(grid)))
    if seen.open > OPEN_MAX:
        raise ExchangeError(
            f"mesh: {seen.open:.1%} of all directions meet nothing, more than {OPEN_MAX:.0%}; "
            "it is not closed: close it, or import it as a cylinder (--geometry cylinder)"
        )
    if seen.hidden > HIDDEN_MAX:
        raise ExchangeError(
            f"mesh: {seen.hidden:.1%} of its surface is hidden from its centre at {centre_mm:.1f} mm, more than "
            f"{HIDDEN_MAX:.0%}; it is not star-shaped, and that part would be lost: try another centre "
            "(--centre-height), bring its parts one by one, or what its axis sees of it (--geometry cylinder)"
        )
    return grid, seen


def choose_centre(corners: FloatArray) -> float:
    """A height on the axis inside a closed surface (m, 3, 3), with the least of it turned away. [mm]

    The middle, if it is inside and hardly more is turned away from it. Raises ExchangeError when the axis does not pass
    through the inside.
    """
    low, high = float(corners[..., 2].min()), float(corners[..., 2].max())
    heights = low + (high - low) * (np.arange(CANDIDATES) + 0.5) / CANDIDATES
    turns, away = np.array([turns_round(corners, float(height)) for height in heights]).T
    inside = np.flatnonzero(turns >= INSIDE_MIN)
    if not inside.size:
        raise ExchangeError("mesh: the axis does not pass through the inside of a closed surface; move it (--centre)?")
    good = inside[away[inside] <= away[inside].min() + NEAR_ENOUGH]
    return float(heights[good[np.argmin(np.abs(good - CANDIDATES // 2))]])


def turns_round(corners: FloatArray, centre_mm: float) -> tuple[float, float]:
    """How often a surface (m, 3, 3) encloses a point on the axis, and what share of its area turns away from it.

    1 inside a closed surface, 0 outside, either way its triangles wind. Source: Van Oosterom and Strackee 1983.
    """
    solid = away_mm2 = area_mm2 = 0.0
    for first in range(0, len(corners), FACES_AT_ONCE):
        a, b, c = np.moveaxis(corners[first : first + FACES_AT_ONCE] - np.array([0.0, 0.0, centre_mm]), 1, 0)
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        u, v, w = (np.linalg.norm(corner, axis=1) for corner in (a, b, c))
        ab, bc, ca = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a)))
        solid += float(np.arctan2(volume, u * v * w + ab * w + bc * u + ca * v).sum())
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        away_mm2 += float(area[volume < 0].sum())
        area_mm2 += float(area.sum())
    away = away_mm2 / area_mm2 if area_mm2 else 1.0
    turns = solid / (2 * math.pi)
    return abs(turns), (away if turns >= 0 else 1 - away)


def _fit(corners: FloatArray, size: tuple[int, int, int, int], theta0_rad: float, centre_mm: float) -> GridSpec:
    reach_mm = float(np.linalg.norm(corners - np.array([0.0, 0.0, centre_mm]), axis=-1).max())
    step_mm = max(STEP_MIN_MM, reach_mm / (STEPS_MAX - 1))
    try:
        return GridSpec(*size, step_mm, math.pi * reach_mm / size[1], centre_mm, theta0_rad, "sphere")
    except ValueError as problem:
        raise ExchangeError(f"vertices: their extent makes no grid ({problem}); is the unit right?") from problem


def _measured(grid: Grid) -> BoolArray:
    return np.not_equal(grid.range_steps, VOID)


def solid_share(chosen: BoolArray) -> float:
    """Share of all directions, by solid angle, of those that are set. (H, W)"""
    height = len(chosen)
    solid = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    return float(chosen.mean(axis=1) @ solid / solid.sum())


def _hidden(corners: FloatArray, grid: Grid) -> float:
    """Share of a mesh's area whose middles lie below the surface that the grid has in their direction."""
    nearest = nearest_round(grid)
    hidden_mm2 = area_mm2 = 0.0
    for first in range(0, len(corners), FACES_AT_ONCE):
        faces = corners[first : first + FACES_AT_ONCE] - np.array([0.0, 0.0, grid.spec.z_max_mm])
        middle = faces.mean(axis=1)
        distance = np.linalg.norm(middle, axis=1)
        area = np.linalg.norm(np.cross(faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]), axis=1)
        area, middle, distance = area[distance > 0], middle[distance > 0], distance[distance > 0]
        surface = nearest[DirectionGrid.of(grid.spec).snap(*directions(middle))] * grid.spec.step_mm
        hidden_mm2 += float(area[distance < (1 - DEPTH_TOLERANCE) * surface].sum())
        area_mm2 += float(area.sum())
    return hidden_mm2 / area_mm2 if area_mm2 else 0.0


def nearest_round(grid: Grid) -> StepArray:
    """The least range of each sample and its neighbours, so that a steep side does not count as hidden. (H, W) steps"""
    far = np.where(_measured(grid), grid.range_steps, np.uint16(STEPS_MAX))
    across = np.minimum(np.minimum(np.roll(far, 1, 1), np.roll(far, -1, 1)), far)
    padded = np.pad(across, ((1, 1), (0, 0)), mode="edge")
    return np.asarray(np.minimum(np.minimum(padded[:-2], padded[2:]), across))
