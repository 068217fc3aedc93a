"""A cylindrical scan as a sphere: its sides resampled column by column, its ends closed where they are round.

What the sphere has comes, in this order, from the scan's own samples; from other sweeps of the same object, where the
scan saw nothing or saw the surface edge-on; from its round ends (exchange.ends); and from caps, if they are asked for.
Directions that nothing of it fills are void. `Closed` says what is hidden, what is open, and how much was made up.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from exchange.cast import cast_mesh, to_steps
from exchange.ends import POINTS, SIDES, End, find_end, lid_colours, paint_lid, with_end
from exchange.errors import ExchangeError
from exchange.fit import Fit
from exchange.profile import columns_mm, meet, profiles, sample_rows, strips
from exchange.rays import LevelRays, StarRays
from exchange.star import (
    CANDIDATES,
    DEPTH_TOLERANCE,
    HIDDEN_MAX,
    INSIDE_MIN,
    NEAR_ENOUGH,
    OPEN_MAX,
    nearest_round,
    solid_share,
)
from exchange.sweeps import Sweep, surface_towards
from protocol.grid import HEIGHT_MAX, STEPS_MAX, VOID, BoolArray, FloatArray, Grid, GridSpec, ImageArray, StepArray
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid

COLUMNS_LOOKED_AT = 180  # tell where a centre may stand and how many rows are needed
EDGE_ON_ROWS = 4.0  # samples further apart than that, as the centre sees them, say little of what is between them
REACH_MARGIN = 1.25  # of what the scan reaches: so much more may another sweep
ROWS_OF = 8  # rows come in whole blocks
TEXEL_ROWS_OF = 16
_NO_TEXTURE = np.zeros((1, 1, 3), np.uint8)

Progress = Callable[[float], object]
SourceArray = NDArray[np.uint8]  # of _Source


@dataclass(frozen=True, slots=True)
class Closed:
    """What a scan became as a sphere. hidden : share of its surface.  All others : shares of all directions.

    centre_mm : height of the centre.  open : void.  swept : from the other sweeps.  rounded : on round ends, which meet
    the axis within a row.  capped : made up.  misfit_mm : how far those sweeps lie from the scan, root mean square.
    """

    centre_mm: float
    hidden: float
    open: float
    swept: float
    rounded: float
    capped: float
    misfit_mm: float = 0.0

    def __str__(self) -> str:
        parts = (
            (self.hidden, "of the surface hidden from there"),
            (self.open, "of all directions void"),
            (self.swept, f"from other sweeps, which fit within {self.misfit_mm:.2g} mm"),
            (self.rounded, "between the last row of a round end and the axis"),
            (self.capped, "made up: caps over open ends"),
        )
        said = "".join(f"; {share:.1%} {what}" for share, what in parts if share >= 0.0005)
        return f"a cylinder seen from a centre at {self.centre_mm:.1f} mm{said}"


class _Source(IntEnum):
    """Where the range in a direction comes from."""

    VOID = 0
    SAMPLES = 1
    EDGE_ON = 2
    ROUND = 3
    CAP = 4
    SWEEP = 5  # the first of them, the second 6


def close_scan(
    grid: Grid,
    sweeps: Sequence[Sweep] = (),
    *,
    caps: bool = False,
    centre_mm: float | None = None,
    progress: Progress = lambda share: None,
) -> tuple[Grid, Closed]:
    """A cylindrical scan as a spherical one of its resolution.

    sweeps : of the same object when it was tipped; they are fitted to the scan (exchange.fit).  caps : make up a lid
    over an end that is open.
    centre_mm : height of the centre on the axis; None: chosen.  progress : told the share done, 0..1.
    Raises ExchangeError for a grid that is no cylinder, a centre outside, more than HIDDEN_MAX hidden from it, or a
    sweep that does not fit.
    """
    if grid.spec.geometry != "cylinder":
        raise ExchangeError(f"scan: is a {grid.spec.geometry} already")
    top, bottom = (find_end(grid.spec, grid.range_steps, side, cap=caps) for side in SIDES)
    view = _View(grid, (top, bottom), _fitted(grid, (top, bottom), centre_mm, REACH_MARGIN if sweeps else 1.0))
    fits = [sweep.fitted(grid) for sweep in sweeps]
    steps, source = _ranges(view)
    progress(0.2)
    others = [_look_at(view, sweep, found, source) for sweep, found in zip(sweeps, fits, strict=True)]
    _fill(steps, source, others)
    mean_mm = view.spec.step_mm * float(steps.mean(where=steps != VOID))
    spec = replace(view.spec, pitch_mm=math.pi * mean_mm / view.spec.height)
    texture = _texture(view, source, others, lambda share: progress(0.2 + 0.8 * share))
    closed = thin_grid(Grid(spec, steps, texture))
    hidden = _hidden(view, closed)
    if hidden > HIDDEN_MAX:
        raise ExchangeError(
            f"scan: {hidden:.1%} of its surface is hidden from its centre, more than {HIDDEN_MAX:.0%}; "
            "it is not star-shaped, and that part would be lost: try another centre (--centre-height), or keep it "
            "as a cylinder"
        )
    swept, rounded, capped = map(solid_share, (source >= _Source.SWEEP, source == _Source.ROUND, source == _Source.CAP))
    is_void = np.equal(closed.range_steps, VOID)
    misfit_mm = max((found.misfit_mm for found in fits), default=0.0)
    return closed, Closed(spec.z_max_mm, hidden, solid_share(is_void), swept, rounded, capped, misfit_mm)


def closes(grid: Grid) -> bool:
    """Whether a cylinder is a closed object seen from nearly everywhere: OPEN_MAX void, HIDDEN_MAX hidden at most."""
    every = max(1, grid.spec.width // COLUMNS_LOOKED_AT)
    steps = np.ascontiguousarray(grid.range_steps[:, ::every])
    few = Grid(replace(grid.spec, width=steps.shape[1], texture_width=1, texture_height=1), steps, _NO_TEXTURE)
    try:
        return close_scan(few)[1].open <= OPEN_MAX
    except ExchangeError:
        return False


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Columns as the centre sees them, each (rows, n). range_mm : NaN = void.  row : of the scan.  rim : share of the
    way from the axis to it, on an end.  source : _Source.  lower : on the lower end."""

    range_mm: FloatArray
    row: FloatArray
    rim: FloatArray
    source: SourceArray
    lower: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """A cylinder with its ends, and the sphere it is to become."""

    grid: Grid
    ends: tuple[End | None, End | None]
    spec: GridSpec

    def strips(self, rows: int, width: int) -> list[slice]:
        """Columns that are worked on at a time."""
        return strips(width, max(rows, self.grid.spec.height + 2 * POINTS))

    def points(self, columns: slice, width: int) -> tuple[FloatArray, FloatArray]:
        """The profiles of columns, from the axis over the top end, down the sides, and back to the axis."""
        spec = self.grid.spec
        range_mm = columns_mm(spec, self.grid.range_steps, width, columns)
        top, bottom = (with_end(spec, range_mm, side, end) for side, end in zip(SIDES, self.ends, strict=True))
        sides = profiles(spec, range_mm)
        out, z = (np.concatenate([t, s, b[::-1]]) for t, s, b in zip(top, sides, bottom, strict=True))
        return out, z

    def look(self, columns: slice, width: int, rows: int) -> _Seen:
        """Along the directions of some columns, of `width` all round, in all of `rows` rows."""
        height = self.grid.spec.height
        rays = StarRays(width, rows, self.spec.theta0_rad, self.spec.z_max_mm)
        out, z = self.points(columns, width)
        range_mm, place = meet(out, z, rays)
        void = np.isnan(place)
        at = np.where(void, POINTS, place)
        upper, lower = at < POINTS - 1, at > POINTS + height
        edge_on = self._edge_on(rays.row_at(out, z), at)
        source = np.where(edge_on, np.uint8(_Source.EDGE_ON), np.uint8(_Source.SAMPLES))
        for end, there in zip(self.ends, (upper, lower), strict=True):
            source[there] = _Source.CAP if end is not None and end.capped else _Source.ROUND
        source[void] = _Source.VOID
        rim = np.where(upper, at, POINTS + height + POINTS - 1 - at) / (POINTS - 1)
        return _Seen(range_mm, np.clip(at - POINTS, 0, height - 1), np.clip(rim, 0, 1), source, lower)

    @staticmethod
    def _edge_on(rows: FloatArray, at: FloatArray) -> BoolArray:
        piece = np.minimum(at.astype(np.int64), len(rows) - 2)
        far: BoolArray = np.take_along_axis(np.abs(np.diff(rows, axis=0)) > EDGE_ON_ROWS, piece, axis=0)
        return far


def _ranges(view: _View) -> tuple[StepArray, SourceArray]:
    """Range of all directions, and where it comes from. (H, W) each"""
    width, height = view.spec.width, view.spec.height
    steps, source = np.zeros((height, width), np.uint16), np.zeros((height, width), np.uint8)
    for columns in view.strips(height, width):
        seen = view.look(columns, width, height)
        steps[:, columns], source[:, columns] = to_steps(seen.range_mm, view.spec.step_mm), seen.source
    if not steps.any():
        raise ExchangeError("scan: nothing is measured")
    return steps, source


def _look_at(view: _View, sweep: Sweep, found: Fit, source: SourceArray) -> Grid | None:
    """A sweep as the centre sees it, where the scan itself has nothing good."""
    spec = view.spec
    poor = np.not_equal(source, _Source.SAMPLES)
    mesh = surface_towards(sweep, found, poor, DirectionGrid.of(spec), spec.z_max_mm)
    return None if mesh is None else cast_mesh(mesh, spec)


def _fill(steps: StepArray, source: SourceArray, others: Sequence[Grid | None]) -> None:
    """Take from sweeps what the scan does not have, or saw edge-on."""
    for n, other in enumerate(others):
        if other is not None:
            taken = (source != _Source.SAMPLES) & (source < _Source.SWEEP) & (other.range_steps != VOID)
            steps[taken], source[taken] = other.range_steps[taken], _Source.SWEEP + n


def _texture(view: _View, ranges: SourceArray, others: Sequence[Grid | None], progress: Progress) -> ImageArray:
    """Colours of all directions, black where nothing is. (Ht, Wt, 3) uint8   ranges : where range comes from."""
    width, height = view.spec.texture_width, view.spec.texture_height
    texture = np.zeros((height, width, 3), np.uint8)
    source = np.zeros((height, width), np.uint8)
    lids = [lid_colours(view.grid, side) for side in SIDES]
    rows_of = view.grid.spec.texture_height / view.grid.spec.height
    for columns in view.strips(height, width):
        seen = view.look(columns, width, height)
        strip = sample_rows(view.grid.texture[:, columns], (seen.row + 0.5) * rows_of - 0.5)
        ending = (seen.source == _Source.ROUND) | (seen.source == _Source.CAP)
        for lid, lower in zip(lids, (False, True), strict=True):
            there = ending & (seen.lower == lower)
            if there.any():
                strip[there] = paint_lid(lid, seen.rim, columns)[there]
        strip[seen.source == _Source.VOID] = 0
        texture[:, columns], source[:, columns] = strip, seen.source
        progress(columns.stop / width)
    for n, other in enumerate(others):
        if other is not None:
            _paint(texture, source == _Source.VOID, ranges == _Source.SWEEP + n, other.texture)
    return texture


def _paint(texture: ImageArray, void: BoolArray, swept: BoolArray, other: ImageArray) -> None:
    """Take a sweep's colours where its range was taken, and for void texels beside that."""
    height, width = void.shape
    cells = np.pad(swept.astype(np.uint8), ((0, 0), (1, 1)), mode="wrap")
    beside = cv2.dilate(cells, np.ones((3, 3), np.uint8))[:, 1:-1]
    size = width, height
    here, near = (cv2.resize(of, size, interpolation=cv2.INTER_NEAREST) > 0 for of in (cells[:, 1:-1], beside))
    taken = here | (near & void)
    texture[taken] = other[taken]


def _hidden(view: _View, closed: Grid) -> float:
    """Share of the scan's own area whose middles lie below the surface that the sphere has in their direction."""
    spec = closed.spec
    nearest = nearest_round(closed)
    rays = StarRays(spec.width, spec.height, spec.theta0_rad, spec.z_max_mm)
    hidden_mm2 = area_mm2 = 0.0
    for columns in view.strips(spec.height, spec.width):
        range_mm = columns_mm(view.grid.spec, view.grid.range_steps, spec.width, columns)
        out, z = profiles(view.grid.spec, range_mm)
        area, (out, z) = _area(out, z), ((a[1:] + a[:-1]) / 2 for a in (out, z))
        row = np.clip(np.rint(np.nan_to_num(rays.row_at(out, z))), 0, spec.height - 1).astype(np.int64)
        surface = np.take_along_axis(nearest[:, columns], row, axis=0) * spec.step_mm
        below = np.hypot(out, z - spec.z_max_mm) < (1 - DEPTH_TOLERANCE) * surface
        hidden_mm2 += float(area[below].sum())
        area_mm2 += float(area.sum())
    return hidden_mm2 / area_mm2 if area_mm2 else 0.0


def _area(out: FloatArray, z: FloatArray) -> FloatArray:
    """Area of each piece of profiles (k, n), by the angle of a column; 0 where there is none. (k - 1, n) [mm2]"""
    return np.nan_to_num(np.hypot(np.diff(out, axis=0), np.diff(z, axis=0)) * (out[1:] + out[:-1]) / 2)


# -- the sphere it is to become ----------------------------------------------------------------------------------------


def _fitted(
    grid: Grid, ends: tuple[End | None, End | None], centre_mm: float | None, margin: float
) -> GridSpec:
    """Geometry of a sphere about a centre that is inside, as dense as the scan. Raises ExchangeError."""
    spec = grid.spec
    every = max(1, spec.width // COLUMNS_LOOKED_AT)
    few = replace(spec, width=len(range(0, spec.width, every)))
    view = _View(Grid(few, grid.range_steps[:, ::every], grid.texture), ends, spec)
    out, z = view.points(slice(0, few.width), few.width)
    if np.isnan(out).all():
        raise ExchangeError("scan: nothing is measured")
    if centre_mm is None:
        centre_mm = _choose_centre(out, z)
    elif _inside(out, z, centre_mm) < INSIDE_MIN:
        raise ExchangeError(f"centre: {centre_mm:g} mm up the axis is not inside the object")
    turn = np.abs(np.diff(np.arctan2(out, z - centre_mm)[POINTS:-POINTS], axis=0)) / np.pi
    turn = turn[turn > 0]
    rows = 1 / float(np.median(turn)) if turn.size else spec.height
    height = _whole(rows, ROWS_OF)
    texture_height = _whole(height * spec.texture_height / spec.height, TEXEL_ROWS_OF)
    reach_mm = margin * _reach(grid, ends, centre_mm)
    step_mm = max(spec.step_mm, reach_mm / (STEPS_MAX - 1))
    try:
        return GridSpec(
            spec.width, height, spec.texture_width, texture_height, step_mm, math.pi * reach_mm / height, centre_mm,
            spec.theta0_rad, "sphere",
        )  # fmt: skip
    except ValueError as problem:
        raise ExchangeError(f"scan: its extent makes no sphere ({problem})") from problem


def _choose_centre(out: FloatArray, z: FloatArray) -> float:
    """A height on the axis inside, with the least of the profiles turned away; the middle, if it is hardly worse."""
    low, high = float(np.nanmin(z)), float(np.nanmax(z))
    heights = low + (high - low) * (np.arange(CANDIDATES) + 0.5) / CANDIDATES
    inside = np.flatnonzero([_inside(out, z, height) >= INSIDE_MIN for height in heights])
    if not inside.size:
        raise ExchangeError("scan: the axis does not pass through the inside of the object; stand it on the middle")
    away = np.array([_turned_away(out, z, heights[i]) for i in inside])
    good = inside[away <= away.min() + NEAR_ENOUGH]
    return float(heights[good[np.argmin(np.abs(good - CANDIDATES // 2))]])


def _inside(out: FloatArray, z: FloatArray, centre_mm: float) -> float:
    """Share of the bearings in which a level ray from the axis meets the surface: over half of them from inside."""
    met, _ = meet(out, z, LevelRays(out.shape[1], 1, 0.0, centre_mm + 0.5, 1.0))
    return float(np.isfinite(met).mean())


def _turned_away(out: FloatArray, z: FloatArray, centre_mm: float) -> float:
    area = _area(out, z)
    back = np.diff(np.arctan2(out, z - centre_mm), axis=0) < 0
    return float(area[back].sum() / area.sum()) if area.any() else 1.0


def _whole(rows: float, of: int) -> int:
    return min(max(of * math.ceil(rows / of), of), HEIGHT_MAX)


def _reach(grid: Grid, ends: tuple[End | None, End | None], centre_mm: float) -> float:
    """The furthest that anything is from the centre. [mm]"""
    spec = grid.spec
    furthest = grid.range_steps.max(axis=1) * spec.step_mm
    up = spec.height_mm(np.arange(spec.height)) - centre_mm
    reach = float(np.hypot(furthest, up)[furthest > 0].max())
    return max([reach, *(abs(end.apex_mm - centre_mm) for end in ends if end is not None)])
