"""Triangles of any mesh, seen along rays towards the axis or a centre on it, as a grid.

A ray of a regular grid stands at a known angle and height, so nothing has to be searched: each triangle is tried on the
rays inside its own bounds in angle and height, and the outermost hit wins. In the vertical half plane of a ray with
the unit vectors e = (cos a, sin a) and t = (-sin a, cos a), a corner P lies at (s, z) = (t.P, P_z); the ray meets the
triangle where its barycentric coordinates there put (0, z_ray), at the range sum b_i (e.P_i). Corners of neighbouring
triangles give edge functions that are exactly opposite, so no ray slips between them. From a centre it is the same with
other coordinates: in the half plane, P lies so far across the ray and so far along it.

Rays are worked off in bands of rows and triangles in batches: memory is bounded by the mesh and a batch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from exchange.errors import ExchangeError
from exchange.rays import LevelRays, Rays, StarRays, rays_of
from protocol.grid import STEPS_MAX, BoolArray, FloatArray, Grid, GridSpec, ImageArray, IntArray, mm_to_steps

BAND_RAYS = 1 << 19
BATCH_TRIALS = 1 << 19
TRIALS_MAX = 4_000_000_000
STEP_MIN_MM = 0.001
PIXEL_SLACK = 1e-6  # samples: a corner on a ray stays on it when rounded
CAP_SLACK = 1e-6  # rad: the same for a cap's edge
TINY = 1e-12
EDGE_SLACK = 1e-4  # share of a triangle's height: the same for a ray along a free edge, in coordinates kept as float32

Progress = Callable[[float], object]


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles in the turntable's frame: the axis is z, up; millimetres.

    corners : (m, 3, 3) float64: face, corner, xyz.
    image : (m,) int, which of `images` colours a face at the texture coordinates uv (m, 3, 2) (v up, as in OBJ), or -1:
    its corners' own colours (m, 3, 3) uint8 do.    images : (h, w, 3) uint8 RGB each.
    """

    corners: FloatArray
    image: IntArray
    uv: NDArray[np.float32]
    colours: ImageArray
    images: tuple[ImageArray, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Bounds:
    """First and last column and row of the rays each face may meet. (m,) int64; columns run on past the seam."""

    left: IntArray
    right: IntArray
    top: IntArray
    bottom: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """What each ray of a band met first. radius_mm : (n,) float64, NaN = nothing. face : (n,). weight : (n, 3)"""

    radius_mm: FloatArray
    face: IntArray
    weight: FloatArray


def fit_spec(positions: FloatArray, size: tuple[int, int, int, int], theta0_rad: float = 0.0) -> GridSpec:
    """The grid that holds every position (..., 3) [mm]. size : W, H, Wt, Ht. Raises ExchangeError when none can."""
    if not positions.size:
        raise ExchangeError("vertices: none")
    if not np.isfinite(positions).all():
        raise ExchangeError("vertices: a coordinate is not finite")
    z_min_mm, z_max_mm = float(positions[..., 2].min()), float(positions[..., 2].max())
    radius_mm = float(np.hypot(positions[..., 0], positions[..., 1]).max())
    step_mm = max(STEP_MIN_MM, radius_mm / (STEPS_MAX - 1))
    width, height, texture_width, texture_height = size
    try:
        pitch_mm = (z_max_mm - z_min_mm) / height
        return GridSpec(width, height, texture_width, texture_height, step_mm, pitch_mm, z_max_mm, theta0_rad)
    except ValueError as problem:
        raise ExchangeError(f"vertices: their extent makes no grid ({problem}); is the unit right?") from problem


def cast_mesh(mesh: Mesh, spec: GridSpec, progress: Progress = lambda share: None) -> Grid:
    """Range and colour of the outermost surface at every sample and texel of a grid; void and black where none is.

    progress : called with the share done, 0..1.
    Raises ExchangeError for a mesh that meets no ray, or needs more than TRIALS_MAX trials.
    """
    ranges, texels = rays_of(spec, spec.width, spec.height), rays_of(spec, spec.texture_width, spec.texture_height)
    share = ranges.columns * ranges.rows / (ranges.columns * ranges.rows + texels.columns * texels.rows)
    radius_mm = np.full((spec.height, spec.width), np.nan)
    for rows, hits in _cast(mesh, ranges, lambda done: progress(share * done)):
        radius_mm[rows] = hits.radius_mm.reshape(-1, spec.width)
    if np.isnan(radius_mm).all():
        raise ExchangeError("mesh: no ray towards the axis meets it")
    texture = np.zeros((spec.texture_height, spec.texture_width, 3), np.uint8)
    for rows, hits in _cast(mesh, texels, lambda done: progress(share + (1 - share) * done)):
        texture[rows] = _colours(mesh, hits).reshape(-1, spec.texture_width, 3)
    return Grid(spec, to_steps(radius_mm, spec.step_mm), texture)


def to_steps(radius_mm: FloatArray, step_mm: float) -> NDArray[np.uint16]:
    """Ranges as steps, same shape. What is nearer to the axis than half a step stays measured, at one step.

    Raises ExchangeError for a range that takes more steps than there are.
    """
    try:
        return mm_to_steps(np.maximum(radius_mm, step_mm), step_mm)  # NaN stays NaN
    except ValueError as problem:
        raise ExchangeError(f"vertices: {problem}") from problem


def _cast(mesh: Mesh, lattice: Rays, progress: Progress) -> Iterator[tuple[slice, _Hits]]:
    """The rows of a lattice in bands, each with what its rays hit."""
    bounds = _bounds(mesh.corners, lattice)
    trials = float(np.sum((bounds.right - bounds.left + 1.0) * np.maximum(bounds.bottom - bounds.top + 1, 0)))
    if trials > TRIALS_MAX:
        raise ExchangeError(
            f"mesh: {len(mesh.corners)} faces need {trials:.3g} trials, at most {TRIALS_MAX}; reduce it"
        )
    height = max(1, BAND_RAYS // lattice.columns)
    for first in range(0, lattice.rows, height):
        rows = slice(first, min(first + height, lattice.rows))
        yield rows, _hit_band(mesh.corners, lattice, bounds, rows)
        progress(rows.stop / lattice.rows)


def _bounds(corners: FloatArray, rays: Rays) -> _Bounds:
    """Rays each face may meet."""
    return _level_bounds(corners, rays) if isinstance(rays, LevelRays) else _cap_bounds(corners, rays)


def _level_bounds(corners: FloatArray, lattice: LevelRays) -> _Bounds:
    """Rays each face may meet. A face round the axis, or with an edge through it, is tried at every angle."""
    turn = lattice.columns / (2 * math.pi)
    at = (np.arctan2(corners[..., 1], corners[..., 0]) - lattice.theta0_rad) * turn - 0.5
    edges = np.roll(at, -1, axis=1) - at
    edges -= lattice.columns * np.rint(edges / lattice.columns)
    second, third = at[:, 0] + edges[:, 0], at[:, 0] + edges[:, 0] + edges[:, 1]
    across = np.stack([at[:, 0], second, third], axis=1)
    everywhere = (np.abs(edges.sum(axis=1)) > 0.5) | (np.abs(edges) > lattice.columns * (0.5 - 1e-9)).any(axis=1)
    down = (lattice.z_max_mm - corners[..., 2]) / lattice.pitch_mm - 0.5
    left, right = _whole(across)
    top, bottom = _whole(down)
    right = np.minimum(right, left + lattice.columns - 1)
    left, right = np.where(everywhere, 0, left), np.where(everywhere, lattice.columns - 1, right)
    return _Bounds(left, right, np.maximum(top, 0), np.minimum(bottom, lattice.rows - 1))


def _cap_bounds(corners: FloatArray, star: StarRays) -> _Bounds:
    """Rays each face may meet: those into a cap round its corners, as the centre sees it."""
    towards = corners - np.array([0.0, 0.0, star.centre_mm])
    towards /= np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), TINY)
    middle = towards.sum(axis=1)
    length = np.linalg.norm(middle, axis=-1)
    middle /= np.maximum(length, TINY)[:, None]
    radius = np.arccos(np.clip(np.einsum("fcx,fx->fc", towards, middle).min(axis=1), -1, 1)) + CAP_SLACK
    polar = np.arctan2(np.hypot(middle[:, 0], middle[:, 1]), middle[:, 2])
    turn = star.columns / (2 * math.pi)
    across = (np.arctan2(middle[:, 1], middle[:, 0]) - star.theta0_rad) * turn - 0.5
    everything = (length < TINY) | (radius >= np.pi / 2)
    everywhere = everything | (polar <= radius) | (np.pi - polar <= radius)
    half = turn * np.arcsin(np.where(everywhere, 0, np.sin(radius) / np.maximum(np.sin(polar), np.sin(radius))))
    left, right = _whole(np.stack([across - half, across + half], axis=1))
    down = star.rows / np.pi * np.stack([polar - radius, polar + radius], axis=1) - 0.5
    top, bottom = _whole(down)
    left, right = np.where(everywhere, 0, left), np.where(everywhere, star.columns - 1, right)
    top, bottom = np.where(everything, 0, np.maximum(top, 0)), np.where(everything, star.rows - 1, bottom)
    return _Bounds(left, np.minimum(right, left + star.columns - 1), top, np.minimum(bottom, star.rows - 1))


def _whole(places: FloatArray) -> tuple[IntArray, IntArray]:
    """First and last whole number between the corners of each face."""
    first = np.ceil(places.min(axis=1) - PIXEL_SLACK)
    last = np.floor(places.max(axis=1) + PIXEL_SLACK)
    return first.astype(np.int64), last.astype(np.int64)


def _hit_band(corners: FloatArray, lattice: Rays, bounds: _Bounds, rows: slice) -> _Hits:
    rays = (rows.stop - rows.start) * lattice.columns
    hits = _Hits(np.full(rays, np.nan), np.zeros(rays, np.int64), np.zeros((rays, 3)))
    top, bottom = np.maximum(bounds.top, rows.start), np.minimum(bounds.bottom, rows.stop - 1)
    faces = np.flatnonzero((bottom >= top) & (bounds.right >= bounds.left))
    wide, high = (bounds.right - bounds.left + 1)[faces], (bottom - top + 1)[faces]
    for batch in _batches(wide * high):
        face, inside = _expand(wide[batch] * high[batch])
        row, column = np.divmod(inside, wide[batch][face])
        face = faces[batch][face]
        row, column = row + top[face], (column + bounds.left[face]) % lattice.columns
        _keep_outermost(
            hits, (row - rows.start) * lattice.columns + column, face, *_meet(corners, lattice, face, row, column)
        )
    return hits


def _batches(trials: IntArray) -> Iterator[slice]:
    """Runs of faces with about BATCH_TRIALS trials each."""
    ends = np.cumsum(trials)
    first = 0
    while first < len(trials):
        done = int(ends[first - 1]) if first else 0
        last = max(first + 1, int(np.searchsorted(ends, done + BATCH_TRIALS, "right")))
        yield slice(first, last)
        first = last


def _expand(counts: IntArray) -> tuple[IntArray, IntArray]:
    """Each item as often as it counts, and the number of each within its item."""
    item = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    return item, np.arange(len(item)) - starts[item]


def _meet(
    corners: FloatArray, lattice: Rays, face: IntArray, row: IntArray, column: IntArray
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Whether each ray meets its face, at what range, and with what weights of the corners."""
    angle = lattice.angle_rad(np.arange(lattice.columns))
    cos, sin = np.cos(angle)[column], np.sin(angle)[column]
    x, y, z = (corners[face, :, axis].T for axis in range(3))
    aside = y * cos - x * sin
    above, along = lattice.from_ray(x * cos + y * sin, z, row)
    edge = np.stack([aside[i] * above[j] - aside[j] * above[i] for i, j in ((1, 2), (2, 0), (0, 1))])
    area = edge.sum(axis=0)
    flat = area == 0  # seen edge-on
    weight = edge / np.where(flat, 1, area)
    met = ~flat & (weight >= -EDGE_SLACK).all(axis=0)
    weight = np.clip(weight, 0, 1)
    weight /= np.where(met, weight.sum(axis=0), 1)
    radius_mm = (weight * along).sum(axis=0)
    return met & (radius_mm > 0), radius_mm, weight


def _keep_outermost(
    hits: _Hits, ray: IntArray, face: IntArray, met: BoolArray, radius_mm: FloatArray, weight: FloatArray
) -> None:
    better = np.flatnonzero(met & ~(radius_mm <= hits.radius_mm[ray]))
    better = better[np.argsort(radius_mm[better], kind="stable")]  # of several on one ray the last is kept
    where = ray[better]
    hits.radius_mm[where] = radius_mm[better]
    hits.face[where] = face[better]
    hits.weight[where] = weight[:, better].T


def _colours(mesh: Mesh, hits: _Hits) -> ImageArray:
    """Colour at each hit, black where there is none. (n, 3) uint8 RGB"""
    colours = np.zeros((len(hits.face), 3), np.uint8)
    hit = ~np.isnan(hits.radius_mm)
    image = np.where(hit, mesh.image[hits.face], -2)
    for number in np.unique(image[hit]):
        chosen = image == number
        face, weight = hits.face[chosen], hits.weight[chosen][..., None]
        if number < 0:
            colours[chosen] = np.rint((mesh.colours[face] * weight).sum(axis=1))
        else:
            colours[chosen] = _sample(mesh.images[number], (mesh.uv[face] * weight).sum(axis=1))
    return colours


def _sample(image: ImageArray, uv: FloatArray) -> ImageArray:
    """An image at texture coordinates (n, 2), v up, bilinear; it repeats across and down, as renderers have it."""
    height, width = image.shape[:2]
    x, y = uv[:, 0] * width - 0.5, (1 - uv[:, 1]) * height - 0.5
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    across, down = (x - left)[:, None], (y - top)[:, None]
    columns, rows = (left % width, (left + 1) % width), _rows(top, height)
    upper, lower = (image[row, columns[0]] * (1 - across) + image[row, columns[1]] * across for row in rows)
    sampled: NDArray[Any] = np.rint(upper * (1 - down) + lower * down)
    return sampled.astype(np.uint8)


def _rows(top: IntArray, height: int) -> tuple[IntArray, IntArray]:
    """Rows above and below a place. Within half a texel of an edge there is no neighbour to blend with."""
    wrapped = np.where((top < -1) | (top >= height), top % height, top)
    return np.maximum(wrapped, 0), np.minimum(wrapped + 1, height - 1)
