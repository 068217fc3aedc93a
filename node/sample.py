"""The values a refinement carries, gathered from a scan: the node's half of protocol.reconstruct.

Range values are point samples of the scan, voids filled. Texture values are averages over cells; at spacing 1 a cell is
a texel. Source: REQUIREMENTS F-07b.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from node.library import Scan
from protocol.grid import VOID, BoolArray, ImageArray, IntArray, StepArray
from protocol.lattice import QUARTERS, Axis
from protocol.reconstruct import Selection, Window, cut, every

FILL_CELL = 8  # texels: 4 spare 1% of the bytes and take half as long again


def range_samples(scan: Scan, selection: Selection) -> tuple[StepArray, BoolArray]:
    """Filled range at the transmitted positions, and which of these values anyone will see. sample_shape each.

    Seen are samples of adopted blocks that are measured or, where cells between samples hang on them, near such.
    """
    lattice, shape = selection.lattice, selection.lattice.shape
    rows = _run(lattice.y.border[selection.y.sample] // 2)
    columns = _run(lattice.x.border[selection.x.sample] // 2 % shape.own_width * shape.stride)
    seen = np.asarray(scan.range_steps[rows][:, columns]) != VOID
    if lattice.parameters.half_spacing > 2:
        seen = cv2.dilate(seen.view(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)
    if not selection.adopted.all():
        seen &= _stencil(selection)
    return np.asarray(scan.filled[rows][:, columns]), seen


def _run(index: IntArray) -> IntArray | slice:
    """The same indices as a slice, where their steps are equal: a view then, instead of a gather."""
    if index.size < 2:
        return index
    steps = np.diff(index)
    if steps[0] > 0 and np.all(steps == steps[0]):
        return slice(int(index[0]), int(index[-1]) + 1, int(steps[0]))
    return index


def _stencil(selection: Selection) -> BoolArray:
    """Which transmitted samples are corners of an adopted cell's stencil. sample_shape bool."""
    if _is_every_cell(selection.y) and _is_every_cell(selection.x):
        return selection.seen_cells()
    return _spread(_spread(selection.adopted, selection.y).T, selection.x).T


def _is_every_cell(window: Window) -> bool:
    """Whether its samples are its positions, one by one and in their order."""
    spaced = window.sample.size == window.low.size and bool((window.whole == QUARTERS).all())
    return spaced and bool((np.diff(window.low, prepend=0) >= 0).all())


def _spread(blocks: BoolArray, window: Window) -> BoolArray:
    """Whether a sample of an axis hangs on any block that is true. (blocks, n) to (samples, n) bool.

    Samples follow each other, so each block hangs on a run of them, all round one that may begin before sample 0.
    """
    count, samples = window.size.size, window.sample.size
    if count == 1:
        return blocks.repeat(samples, axis=0)
    stop = np.cumsum(window.size)
    last = stop - 1 + window.beyond
    begin, low = window.low[stop - window.size], window.low[last]
    end = np.where(window.part[last] > 0, window.high[last], low)
    begin, end = begin - samples * (begin > low), end + samples * (end < low)
    upto = np.zeros((count + 1, blocks.shape[1]), np.int32)
    np.cumsum(blocks, axis=0, out=upto[1:])
    hangs = np.zeros((samples, blocks.shape[1]), np.bool_)
    for turned in (0, -samples, samples) if begin[0] < 0 or end[-1] >= samples else (0,):
        sample = np.arange(turned, turned + samples)
        first, behind = np.searchsorted(end, sample), np.searchsorted(begin, sample, side="right")
        hangs |= upto[behind] > upto[first]
    return hangs


def void_cells(scan: Scan, selection: Selection) -> BoolArray:
    """Which cells of a selection's patch are void, of those that are adopted or next to it. (rows, columns) bool."""
    void = np.asarray(cut(scan.range_steps, selection)) == VOID
    if void.any() and not selection.adopted.all():
        void &= selection.seen_cells()
    return np.asarray(void, np.bool_)


def texture_samples(scan: Scan, selection: Selection) -> ImageArray:
    """Mean colour of each transmitted cell. sample_shape + (3,) uint8; smoothly continued where nobody looks."""
    texels = _cell_means(scan, selection)
    return texels if selection.adopted.all() else smoothed(texels, _stencil(selection))


def smoothed(texels: ImageArray, seen: BoolArray, cell: int = FILL_CELL) -> ImageArray:
    """Texels with those unseen taken from means of what is seen round them, ever wider ones: what a wavelet codes in
    few bytes. The nearest seen texel's colour instead took a fifth more for a whole patch.

    cell : side of the smallest that are averaged, a power of two.
    """
    height, width = seen.shape
    cells = -(-height // cell), -(-width // cell)
    whole = cells[0] * cell, cells[1] * cell
    mask = seen.view(np.uint8)
    known, share = np.zeros((*whole, 3), np.uint8), np.zeros(whole, np.uint8)
    cv2.copyTo(np.ascontiguousarray(texels), mask, known[:height, :width])
    share[:height, :width] = mask * np.uint8(255)
    total, seen_share = (_shrunk(image, cell).astype(np.float32) for image in (known, share))
    means = np.clip(_means(total, seen_share / np.float32(255)), 0, 255).astype(np.uint8)
    alike = max(cell // 2, 1)  # rows: to interpolate each takes twice the time
    filled = cv2.resize(means, (whole[1], whole[0] // alike), interpolation=cv2.INTER_LINEAR)
    filled = filled.repeat(alike, axis=0)[:height, :width]
    cv2.copyTo(known[:height, :width], mask, filled)
    return np.asarray(filled, np.uint8)


def _shrunk(image: NDArray[np.uint8], cell: int) -> NDArray[np.uint8]:
    """Means of square cells: halving again and again is what OpenCV does quickest."""
    while cell > 1:
        size = image.shape[1] // 2, image.shape[0] // 2
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8).reshape(
            *size[::-1], *image.shape[2:]
        )
        cell //= 2
    return image


def _means(total: NDArray[np.float32], share: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean colours of cells of which a share (h, w) was seen; where none was, interpolated between cells twice as wide.

    total : (h, w, 3) the mean with what is unseen black.
    """
    height, width = share.shape
    some = share > 0
    means = cv2.divide(total, cv2.merge((np.maximum(share, np.float32(1e-9)),) * 3)).reshape(total.shape)
    if some.all() or height * width == 1:
        return np.asarray(means, np.float32)
    size = -(-width // 2), -(-height // 2)
    wider = (np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), np.float32) for part in (total, share))
    between = _means(next(wider).reshape(*size[::-1], 3), next(wider).reshape(size[::-1]))
    around = cv2.resize(between, (width, height), interpolation=cv2.INTER_LINEAR).reshape(total.shape)
    cv2.copyTo(means, some.view(np.uint8), around)
    return np.asarray(around, np.float32)


def _cell_means(scan: Scan, selection: Selection) -> ImageArray:
    lattice = selection.lattice
    texture = _Texture.of(scan, lattice.shape.stride)
    y, x = _Cells(lattice.y, selection.y.sample), _Cells(lattice.x, selection.x.sample)
    spacing = lattice.parameters.half_spacing
    core_y, core_x = y.plateau(spacing), x.plateau(spacing)
    core_borders = y.border[core_y.start : core_y.stop + 1], x.border[core_x.start : core_x.stop + 1]
    core = _plateau_means(texture, *core_borders, spacing)
    if core.shape[:2] == (y.border.size - 1, x.border.size - 1):
        return core[_run(y.wanted)][:, _run(x.wanted)]
    texels = np.empty((y.border.size - 1, x.border.size - 1, 3), np.uint8)
    texels[core_y, core_x] = core
    for rows in (slice(0, core_y.start), slice(core_y.stop, texels.shape[0])):
        _fill_skirt(texture, texels, y, x, rows, slice(0, texels.shape[1]))
    for columns in (slice(0, core_x.start), slice(core_x.stop, texels.shape[1])):
        _fill_skirt(texture, texels, y, x, core_y, columns)
    return texels[_run(y.wanted)][:, _run(x.wanted)]


@dataclass(frozen=True, slots=True, eq=False)
class _Texture:
    """A texture of which every stride-th column counts, and the same at spacings 1, 2, 4, ..., as far as there are."""

    texels: ImageArray
    stride: int
    pyramid: tuple[ImageArray, ...]

    @classmethod
    def of(cls, scan: Scan, stride: int) -> _Texture:
        return cls(scan.texture, stride, scan.pyramid[: None if stride == 1 else 1])

    def crop(self, top: int, height: int, left: int, width: int, level: int = 0) -> ImageArray:
        """A rectangle of texels that count, at spacing 2^level; cyclic in x, below the last row that row goes on.

        Returns (height, width, 3) uint8.
        """
        image, stride = self.pyramid[level], self.stride
        rows, columns = image.shape[0], image.shape[1] // stride
        left %= columns
        if top + height > rows:
            image = image[np.minimum(np.arange(top, top + height), rows - 1)]
            top = 0
        image = image[top : top + height]
        if left + width <= columns:
            return np.asarray(every(image, slice(left, left + width), stride))
        parts = [every(image, slice(left, columns), stride)]
        width -= columns - left
        while width > 0:
            parts.append(every(image, slice(0, min(width, columns)), stride))
            width -= columns
        return np.concatenate(parts, axis=1)


class _Cells:
    """One axis' cells round the wanted ones. border : (n + 1,) half texels.  wanted : indices into them."""

    def __init__(self, axis: Axis, sample: IntArray) -> None:
        self.border = axis.border[sample[0] : sample[-1] + 2]
        self.wanted = sample - sample[0]

    def plateau(self, half_spacing: int) -> slice:
        """The longest run of cells as wide as the plateau's."""
        same = np.concatenate([[False], np.diff(self.border) == half_spacing, [False]])
        edges = np.flatnonzero(np.diff(same.astype(np.int8)))
        if not edges.size:
            return slice(0, 0)
        starts, stops = edges[::2], edges[1::2]
        longest = int(np.argmax(stops - starts))
        return slice(int(starts[longest]), int(stops[longest]))


def _plateau_means(texture: _Texture, y: IntArray, x: IntArray, half_spacing: int) -> ImageArray:
    """Means over equal cells whose borders (half texels) are given. (len(y) - 1, len(x) - 1, 3) uint8."""
    rows, columns = y.size - 1, x.size - 1
    if rows < 1 or columns < 1:
        return np.empty((max(rows, 0), max(columns, 0), 3), np.uint8)
    step = half_spacing // 2
    height, width = texture.texels.shape[0], texture.texels.shape[1] // texture.stride
    on_pyramid = half_spacing in (2, 4, 8, 16) and step.bit_length() <= len(texture.pyramid)
    aligned = not (y[0] % half_spacing or x[0] % half_spacing or width % step)
    if on_pyramid and aligned and y[-1] <= 2 * height:
        top, left = int(y[0]) // half_spacing, int(x[0]) // half_spacing
        return texture.crop(top, rows, left, columns, step.bit_length() - 1)
    even_rows, even_columns = rows + rows % 2, columns + columns % 2  # so that cells of 1.5 texels end on whole ones
    source = texture.crop(
        int(y[0]) // 2, even_rows * half_spacing // 2, int(x[0]) // 2, even_columns * half_spacing // 2
    )
    return np.asarray(cv2.resize(source, (even_columns, even_rows), interpolation=cv2.INTER_AREA)[:rows, :columns])


def _fill_skirt(
    texture: _Texture, texels: ImageArray, y: _Cells, x: _Cells, rows: slice, columns: slice
) -> None:
    """Mean colour of the cells in a strip, the narrow direction first. Half-texel borders are taken as whole ones."""
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return
    y_border = y.border[rows.start : rows.stop + 1] // 2
    x_border = x.border[columns.start : columns.stop + 1] // 2
    height, width = int(y_border[-1] - y_border[0]), int(x_border[-1] - x_border[0])
    source = texture.crop(int(y_border[0]), height, int(x_border[0]), width)
    if rows.stop - rows.start <= columns.stop - columns.start:
        strip = _column_means(_row_means(source, y_border - y_border[0]), x_border - x_border[0])
    else:
        strip = _row_means(_column_means(source, x_border - x_border[0]), y_border - y_border[0])
    texels[rows, columns] = strip


def _row_means(image: ImageArray, border: IntArray) -> ImageArray:
    """Mean of each run of rows between whole borders. (len(border) - 1, columns, 3) uint8."""
    counts = np.diff(border)
    if np.all(counts == 1):
        return image
    sums = np.add.reduceat(image, border[:-1], axis=0, dtype=np.uint32)
    counts = counts.astype(np.uint32)[:, None, None]
    return ((2 * sums + counts) // (2 * counts)).astype(np.uint8)


def _column_means(image: ImageArray, border: IntArray) -> ImageArray:
    return np.swapaxes(_row_means(np.swapaxes(image, 0, 1), border), 0, 1)
