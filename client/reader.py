"""The reading half of a session: takes what the node says, changes the model, and tells whoever waits.

One task reads the stream and is the only one that changes the model: refinements are applied one after the other, in
a worker thread, so that the event loop stays free. Whoever asked for something waits on a future of that request.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar
from weakref import WeakSet

from client.errors import NodeLost, RequestRefused
from client.live import LiveFeed
from client.model import Applied, Model
from client.news import News, NewScan
from client.replica import Replica
from client.stream import Stream
from client.update import Tally, Update
from protocol import messages as m
from protocol.errors import RemoteWireError
from protocol.live import LiveColumns
from protocol.refinement import Generator, Refinement
from protocol.session import Said

READ_OUT_S = 5.0  # of a line that is closed already; all that came is there
log = logging.getLogger(__name__)

Answer = TypeVar("Answer", Model, Update, m.Enveloped)


@dataclass(frozen=True, slots=True)
class Stats:
    """What a session has carried so far. Bytes are of WebSocket messages; apply_s is decoding and reconstruction."""

    bytes_sent: int
    bytes_received: int
    refinements: int
    samples: int
    updates: int
    resyncs: int
    apply_s: float


class Reader:
    """Reads a stream from now on. live : the running sweep's frames.  ended : why nothing more comes; None: it does."""

    def __init__(self, stream: Stream) -> None:
        self.live = LiveFeed()
        self.ended: Exception | None = None
        self._stream = stream
        self._replica: Replica | None = None
        self._request = 0
        self._opening: dict[int, asyncio.Future[Model]] = {}
        self._looking: dict[int, asyncio.Future[Update]] = {}
        self._enveloping: dict[int, asyncio.Future[m.Enveloped]] = {}
        self._waiting: tuple[dict[int, asyncio.Future[Any]], ...] = self._opening, self._looking, self._enveloping
        self._tallies: dict[int, Tally] = {}
        self._news: WeakSet[News] = WeakSet()
        self._refinements = self._samples = self._updates = self._resyncs = 0
        self._apply_s = 0.0
        self._applying: asyncio.Future[Applied | None] | None = None
        self._task = asyncio.create_task(self._read())

    @property
    def model(self) -> Model | None:
        """The scan that is open; None before the first."""
        return self._replica.model if self._replica and self._replica.model.complete else None

    @property
    def stats(self) -> Stats:
        """What the stream has carried so far."""
        return Stats(
            self._stream.bytes_sent,
            self._stream.bytes_received,
            self._refinements,
            self._samples,
            self._updates,
            self._resyncs,
            self._apply_s,
        )

    def new_request(self) -> int:
        """The number of the next request."""
        self._request += 1
        return self._request

    def opening(self, request: int) -> AbstractContextManager[asyncio.Future[Model]]:
        """While somebody waits for a scan to be open: its model, once the first view is in."""
        return _answer_in(self._opening, request)

    @contextmanager
    def looking(self, request: int) -> Iterator[asyncio.Future[Update]]:
        """While somebody waits for the answer to a look."""
        self._tallies[request] = Tally(request)
        try:
            with _answer_in(self._looking, request) as answer:
                yield answer
        finally:
            del self._tallies[request]

    def enveloping(self, request: int) -> AbstractContextManager[asyncio.Future[m.Enveloped]]:
        """While somebody waits to hear how far off each block is."""
        return _answer_in(self._enveloping, request)

    def is_looking(self, request: int) -> bool:
        """Whether a look is still to be answered."""
        return request in self._looking and self.ended is None

    def published(self) -> News:
        """Scans published from now on."""
        news = News()
        self._news.add(news)
        if self.ended is not None:
            news.end(self.ended)
        return news

    async def read_out(self) -> None:
        """Wait until all is read that a node said before it went, the reason among it."""
        await asyncio.wait({self._task}, timeout=READ_OUT_S)

    async def close(self) -> None:
        """Read no more; whoever still waits gets NodeLost."""
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        if self._applying is not None:
            await asyncio.gather(self._applying, return_exceptions=True)
        self._end(NodeLost("the session was closed"), on_purpose=True)

    async def _read(self) -> None:
        try:
            while True:
                await self._take(*await self._stream.receive())
        except RemoteWireError as violation:
            self._end(violation)
            await self._stream.close(violation)
        except Exception as error:  # whatever it was, whoever waits must hear of it
            self._end(error)

    async def _take(self, said: Said, size: int) -> None:
        match said:
            case Refinement():
                await self._refine(said, size)
            case m.Opened():
                self._bind(said)
            case m.Updated():
                await self._answer(said, size)
            case m.Enveloped(request=request):
                if (asked := self._enveloping.pop(request, None)) is not None:
                    _settle(asked, said)
            case m.Resync():
                await self._state(self._bound().state())
            case m.Refused():
                self._refuse(said)
            case m.Published(scan, sweep, made_from):
                for news in list(self._news):
                    news.tell(NewScan(scan, sweep, made_from))
            case LiveColumns() | m.LiveStarted() | m.LiveProgress() | m.LiveEnded():
                self.live.take(said)
            case m.Goodbye(reason=reason):
                raise NodeLost(f"{self._stream.url} ended the stream: {reason}")

    async def _refine(self, refinement: Refinement, size: int) -> None:
        replica, tally = self._bound(), self._tallies.get(refinement.look)
        if tally is not None:
            tally.bytes_received += size
        self._applying = asyncio.get_running_loop().run_in_executor(None, replica.apply, refinement)
        applied = await asyncio.shield(self._applying)
        if applied is None:
            await self._state(replica.object())
            return
        self._refinements += 1
        self._samples += refinement.samples
        self._apply_s += applied.apply_s
        if tally is not None:
            tally.add(refinement, applied)
        if refinement.generator is Generator.COARSE and replica.model.complete:
            await self._first_view(replica)

    async def _first_view(self, replica: Replica) -> None:
        if (waiting := self._opening.pop(replica.request, None)) is not None:
            _settle(waiting, replica.model)
        await self._say(replica.acknowledge())

    def _bind(self, opened: m.Opened) -> None:
        self._check_asked(opened.request)
        self._replica = Replica(opened)
        for older in [request for request in self._looking if request < opened.request]:
            self._close(m.Updated(older, 0, "superseded"))

    async def _answer(self, updated: m.Updated, size: int) -> None:
        self._check_asked(updated.request)
        replica = self._bound()
        superseded = updated.reason == "superseded"  # may overtake the update in the air, so it says nothing of order
        lost = 0 if superseded else replica.missing(updated)
        self._updates += 1
        if updated.request in self._looking:
            self._tallies[updated.request].bytes_received += size
            self._close(updated, lost)
        if lost:
            await self._state(replica.object())
        elif not superseded:
            await self._say(replica.acknowledge())

    async def _state(self, state: m.State | None) -> None:
        if state is not None:
            self._resyncs += 1
            await self._say(state)

    def _close(self, updated: m.Updated, lost: int = 0) -> None:
        """Answer a look."""
        _settle(self._looking.pop(updated.request), self._tallies[updated.request].close(updated, lost))

    def _refuse(self, refused: m.Refused) -> None:
        error = RequestRefused(refused.code, refused.message)
        for waiting in self._waiting:
            if (answer := waiting.pop(refused.request, None)) is not None:
                _settle(answer, error)
                return
        log.warning("%s, about request %d, which nobody waits for", error, refused.request)

    async def _say(self, message: m.FromClient) -> None:
        """Say something, if the node still listens; why it does not is read next."""
        with suppress(NodeLost):
            await self._stream.send(message)

    def _end(self, cause: Exception, on_purpose: bool = False) -> None:
        if self.ended is not None:
            return
        self.ended = cause
        for waiting in self._waiting:
            for answer in waiting.values():
                _settle(answer, cause)
            waiting.clear()
        for news in list(self._news):
            news.end(None if on_purpose else cause)
        self.live.end(None if on_purpose else cause)

    def _check_asked(self, request: int) -> None:
        if not 0 < request <= self._request:
            raise RemoteWireError(f"an answer to request {request}, which nobody made")

    def _bound(self) -> Replica:
        if self._replica is None:
            raise RemoteWireError("the node speaks of a scan before one is open")
        return self._replica


@contextmanager
def _answer_in(waiting: dict[int, asyncio.Future[Answer]], request: int) -> Iterator[asyncio.Future[Answer]]:
    """A place for the answer to a request, for as long as somebody waits for it."""
    answer: asyncio.Future[Answer] = asyncio.get_running_loop().create_future()
    waiting[request] = answer
    try:
        yield answer
    finally:
        waiting.pop(request, None)


def _settle(answer: asyncio.Future[Answer], value: Answer | Exception) -> None:
    """Give an answer to whoever waits for it, unless they were cancelled in this very turn of the loop."""
    if answer.done():
        return
    if isinstance(value, Exception):
        answer.set_exception(value)
    else:
        answer.set_result(value)
