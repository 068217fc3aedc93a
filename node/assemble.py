"""Columns in, a grid out: what the turntable measured at its own angles becomes W equal angles.

The encoder says where a column stands; the order in which columns come, and how often, does not matter. A column whose
encoder count is the nearest one to an equal angle IS that angle's column, bit for bit. Any other angle is interpolated
between the two columns round it. A turn with a hole is refused, never bridged.

Source: REQUIREMENTS A.6 (ticks are resampled to W equal angles, a partial turn is never served as complete, holes keep
their mask).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.errors import FoveascanError, RemoteWireError
from protocol.grid import VOID, Grid, GridSpec, ImageArray, IntArray, StepArray

COUNTS_MAX = 1 << 31
COUNTS_PER_COLUMN_MIN = 2
TURNS_KEPT = 2
STRIP_COLUMNS = 64
WEIGHT_BITS = 15
WEIGHT_ONE = np.uint32(1 << WEIGHT_BITS)

WeightArray = NDArray[np.uint32]
Samples = TypeVar("Samples", StepArray, ImageArray)


class IncompleteTurn(FoveascanError):
    """A sweep that leaves some angles without columns.

    range_columns, texture_columns : the columns of the grid that are missing.
    """

    def __init__(self, range_columns: IntArray, texture_columns: IntArray) -> None:
        self.range_columns = range_columns
        self.texture_columns = texture_columns
        missing = f"{range_columns.size} range and {texture_columns.size} texture columns are missing"
        super().__init__(f"the turn is not complete: {missing}")


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
        """Counts from the left edge of column 0, in the direction of the columns, in [0, counts_per_turn)."""
        return (count - self.zero_count) * self.direction % self.counts_per_turn


class Assembler:
    """Takes the columns of one turn in any order, whole or in pieces, and makes the grid once they are all there.

    Raises ValueError when the encoder is too coarse for the grid.
    """

    def __init__(self, spec: GridSpec, encoder: Encoder) -> None:
        needed = COUNTS_PER_COLUMN_MIN * max(spec.width, spec.texture_width)
        if encoder.counts_per_turn < needed:
            raise ValueError(
                f"{encoder.counts_per_turn} encoder counts per turn are too few for this grid, need {needed}"
            )
        self._spec = spec
        self._encoder = encoder
        steps = np.empty((TURNS_KEPT * spec.width, spec.height), np.uint16)  # memory is taken only as columns come
        texels = np.empty((TURNS_KEPT * spec.texture_width, spec.texture_height, 3), np.uint8)
        self._range = _Columns("range", spec.width, steps, blend_range)
        self._texture = _Columns("texture", spec.texture_width, texels, blend_texture)

    def add_range_column(self, encoder_count: int, row0: int, samples: StepArray) -> None:
        """Take rows row0... of the range column at an encoder count. samples : (n,) uint16 steps, 0 = void.

        The last word on a sample counts. Raises RemoteWireError when the rows do not fit the column, or when the sweep
        brings more distinct columns than two turns hold.
        """
        self._range.add(self._encoder.tick(encoder_count), row0, samples)

    def add_texture_column(self, encoder_count: int, row0: int, samples: ImageArray) -> None:
        """Take rows row0... of the texture column at an encoder count, as for range. samples : (n, 3) uint8 RGB."""
        self._texture.add(self._encoder.tick(encoder_count), row0, samples)

    def missing_range(self) -> IntArray:
        """Range columns of the grid that nothing complete stands at or close enough round. (n,) ascending."""
        return self._range.resampling(self._encoder.counts_per_turn).missing

    def missing_texture(self) -> IntArray:
        """Texture columns of the grid that nothing complete stands at or close enough round. (n,) ascending."""
        return self._texture.resampling(self._encoder.counts_per_turn).missing

    def finish(self) -> Grid:
        """The sweep as a grid of equal angles. Raises IncompleteTurn."""
        counts = self._encoder.counts_per_turn
        range_plan, texture_plan = self._range.resampling(counts), self._texture.resampling(counts)
        if range_plan.missing.size or texture_plan.missing.size:
            raise IncompleteTurn(range_plan.missing, texture_plan.missing)
        s = self._spec
        range_steps = np.empty((s.height, s.width), np.uint16)
        texture = np.empty((s.texture_height, s.texture_width, 3), np.uint8)
        self._range.resample(range_plan, range_steps)
        self._texture.resample(texture_plan, texture)
        return Grid(s, range_steps, texture)


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


def resampling(ticks: IntArray, slots: IntArray, counts_per_turn: int, width: int) -> Resampling:
    """Plan W equal angles from columns at `ticks`, which stand in `slots`.

    ticks : (n,) distinct encoder counts from the left edge of column 0.  slots : (n,) where their columns are kept.
    A column within half a count of an angle is that angle's. A gap of two columns or more, give or take a count, is a
    hole, and the angles in it are missing.
    """
    if not ticks.size:
        nothing = np.zeros(width, np.int64)
        return Resampling(nothing, nothing, nothing.astype(np.uint32), np.arange(width))
    order = np.argsort(ticks)
    ticks, slots = ticks[order], slots[order]
    turn = 2 * width * counts_per_turn  # angles in units of 1/(2 W counts) of a turn: both kinds are whole
    angle = counts_per_turn * (2 * np.arange(width) + 1)
    before = np.searchsorted(2 * width * ticks, angle, side="right") - 1
    after = (before + 1) % ticks.size
    gap = (2 * width * (ticks[after] - ticks[before]) - 1) % turn + 1  # one lone column: a whole turn
    along = (angle - 2 * width * ticks[before]) % turn
    along = np.where(along <= width, 0, np.where(gap - along <= width, gap, along))
    hole = (0 < along) & (along < gap) & (gap >= 2 * (2 * counts_per_turn - width))
    weight = ((along << WEIGHT_BITS) + gap // 2) // gap
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


class _Columns(Generic[Samples]):
    """The columns of one channel as they came: one slot per encoder count, each a copy made once."""

    def __init__(
        self, channel: str, width: int, slots: Samples, blend: Callable[[Samples, Samples, WeightArray], Samples]
    ) -> None:
        self._channel = channel
        self._width = width
        self._slots: Samples = slots
        self._blend: Callable[[Samples, Samples, WeightArray], Samples] = blend
        self._slot_of: dict[int, int] = {}
        self._whole = (1 << slots.shape[1]) - 1
        self._rows = [0] * slots.shape[0]  # per slot, a bit for each row that has come

    def add(self, tick: int, row0: int, samples: Samples) -> None:
        height = self._slots.shape[1]
        if samples.dtype != self._slots.dtype or samples.shape[1:] != self._slots.shape[2:]:
            wanted = "(n, 3) uint8" if self._slots.ndim == 3 else "(n,) uint16"
            raise ValueError(f"{self._channel} samples must be {wanted}, got {samples.shape} {samples.dtype}")
        if not (0 <= row0 and row0 + samples.shape[0] <= height):
            raise RemoteWireError(f"{self._channel} rows {row0}+{samples.shape[0]} do not fit a column of {height}")
        slot = self._slot_of.get(tick, len(self._slot_of))
        if slot == len(self._slots):
            raise RemoteWireError(f"more than {len(self._slots)} {self._channel} columns in one sweep")
        self._slot_of[tick] = slot
        self._slots[slot, row0 : row0 + samples.shape[0]] = samples
        self._rows[slot] |= ((1 << samples.shape[0]) - 1) << row0

    def resampling(self, counts_per_turn: int) -> Resampling:
        complete = [(tick, slot) for tick, slot in self._slot_of.items() if self._rows[slot] == self._whole]
        ticks, slots = np.array(complete, np.int64).reshape(-1, 2).T
        return resampling(ticks, slots, counts_per_turn, self._width)

    def resample(self, plan: Resampling, grid: Samples) -> None:
        """Fill a grid (H, W, ...) strip by strip: a strip of columns stays in the cache while it is turned."""
        for start in range(0, self._width, STRIP_COLUMNS):
            part = slice(start, start + STRIP_COLUMNS)
            grid[:, part] = cv2.transpose(self._strip(plan.left[part], plan.right[part], plan.weight[part]))

    def _strip(self, left: IntArray, right: IntArray, weight: WeightArray) -> Samples:
        if not np.any(weight % WEIGHT_ONE):
            exact: Samples = self._slots[np.where(weight, right, left)]
            return exact
        return self._blend(self._slots[left], self._slots[right], weight)


def _mix(left: Samples, right: Samples, weight: WeightArray) -> WeightArray:
    """left (1 - weight) + right weight, halves up; 65535 * 32768 still fits 32 bits."""
    total: WeightArray = left * (WEIGHT_ONE - weight) + right * weight + WEIGHT_ONE // 2
    return np.right_shift(total, np.uint32(WEIGHT_BITS))
