"""Columns in, a grid out: what the turntable measured at its own angles becomes W equal angles.

The encoder says where a column stands; the order in which columns come, and how often, does not matter. A column whose
encoder count is the nearest one to an equal angle IS that angle's column, bit for bit. Any other angle is interpolated
between the two columns round it. A turn with a hole is refused, never bridged. Angles seen in several turns are
averaged; a turn in which the object stands elsewhere than in the first is left out, and the report says so.

Source: REQUIREMENTS A.6 (ticks are resampled to W equal angles, a partial turn is never served as complete, holes keep
their mask).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import cv2
import numpy as np

from node.axis import Axis
from node.axis_correction import correct
from node.laps import OUTLIER_SIGMAS, average, difference_sigma, shift_between
from node.repair import Repaired, repair
from node.resampling import (
    WEIGHT_ONE,
    Encoder,
    Laps,
    Resampling,
    WeightArray,
    blend_range,
    blend_texture,
    resampling,
)
from node.scan_quality import ScanQuality, coverage_of, slip_matters, survey
from protocol.errors import FoveascanError, RemoteWireError
from protocol.grid import VOID, BoolArray, FloatArray, Grid, GridSpec, ImageArray, IntArray, StepArray
from protocol.scanner_messages import Payload

COUNTS_PER_COLUMN_MIN = 2
TURNS_KEPT = 2  # room at first, where nobody said how many come
TURNS_AT_ONCE_MAX = 8  # room at first, whatever was said; more is made as they come
TURNS_MAX = 66
STRIP_COLUMNS = 64
TOLERANCE_ROWS = 0.25  # ranges that differ by less than this part of a row's height are no outliers
TOLERANCE_GREY = 24.0
SIGMA_COLUMNS = 256  # are enough to tell the noise
SLIP_COLUMNS = 512  # are enough to tell a slip, of an eighth of a turn at most
SLIP_COLUMNS_MIN = 16
SLIP_REACH_MIN = 8
PROFILE_ROWS = 256

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


@dataclass(frozen=True, slots=True, eq=False)
class Assembly:
    """A finished sweep: its grid, which tells what was repaired of it, and what it is worth.

    scanner, settings : who swept it, by serial number, and the number of its calibration then, where that is known.
    """

    grid: Grid
    quality: ScanQuality
    scanner: str = ""
    settings: int = 0


class Assembler:
    """Takes the columns of a sweep in any order, whole or in pieces, and makes the grid once they are all there.

    turns : how many are expected.  Raises ValueError when the encoder is too coarse for the grid.
    """

    def __init__(self, spec: GridSpec, encoder: Encoder, turns: int = TURNS_KEPT) -> None:
        needed = COUNTS_PER_COLUMN_MIN * max(spec.width, spec.texture_width)
        if encoder.counts_per_turn < needed:
            raise ValueError(
                f"{encoder.counts_per_turn} encoder counts per turn are too few for this grid, need {needed}"
            )
        self._spec = spec
        self._encoder = encoder
        turns = min(turns, TURNS_AT_ONCE_MAX)
        steps = np.empty((turns * spec.width, spec.height), np.uint16)  # memory is taken only as columns come
        texels = np.empty((turns * spec.texture_width, spec.texture_height, 3), np.uint8)
        tolerance = TOLERANCE_ROWS * spec.pitch_mm / spec.step_mm
        self._range = _Columns("range", spec.width, steps, blend_range, tolerance)
        self._texture = _Columns("texture", spec.texture_width, texels, blend_texture, TOLERANCE_GREY)

    def add_range_column(self, encoder_count: int, row0: int, samples: StepArray) -> None:
        """Take rows row0... of the range column at an encoder count. samples : (n,) uint16 steps, 0 = void.

        The last word on a sample counts. Raises RemoteWireError when the rows do not fit the column, or when the sweep
        brings more columns than any sweep has.
        """
        self._range.add(self._encoder.tick(encoder_count), row0, samples)

    def add_range_bytes(self, encoder_count: int, row0: int, data: Payload) -> None:
        """As add_range_column, samples as they travel: little-endian uint16."""
        self._range.add_bytes(self._encoder.tick(encoder_count), row0, data)

    def add_texture_bytes(self, encoder_count: int, row0: int, data: Payload) -> None:
        """As add_texture_column, samples as they travel: R, G and B, a byte each."""
        self._texture.add_bytes(self._encoder.tick(encoder_count), row0, data)

    def add_texture_column(self, encoder_count: int, row0: int, samples: ImageArray) -> None:
        """Take rows row0... of the texture column at an encoder count, as for range. samples : (n, 3) uint8 RGB."""
        self._texture.add(self._encoder.tick(encoder_count), row0, samples)

    def missing_range(self) -> IntArray:
        """Range columns of the grid that nothing complete stands at or close enough round. (n,) ascending."""
        return self._range.folded(self._encoder.counts_per_turn).missing

    def missing_texture(self) -> IntArray:
        """Texture columns of the grid that nothing complete stands at or close enough round. (n,) ascending."""
        return self._texture.folded(self._encoder.counts_per_turn).missing

    def finish(self) -> Grid:
        """The sweep as a grid of equal angles, averaged where it was seen more than once. Raises IncompleteTurn."""
        return self._average()[0]

    def assembly(self, *, repairs: bool = True, apart: bool = False, axis: Axis | None = None) -> Assembly:
        """The grid, and what there is to say about it. Raises IncompleteTurn.

        repairs : take spikes out and fill small holes; without, every sample is one that was measured.
        apart : range and texture were not seen at the same time.
        axis : the table's own, where it is not the one that the sensor believes in; the grid is laid about it.
        """
        grid, quality = self._average(apart)
        if repairs:
            repaired = repair(grid, quality.noise_mm or 0.0, axis)
        else:
            if axis is not None:
                correct(grid, axis)
            repaired = Repaired(grid, 0, 0)
        found = survey(repaired.grid)
        said = replace(
            quality,
            coverage=found.coverage - repaired.filled / grid.range_steps.size,
            spikes=repaired.spikes,
            filled=repaired.filled,
            holes=found.holes,
            dead_rows=found.dead_rows,
            saturated_columns=found.saturated_columns,
            axis=axis,
        )
        return Assembly(repaired.grid, said)

    def _average(self, apart: bool = False) -> tuple[Grid, ScanQuality]:
        counts = self._encoder.counts_per_turn
        missing = self.missing_range(), self.missing_texture()
        if missing[0].size or missing[1].size:
            raise IncompleteTurn(*missing)
        s = self._spec
        range_laps, texture_laps = self._range.laps(counts), self._texture.laps(counts)
        slips = self._slips_deg(range_laps, texture_laps, apart)
        moved = {lap for lap, (_, matters) in slips.items() if matters}
        range_steps = np.empty((s.height, s.width), np.uint16)
        texture = np.empty((s.texture_height, s.texture_width, 3), np.uint8)
        range_used = {lap: plan for lap, plan in range_laps.items() if lap not in moved}
        texture_used = {lap: plan for lap, plan in texture_laps.items() if lap not in moved}
        rejected = self._range.resample(range_used, self._range.folded(counts), range_steps)
        rejected += self._texture.resample(texture_used, self._texture.folded(counts), texture)
        sigma = self._range.sigma(range_used)
        worst = max((slip for slip, _ in slips.values()), key=abs, default=None)
        quality = ScanQuality(
            coverage_of(range_steps),
            passes=max(self._range.whole_laps(range_used), self._texture.whole_laps(texture_used)),
            noise_mm=None if sigma is None else sigma * s.step_mm,
            rejected=rejected,
            slip_deg=worst,
            has_slipped=bool(moved),
            set_aside=len(moved),
        )
        return Grid(s, range_steps, texture), quality

    def _slips_deg(self, range_laps: Laps, texture_laps: Laps, apart: bool) -> dict[int, tuple[float, bool]]:
        """By how much each later lap is turned against the first, and whether that matters, as far as it shows.

        What both cameras saw at once is judged by the finer one; apart, by the one that saw it move further.
        """
        slips: dict[int, tuple[float, bool]] = {}
        for lap in sorted(range_laps.keys() | texture_laps.keys())[1:]:
            for columns, laps in ((self._texture, texture_laps), (self._range, range_laps)):
                slip = columns.slip(laps, lap)
                if slip is None:
                    continue
                found = slip * 360.0 / columns.width, slip_matters(slip)
                slips[lap] = max(slips.get(lap, found), found, key=lambda said: (said[1], abs(said[0])))
                if not apart:
                    break
        return slips


class _Columns(Generic[Samples]):
    """The columns of one channel as they came: one slot per encoder count, each a copy made once."""

    def __init__(
        self,
        channel: str,
        width: int,
        slots: Samples,
        blend: Callable[[Samples, Samples, WeightArray], Samples],
        tolerance: float,
    ) -> None:
        self._channel = channel
        self.width = width
        self._slots: Samples = slots
        self._bytes = slots.reshape(-1).data.cast("B")
        self._tolerance = tolerance
        self._blend: Callable[[Samples, Samples, WeightArray], Samples] = blend
        self._slot_of: dict[int, int] = {}
        self._height = slots.shape[1]
        self._column_bytes, self._row_bytes = slots.strides[:2]
        self._whole = (1 << self._height) - 1
        self._rows = [0] * slots.shape[0]  # per slot, a bit for each row that has come

    def add(self, tick: int, row0: int, samples: Samples) -> None:
        if samples.dtype != self._slots.dtype or samples.shape[1:] != self._slots.shape[2:]:
            wanted = "(n, 3) uint8" if self._slots.ndim == 3 else "(n,) uint16"
            raise ValueError(f"{self._channel} samples must be {wanted}, got {samples.shape} {samples.dtype}")
        self.add_bytes(tick, row0, np.ascontiguousarray(samples).data.cast("B"))

    def add_bytes(self, tick: int, row0: int, data: Payload) -> None:
        """Numpy would let other threads in, and wait for them (protocol.checksum); so bytes are copied as such."""
        rows = len(data) // self._row_bytes
        if row0 < 0 or row0 + rows > self._height:
            raise RemoteWireError(f"{self._channel} rows {row0}+{rows} do not fit a column of {self._height}")
        slot = self._slot_of.get(tick, len(self._slot_of))
        if slot == len(self._rows):
            self._grow()
        self._slot_of[tick] = slot
        begin = slot * self._column_bytes + row0 * self._row_bytes
        self._bytes[begin : begin + len(data)] = data
        self._rows[slot] |= self._whole if rows == self._height else ((1 << rows) - 1) << row0

    def _grow(self) -> None:
        """Make room for twice as many columns."""
        if len(self._slots) >= TURNS_MAX * self.width:
            raise RemoteWireError(f"more than {len(self._slots)} {self._channel} columns in one sweep")
        larger = np.empty((2 * len(self._slots), *self._slots.shape[1:]), self._slots.dtype)
        larger[: len(self._slots)] = self._slots
        self._rows += [0] * len(self._slots)
        self._slots = larger
        self._bytes = larger.reshape(-1).data.cast("B")

    def _complete(self) -> tuple[IntArray, IntArray]:
        """Ticks of the columns that are whole, and their slots. (n,) each"""
        whole = [(tick, slot) for tick, slot in self._slot_of.items() if self._rows[slot] == self._whole]
        ticks, slots = np.array(whole, np.int64).reshape(-1, 2).T
        return ticks, slots

    def folded(self, counts_per_turn: int) -> Resampling:
        """All turns as one; of columns at the same angle, the first one stands for all."""
        ticks, slots = self._complete()
        order = np.argsort(ticks, kind="stable")
        angles, first = np.unique(ticks[order] % counts_per_turn, return_index=True)
        return resampling(angles, slots[order][first], counts_per_turn, self.width)

    def laps(self, counts_per_turn: int) -> Laps:
        """A plan for each turn that has something of its own."""
        ticks, slots = self._complete()
        numbers = np.unique(ticks // counts_per_turn).tolist()
        plans = {lap: resampling(ticks, slots, counts_per_turn, self.width, lap) for lap in numbers}
        return {lap: plan for lap, plan in plans.items() if plan.missing.size < self.width}

    def whole_laps(self, laps: Laps) -> int:
        """How many of them are turns, and not an overlap of two."""
        return sum(2 * plan.missing.size < self.width for plan in laps.values())

    def resample(self, laps: Laps, folded: Resampling, grid: Samples) -> int:
        """Fill a grid (H, W, ...) strip by strip: a strip of columns stays in the cache while it is turned.

        Angles that no lap has are taken from `folded`. Returns how many samples were left out of the mean.
        """
        seen = self._seen(laps)
        sigma = self.sigma(laps) if len(laps) > 1 else None
        tolerance = max(OUTLIER_SIGMAS * (sigma or 0.0), self._tolerance)
        rejected = 0
        for start in range(0, self.width, STRIP_COLUMNS):
            part = slice(start, start + STRIP_COLUMNS)
            plans = [plan for plan, has in zip(laps.values(), seen, strict=True) if has[part].any()]
            if len(plans) < 2:
                strip = self._strip(folded.part(part))
            else:
                has = np.stack([has[part] for has in seen if has[part].any()])
                strip, left_out = self._mean([plan.part(part) for plan in plans], has, folded.part(part), tolerance)
                rejected += left_out
            grid[:, part] = cv2.transpose(strip)
        return rejected

    def sigma(self, laps: Laps) -> float | None:
        """Standard deviation of one sample, from the first two laps that have something in common."""
        ordered = sorted(laps)
        for one, other in zip(ordered, ordered[1:], strict=False):
            both = np.flatnonzero(np.logical_and(*self._seen({one: laps[one], other: laps[other]})))[:SIGMA_COLUMNS]
            if both.size:
                a, b = (self._strip(_chosen(laps[lap], both)) for lap in (one, other))
                return difference_sigma(a, b, self._measured(a) & self._measured(b))
        return None

    def slip(self, laps: Laps, lap: int) -> float | None:
        """By how many columns a lap is turned against the first one, where it shows.

        A lap's beginning tells what moved before it; what moves in the last one shows at its end.
        """
        first = min(laps, default=lap)
        if lap == first or lap not in laps:
            return None
        one, other = self._seen({first: laps[first], lap: laps[lap]})
        columns = np.flatnonzero(other)
        few = min(SLIP_COLUMNS, max(SLIP_COLUMNS_MIN, self.width // 8))
        parts = [columns[:few]]
        if lap == max(laps) and columns.size > 2 * few:
            parts.append(columns[-few:])
        slips = [self._shift(laps[first], laps[lap], part, one[part]) for part in parts]
        return max((slip for slip in slips if slip is not None), key=abs, default=None)

    def _shift(self, first: Resampling, lap: Resampling, columns: IntArray, valid: BoolArray) -> float | None:
        """By how many columns these ones are further on in one lap than in the first."""
        before, after = (self._profile(_chosen(plan, columns)) for plan in (first, lap))
        return shift_between(before, after, valid, max(SLIP_REACH_MIN, self.width // 36))

    def _profile(self, plan: Resampling) -> FloatArray:
        """(n, m) columns thinned to at most 256 rows, NaN where void."""
        strip = self._strip(plan)
        thin = strip[:, :: max(1, strip.shape[1] // PROFILE_ROWS)]
        values = np.where(self._measured(thin), thin, np.nan).astype(np.float64)
        return values.reshape(len(values), -1)

    def _seen(self, laps: Laps) -> list[BoolArray]:
        """(W,) columns that each lap has."""
        seen = [np.ones(self.width, np.bool_) for _ in laps]
        for has, plan in zip(seen, laps.values(), strict=True):
            has[plan.missing] = False
        return seen

    def _mean(
        self, plans: list[Resampling], has: BoolArray, folded: Resampling, tolerance: float
    ) -> tuple[Samples, int]:
        """(n, H, ...) the mean of what several laps have, and how many samples were left out."""
        strips: Samples = np.stack([self._strip(plan) for plan in plans])
        shape = (*has.shape, *(1,) * (strips.ndim - 2))
        mean, left_out = average(strips, self._measured(strips) & has.reshape(shape), tolerance)
        none = ~has.any(axis=0)
        if none.any():
            mean[none] = self._strip(folded)[none]
        return mean, int(left_out.sum())

    def _measured(self, samples: Samples) -> BoolArray:
        """Which samples are not void, same shape; every texel is measured."""
        return samples != VOID if self._slots.ndim == 2 else np.ones(samples.shape, np.bool_)

    def _strip(self, plan: Resampling) -> Samples:
        """(n, H, ...) the columns of a plan."""
        if not np.any(plan.weight % WEIGHT_ONE):
            exact: Samples = self._slots[np.where(plan.weight, plan.right, plan.left)]
            return exact
        return self._blend(self._slots[plan.left], self._slots[plan.right], plan.weight)


def _chosen(plan: Resampling, columns: IntArray) -> Resampling:
    """A plan of some columns."""
    return Resampling(plan.left[columns], plan.right[columns], plan.weight[columns], np.empty(0, np.int64))
