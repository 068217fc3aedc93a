"""A picture of a scan's first view, as the page shows it when nobody has moved the camera.

The page shows it until it has drawn the model itself. So camera, lights and normals are those of
`client/viewer/src/view` (framing.ts, stage.ts, shaders.ts): whoever changes them there changes them here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from exchange.errors import ExchangeError
from exchange.mesh import Band, GridMesh, Seam
from node.coarse import Coarse
from protocol.grid import VOID, FloatArray, Grid, GridSpec, IntArray

HEIGHT = 480
"""Of the picture, whatever is in it. [px]"""
FINER = 2  # drawn so much larger, so that edges are smooth
SPLAT = 3  # a point covers so many pixels of that, squared
POINTS = 1 << 14  # at a time
SPACING = 2.2  # from one to the next, where they are as far away as the axis
QUALITY = 85
ASPECT_MIN, ASPECT_MAX = 0.2, 3.0
FIELD_OF_VIEW_RAD = math.radians(28)
MARGIN = 1.08
USUAL_MM = 500.0  # the scan is drawn as if it were so high
ELEVATION_RAD = 0.1
KEY, FILL = (np.array(light) / np.linalg.norm(light) for light in ((-0.45, 0.55, 0.8), (0.8, 0.05, 0.45)))
WRAP = 0.25  # the key light reaches round
INSIDE = 0.65  # as bright is what is seen from within

ByteArray = NDArray[np.uint8]
Float32Array = NDArray[np.float32]


def draw_picture(coarse: Coarse) -> bytes:
    """WebP, HEIGHT high and as wide as lets the scan fill it both ways; transparent where nothing was measured."""
    coarse = replace(coarse, spec=_usual_size(coarse.spec))
    radius_mm, bottom_mm, top_mm = _bounds(coarse)
    half = math.tan(FIELD_OF_VIEW_RAD / 2)
    aspect = min(max(2 * radius_mm / (top_mm - bottom_mm), ASPECT_MIN), ASPECT_MAX)
    distance_mm = MARGIN * (radius_mm + max((top_mm - bottom_mm) / 2, radius_mm / aspect) / half)
    height, width = FINER * HEIGHT, FINER * round(HEIGHT * aspect)
    picture, depth_mm = np.zeros((height, width, 4), np.uint8), np.full((height, width), np.inf, np.float32)
    for points, normals, colours in _surface(coarse, (height / SPACING, math.pi * width / SPACING)):
        at = _seen_from(points - np.array([0, 0, (bottom_mm + top_mm) / 2]))
        at[:, 2] = distance_mm - at[:, 2]
        x = (at[:, 0] / (at[:, 2] * half * aspect) + 1) * width / 2
        y = (1 - at[:, 1] / (at[:, 2] * half)) * height / 2
        _throw(picture, depth_mm, (y.astype(np.int64), x.astype(np.int64)), at[:, 2], _lit(colours, normals, at))
    return _packed(picture)


def _usual_size(spec: GridSpec) -> GridSpec:
    """A picture shows no size; with other rows, a pitch at a bound of what a GridSpec takes would be beyond it."""
    scale = min(USUAL_MM / (spec.height * spec.pitch_mm), USUAL_MM / spec.step_mm)
    return replace(spec, step_mm=scale * spec.step_mm, pitch_mm=scale * spec.pitch_mm, z_max_mm=0.0)


def _bounds(coarse: Coarse) -> tuple[float, float, float]:
    """How far from the axis, how low and how high something was measured. [mm]"""
    spec, rows = coarse.spec, np.flatnonzero(coarse.measured.any(axis=1))
    if not rows.size:
        return 1.0, spec.z_max_mm - spec.height * spec.pitch_mm, spec.z_max_mm
    most_mm = coarse.range_steps.max(axis=1)[rows] * spec.step_mm
    edges = np.array([rows, rows + 1]) / len(coarse.range_steps)
    if spec.geometry == "cylinder":
        heights_mm = spec.z_max_mm - edges * spec.height * spec.pitch_mm
    else:
        heights_mm = spec.z_max_mm + most_mm * np.cos(np.pi * edges)
        most_mm = most_mm * np.sin(np.pi * edges.mean(axis=0))
    return float(most_mm.max()), float(heights_mm.min()), float(heights_mm.max())


def _surface(coarse: Coarse, least: tuple[float, float]) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Points on it [mm], normals and colours, (n, 3) each, some rows at a time.

    least : how many rows and columns there are in all. Between cells range is interpolated as in a client's model;
    normals are those of the cells.
    """
    cells = coarse.filled.shape
    finer = [math.ceil(wanted / count) for wanted, count in zip(least, cells, strict=True)]
    measured = np.repeat(np.repeat(coarse.measured, finer[0], 0), finer[1], 1)
    steps = np.rint(_stretched(coarse.filled.astype(np.float32), finer)).astype(np.uint16)
    steps[~measured] = VOID
    try:
        whole = GridMesh(Grid(_spaced(coarse, cells), coarse.filled, coarse.texture), Seam.SHARED)
        mesh = GridMesh(Grid(_spaced(coarse, steps.shape), steps, coarse.texture), Seam.SHARED)
    except ExchangeError:  # nothing spans a surface
        return
    of_cells = np.concatenate([whole.normals(band) for band in whole.bands()]).reshape(*cells, 3)
    for band in mesh.bands(POINTS):
        here = _stretched_rows(of_cells, finer, band)[measured[slice(*band)]].astype(np.float64)
        here /= np.linalg.norm(here, axis=1, keepdims=True)
        yield mesh.positions(band), here, mesh.colours(band).astype(np.float64)


def _spaced(coarse: Coarse, shape: tuple[int, ...]) -> GridSpec:
    """The scan's geometry at so many rows and columns, with the texture of its first view."""
    (height, width), (texture_height, texture_width) = shape, coarse.texture.shape[:2]
    return replace(
        coarse.spec, width=width, height=height, pitch_mm=coarse.spec.pitch_mm * coarse.spec.height / height,
        texture_width=texture_width, texture_height=texture_height,
    )  # fmt: skip


def _stretched(cells: Float32Array, finer: list[int]) -> Float32Array:
    """So many samples instead of each cell, interpolated between their middles; columns are cyclic."""
    padded = np.concatenate([cells[:, -1:], cells, cells[:, :1]], axis=1)
    down, across = finer
    size = across * padded.shape[1], down * padded.shape[0]
    return np.asarray(cv2.resize(padded, size, interpolation=cv2.INTER_LINEAR)[:, across:-across], np.float32)


def _stretched_rows(cells: Float32Array, finer: list[int], band: Band) -> Float32Array:
    """Rows of what `_stretched` would make, of the cells they lie between."""
    down = finer[0]
    first = max(band.first // down - 1, 0)
    above = first * down
    return _stretched(cells[first : -(-band.end // down) + 1], finer)[band.first - above : band.end - above]


def _seen_from(points: FloatArray) -> FloatArray:
    """To the right, up and towards the camera, of what lies round the place that it looks at. (n, 3)"""
    out, round_, up = points.T
    sine, cosine = math.sin(ELEVATION_RAD), math.cos(ELEVATION_RAD)
    return np.stack([round_, cosine * up - sine * out, sine * up + cosine * out], axis=1)


def _throw(
    picture: ByteArray, depth_mm: Float32Array, pixels: tuple[IntArray, IntArray], away_mm: FloatArray,
    shaded: ByteArray,
) -> None:
    """Put points into a picture where they are the nearest yet. pixels : rows, columns."""
    (height, width), (y, x) = depth_mm.shape, pixels
    inside = (x >= SPLAT) & (x < width - SPLAT) & (y >= SPLAT) & (y < height - SPLAT)
    at, away_mm, shaded = (y * width + x)[inside], away_mm[inside].astype(np.float32), shaded[inside]
    reach = range(-(SPLAT // 2), SPLAT // 2 + 1)
    shifts = [down * width + across for down in reach for across in reach]
    nearest, cells = depth_mm.reshape(-1), picture.reshape(-1, 4)
    for shift in shifts:
        np.minimum.at(nearest, at + shift, away_mm)
    for shift in shifts:
        own = nearest[at + shift] == away_mm
        cells[at[own] + shift] = shaded[own]


def _lit(texels: FloatArray, normals: FloatArray, at: FloatArray) -> ByteArray:
    """Colours as the page shades them, RGBA. normals : as the scan lies.  at : from the camera: right, up, away [mm]"""
    facing, sky = _seen_from(normals), normals[:, 2:]
    sight = at * np.array([-1, -1, 1])
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    within = (facing * sight).sum(axis=1, keepdims=True) < 0
    facing, sky = np.where(within, -facing, facing), np.where(within, -sky, sky)
    key = np.maximum(0, (facing @ KEY[:, None] + WRAP) / (1 + WRAP))
    fill = np.maximum(0, facing @ FILL[:, None])
    light = 0.78 * key * [1, 0.975, 0.94] + 0.16 * fill * [0.86, 0.92, 1] + 0.13 + 0.14 * (0.5 + 0.5 * sky)
    between = KEY + sight
    between /= np.linalg.norm(between, axis=1, keepdims=True)
    gloss = 0.018 * np.maximum(0, (facing * between).sum(axis=1, keepdims=True)) ** 24
    lit = texels / 255 * (1.1404 * np.sqrt(light) - 0.1402 * light) + gloss
    shaded = np.full((len(at), 4), 255, np.uint8)
    shaded[:, :3] = np.rint(255 * np.clip(lit * np.where(within, INSIDE, 1), 0, 1))
    return shaded


def _packed(picture: ByteArray) -> bytes:
    """WebP of an RGBA picture that is black where it is transparent, made smaller."""
    small = np.asarray(cv2.resize(picture, None, fx=1 / FINER, fy=1 / FINER, interpolation=cv2.INTER_AREA), np.float32)
    small[..., :3] *= np.float32(255) / np.maximum(small[..., 3:], np.float32(1))
    bgra = np.rint(small[..., [2, 1, 0, 3]]).astype(np.uint8)
    _, coded = cv2.imencode(".webp", bgra, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return coded.tobytes()
