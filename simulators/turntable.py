"""A turntable with a range camera and a colour camera: knows angles, counts and time, and nothing of bytes.

The table turns counter-clockwise seen from above. Each camera is triggered once per column by the encoder; jitter moves
the moment of the trigger, and the encoder says truly where the table stood then, unless a flaw says otherwise. Time
enters as `step(dt_s)`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.grid import Grid, ImageArray, IntArray, StepArray
from protocol.scanner_messages import OVERLAP_TURN, Channel
from simulators.flaws import FLAWLESS, Flaws

_COUNTS_MIN = 65536  # a coarser encoder would make jitter a matter of one or two counts
_COUNT_LIMIT = 2**31
_CHANNELS = {int(channel): channel for channel in (Channel.RANGE, Channel.TEXTURE)}  # looked up, thousands a second
_JITTER_REACH = 0.4  # of a column; so columns of one channel never change places


class Standing(Protocol):
    """What can stand on the table (simulators.specimen.Specimen does)."""

    @property
    def grid(self) -> Grid:
        """Its truth, and the geometry of that."""
        ...

    def range_column(self, angle_rad: float) -> StepArray:
        """(H,) uint16 steps seen at an angle."""
        ...

    def texture_column(self, angle_rad: float) -> ImageArray:
        """(Ht, 3) uint8 RGB seen at an angle."""
        ...


@dataclass(frozen=True, slots=True)
class Exposure:
    """One column was seen: by which camera, in which pass, at which encoder count and time.

    turned : how far the table had really turned since the start. [counts]
    """

    channel: Channel
    pass_index: int
    column: int
    encoder: int
    time_us: int
    turned: int


@dataclass(frozen=True, slots=True)
class _Schedule:
    """Triggers of a sweep. counts : (n,) ascending.  triggers : count, channel, pass, column of each."""

    counts: IntArray
    triggers: list[tuple[int, int, int, int]]


class Turntable:
    """Table, cameras, and what stands there.

    turn_s : time of a turn at full speed.     jitter_counts : standard deviation of the trigger. [encoder counts]
    home_encoder : count at the home mark, where the angle is the specimen's theta0_rad.
    Without jitter every column is seen at exactly its nominal angle: a turn has counts for each of them.
    """

    def __init__(
        self,
        specimen: Standing,
        *,
        turn_s: float = 1.0,
        jitter_counts: float = 0.0,
        home_encoder: int = 0,
        seed: int = 0,
        flaws: Flaws = FLAWLESS,
    ) -> None:
        spec = specimen.grid.spec
        nominal = math.lcm(2 * spec.width, 2 * spec.texture_width)
        self.specimen = specimen
        self.counts_per_turn = nominal * -(-_COUNTS_MIN // nominal)
        self.home_encoder = home_encoder
        self._rate = self.counts_per_turn / turn_s
        self._jitter_counts = jitter_counts
        self._flaws = flaws
        self._sense = -1 if flaws.is_reversed else 1
        self._haste = 1  # how many times faster than a whole pass the first turn goes
        self._sweeps = 0
        self._rng = np.random.default_rng(seed)
        self._time_s = 0.0
        self._position = 0.0  # counts since the home mark of this movement
        self._goal = 0.0
        self._next = 0
        self._schedule = self._plan(Channel(0), 0, 0, 1)

    @property
    def encoder(self) -> int:
        """What the encoder shows. [counts]"""
        return self._shown(self._sense * math.floor(self._position))

    @property
    def is_moving(self) -> bool:
        """Whether it is on its way somewhere."""
        return self._position < self._goal

    def home(self) -> None:
        """Set out for the home mark."""
        self._set_out(self._plan(Channel(0), 0, 0, 1), 0)

    def begin(self, channels: Channel, passes: int, overlap: int = 0, stride: int = 1) -> None:
        """Set out for a sweep, which begins at the home mark.

        overlap : how far to go on after the passes, in 1/256 turn.   stride : of the first pass, take every so many-th
        column in a fast turn and the others in another. Raises ValueError if the encoder cannot count so far.
        """
        turns = passes + (stride > 1) + overlap / OVERLAP_TURN + self._flaws.overshoot_turns
        goal = math.ceil(turns * self.counts_per_turn)
        if abs(self.home_encoder) + goal + self.counts_per_turn >= _COUNT_LIMIT:
            raise ValueError(f"{passes} passes of {self.counts_per_turn} counts overrun the encoder")
        self._set_out(self._plan(channels, passes, overlap, stride), goal)
        self._sweeps += 1
        self._haste = stride

    def halt(self) -> None:
        """Stop where it stands."""
        self._goal = self._position

    def step(self, dt_s: float, room: int) -> list[Exposure]:
        """Let time pass. Returns what was exposed; the table stops at the last column there is `room` for."""
        schedule, position = self._schedule, self._position
        rate = self._rate_at(position)
        reach = min(position + rate * dt_s, self._goal)
        end = int(schedule.counts.searchsorted(math.floor(reach), "right"))
        if end > self._next + room:
            end = self._next + room
            reach = max(position, float(schedule.counts[end - 1])) if end else position
        seen = [self._expose(i, position, rate) for i in range(self._next, end)]
        self._next, self._position = end, reach
        self._time_s += dt_s
        return seen

    def samples(self, exposure: Exposure) -> StepArray | ImageArray:
        """What the camera saw: (H,) uint16 steps or (Ht, 3) uint8 RGB."""
        spec, flaws = self.specimen.grid.spec, self._flaws
        turns = flaws.turns_seen(exposure.turned, self.counts_per_turn, self._sweeps)
        angle_rad = spec.theta0_rad + 2 * math.pi * turns
        place = exposure.pass_index, exposure.column
        if exposure.channel is Channel.RANGE:
            return flaws.range_seen(self.specimen.range_column(angle_rad), *place)
        return flaws.texture_seen(self.specimen.texture_column(angle_rad), *place, spec.texture_width)

    def _expose(self, index: int, position: float, rate: float) -> Exposure:
        """Trigger number `index`, while the table moves on from `position`."""
        count, channel, pass_index, column = self._schedule.triggers[index]
        time_s = self._time_s + max(0.0, (count - position) / rate)
        turned = self._sense * count
        return Exposure(_CHANNELS[channel], pass_index, column, self._shown(turned), round(1e6 * time_s), turned)

    def _shown(self, turned: int) -> int:
        """The encoder's count when the table has turned so far since the start."""
        return self.home_encoder + self._flaws.count_shown(turned, self.counts_per_turn)

    def _rate_at(self, position: float) -> float:
        """Speed. [counts/s]"""
        return self._rate * (self._haste if position < self.counts_per_turn else 1)

    def _set_out(self, schedule: _Schedule, goal: float) -> None:
        """Take the next home mark ahead as the origin, and `goal` counts behind it as the end."""
        beyond = self._position % self.counts_per_turn
        self._position = beyond - self.counts_per_turn if beyond else 0.0
        self._schedule, self._goal, self._next, self._haste = schedule, goal, 0, 1

    def _plan(self, channels: Channel, passes: int, overlap: int, stride: int) -> _Schedule:
        spec = self.specimen.grid.spec
        widths = {Channel.RANGE: spec.width, Channel.TEXTURE: spec.texture_width}
        beyond = self._flaws.overshoot_turns
        parts = [
            self._plan_channel(channel, width, passes, _places(width, passes, overlap, stride, beyond))
            for channel, width in widths.items()
            if channel in channels
        ]
        table = np.concatenate([*parts, np.empty((0, 4), np.int64)])
        table = table[np.argsort(table[:, 0], kind="stable")]
        return _Schedule(np.ascontiguousarray(table[:, 0]), [tuple(trigger) for trigger in table.tolist()])

    def _plan_channel(
        self, channel: Channel, width: int, passes_named: int, places: tuple[IntArray, IntArray]
    ) -> IntArray:
        """(n, 4) count, channel, pass, column of one camera's triggers."""
        index, passes = places
        spacing = self.counts_per_turn // width
        counts = (2 * index + 1) * (spacing // 2) + self._jitter(len(index), spacing)
        columns = index % width
        if self._sense < 0:  # those of the overlap are named in the order in which they come
            columns = np.where(passes < passes_named, width - 1 - columns, columns)
        return np.stack([counts, np.full_like(index, channel), passes, columns], axis=1)

    def _jitter(self, n: int, spacing: int) -> NDArray[np.int64]:
        """(n,) displacements of triggers `spacing` counts apart. [counts]"""
        reach = int(_JITTER_REACH * spacing)
        return np.clip(np.rint(self._rng.normal(0.0, self._jitter_counts, n)), -reach, reach).astype(np.int64)


def _places(width: int, passes: int, overlap: int, stride: int, overshoot: float) -> tuple[IntArray, IntArray]:
    """Where a camera of `width` columns a turn is triggered: (n,) columns since the start, (n,) the pass of each."""
    turn = np.arange(width)
    first = [turn[::stride], width + np.delete(turn, np.s_[::stride])] if stride > 1 else [turn]
    if not passes:
        first = []
    later = [(len(first) - 1 + p) * width + turn for p in range(1, passes)]
    end = width * (len(first) + len(later))
    beyond = end + turn[: width * overlap // OVERLAP_TURN]
    too_far = beyond.size + end + turn[: int(overshoot * width)]
    parts = [*((0, part) for part in first), *enumerate(later, 1), (passes, beyond), (passes + 1, too_far)]
    return np.concatenate([part for _, part in parts]), np.concatenate([np.full_like(part, p) for p, part in parts])
