"""What a finished scan gets once, before anyone asks: its first view, its voids filled, its texture at every scale.

All averages are exact: areas are counted in whole units of 1/(cells) of a sample, sums are integers, and one rounding
ends each mean. So every machine computes the same first view, and a scan rolled by whole coarse cells has its coarse
grid rolled by as many.

Source: REQUIREMENTS F-11 (the coarse grid the dense one starts from), AT-04, AT-08.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import TypeVar

import cv2
import numpy as np

from protocol.grid import VOID, BoolArray, Grid, GridSpec, ImageArray, IntArray, StepArray

FIRST_VIEW_BYTES = 32768
RANGE_SPACING_MIN = 8
TEXTURE_SPACING_MIN = 4
BYTES_PER_RANGE_CELL = 4
BYTES_PER_TEXEL = 1
SLACK = 1e-9  # so that no machine's sine decides

Array = TypeVar("Array", StepArray, ImageArray)


@dataclass(frozen=True, slots=True, eq=False)
class Coarse:
    """The first view of a scan: what every client starts from.

    range_steps : (h, w) uint16, 0 where less than half of the cell was measured.
    filled : (h, w) uint16, the same with voids taken from the nearest measured cell: what codes well.
    texture : (ht, wt, 3) uint8 RGB.
    Their shapes are the truth about the spacing, which need not be whole.
    """

    spec: GridSpec
    range_steps: StepArray
    filled: StepArray
    texture: ImageArray

    @property
    def measured(self) -> BoolArray:
        """Cells that hold a range. (h, w) bool."""
        return np.not_equal(self.range_steps, VOID)

    @property
    def range_spacing(self) -> tuple[Fraction, Fraction]:
        """Rx = W/w and Ry = H/h. [range samples]"""
        rows, columns = self.range_steps.shape
        return Fraction(self.spec.width, columns), Fraction(self.spec.height, rows)

    @property
    def texture_spacing(self) -> tuple[Fraction, Fraction]:
        """Wt/wt and Ht/ht. [texels]"""
        rows, columns = self.texture.shape[:2]
        return Fraction(self.spec.texture_width, columns), Fraction(self.spec.texture_height, rows)


def build_coarse(grid: Grid, first_view_bytes: int = FIRST_VIEW_BYTES) -> Coarse:
    """The first view of a grid, in a number of samples that should code into first_view_bytes.

    The samples are bounded here (32 KiB: 8192 cells, 32768 texels); the bytes are whoever encodes them's to keep.
    """
    s = grid.spec
    cells = coarse_shape(s.height, s.width, RANGE_SPACING_MIN, first_view_bytes // BYTES_PER_RANGE_CELL)
    texels = coarse_shape(s.texture_height, s.texture_width, TEXTURE_SPACING_MIN, first_view_bytes // BYTES_PER_TEXEL)
    range_steps = average_range(grid.range_steps, *cells)
    texture = average_texture(grid.texture, grid.range_steps != VOID, *texels)
    if s.geometry == "sphere":
        range_steps, texture = evened(range_steps), evened(texture)
    return Coarse(s, _read_only(range_steps), fill_voids(range_steps), _read_only(texture))


def coarse_shape(height: int, width: int, spacing_min: int, cells_max: int) -> tuple[int, int]:
    """Rows and columns of a coarse grid: the smallest spacing, spacing_min doubled, that needs at most cells_max cells.

    Raises ValueError when cells_max < 1.
    """
    if cells_max < 1:
        raise ValueError(f"a coarse grid needs at least one cell, got room for {cells_max}")
    spacing = spacing_min
    while (rows := -(-height // spacing)) * (columns := -(-width // spacing)) > cells_max:
        spacing *= 2
    return rows, columns


def average_range(range_steps: StepArray, rows: int, columns: int) -> StepArray:
    """Mean of the measured samples in each of rows x columns equal cells, by area. (rows, columns) uint16.

    A cell is void when less than half of its area was measured.
    """
    height, width = range_steps.shape
    means = np.empty((rows, columns), np.uint16)
    for row, band in enumerate(_bands(height, rows)):
        steps = range_steps[band.rows]
        area = _cell_sums((steps != VOID).view(np.uint8), band, columns)
        total = _cell_sums(steps, band, columns)
        means[row] = np.where(2 * area < height * width, VOID, _rounded(total, np.maximum(area, 1)))
    return means


def average_texture(texture: ImageArray, measured: BoolArray, rows: int, columns: int) -> ImageArray:
    """Mean colour of each of rows x columns equal cells, by area. (rows, columns, 3) uint8.

    measured : (H, W) bool over the range grid. Texels whose centre lies on a void cell count only where a coarse cell
    has no others.
    """
    height, width = texture.shape[:2]
    mask_row = _nearest(height, measured.shape[0])
    mask_wide = np.take(measured, _nearest(width, measured.shape[1]), axis=1).view(np.uint8)
    means = np.empty((rows, columns, 3), np.uint8)
    for row, band in enumerate(_bands(height, rows)):
        texels = np.asarray(texture[band.rows])
        mask = mask_wide[mask_row[band.rows]]
        area = _cell_sums(mask, band, columns)[:, None]
        total = _cell_sums(np.asarray(cv2.copyTo(texels, mask), np.uint8), band, columns)
        if not area.all():
            total = np.where(area == 0, _cell_sums(texels, band, columns), total)
        means[row] = _rounded(total, np.where(area == 0, height * width, area))
    return means


def evened(cells: Array) -> Array:
    """Cells of directions, with those of rows near a pole averaged along them over as much as a row is high.

    There they are wedges, narrow and long; what differs from one to the next would be seen as spokes.
    cells : (h, w) uint16, voids left out and left void, or (h, w, 3) uint8.
    """
    rows, columns = cells.shape[:2]
    narrow = columns / (2 * rows * np.sin(np.pi * (np.arange(rows) + 0.5) / rows))  # cells as wide as a row is high
    averaged = np.array(cells)
    for row, half in enumerate(np.floor((narrow - 1) / 2 + SLACK).astype(np.int64).tolist()):
        if half > 0:
            line = cells[row].reshape(columns, -1).astype(np.int64)
            seen = (line != VOID).any(axis=1, keepdims=True).astype(np.int64) if cells.ndim == 2 else np.ones_like(line)
            total, count = _sums_round(line, half), _sums_round(seen, half)
            averaged[row] = np.where(seen > 0, _rounded(total, np.maximum(count, 1)), VOID).reshape(cells[row].shape)
    return averaged


def _sums_round(line: IntArray, half: int) -> IntArray:
    """Sum over each value of a circle and `half` on either side. (w, n) int64"""
    upto = np.cumsum(np.concatenate([np.zeros_like(line[:1]), line[-half:], line, line[:half]]), axis=0)
    return np.asarray(upto[2 * half + 1 :] - upto[: -2 * half - 1])


def fill_voids(range_steps: StepArray) -> StepArray:
    """Range with every void given the value of the nearest measured sample, cyclic in x. (H, W) uint16, read-only.

    Nearest by OpenCV's 5x5 chamfer distance (within 2% of Euclid's). Without one measured sample nothing is filled.
    """
    void = (range_steps == VOID).view(np.uint8)
    if void.all() or not void.any():
        return _read_only(np.array(range_steps))
    columns = range_steps.shape[1]
    pad = min(_reach(void), columns)
    wide = np.concatenate([range_steps[:, columns - pad :], range_steps, range_steps[:, :pad]], axis=1)
    _, label = cv2.distanceTransformWithLabels(
        (wide == VOID).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    source = np.concatenate([[np.uint16(VOID)], wide[wide != VOID]])  # labels count measured samples from 1
    filled = np.array(range_steps)
    at = void.view(np.bool_)
    filled[at] = source[label[:, pad : pad + columns][at]]
    return _read_only(filled)


def build_pyramid(texture: ImageArray, spacing_max: int) -> tuple[ImageArray, ...]:
    """The texture at spacings 1, 2, 4, ... up to spacing_max: each (ceil(Ht/2^k), ceil(Wt/2^k), 3) uint8, read-only.

    Entry k holds averages over cells of 2^k x 2^k texels that start at texel 0; cells cut by the right or bottom edge
    weigh their last column or row double at each halving.
    """
    levels = [_read_only(texture)]
    while 2 ** len(levels) <= spacing_max:
        levels.append(_read_only(_halved(levels[-1])))
    return tuple(levels)


@dataclass(frozen=True, slots=True)
class _Band:
    """The samples one coarse row touches, and what part of the outermost two it takes (of `whole`)."""

    rows: slice
    first: int
    last: int
    whole: int


def _bands(size: int, cells: int) -> Iterator[_Band]:
    """The cells of an axis of `size` samples: cell c spans c*size/cells to (c + 1)*size/cells."""
    for cell in range(cells):
        start, first_cut = divmod(cell * size, cells)
        stop, last_part = divmod((cell + 1) * size, cells)
        yield _Band(slice(start, stop + (last_part > 0)), cells - first_cut, last_part or cells, cells)


def _cell_sums(samples: StepArray | ImageArray, band: _Band, columns: int) -> IntArray:
    """Sums over the cells of one coarse row, weighted by area in units of 1/(rows*columns) of a sample.

    samples : (n, W) or (n, W, 3), the rows of the band.  Returns (columns,) or (columns, 3) int64.
    """
    return _column_sums(_row_sum(samples, band), columns)


def _row_sum(samples: StepArray | ImageArray, band: _Band) -> IntArray:
    """Weighted sum over the rows of a band, exactly. (n, W, ...) -> (W, ...) int64."""
    depth = cv2.CV_32S if samples.dtype == np.uint8 else cv2.CV_64F  # both exact: 2^14 rows of 2^16 steps < 2^53
    flat = samples.reshape(samples.shape[0], -1)
    total: IntArray = cv2.reduce(flat, 0, cv2.REDUCE_SUM, dtype=depth)[0].astype(np.int64) * band.whole
    for row, part in ((0, band.first), (-1, band.last)):
        if part < band.whole:
            total -= (band.whole - part) * flat[row].astype(np.int64)
    return total.reshape(samples.shape[1:])


def _column_sums(line: IntArray, cells: int) -> IntArray:
    """Weighted sums over the cells of a line. (W, ...) -> (cells, ...) int64."""
    size = line.shape[0]
    edge, part = np.divmod(np.arange(cells + 1) * size, cells)
    part = part.reshape(-1, *(1,) * (line.ndim - 1))
    beyond = part * line[np.minimum(edge, size - 1)]  # what each edge leaves to the cell on its left; 0 at whole edges
    within: IntArray = cells * np.add.reduceat(line, edge[:-1], axis=0)
    within += beyond[1:] - beyond[:-1]
    return within


def _rounded(total: IntArray, area: IntArray) -> IntArray:
    """total/area, halves up, in integers (F-09c's rule)."""
    return (2 * total + area) // (2 * area)


def _nearest(size: int, other: int) -> IntArray:
    """For each of `size` samples, the sample of an axis of `other` that its centre lies on."""
    return (2 * np.arange(size) + 1) * other // (2 * size)


def _reach(void: ImageArray) -> int:
    """How far sideways the nearest measured sample can be, at most: no distance we use exceeds the city-block one."""
    return math.ceil(float(cv2.distanceTransform(void, cv2.DIST_L1, cv2.DIST_MASK_3).max())) + 1


def _halved(image: ImageArray) -> ImageArray:
    height, width = image.shape[:2]
    if height % 2 or width % 2:
        image = np.asarray(cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE), np.uint8)
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _read_only(array: Array) -> Array:
    view = array.view()
    view.flags.writeable = False
    return view
