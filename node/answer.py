"""The answer to one look: planned in a thread or a process of its own, sent in parts as these are there."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from typing import Any

from node.ahead import Ahead
from node.bound import AnyUpdate, Bound, updated
from node.coded import Coded
from node.exhibits import Exhibits
from node.foveate import Update
from node.metrics import Metrics
from node.outbox import Outbox
from node.wanted import Wanted
from protocol import messages as m
from protocol.errors import CodecError, LatticeError

QUICK_BYTES_S = 50e6 / 8  # on faster links time counts more than bytes


class Answer:
    """For the event loop: `plan`, and with what comes of that `send`. is_wanted : until the client takes its look back.

    is_overtaken : whether a newer look shall stop this one.
    """

    def __init__(
        self, look: m.Look, bound: Bound, outbox: Outbox, exhibits: Exhibits, metrics: Metrics,
        is_overtaken: Callable[[], bool],
    ) -> None:  # fmt: skip
        self.look, self._bound, self._outbox = look, bound, outbox
        self._exhibits, self._metrics = exhibits, metrics
        self._is_overtaken = is_overtaken
        self.is_wanted = True

    async def plan(self, codecs: Sequence[m.CodecName], hurried: bool) -> AnyUpdate:
        """The update, its beginning sent already where that was there earlier. codecs, hurried : as of Wanted.

        Raises LatticeError or CodecError where the look does not fit the scan or its opening.
        """
        bound, state = self._bound, self._bound.state
        try:
            update = await self._plan(self._wanted(codecs, hurried))
        except (LatticeError, CodecError):
            await self._call_off()
            raise
        self.is_wanted |= bound.begun > 0
        if bound.state is not state:  # the client has objected to what came ahead
            bound.begun, self.is_wanted = 0, False
        return update

    def _wanted(self, codecs: Sequence[m.CodecName], hurried: bool) -> Wanted:
        look, rate = self.look, self._outbox.rate
        budget = look.max_bytes
        if look.max_wait_s is not None:
            affordable = rate.budget_bytes(look.max_wait_s)
            budget = affordable if budget is None else min(budget, affordable)
        return Wanted(look, tuple(codecs), budget, rate.bandwidth_bytes_s > QUICK_BYTES_S, hurried)

    def _superseded(self) -> bool:
        return not self.is_wanted or self._is_overtaken()

    async def _plan(self, wanted: Wanted) -> AnyUpdate:
        bound, models = self._bound, self._exhibits.models(self._bound.scan)
        if wanted.hurried:
            self._metrics.hurried()
        pool = None if wanted.hurried else self._exhibits.idle_pool()
        ahead = Ahead(self._superseded)

        def job() -> AnyUpdate:
            update = bound.plan(wanted, models, ahead.superseded, pool, None if pool is None else ahead.send)
            return update.settled() if pool is None and isinstance(update, Update) else update

        def elsewhere() -> AnyUpdate | None:
            return self._exhibits.planners.plan(bound, wanted, models, self._superseded)

        planning = asyncio.ensure_future(self._exhibits.work(job, "look", None if pool else elsewhere))
        try:
            either: set[asyncio.Future[Any]] = {planning, ahead.first}
            await asyncio.wait(either, return_when=asyncio.FIRST_COMPLETED)
            if ahead.first.done():
                await self._send_ahead(ahead.first.result())
            return await planning
        finally:
            planning.cancel()

    async def _send_ahead(self, coded: Sequence[Coded]) -> None:
        """Send what the update begins with while the rest is planned."""
        self._outbox.begin()
        for refinement in self._bound.begin(coded, self.look):
            await self._outbox.send_bytes(refinement)

    async def _call_off(self) -> None:
        """There is no end of an update that was begun: the client shall say what it holds."""
        if self._bound.begun:
            self._bound.begun = 0
            await self._outbox.send(m.Resync(self._bound.epoch, "an update could not be ended"))

    async def send(self, update: AnyUpdate, spent_s: float) -> None:
        """Send what was planned, but for what was sent ahead, and that it ends there. spent_s : planning it took."""
        if self._bound.begun:
            self._outbox.go_on()
        elif update.coded:
            self._outbox.begin()
        for refinement in self._bound.take(update, self.look):  # counts all at once, as what is said meanwhile must
            await self._outbox.send_bytes(refinement)
        if isinstance(update, Update) and update.settle is not None:
            update = await self._exhibits.work(update.settled)
        self._metrics.updated(update.reason)
        await self._outbox.send(updated(self.look, self._bound.next_seq, update, spent_s))
