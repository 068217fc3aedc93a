"""From what travelled to the dense model: which samples a refinement carries, and the cells it fills with them.

Range is interpolated in integers, so that every client gets the same grid; texture in float32, where a level of
difference does no harm. Adopted blocks are overwritten whole; nothing else changes.

Source: REQUIREMENTS F-08, F-09c, F-11.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.errors import LatticeError
from protocol.grid import VOID, BoolArray, FloatArray, ImageArray, IntArray, StepArray
from protocol.holdings import ChannelHoldings, HashArray, hash_blocks
from protocol.lattice import QUARTERS, Axis, ChannelShape, Lattice
from protocol.rings import Cells, ring_strides, widened

Number = TypeVar("Number", bound=np.number[Any])
BAND_ROWS = 256
_COPIED_MIN = 16  # cells: fewer are interpolated with the others
_SHIFTED_MAX = 1 << 14  # times the largest step is below 2^31
LightArray = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """One axis of a selection: the run of covered blocks round the adopted ones, and the samples they need.

    Positions are a row's own samples (ChannelShape.stride): all of them but on a sphere, and there, where stride > 1,
    `beyond` more than the blocks hold.

    block : (b,) int64 block indices.   size : (b,) int64 positions in each.   start : first position, not wrapped.
    sample : (n,) int64 the lattice's samples that travel, ascending.
    low, high : (cells,) int64 for each position, the two transmitted samples beside it ...
    part, whole : (cells,) int64 ... and its place between them, part / whole.
    """

    block: IntArray
    size: IntArray
    start: int
    sample: IntArray
    low: IntArray
    high: IntArray
    part: IntArray
    whole: IntArray
    beyond: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """What one refinement of a lattice carries. The payload is an image: y.sample by x.sample.

    Its rectangle is all cells of the windows' blocks; a patch of it has rows and columns of own samples, and where
    cells lie between these, one column more.
    adopted : (by, bx) bool over the windows' blocks; the first and last row and column each hold an adopted block.
    """

    lattice: Lattice
    y: Window
    x: Window
    adopted: BoolArray

    @property
    def sample_shape(self) -> tuple[int, int]:
        """Rows and columns of the payload."""
        return self.y.sample.size, self.x.sample.size

    @property
    def samples(self) -> int:
        """Number of values in the payload."""
        return self.y.sample.size * self.x.sample.size

    def adopted_cells(self) -> BoolArray:
        """Which own samples of the windows' rectangle are adopted. (rows, columns) bool, without the column more."""
        return np.repeat(np.repeat(self.adopted, self.x.size, axis=1), self.y.size, axis=0)

    def seen_cells(self) -> BoolArray:
        """The same with those that adopted cells hang on, of a patch. (rows, columns) bool."""
        if not self.x.beyond:
            return self.adopted_cells()
        own = np.repeat(self.adopted, self.x.size, axis=1)
        seen = np.zeros((own.shape[0], own.shape[1] + self.x.beyond), np.bool_)
        seen[:, : own.shape[1]] = own
        seen[:, self.x.beyond :] |= own
        return np.repeat(seen, self.y.size, axis=0)

    def adopted_blocks(self) -> IntArray:
        """Flat indices of the adopted blocks. (n,) int64, in the windows' row order."""
        rows, columns = np.nonzero(self.adopted)
        return self.y.block[rows] * self.lattice.shape.blocks[1] + self.x.block[columns]

    def spans(self) -> Iterator[tuple[slice, slice, slice]]:
        """Where a patch lies: (rows, own columns of the grid, columns of the patch), cut at the seam."""
        width = self.lattice.shape.own_width
        rows = slice(self.y.start, self.y.start + self.y.low.size)
        done = 0
        while done < self.x.low.size:
            column = (self.x.start + done) % width
            run = min(self.x.low.size - done, width - column)
            yield rows, slice(column, column + run), slice(done, done + run)
            done += run


def select(lattice: Lattice, held: ChannelHoldings, rank: int) -> tuple[Selection, BoolArray] | None:
    """What a refinement at `rank` would carry to a client that holds `held`, or None when nothing would be adopted.

    Returns the selection and the adopted blocks over the whole lattice (for ChannelHoldings.adopt).
    """
    adopted = held.adoptable(lattice, rank)
    rows, columns = np.flatnonzero(adopted.any(1)), np.flatnonzero(adopted.any(0))
    if not rows.size:
        return None
    y = _window(lattice.y, int(rows[0]), int(rows[-1]) + 1)
    x = _window(lattice.x, int(columns[0]), int(columns[-1]) + 1, lattice.shape.beyond)
    core = adopted[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Selection(lattice, y, x, core), adopted


@lru_cache(maxsize=64)
def _window(axis: Axis, begin: int, end: int, beyond: int = 0) -> Window:
    begin_at, end_at = int(axis.first[begin]), int(axis.last[end - 1]) + 1
    at = axis.at[begin_at:end_at]
    sample, local = _numbered(axis.sample[begin_at:end_at])
    start = int(axis.start[begin])
    position = QUARTERS * np.arange(start, int(axis.stop[end - 1]) + beyond, dtype=np.int64)
    if at.size == 1:
        zero = np.zeros(position.size, np.int64)
        low, high, part, whole = zero, zero, zero, np.ones_like(zero)
    else:
        index = np.minimum(np.searchsorted(at, position, side="right") - 1, at.size - 2)
        low, high = local[index], local[index + 1]
        part, whole = position - at[index], at[index + 1] - at[index]
    size = axis.stop[begin:end] - axis.start[begin:end]
    return Window(axis.block[begin:end], size, start, sample, low, high, part, whole, beyond)


def _numbered(sample: IntArray) -> tuple[IntArray, IntArray]:
    """Samples once each, ascending, and for each given one its place among them."""
    if sample[-1] - sample[0] == sample.size - 1 and np.all(np.diff(sample) == 1):  # nearly always: a run of them
        return sample, sample - sample[0]
    once, place = np.unique(sample, return_inverse=True)
    return once, place


def range_patch(selection: Selection, range_steps: StepArray) -> StepArray:
    """Dense range of the windows' rectangle from the transmitted samples, by integer bilinear interpolation.

    range_steps : sample_shape uint16, dequantised, without voids.  Returns (rows, columns) uint16.
    A cell between samples z with integer weights w that add up to d is (2 sum(w z) + d) // (2 d). Where d is the same
    small power of two everywhere, that is a shift. Else every product stays below 2^53, so float64 holds it exactly and
    its quotient's floor is the integer one.
    """
    y, x = selection.y, selection.x
    _check_samples(selection, range_steps.shape)
    d = _even_whole(y) * _even_whole(x)
    if 0 < d <= _SHIFTED_MAX and d & (d - 1) == 0:
        weighted = _blend(_blend(range_steps.astype(np.int32), x, 1), y, 0)
        weighted += d >> 1
        weighted >>= d.bit_length() - 1
        return weighted.astype(np.uint16)
    weighted = _blend(_blend(range_steps.astype(np.float64), x, 1), y, 0)
    whole_y, whole_x = (np.where(window.part.any(), window.whole, 1).astype(np.float64) for window in (y, x))
    return _round_ratio(weighted, np.multiply.outer(whole_y, whole_x))


def _even_whole(window: Window) -> int:
    """What all its wholes are; 1 where cells are samples and 0 where wholes differ."""
    if not window.part.any():
        return 1
    return int(window.whole[0]) if (window.whole == window.whole[0]).all() else 0


def _blend(samples: NDArray[Any], window: Window, axis: int) -> NDArray[Any]:
    """Weighted sums along an axis, not yet divided: low (whole - part) + high part; samples where cells are these."""
    low = samples.take(window.low, axis)
    if not window.part.any():
        return low
    along = (1, -1) if axis else (-1, 1)
    part, whole = (number.astype(samples.dtype).reshape(along) for number in (window.part, window.whole))
    high = samples.take(window.high, axis)
    high -= low
    high *= part
    low *= whole
    low += high
    return low


def _round_ratio(numerator: FloatArray, denominator: FloatArray) -> StepArray:
    rounded: StepArray = np.floor((2 * numerator + denominator) / (2 * denominator)).astype(np.uint16)
    return rounded


def texture_patch(selection: Selection, texels: ImageArray) -> ImageArray:
    """Dense texture of the windows' rectangle from the transmitted texels, bilinear, rounded half up.

    texels : sample_shape + (3,) uint8.  Returns (rows, columns, 3) uint8. Works in bands, so memory stays bounded.
    """
    y, x = selection.y, selection.x
    _check_samples(selection, texels.shape[:2])
    if (enlarged := _enlarged(y, x, texels)) is not None:
        return enlarged
    patch = np.empty((y.low.size, x.low.size, 3), np.uint8)
    rows, columns = _copied(y), _copied(x)
    patch[rows, columns] = texels[_samples(y, rows), _samples(x, columns)]
    everywhere = slice(0, x.low.size)
    for rest in (slice(0, rows.start), slice(rows.stop, y.low.size)):
        _fill_between(patch, texels, y, x, rest, everywhere)
    for rest in (slice(0, columns.start), slice(columns.stop, x.low.size)):
        _fill_between(patch, texels, y, x, rows, rest)
    return patch


def _copied(window: Window) -> slice:
    """The longest run of cells that are samples, one by one; none where that is short."""
    follows = np.diff(window.low, prepend=-2) == 1
    breaks = np.flatnonzero(np.concatenate([[True], ~(follows[1:] & (window.part[1:] == 0)), [True]]))
    longest = int(np.argmax(np.diff(breaks)))
    start, stop = int(breaks[longest]), int(breaks[longest + 1])
    start += int(window.part[start] != 0)
    return slice(start, stop) if stop - start >= _COPIED_MIN else slice(0, 0)


def _samples(window: Window, cells: slice) -> slice:
    """The samples that such a run of cells is."""
    first = int(window.low[cells.start]) if cells.stop else 0
    return slice(first, first + cells.stop - cells.start)


def _fill_between(patch: ImageArray, texels: ImageArray, y: Window, x: Window, rows: slice, columns: slice) -> None:
    """Interpolate some rows and columns of a patch."""
    if columns.start == columns.stop:
        return
    part_x, part_y = x.part[columns] / x.whole[columns], y.part / y.whole
    for top in range(rows.start, rows.stop, BAND_ROWS):
        band = slice(top, min(top + BAND_ROWS, rows.stop))
        low, high = y.low[band], y.high[band]
        few = texels[low[0] : high[-1] + 1].astype(np.float32)
        across = _between(few, x.low[columns], x.high[columns], part_x, 1)
        patch[band, columns] = _between(across, low - low[0], high - low[0], part_y[band], 0) + np.float32(0.5)


def _enlarged(y: Window, x: Window, texels: ImageArray) -> ImageArray | None:
    """The same where every cell is as large, 2, 4 or 8 texels: what image libraries do at once. Else None."""
    p = int(x.whole[0]) // QUARTERS
    if p not in (2, 4, 8):
        return None
    low = x.low
    if x.high[-1] < x.low[-1]:  # all round: the last column goes before the first one, the first behind the last
        texels = np.concatenate([texels[:, -1:], texels, texels[:, :1]], axis=1)
        low = np.where(np.arange(low.size) < np.argmin(low), 0, low + 1)
    top, left = _first_texel(y, y.low, p, y.sample.size), _first_texel(x, low, p, texels.shape[1])
    if top is None or left is None:
        return None
    size = texels.shape[1] * p, texels.shape[0] * p
    whole = cv2.resize(texels, size, interpolation=cv2.INTER_LINEAR_EXACT)
    return np.asarray(whole[top : top + y.low.size, left : left + x.low.size])


def _first_texel(window: Window, low: IntArray, p: int, samples: int) -> int | None:
    """Where an axis' positions begin in its samples enlarged p times, if they follow each other there."""
    place = 2 * p * low + 2 * p * window.part // window.whole + p - 1
    regular = (window.whole == QUARTERS * p).all() and (np.diff(place) == 2).all() and (window.low != window.high).all()
    inside = regular and place[0] >= 0 and place[0] % 2 == 0 and place[-1] // 2 < p * samples
    return int(place[0]) // 2 if inside else None


def _between(samples: LightArray, low: IntArray, high: IntArray, part: FloatArray, axis: int) -> LightArray:
    """Linear interpolation along an axis: samples[low], part (n,) of the way to samples[high]."""
    start = samples.take(low, axis)
    if part.any():
        way = samples.take(high, axis)
        way -= start
        way *= np.expand_dims(part.astype(np.float32), (1 - axis, 2))
        start += way
    return start


def paste(dense: Cells, patch: Cells, selection: Selection) -> None:
    """Overwrite the adopted blocks of a dense array with a patch; every other cell stays as it is."""
    stride = selection.lattice.shape.stride
    wide = dense_of(patch, selection)
    where = np.repeat(selection.adopted_cells().view(np.uint8), stride, axis=1)
    whole = bool(selection.adopted.all())
    for rows, columns, source in selection.spans():
        last = min(source.stop, where.shape[1] // stride)
        to = slice(columns.start * stride, (columns.start + last - source.start) * stride)
        of = slice(source.start * stride, last * stride)
        if whole:
            dense[rows, to] = wide[:, of]
        else:
            cv2.copyTo(wide[:, of], where[:, of], dense[rows, to])


def dense_of(patch: Cells, selection: Selection) -> Cells:
    """The windows' rectangle from a patch: cells between a row's own samples are interpolated, as in the scan itself.

    In a strip whose stride was limited a patch has more columns than some rows have samples: only these count there.
    """
    shape, size = selection.lattice.shape, selection.y.size
    if not shape.sphere:
        return patch
    own = ring_strides(shape.width, shape.height, shape.block)[selection.y.block].repeat(size)
    tops = np.flatnonzero(np.diff(own, prepend=0))
    columns = patch.shape[1] - selection.x.beyond
    parts = [
        rows[:, :columns] if stride == 1 else widened(rows[:, :: stride // shape.stride], stride)
        for rows, stride in zip(np.split(patch, tops[1:]), own[tops].tolist(), strict=True)
    ]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def cut(dense: StepArray | ImageArray, selection: Selection) -> StepArray | ImageArray:
    """What a patch would be if it were the dense array's own, the seam joined. (rows, columns, ...) copy."""
    stride = selection.lattice.shape.stride
    return np.concatenate([every(dense[rows], columns, stride) for rows, columns, _ in selection.spans()], axis=1)


def every(rows: StepArray | ImageArray, columns: slice, stride: int) -> StepArray | ImageArray:
    """Some of the columns that are multiples of a stride: rows[:, ::stride][:, columns], but quick for colours."""
    if stride == 1 or rows.ndim == 2:
        return rows[:, ::stride][:, columns]
    wide = rows[:, columns.start * stride : columns.stop * stride]
    size = columns.stop - columns.start, rows.shape[0]
    return np.asarray(cv2.resize(wide, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def content_hashes(patch: StepArray, selection: Selection) -> HashArray:
    """Hashes of the adopted blocks of a range patch, in the order of Selection.adopted_blocks. (n,) uint32."""
    side, stride = selection.lattice.shape.block, selection.lattice.shape.stride
    rows, columns = selection.adopted.shape
    patch = pad_blocks(dense_of(patch, selection), selection.y.size, selection.x.size * stride, side)
    cells = patch.reshape(rows, side, columns, side).transpose(0, 2, 1, 3)
    return hash_blocks(cells[selection.adopted])


def pad_blocks(cells: NDArray[Number], heights: IntArray, widths: IntArray, side: int) -> NDArray[Number]:
    """A rectangle of blocks, cut ones padded with 0 to their full side. heights, widths : cells in each block."""
    if cells.shape == (heights.size * side, widths.size * side):
        return cells
    padded = np.zeros((heights.size * side, widths.size * side), cells.dtype)
    padded[np.ix_(_padded_place(heights, side), _padded_place(widths, side))] = cells
    return padded


def _padded_place(size: IntArray, side: int) -> IntArray:
    """Where each dense position goes when every block is padded to its full side."""
    return np.concatenate([index * side + np.arange(n) for index, n in enumerate(size.tolist())])


def coarse_to_range(coarse_steps: StepArray, shape: ChannelShape) -> StepArray:
    """Dense range from the first view: bilinear between cell centres, voids left out. (H, W) uint16.

    coarse_steps : (h, w) uint16, 0 = void. Position of dense column x in coarse units: ((2x + 1) w - W) / 2W, cyclic;
    rows likewise, clamped. A cell is void iff the nearest coarse cell is (ties: the later one); else
    (2 sum(w z) + d) // (2 d) over the measured ones.
    """
    if coarse_steps.shape != (shape.coarse_height, shape.coarse_width):
        raise LatticeError(f"first view must be {shape.coarse_height} x {shape.coarse_width} range samples")
    x_low, x_high, x_part = _between_centres(shape.width, shape.coarse_width, cyclic=True)
    y_low, y_high, y_part = _between_centres(shape.height, shape.coarse_height, cyclic=False)
    dense = np.empty((shape.height, shape.width), np.uint16)
    columns = np.where(x_part < shape.width, x_low, x_high)
    for top in range(0, shape.height, BAND_ROWS):
        band = slice(top, top + BAND_ROWS)
        total, weight = np.zeros((2, y_low[band].size, shape.width))
        for y, y_weight in ((y_low, 2 * shape.height - y_part), (y_high, y_part)):
            for x, x_weight in ((x_low, 2 * shape.width - x_part), (x_high, x_part)):
                corner = coarse_steps[np.ix_(y[band], x)].astype(np.float64)
                share = np.multiply.outer(y_weight[band], x_weight) * (corner != VOID)
                total += share * corner
                weight += share
        rows = np.where(y_part[band] < shape.height, y_low[band], y_high[band])
        void = coarse_steps[np.ix_(rows, columns)] == VOID
        dense[band] = _round_ratio(np.where(void, VOID, total), np.where(void, 1, weight))
    return dense


def coarse_to_texture(coarse: ImageArray, shape: ChannelShape) -> ImageArray:
    """Dense texture from the first view: bilinear between cell centres, cyclic in x. (Ht, Wt, 3) uint8."""
    if coarse.shape != (shape.coarse_height, shape.coarse_width, 3):
        raise LatticeError(f"first view must be {shape.coarse_height} x {shape.coarse_width} texels")
    # Pad by whole cells that are whole texels too, so that cell centres stay where they are in the enlarged image.
    pad = shape.coarse_width // math.gcd(shape.width, shape.coarse_width)
    wide = np.concatenate([coarse[:, -pad:], coarse, coarse[:, :pad]], axis=1)
    margin = pad * shape.width // shape.coarse_width
    dense = cv2.resize(wide, (shape.width + 2 * margin, shape.height), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(dense[:, margin : margin + shape.width], np.uint8)


def _between_centres(size: int, coarse: int, *, cyclic: bool) -> tuple[IntArray, IntArray, IntArray]:
    """For each dense position the coarse cells beside it and its place between them, in units of 1 / (2 size)."""
    position = (2 * np.arange(size, dtype=np.int64) + 1) * coarse - size
    low = position // (2 * size)
    part = position - low * (2 * size)
    if cyclic:
        return low % coarse, (low + 1) % coarse, part
    return np.clip(low, 0, coarse - 1), np.clip(low + 1, 0, coarse - 1), part


def _check_samples(selection: Selection, shape: tuple[int, ...]) -> None:
    if shape != selection.sample_shape:
        raise LatticeError(f"expected {selection.sample_shape} samples, got {shape}")
