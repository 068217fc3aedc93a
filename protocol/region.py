"""The part of a grid that a click is about."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from protocol.grid import IntArray


@dataclass(frozen=True, slots=True)
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

    def blocks(self, side: int) -> tuple[int, int, int, int]:
        """The blocks it touches: (first column, first row, columns, rows); all round when it meets itself."""
        columns = -(-self.turn // side)
        first, last = self.left % self.turn // side, (self.left + self.width - 1) % self.turn // side
        wide = (last - first) % columns + 1
        if self.width > self.turn - side or (self.width > side and wide == 1):
            first, wide = 0, columns
        top, bottom = self.top // side, (self.top + self.height - 1) // side
        return first, top, wide, bottom - top + 1


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
