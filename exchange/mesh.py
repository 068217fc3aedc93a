"""The triangles of a grid, a band of rows at a time, so that a writer never holds more than a band.

Frame: the turntable's. x and y across, z up along the axis, millimetres; triangles wind counter-clockwise seen from
outside. The grid is cyclic: the last column is joined to the first. A quad with four measured corners becomes two
triangles along the diagonal that differs less in range, one with three becomes one, any other is a hole. On a
sphere the first and the last row are closed over their pole, if all of the row is measured.

Texture coordinates (u, v) have v = 0 at the texture's top edge and u = 0 at its left edge, so a texel's centre is half
a texel in, as in protocol/grid.py: u = (column + 0.5) / W. At the seam u runs on past 1 and needs a repeating sampler.
A format with one index for position and texture gets a copy of column 0 behind the last (`Seam.DOUBLED`, the very
same positions and normals); any other shares the vertices (`Seam.SHARED`), closed in its indices too.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from exchange.errors import ExchangeError
from protocol.grid import VOID, BoolArray, FloatArray, Grid, ImageArray, IntArray

BAND_CELLS = 1 << 17
COLUMNS_MIN = 3
ROWS_MIN = 2

Float32Array = NDArray[np.float32]


class Seam(Enum):
    """Whether column 0 stands once, or a second time behind the last column."""

    SHARED = 0
    DOUBLED = 1


class Band(NamedTuple):
    """Rows first .. end - 1."""

    first: int
    end: int


class GridMesh:
    """The triangles over one grid. vertices, faces : how many there are.

    Vertices are the measured samples, row after row; faces index them.
    Raises ExchangeError for a grid that spans no surface.
    """

    def __init__(self, grid: Grid, seam: Seam) -> None:
        spec = grid.spec
        if spec.width < COLUMNS_MIN or spec.height < ROWS_MIN:
            raise ExchangeError(f"a grid of {spec.width} x {spec.height} samples spans no surface")
        self.grid = grid
        self._columns = np.arange(spec.width + (seam is Seam.DOUBLED)) % spec.width
        self._u = (np.arange(self._columns.size) + 0.5) / spec.width
        angle = spec.angle_rad(self._columns)
        self._cos, self._sin = np.cos(angle), np.sin(angle)
        per_row = np.count_nonzero(grid.range_steps, axis=1).astype(np.int64)
        if seam is Seam.DOUBLED:
            per_row += grid.range_steps[:, 0] != VOID
        self._row_start = np.concatenate([[0], np.cumsum(per_row)])
        self.vertices = int(self._row_start[-1])
        self._sin_v, self._cos_v = _polar(grid)
        self.faces = sum(int(np.count_nonzero(self._triangles(band))) for band in self._quad_bands())
        self.faces += sum(len(lid) for lid in self._lids())
        if not self.faces:
            raise ExchangeError("nothing is measured that spans a surface")

    def bands(self, cells: int = BAND_CELLS) -> Iterator[Band]:
        """Rows in bands of so many cells that partition the grid."""
        return _bands(self.grid.spec.height, self.grid.spec.width, cells)

    def positions(self, band: Band) -> FloatArray:
        """Vertices of a band. (n, 3) float64 [mm]"""
        rows, columns = self._measured(band)
        spec = self.grid.spec
        radius = self.grid.range_steps[rows, self._columns[columns]] * spec.step_mm
        if spec.geometry == "cylinder":
            return np.stack([radius * self._cos[columns], radius * self._sin[columns], spec.height_mm(rows)], axis=1)
        out, up = radius * self._sin_v[rows], spec.z_max_mm + radius * self._cos_v[rows]
        return np.stack([out * self._cos[columns], out * self._sin[columns], up], axis=1)

    def normals(self, band: Band) -> Float32Array:
        """Unit normals of a band's vertices, outward, from the slopes towards measured neighbours. (n, 3)

        With the unit vectors e_r, e_a, e_z of the cylinder and r = r(a, z) the surface's normal is
        r e_r - (dr/da) e_a - r (dr/dz) e_z. With those of the sphere, e_v downwards, and r = r(a, v) it is
        r e_r - (dr/da) / sin v e_a - (dr/dv) e_v.
        """
        spec, steps = self.grid.spec, self.grid.range_steps
        low, high = max(band.first - 1, 0), min(band.end + 1, spec.height)
        radius = steps[low:high] * np.float32(spec.step_mm)
        measured = radius > 0
        core = slice(band.first - low, band.end - low)
        turn = 2 * np.pi / spec.width
        around = _slope(np.roll(radius, 1, 1), radius, np.roll(radius, -1, 1), turn)[core]
        padded = np.pad(radius, ((1, 1), (0, 0)))
        sphere = spec.geometry == "sphere"
        down = _slope(padded[:-2], radius, padded[2:], np.pi / spec.height if sphere else spec.pitch_mm)[core]
        rows, columns = np.nonzero(measured[core][:, self._columns])
        at = rows, self._columns[columns]
        out, across, up = radius[core][at], -around[at], radius[core][at] * down[at]
        if sphere:
            sin_v, cos_v = (of[rows + band.first].astype(np.float32) for of in (self._sin_v, self._cos_v))
            across /= sin_v
            out, up = out * sin_v - down[at] * cos_v, out * cos_v + down[at] * sin_v
        cos, sin = self._cos[columns], self._sin[columns]
        normal = np.stack([out * cos - across * sin, out * sin + across * cos, up], axis=1)
        unit: Float32Array = (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)
        return unit

    def texture_coordinates(self, band: Band) -> FloatArray:
        """(u, v) of a band's vertices, v down from the texture's top edge. (n, 2)"""
        rows, columns = self._measured(band)
        return np.stack([self._u[columns], (rows + 0.5) / self.grid.spec.height], axis=1)

    def colours(self, band: Band) -> ImageArray:
        """The texture at a band's vertices, interpolated between texels. (n, 3) uint8 RGB"""
        spec = self.grid.spec
        v = (np.arange(band.first, band.end) + 0.5) / spec.height
        measured = self.grid.range_steps[slice(*band), self._columns] != VOID
        colours: ImageArray = sample_lattice(self.grid.texture, self._u, v)[measured]
        return colours

    def face_bands(self) -> Iterator[IntArray]:
        """All faces in order, as vertex numbers. (m, 3) each"""
        for band in self._quad_bands():
            yield self._number(band)[self._corners(band)]
        yield from self._lids()

    def triangle_bands(self) -> Iterator[FloatArray]:
        """All faces in order, as corners. (m, 3, 3) each: face, corner, xyz [mm]"""
        for band in self._quad_bands():
            numbers = self._number(band)[self._corners(band)] - self._row_start[band.first]
            yield self.positions(band)[numbers]
        for lid in self._lids():
            band = Band(0, 1) if lid[0, 0] == 0 else Band(self.grid.spec.height - 1, self.grid.spec.height)
            yield self.positions(band)[lid - self._row_start[band.first]]

    def textured_bands(self) -> Iterator[tuple[FloatArray, FloatArray]]:
        """The same without lids, and their texture coordinates. (m, 3, 3), (m, 3, 2) each"""
        for band in self._quad_bands():
            numbers = self._number(band)[self._corners(band)] - self._row_start[band.first]
            yield self.positions(band)[numbers], self.texture_coordinates(band)[numbers]

    def _lids(self) -> Iterator[IntArray]:
        """The triangles that close a sphere's measured first and last rows over the poles, as vertex numbers. (m, 3)"""
        spec = self.grid.spec
        if spec.geometry == "cylinder":
            return
        fan = np.arange(1, spec.width - 1)
        for row, after, before in ((0, 0, 1), (spec.height - 1, 1, 0)):
            if self.grid.range_steps[row].all():
                yield self._row_start[row] + np.stack([0 * fan, fan + after, fan + before], axis=1)

    def _measured(self, band: Band) -> tuple[IntArray, IntArray]:
        """Row and column (of ours) of each vertex in a band."""
        rows, columns = np.nonzero(self.grid.range_steps[slice(*band)][:, self._columns])
        return rows + band.first, columns

    def _quad_bands(self) -> Iterator[Band]:
        """Bands that share a row with the next: every quad is in one of them."""
        for band in _bands(self.grid.spec.height - 1, self.grid.spec.width):
            yield Band(band.first, band.end + 1)

    def _closed(self, band: Band) -> IntArray:
        """Steps of a band's rows with column 0 again behind the last. (rows, W + 1)"""
        steps = self.grid.range_steps[slice(*band)].astype(np.int64)
        return np.concatenate([steps, steps[:, :1]], axis=1)

    def _number(self, band: Band) -> IntArray:
        """Vertex numbers over the closed columns; undefined where nothing is measured. (rows, W + 1)"""
        measured = self.grid.range_steps[slice(*band), self._columns] != VOID
        number = np.cumsum(measured, axis=1) - 1 + self._row_start[slice(*band), None]
        return number if self._columns.size > self.grid.spec.width else np.concatenate([number, number[:, :1]], 1)

    def _triangles(self, band: Band) -> BoolArray:
        """Which of the four triangles over each quad exist: without corner b, c, d, a. (quads, 4)"""
        steps = self._closed(band)
        a, b, c, d = steps[:-1, :-1], steps[:-1, 1:], steps[1:, :-1], steps[1:, 1:]
        has_a, has_b, has_c, has_d = a != VOID, b != VOID, c != VOID, d != VOID
        along_ad = np.abs(a - d) <= np.abs(b - c)
        exist = [
            has_a & has_c & has_d & (along_ad | ~has_b),
            has_a & has_d & has_b & (along_ad | ~has_c),
            has_a & has_c & has_b & ~(along_ad & has_d),
            has_b & has_c & has_d & ~(along_ad & has_a),
        ]
        return np.stack(exist, axis=-1).reshape(-1, 4)

    def _corners(self, band: Band) -> tuple[IntArray, IntArray]:
        """Row and closed column of each face's corners, counter-clockwise seen from outside. (m, 3) each"""
        quad, kind = np.nonzero(self._triangles(band))
        row, column = np.divmod(quad, self.grid.spec.width)
        return row[:, None] + CORNER_ROWS[kind], column[:, None] + CORNER_COLUMNS[kind]


#   a - b     Triangles of a quad, in the order of `_triangles`: acd, adb, acb, bcd.
#   |   |     b is counter-clockwise of a (to its right seen from outside), c below it.
#   c - d
CORNER_ROWS = np.array([[0, 1, 1], [0, 1, 0], [0, 1, 0], [0, 1, 1]])
CORNER_COLUMNS = np.array([[0, 0, 1], [0, 1, 1], [0, 0, 1], [1, 0, 1]])


def extent_mm(grid: Grid) -> tuple[float, float, float]:
    """How large what a grid has measured is, along x, y and up; zeros where it has measured nothing. [mm]"""
    spec = grid.spec
    rows, columns = np.nonzero(grid.range_steps)
    if not rows.size:
        return 0.0, 0.0, 0.0
    radius = grid.range_steps[rows, columns] * spec.step_mm
    sin_v, cos_v = _polar(grid)
    is_sphere = spec.geometry == "sphere"
    out, up = (radius * sin_v[rows], radius * cos_v[rows]) if is_sphere else (radius, spec.height_mm(rows))
    angle = spec.angle_rad(np.arange(spec.width))
    x, y = out * np.cos(angle)[columns], out * np.sin(angle)[columns]
    return float(np.ptp(x)), float(np.ptp(y)), float(np.ptp(up))


def sample_lattice(texture: ImageArray, u: FloatArray, v: FloatArray) -> ImageArray:
    """A texture at every (u, v) of a lattice, bilinear, cyclic in u, clamped in v. (len(v), len(u), 3) uint8"""
    height, width = texture.shape[:2]
    x, y = u * width - 0.5, np.clip(v * height - 0.5, 0, height - 1)
    left, top = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    across, down = (x - left).astype(np.float32)[None, :, None], (y - top).astype(np.float32)[:, None, None]
    right, bottom = (left + 1) % width, np.minimum(top + 1, height - 1)
    upper, lower = (_blend(texture[rows][:, left % width], texture[rows][:, right], across) for rows in (top, bottom))
    return np.rint(_blend(upper, lower, down)).astype(np.uint8)


def _blend(first: NDArray[Any], second: NDArray[Any], weight: Float32Array) -> Float32Array:
    blended: Float32Array = first.astype(np.float32) * (1 - weight) + second.astype(np.float32) * weight
    return blended


def _polar(grid: Grid) -> tuple[FloatArray, FloatArray]:
    """Sine and cosine of the rows' polar angles, of a sphere. (H,) each"""
    polar = np.pi * (np.arange(grid.spec.height) + 0.5) / grid.spec.height
    return np.sin(polar), np.cos(polar)


def _slope(before: Float32Array, here: Float32Array, after: Float32Array, spacing: float) -> Float32Array:
    """Slope between the measured ones of three neighbours; 0 for a sample that stands alone."""
    has_before, has_after = before > 0, after > 0
    rise = np.where(has_after, after, here) - np.where(has_before, before, here)
    run = (has_before.astype(np.float32) + has_after) * np.float32(spacing)
    slope: Float32Array = np.divide(rise, run, out=np.zeros_like(here), where=run > 0)
    return slope


def _bands(rows: int, columns: int, cells: int = BAND_CELLS) -> Iterator[Band]:
    height = max(1, cells // columns)
    for first in range(0, rows, height):
        yield Band(first, min(first + height, rows))
