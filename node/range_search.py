"""The range of one look: spacing and quantum that reach the error asked for, or that fit a limit.

What a quantum leaves and takes is known without coding (protocol.codec_lift.Survey), so the choice costs no encode.

Source: REQUIREMENTS F-14b, E-01.
"""

from __future__ import annotations

import math

import msgspec

from node.coded import Coded
from node.library import Scan
from node.quality import Encodes
from node.range_bitmaps import reach_range
from node.range_model import RangeModel
from node.refine_range import (
    QUANTUM_MAX,
    Trial,
    choose_range,
    code_range,
    expected_range_bytes,
    guess_range,
    select_range,
    trial_of,
)
from node.state import ClientState
from protocol.lattice import Channel
from protocol.messages import Look, RangeParameters
from protocol.region import Region

SKIRT_S = 1.0
AIM_SHORT = 0.04  # of the bytes there are: expectations are a few percent off
SPARE_SHARE = 0.6  # of the bytes that may stay unused: where there are many, aiming that much lower spares an encode
AIM_SHORT_MAX = 0.12
TRIES_MAX = 4
GUESSES = 6
FINENESS = 1 / 32  # of a quantum, to which it is searched
DOUBLINGS_A_HALVING = 1.4  # of the quantum, of the bytes
FINER_FROM = 0.25  # of the quantum wanted: from there on a closer spacing may leave less error
SPACING_MAX = 8
OVERSTATED = 1.06  # by this at most are interpolated errors as they are known beforehand


class RangeSearch:
    """Finds the range refinements that answer a look."""

    def __init__(
        self,
        scan: Scan,
        state: ClientState,
        look: Look,
        region: Region,
        model: RangeModel | None,
        hurried: bool,
        encodes: Encodes,
    ) -> None:
        self._scan, self._state, self._look, self._region, self._encodes = scan, state, look, region, encodes
        self._model = model if model is not None and model.knows else None
        self._hurried = hurried
        self.target_steps = look.range_mm / scan.spec.step_mm
        self._expected: dict[RangeParameters, float] = {}
        self._errors: dict[int, float] = {}
        self._trials: dict[int, Trial | None] = {}

    def choose(self, target_steps: float) -> RangeParameters:
        """The cheapest parameters that reach a range error, with the skirt asked for; about these in a hurry."""
        if self._model is None:
            return self._with_skirt(choose_range(self._trial, target_steps))
        guess = guess_range(self._interpolated, target_steps)
        if self._hurried:
            return self._with_skirt(guess)

        def possible(p: int) -> Trial | None:
            error = self._interpolated(p)
            trial = self._trial(p) if error <= OVERSTATED * target_steps else None
            if trial is not None and error <= target_steps:
                trial.assume(error)
            return trial

        return self._with_skirt(choose_range(possible, target_steps, guess.p))

    def expected_bytes(self, wanted: RangeParameters, region: Region | None = None) -> float:
        """What range of the window (or of another region) is expected to take on the wire; 0: it is held already."""
        if region is not None:
            return expected_range_bytes(self._scan, *select_range(self._state, region, wanted))
        if wanted not in self._expected:
            self._expected[wanted] = expected_range_bytes(self._scan, *select_range(self._state, self._region, wanted))
        return self._expected[wanted]

    def reach(self, wanted: RangeParameters) -> list[Coded]:
        """The refinements after which the window is as good as asked for."""
        self._encodes.add()
        found = reach_range(
            self._scan, self._state, self._region, wanted, self.target_steps,
            quick=self._hurried, trial=self._trials.get(wanted.p),
        )  # fmt: skip
        self._encodes.count += max(len(found) - 1, 0)
        return found

    def within(self, wanted: RangeParameters, limit_bytes: float, spare_bytes: float) -> Coded | None:
        """Range with the least error that fits a limit, which it should fill but for spare_bytes.

        None where nothing fits, or where the client holds all of it.
        """
        best, larger = None, 1.0
        short = min(max(SPARE_SHARE * spare_bytes, AIM_SHORT * limit_bytes), AIM_SHORT_MAX * limit_bytes)
        tried: set[tuple[int, int]] = set()
        for _ in range(TRIES_MAX):
            parameters = self._affordable(wanted, (limit_bytes - short) / larger)
            if parameters is None or (parameters.p, parameters.quantum) in tried:
                break
            tried.add((parameters.p, parameters.quantum))
            self._encodes.add()
            coded = code_range(self._scan, self._state, self._region, parameters, quick=self._hurried)
            if coded is None:
                return best
            larger = coded.wire_bytes / max(self.expected_bytes(parameters), 1.0)
            short = min(short, AIM_SHORT / 2 * limit_bytes)
            if coded.wire_bytes <= limit_bytes and (best is None or best.wire_bytes < coded.wire_bytes):
                best = coded
            if best is not None and (limit_bytes - best.wire_bytes <= spare_bytes or len(tried) > 1):
                break
        return best

    def _with_skirt(self, parameters: RangeParameters) -> RangeParameters:
        s = SKIRT_S if self._look.alpha is None else 1 / (self._look.alpha * parameters.p)
        return msgspec.structs.replace(parameters, s=s)

    def _affordable(self, wanted: RangeParameters, limit_bytes: float) -> RangeParameters | None:
        """The spacing and quantum with the least error among those expected to fit; None where none is."""
        best = self._finest(wanted, limit_bytes)
        coarser = best is None or best.quantum > wanted.quantum
        if best is not None and not coarser and best.quantum > FINER_FROM * wanted.quantum:
            return best
        p = wanted.p * 2 if coarser else wanted.p // 2
        while 1 <= p <= SPACING_MAX and (trial := self._trial(p)) is not None:
            other = self._finest(self._with_skirt(msgspec.structs.replace(wanted, p=p)), limit_bytes)
            if other is not None:
                if best is not None and trial.error(other.quantum) >= self._error(best):
                    break
                best = other
            p = p * 2 if coarser else p // 2
        return best

    def _finest(self, wanted: RangeParameters, limit_bytes: float) -> RangeParameters | None:
        """The same spacing with the smallest quantum expected to fit; None where none is."""
        low, high, quantum = 0, QUANTUM_MAX + 1, wanted.quantum  # low takes too much, high does not
        for _ in range(GUESSES):
            size_bytes = self.expected_bytes(msgspec.structs.replace(wanted, quantum=quantum))
            low, high = (quantum, high) if size_bytes > limit_bytes else (low, quantum)
            if high - low <= max(low * FINENESS, 1):
                break
            guess = round(quantum * (max(size_bytes, 1.0) / max(limit_bytes, 1.0)) ** DOUBLINGS_A_HALVING)
            quantum = min(max(guess, low + 1), high - 1, QUANTUM_MAX)
        return msgspec.structs.replace(wanted, quantum=high) if high <= QUANTUM_MAX else None

    def _error(self, parameters: RangeParameters) -> float:
        trial = self._trial(parameters.p)
        return trial.error(parameters.quantum) if trial is not None else 0.0

    def _interpolated(self, p: int) -> float:
        """Error of a spacing that is not quantised. [steps]"""
        assert self._model is not None  # else nobody asks
        if p not in self._errors:
            shape = self._state.shapes[Channel.RANGE]
            finer = p * p < 1 << shape.coarse_level  # than the first view: else nobody would adopt it
            self._errors[p] = self._model.error(self._region, p) if finer else math.inf
        return self._errors[p]

    def _trial(self, p: int) -> Trial | None:
        if p not in self._trials:
            self._trials[p] = trial_of(self._scan, self._state, self._region, p)
        return self._trials[p]
