"""The part of a grid that a click is about: a rectangle, or on a sphere a cap."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from protocol.grid import BoolArray, FloatArray, IntArray


@dataclass(frozen=True)
class Region:
    """A rectangle of a grid, cyclic in x: columns left..left+width (not wrapped), rows top..top+height."""

    left: int
    top: int
    width: int
    height: int
    turn: int

    @property
    def columns(self) -> IntArray:
        """Grid columns, wrapped. (width,) int64."""
        return np.arange(self.left, self.left + self.width) % self.turn

    @property
    def rows(self) -> slice:
        """Grid rows."""
        return slice(self.top, self.top + self.height)

    @property
    def area(self) -> float:
        """How many samples it holds, at the density of the middle."""
        return self.width * self.height

    def sample_area(self, rows: IntArray) -> FloatArray:
        """How large a sample of each of its rows (n,) is. (n,), 1 in the middle of the grid"""
        return np.ones(rows.size)

    def inside(self, rows: IntArray, columns: range) -> BoolArray:
        """Which of rows (any) x columns (ascending, not wrapped) lie in it. (rows, columns) bool"""
        down = (rows >= self.top) & (rows < self.top + self.height)
        return np.logical_and.outer(down, (np.array(columns) - self.left) % self.turn < self.width)

    def counts(self, side: int) -> IntArray:
        """How many of its samples lie in each block of `blocks`. (rows, columns) int64"""
        first, top, wide, high = self.blocks(side)
        edges = _edges(first, wide, side, self.turn)
        rows = np.diff(np.clip(side * np.arange(top, top + high + 1), self.top, self.top + self.height))
        once = np.zeros(1, np.int64)
        columns = _run_counts(once, once + self.left, once + self.width, (1, edges), self.turn)
        return np.asarray(np.multiply.outer(rows, columns[0]))

    def blocks(self, side: int) -> tuple[int, int, int, int]:
        """Blocks of the rectangle round it: first column, first row, columns, rows; from 0 when it is all round."""
        first, wide = _columns_touched(self.left, self.width, side, self.turn)
        top, bottom = self.top // side, (self.top + self.height - 1) // side
        return first, top, wide, bottom - top + 1

    def touched(self, side: int) -> BoolArray:
        """Which blocks of that rectangle it touches. (rows, columns) bool"""
        _, _, wide, high = self.blocks(side)
        return np.ones((high, wide), np.bool_)


@dataclass(frozen=True, eq=False)
class Cap(Region):
    """A round part of a sphere; the rectangle is the smallest round it.

    row_left, row_width : (height,) int64 its columns in each of its rows, cyclic and not wrapped, at least one.
    row_share : (height,) float64 how wide columns are in each row, 1 on the equator.
    """

    row_left: IntArray
    row_width: IntArray
    row_share: FloatArray
    __eq__, __hash__ = object.__eq__, object.__hash__  # two caps may have one rectangle

    @property
    def area(self) -> float:
        """How many samples it holds, at the density of the equator."""
        return float(self.row_width @ self.row_share)

    def sample_area(self, rows: IntArray) -> FloatArray:
        """How large a sample of each row is, 1 on the equator; of rows outside, as large as of the nearest inside."""
        return self.row_share[self._nearest(rows)]

    def _nearest(self, rows: IntArray) -> IntArray:
        """Of each of its rows, from 0, the nearest to these. (n,)"""
        return np.minimum(np.maximum(rows - self.top, 0), self.height - 1)

    def inside(self, rows: IntArray, columns: range) -> BoolArray:
        """Which of rows (any) x columns (ascending, not wrapped) lie in it. (rows, columns) bool"""
        row = self._nearest(rows)
        width = self.row_width[row] * (row == rows - self.top)
        ahead = (columns[0] - self.row_left[row]) % self.turn  # how far its run begins before the first column
        turns = range(0, columns[-1] - columns[0] + int(ahead.max()) + 1, self.turn)
        edges = np.empty((rows.size, 2 * len(turns) + 2), np.int64)
        edges[:, 0], edges[:, -1] = 0, len(columns)
        for place, shift in enumerate(turns):
            edges[:, 2 * place + 1] = -((ahead - shift) // columns.step)
            edges[:, 2 * place + 2] = -((ahead - shift - width) // columns.step)
        within = np.minimum(np.maximum(edges, 0), len(columns))
        inside = np.tile(np.arange(2 * len(turns) + 1) % 2 == 1, rows.size)
        return inside.repeat((within[:, 1:] - within[:, :-1]).ravel()).reshape(rows.size, len(columns))

    def counts(self, side: int) -> IntArray:
        """How many of its samples lie in each block of `blocks`. (rows, columns) int64, read-only"""
        if side not in self._counts:
            first, top, wide, high = self.blocks(side)
            row = np.arange(self.top, self.top + self.height) // side - top
            edges = _edges(first, wide, side, self.turn)
            counts = _run_counts(row, self.row_left, self.row_width, (high, edges), self.turn)
            counts.flags.writeable = False
            self._counts[side] = counts
        return self._counts[side]

    def touched(self, side: int) -> BoolArray:
        """Which blocks of that rectangle it touches: in each row of them one run. (rows, columns) bool, read-only"""
        if side not in self._touched:
            first, top, wide, high = self.blocks(side)
            starts = np.maximum(side * np.arange(top, top + high) - self.top, 0)
            left = np.minimum.reduceat(self.row_left, starts)
            width = np.maximum.reduceat(self.row_left + self.row_width, starts) - left
            begin, count = blocks_touched(left, np.minimum(width, self.turn), side, self.turn)
            column = (first + np.arange(wide) - begin[:, None]) % -(-self.turn // side)
            touched = column < count[:, None]
            touched.flags.writeable = False
            self._touched[side] = touched
        return self._touched[side]

    @cached_property
    def _counts(self) -> dict[int, IntArray]:
        return {}

    @cached_property
    def _touched(self) -> dict[int, BoolArray]:
        return {}


def _edges(first: int, wide: int, side: int, turn: int) -> IntArray:
    """Where block columns begin, and where the last one ends, not wrapped. (wide + 1,)"""
    turns, column = divmod(first + np.arange(wide + 1), -(-turn // side))
    return turns * turn + column * side


def _run_counts(
    row: IntArray, left: IntArray, width: IntArray, blocks: tuple[int, IntArray], turn: int
) -> IntArray:
    """How many columns of runs (n,), cyclic, lie in each block: of a row of blocks each, and between these edges.

    Counted by where runs begin and end, so that it takes as long as there are runs. (rows of blocks, edges - 1) int64
    """
    high, edges = blocks
    sizes, wide = np.diff(edges), edges.size - 1
    begin = edges[0] - (edges[0] - left) % turn  # of the run round the first edge, or left of it
    turns = [
        begin + shift
        for shift in range(0, int(edges[-1]) - int(begin.min()), turn)
        if int((begin + width).max()) + shift > edges[0]
    ]
    ends = np.clip(np.concatenate([*turns, *(each + width for each in turns)]), edges[0], edges[-1])
    block = np.minimum(np.searchsorted(edges, ends, side="right") - 1, wide - 1)
    sign = np.repeat([1, -1], ends.size // 2)
    row = np.concatenate([row] * (ends.size // row.size))
    part = np.bincount(row * wide + block, sign * (edges[block + 1] - ends), high * wide).reshape(high, wide)
    behind = np.bincount(row * (wide + 1) + block + 1, sign, high * (wide + 1)).reshape(high, wide + 1)
    return np.asarray(part + behind[:, :wide].cumsum(axis=1) * sizes, np.int64)


@lru_cache(maxsize=256)
def _columns_touched(left: int, width: int, side: int, turn: int) -> tuple[int, int]:
    first, wide = blocks_touched(np.array([left]), np.array([width]), side, turn)
    return int(first[0]), int(wide[0])


def blocks_touched(left: IntArray, width: IntArray, side: int, turn: int) -> tuple[IntArray, IntArray]:
    """The block columns that runs of columns (n,) touch: the first, how many; all from 0 where it is all."""
    columns = -(-turn // side)
    begin, end = left % turn, left % turn + width - 1
    wraps, first = end >= turn, begin // side
    wide = np.where(wraps, columns - first + (end - turn) // side, end // side - first) + 1
    return np.where(wide >= columns, 0, first), np.minimum(wide, columns)


def region_round(u: float, v: float, share: float, width: int, height: int) -> Region:
    """The region of a click (u, v): odd sides of sqrt(share) of the grid's, centred on the clicked sample.

    It keeps its size at the top and bottom by moving inward. Source: DESIGN 8.
    """
    wide, high = _odd(math.sqrt(share) * width, width), _odd(math.sqrt(share) * height, height)
    column, row = int(u * width), int(v * height)
    top = min(max(row - high // 2, 0), height - high)
    return Region(column - wide // 2, top, wide, high, width)


def _odd(side: float, limit: int) -> int:
    """The odd number nearest to a side, at least 1; the limit itself where everything is asked for."""
    if side >= limit:
        return limit
    return min(max(2 * round((side - 1) / 2) + 1, 1), limit)
