"""What can be wrong with a turntable and its cameras: flaws of the world, which no line repairs.

Everything is drawn from the seed and from the name of the column, so a column sent again is the same column.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.grid import STEPS_MAX, VOID, ImageArray, StepArray

SATURATED = 255
_SPIKE_STEPS = 3000


@dataclass(frozen=True, slots=True)
class Flaws:
    """A set of flaws; by default there are none.

    is_reversed : the table turns clockwise, and the encoder says so.   lost_ticks : counts that the encoder misses,
    `mishap_turns` after the start.   slip_turns : how far what stands on the table slides against it, there in the
    first sweep since power on, to stay there.   nudge_turns : how far somebody turns it after that sweep.
    overshoot_turns : how far the table runs on, still exposing columns.
    dead_rows : rows of the range camera that measure nothing.   saturated_columns : texture columns blinded in a pass.
    spikes, dropouts : share of range samples far off, or void.   noise_steps : standard deviation of the range.
    """

    seed: int = 0
    is_reversed: bool = False
    lost_ticks: int = 0
    slip_turns: float = 0.0
    nudge_turns: float = 0.0
    mishap_turns: float = 0.4
    overshoot_turns: float = 0.0
    dead_rows: int = 0
    saturated_columns: int = 0
    spikes: float = 0.0
    dropouts: float = 0.0
    noise_steps: float = 0.0

    def count_shown(self, turned: int, counts_per_turn: int) -> int:
        """What the encoder shows, in counts since the start, when the table has really turned by `turned`."""
        missed = self.lost_ticks if abs(turned) >= self.mishap_turns * counts_per_turn else 0
        return turned - missed if turned >= 0 else turned + missed

    def turns_seen(self, turned: int, counts_per_turn: int, sweep: int) -> float:
        """How far round the specimen the cameras look then, in sweep 1, 2, ... since power on. [turns]"""
        has_slid = sweep > 1 or abs(turned) >= self.mishap_turns * counts_per_turn
        return turned / counts_per_turn + self.slip_turns * has_slid + self.nudge_turns * (sweep > 1)

    def range_seen(self, steps: StepArray, pass_index: int, column: int) -> StepArray:
        """(H,) what the range camera makes of a column."""
        if not (self.dead_rows or self.spikes or self.dropouts or self.noise_steps):
            return steps
        rng = np.random.default_rng((self.seed, 1, pass_index, column))
        seen = steps.astype(np.int64)
        measured = steps != VOID
        seen += np.rint(rng.normal(0.0, self.noise_steps, len(seen))).astype(np.int64)
        seen += _SPIKE_STEPS * rng.choice([-1, 0, 1], len(seen), p=(self.spikes / 2, 1 - self.spikes, self.spikes / 2))
        seen = np.where(measured & (rng.random(len(seen)) >= self.dropouts), np.clip(seen, 1, STEPS_MAX), VOID)
        seen[self._dead(len(seen))] = VOID
        return seen.astype(np.uint16)

    def texture_seen(self, texels: ImageArray, pass_index: int, column: int, width: int) -> ImageArray:
        """(Ht, 3) what the colour camera makes of a column."""
        if not self.saturated_columns:
            return texels
        count = min(self.saturated_columns, width)
        blinded = np.random.default_rng((self.seed, 2, pass_index)).choice(width, count, replace=False)
        return np.full_like(texels, SATURATED) if column in blinded else texels

    def _dead(self, height: int) -> list[int]:
        """The rows that measure nothing, of a camera with so many."""
        chosen = np.random.default_rng((self.seed, 3)).choice(height, min(self.dead_rows, height), replace=False)
        return [int(row) for row in chosen]


FLAWLESS = Flaws()
