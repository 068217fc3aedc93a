"""From encoder counts to equal angles: where each of W columns of a grid comes from, and how two become one.

Everything is whole: counts, angles in parts of a count, and weights, so the same columns make the same grid everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from protocol.grid import VOID, ImageArray, IntArray, StepArray

COUNTS_MAX = 1 << 31
WEIGHT_BITS = 15
WEIGHT_ONE = np.uint32(1 << WEIGHT_BITS)

WeightArray = NDArray[np.uint32]
Samples = TypeVar("Samples", StepArray, ImageArray)


@dataclass(frozen=True, slots=True)
class Encoder:
    """How encoder counts become angles on the grid.

    counts_per_turn : up to 2^31, at least two per column.  direction : +1 where counts grow with the column, else -1.
    zero_count : the count at the left edge of column 0, that is at GridSpec.theta0_rad.
    A count stands for the angle that it is nearest to. Raises ValueError when out of bounds.
    """

    counts_per_turn: int
    zero_count: int = 0
    direction: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.counts_per_turn <= COUNTS_MAX:
            raise ValueError(f"counts_per_turn must be between 1 and {COUNTS_MAX}, got {self.counts_per_turn}")
        if self.direction not in (1, -1):
            raise ValueError(f"direction must be 1 or -1, got {self.direction}")

    def tick(self, count: int) -> int:
        """Counts from the left edge of column 0, in the direction of the columns; it goes on counting past a turn."""
        return (count - self.zero_count) * self.direction


@dataclass(frozen=True, slots=True, eq=False)
class Resampling:
    """Where each of W equal angles takes its column from.

    left, right : (W,) slots of the columns before and after.  weight : (W,) of the right one, in 1/32768.
    missing : (n,) columns with too wide a gap round them.
    """

    left: IntArray
    right: IntArray
    weight: WeightArray
    missing: IntArray

    def part(self, columns: slice) -> Resampling:
        """The same for some of the columns; `missing` is left out."""
        nothing = np.empty(0, np.int64)
        return Resampling(self.left[columns], self.right[columns], self.weight[columns], nothing)


Laps = dict[int, Resampling]


def resampling(
    ticks: IntArray, slots: IntArray, counts_per_turn: int, width: int, lap: int | None = None
) -> Resampling:
    """Plan W equal angles from columns at `ticks`, which stand in `slots`.

    ticks : (n,) distinct encoder counts from the left edge of column 0.  slots : (n,) where their columns are kept.
    lap : plan the angles of that turn from what was seen in its course; without it, `ticks` lie within one turn, which
    closes on itself. A column within half a count of an angle is that angle's. A gap of two columns or more, give or
    take a count, is a hole, and the angles in it are missing.
    """
    if not ticks.size:
        nothing = np.zeros(width, np.int64)
        return Resampling(nothing, nothing, nothing.astype(np.uint32), np.arange(width))
    order = np.argsort(ticks)
    ticks, slots = ticks[order], slots[order]
    turn = 2 * width * counts_per_turn  # angles in units of 1/(2 W counts) of a turn: both kinds are whole
    angle = counts_per_turn * (2 * np.arange(width) + 1) + (lap or 0) * turn
    before = np.searchsorted(2 * width * ticks, angle, side="right") - 1
    after = (before + 1) % ticks.size
    period = turn if lap is None else 2 * width * (ticks[-1] - ticks[0]) + 2 * turn  # no end meets another there
    gap = (2 * width * (ticks[after] - ticks[before]) - 1) % period + 1  # one lone column: a whole turn
    along = (angle - 2 * width * ticks[before]) % period
    along = np.where(along <= width, 0, np.where(gap - along <= width, gap, along))
    hole = (0 < along) & (along < gap) & (gap >= 2 * (2 * counts_per_turn - width))
    weight = ((np.where(hole, 0, along) << WEIGHT_BITS) + gap // 2) // gap
    return Resampling(slots[before], slots[after], weight.astype(np.uint32), np.flatnonzero(hole))


def blend_range(left: StepArray, right: StepArray, weight: WeightArray) -> StepArray:
    """Linear between two sets of columns where both are measured, else the nearer one's sample, void or not.

    left, right : (n, H) uint16.  weight : (n,) of the right one, in 1/32768.  Returns (n, H) uint16.
    """
    nearer = np.where(2 * weight[:, None] > WEIGHT_ONE, right, left)
    return np.where((left == VOID) | (right == VOID), nearer, _mix(left, right, weight[:, None])).astype(np.uint16)


def blend_texture(left: ImageArray, right: ImageArray, weight: WeightArray) -> ImageArray:
    """Linear between two sets of columns. left, right : (n, Ht, 3) uint8. weight : (n,) in 1/32768."""
    return _mix(left, right, weight[:, None, None]).astype(np.uint8)


def _mix(left: Samples, right: Samples, weight: WeightArray) -> WeightArray:
    """left (1 - weight) + right weight, halves up; 65535 * 32768 still fits 32 bits."""
    total: WeightArray = left * (WEIGHT_ONE - weight) + right * weight + WEIGHT_ONE // 2
    return np.right_shift(total, np.uint32(WEIGHT_BITS))
