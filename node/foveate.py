"""Planning one update: a pure function of a scan, a client's state, what it asks for and the bytes it may take.

Range goes first, since shape without colour helps and colour on the wrong shape does not; texture takes what is left.
Nothing over the budget is ever returned: every candidate is encoded and weighed before it counts.

Source: Cheng, Basu, Pan 2003, Eq. (15), with REQUIREMENTS F-14 and F-14b.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from node.coded import Coded
from node.library import Scan
from node.quality import Point, QualitySearch
from node.refine_range import choose_range, code_range, note_range
from node.refine_texture import SPACINGS, choose_spacing, code_texture, coded_mse, db_of_mse, quality_bounds
from node.state import ClientState
from protocol.grid import RANGE_BLOCK
from protocol.lattice import Channel
from protocol.messages import CodecName, Look, RangeParameters, TextureParameters
from protocol.region import Region, region_round

REPLY_BYTES = 220  # the Updated message that ends an update, carrier included

Reason = Literal["complete", "byte limit", "superseded"]


@dataclass(frozen=True, slots=True)
class Update:
    """A planned update.

    coded : its refinements, in order.    state : the client's state once they have arrived.
    error_max_mm, texture_db : what is left in the window; None where this update did not measure it.
    """

    coded: tuple[Coded, ...]
    state: ClientState
    reason: Reason
    error_max_mm: float | None = None
    texture_db: float | None = None
    encodes: int = 0

    @property
    def wire_bytes(self) -> int:
        """What the update takes on the wire, reply and carrier included."""
        return REPLY_BYTES + sum(coded.wire_bytes for coded in self.coded)


def plan_update(
    scan: Scan,
    state: ClientState,
    look: Look,
    codec: CodecName,
    budget_bytes: int | None = None,
    superseded: Callable[[], bool] = lambda: False,
) -> Update:
    """Plan the update that answers a look.

    codec : the texture codec for this client.   budget_bytes : what the update may take; None for no limit.
    superseded : asked between encodes; when true, what is planned so far is dropped.
    Raises LatticeError or CodecError where explicit parameters do not fit the scan.
    """
    planner = _Planner(scan, state.copy(), look, codec, budget_bytes, superseded)
    try:
        planner.run()
    except _Superseded:
        return Update((), state, "superseded")
    return planner.update()


class _Superseded(Exception):
    """A newer look has come."""


class _Planner:
    """One update in the making."""

    def __init__(
        self,
        scan: Scan,
        state: ClientState,
        look: Look,
        codec: CodecName,
        budget_bytes: int | None,
        superseded: Callable[[], bool],
    ) -> None:
        self._scan, self._state, self._look, self._codec = scan, state, look, codec
        self._left = None if budget_bytes is None else budget_bytes - REPLY_BYTES
        self._superseded = superseded
        self._coded: list[Coded] = []
        self._encodes = 0
        self._limited = False
        self._texture_db: float | None = None
        s = scan.spec
        self._range_region = region_round(look.u, look.v, look.window, s.width, s.height)
        self._texture_region = region_round(look.u, look.v, look.window, s.texture_width, s.texture_height)

    def run(self) -> None:
        """Choose, encode and note the refinements."""
        explicit = self._look.parameters
        if explicit is not None:
            self._take(self._code_range(explicit.range) if explicit.range else None)
            self._take(self._code_texture(explicit.texture) if explicit.texture else None)
            return
        self._refine_range()
        self._refine_texture()

    def update(self) -> Update:
        """What came of it."""
        reason: Reason = "byte limit" if self._limited else "complete"
        error_mm = _error_in(self._state, self._range_region) * self._scan.spec.step_mm
        return Update(tuple(self._coded), self._state, reason, error_mm, self._texture_db, self._encodes)

    def _refine_range(self) -> None:
        target_steps = self._look.range_mm / self._scan.spec.step_mm
        choice = choose_range(self._scan, self._state, self._range_region, target_steps)
        for attempt, parameters in enumerate(_coarser_range(choice.parameters, self._scan.spec.width)):
            coded = self._code_range(parameters)
            if coded is None or self._fits(coded):
                self._limited |= attempt > 0
                self._take(coded)
                return
        self._limited = True

    def _refine_texture(self) -> None:
        look = self._look
        finest = choose_spacing(self._scan, self._state, self._texture_region, look.texture_db, self._codec)
        found = None
        for p in (spacing for spacing in reversed(SPACINGS) if spacing >= finest):
            found = self._search_quality(p)
            if found is not None or not self._limited:
                break
        if found is not None:
            self._texture_db = found.db
            self._take(found.coded)

    def _search_quality(self, p: float) -> Point | None:
        """The cheapest fitting refinement at spacing p that reaches the quality asked for, else the best that fits."""
        target = self._look.texture_db
        search = QualitySearch(target, *quality_bounds(self._codec))
        while (quality := search.next_quality()) is not None:
            coded = self._code_texture(TextureParameters(p=p, quality=quality, codec=self._codec))
            if coded is None:
                return None
            if self._fits(coded):
                search.measured(Point(quality, db_of_mse(coded_mse(self._scan, coded, self._texture_region)), coded))
            else:
                self._limited = True
                search.too_large(quality, coded.wire_bytes / max(self._left or 0, 1))
        return search.best()

    def _code_range(self, wanted: RangeParameters) -> Coded | None:
        self._count_encode()
        return code_range(self._scan, self._state, self._range_region, wanted)

    def _code_texture(self, wanted: TextureParameters) -> Coded | None:
        self._count_encode()
        return code_texture(self._scan, self._state, self._texture_region, wanted)

    def _count_encode(self) -> None:
        if self._superseded():
            raise _Superseded
        self._encodes += 1

    def _fits(self, coded: Coded) -> bool:
        return self._left is None or coded.wire_bytes <= self._left

    def _take(self, coded: Coded | None) -> None:
        if coded is None:
            return
        if not self._fits(coded):
            self._limited = True
            return
        if self._left is not None:
            self._left -= coded.wire_bytes
        if coded.channel is Channel.RANGE:
            note_range(self._scan, self._state, coded)
        else:
            coded.note(self._state)
        self._coded.append(coded)


def _coarser_range(first: RangeParameters, width: int) -> Iterator[RangeParameters]:
    """The parameters chosen, then ever cheaper ones, for a budget that is too small for them."""
    yield first
    for p in (1, 2, 4, 8):
        if p >= first.p and width % p == 0:
            yield RangeParameters(p=p, quantum=max(first.quantum, 2) * (4 if p == first.p else 1), s=None)


def _error_in(state: ClientState, region: Region) -> float:
    """Largest range error left in the blocks a region touches. [steps]"""
    left, top, wide, high = region.blocks(RANGE_BLOCK)
    columns = np.arange(left, left + wide) % state.error.shape[1]
    return float(state.error[top : top + high][:, columns].max(initial=0))
