"""A conversation with one node: open a scan, look at it, hear of new ones.

One task reads the stream and is the only one that changes the model: refinements are applied one after the other, in
a worker thread, so that the event loop stays free. Whoever asked for something waits on a future of that request.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar, overload
from weakref import WeakSet

import aiohttp
import msgspec

from client.classic_model import ClassicModel
from client.discovery import NodeAddress
from client.errors import NodeLost, RequestRefused
from client.live import LiveFeed, LiveFrame
from client.model import Applied, Model
from client.news import News
from client.replica import Replica
from client.rest import ask
from client.stream import Stream, open_stream
from client.update import Tally, Update
from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError
from protocol.holdings import LevelArray, RankArray
from protocol.lattice import Channel
from protocol.live import LiveColumns
from protocol.refinement import Generator, Refinement
from protocol.session import Said

log = logging.getLogger(__name__)

Answer = TypeVar("Answer", Model, Update)


class Held(NamedTuple):
    """Holdings of a channel, block by block: level (0 = every sample) and rank (larger = better)."""

    level: LevelArray
    rank: RankArray


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


@dataclass(frozen=True, slots=True, eq=False)
class _Looking:
    """A look in the air."""

    tally: Tally
    answer: asyncio.Future[Update]

    def close(self, said: m.Updated, lost: int = 0) -> None:
        _settle(self.answer, self.tally.close(said, lost))


@asynccontextmanager
async def connect(node: NodeAddress | str, token: str | None = None) -> AsyncIterator[Session]:
    """A session with a node, given by what `discover` found or by its URL (http://HOST:PORT).

    Raises NodeLost when there is none, RequestRefused when it lets nobody in, RemoteWireError when it speaks otherwise.
    """
    url = node.url if isinstance(node, NodeAddress) else node.rstrip("/")
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    async with aiohttp.ClientSession(headers=headers) as http:
        stream, info = await open_stream(http, url, token)
        session = Session(http, stream, info)
        try:
            yield session
        finally:
            await session.close()


class Session:
    """See `connect`. node : who answers."""

    def __init__(self, http: aiohttp.ClientSession, stream: Stream, node: m.ServerInfo) -> None:
        self.node = node
        self._http = http
        self._stream = stream
        self._replica: Replica | None = None
        self._request = 0
        self._opening: dict[int, asyncio.Future[Model]] = {}
        self._looking: dict[int, _Looking] = {}
        self._news: WeakSet[News] = WeakSet()
        self._live = LiveFeed()
        self._refinements = self._samples = self._updates = self._resyncs = 0
        self._apply_s = 0.0
        self._ended: Exception | None = None
        self._applying: asyncio.Future[Applied | None] | None = None
        self._reader = asyncio.create_task(self._read())

    @property
    def model(self) -> Model | None:
        """The scan that is open; None before the first."""
        return self._replica.model if self._replica and self._replica.model.complete else None

    @property
    def stats(self) -> Stats:
        """What this session has carried so far."""
        return Stats(
            self._stream.bytes_sent,
            self._stream.bytes_received,
            self._refinements,
            self._samples,
            self._updates,
            self._resyncs,
            self._apply_s,
        )

    def holdings(self, channel: Literal["range", "texture"]) -> Held:
        """What both ends agree we hold of a channel, as copies.

        Raises LocalWireError when no scan is open, or one with the classic profile, which has owners instead.
        """
        model = self._opened_model()
        if isinstance(model, ClassicModel):
            raise LocalWireError("a classic model has owners, not levels: see model.owner and model.spacing")
        held = model.holdings.channels[Channel[channel.upper()]]
        return Held(held.level.copy(), held.rank.copy())

    @overload
    async def open(self, scan: str = "latest") -> Model: ...

    @overload
    async def open(self, scan: str = "latest", *, profile: Literal["classic"]) -> ClassicModel: ...

    @overload
    async def open(self, scan: str = "latest", *, profile: m.Profile) -> Model: ...

    async def open(self, scan: str = "latest", *, profile: m.Profile = "default") -> Model:
        """Bind a scan ("latest" or an id) to the session and return its model once the first view is in.

        profile : how it is refined from then on; "classic" is the paper's letter, to reproduce it.
        Looks that are not answered yet end as superseded. Raises RequestRefused for an unknown scan.
        """
        request = self._new_request()
        answer: asyncio.Future[Model] = asyncio.get_running_loop().create_future()
        self._opening[request] = answer
        try:
            await self._send(m.Open(request, scan, profile=profile))
            return await answer
        finally:
            self._opening.pop(request, None)

    async def look(
        self,
        u: float,
        v: float,
        *,
        window: float = 0.05,
        texture_db: float = 40,
        range_mm: float = 0.1,
        max_wait_s: float | None = None,
        max_bytes: int | None = None,
        fill: bool = False,
        alpha: float | None = None,
        scale: float | None = None,
        profile: m.Profile | None = None,
        parameters: m.LookParameters | m.ClassicLookParameters | Mapping[str, Any] | None = None,
    ) -> Update:
        """Refine the model round (u, v), both in [0, 1), and return once it holds what was asked for.

        window : share of the area.      texture_db, range_mm : stop at this quality in it, or at a budget of
        max_wait_s or max_bytes, whichever comes first; fill : spend what is left of it on the periphery.
        alpha : how fast detail falls off outside the window; scale : the window as a share of each axis instead.
        profile : the one the scan was opened with, to be sure of it.
        parameters : explicit sampling instead of the node's choice, as LookParameters (classic: ClassicLookParameters)
        or as the mapping of its JSON. A classic look knows alpha, scale (the paper's sigma), these and the budget only;
        without a scale it takes the largest that fits.
        A newer look supersedes an older one, which then returns early with reason "superseded".
        Raises LocalWireError for values out of bounds, RequestRefused, NodeLost, RemoteWireError.
        """
        bound = self._opened_model().info.profile
        if profile not in (None, bound):
            raise LocalWireError(f"look: the scan is open with the {bound} profile, not {profile!r}: open it anew")
        classic = bound == "classic"
        request = self._new_request()
        look = _checked_look(
            m.Look(
                request,
                u,
                v,
                window,
                texture_db,
                range_mm,
                max_wait_s,
                max_bytes,
                fill,
                alpha,
                scale,
                bound,
                None if classic else parameters,  # type: ignore[arg-type]  # a mapping is converted by the check
                parameters if classic else None,  # type: ignore[arg-type]
            )
        )
        answer: asyncio.Future[Update] = asyncio.get_running_loop().create_future()
        self._looking[request] = _Looking(Tally(request), answer)
        try:
            await self._send(look)
            return await answer
        except asyncio.CancelledError:
            if request in self._looking and self._ended is None:
                with suppress(NodeLost):
                    await self._send(m.Cancel(request))
            raise
        finally:
            self._looking.pop(request, None)

    def published(self) -> News:
        """Ids of scans published from now on: `async for scan in session.published()`."""
        news = News()
        self._news.add(news)
        if self._ended is not None:
            news.end(self._ended)
        return news

    async def live(self) -> AsyncGenerator[LiveFrame, None]:
        """The sweep that runs, else the next one, as it comes in: `async for frame in session.live()`.

        Frames follow each other as fast as they are read; the last one says how the sweep ended. Watching costs the
        link two bytes a cell and three a texel of the first view, once in a sweep. Raises what ends the session.
        """
        self._live.watchers += 1
        try:
            if self._live.watchers == 1:
                await self._send(m.Watch(True))
            async for frame in self._live.frames():
                yield frame
        finally:
            self._live.watchers -= 1
            if not self._live.watchers:
                self._live.forget()
                if self._ended is None:
                    with suppress(NodeLost):
                        await self._send(m.Watch(False))

    async def scans(self) -> list[dict[str, Any]]:
        """The scans in the node's library, newest first, as GET /v1/scans describes them."""
        return list(await ask(self._http, "GET", f"{self._stream.url}/v1/scans"))

    async def scanner(self) -> dict[str, Any]:
        """What the node's scanner is doing, as GET /v1/node says under "capture": phase, progress, sweeps, why."""
        return dict((await ask(self._http, "GET", f"{self._stream.url}/v1/node"))["capture"])

    async def start_sweep(self) -> dict[str, Any]:
        """Start a sweep. Returns at once with what POST /v1/sweeps says; the scan is announced by `published`."""
        return dict(await ask(self._http, "POST", f"{self._stream.url}/v1/sweeps"))

    async def close(self) -> None:
        """End the session; whoever still waits gets NodeLost. `connect` does this at the end of its block."""
        self._reader.cancel()
        await asyncio.gather(self._reader, return_exceptions=True)
        if self._applying is not None:
            await asyncio.gather(self._applying, return_exceptions=True)
        self._end(NodeLost("the session was closed"), on_purpose=True)
        await self._stream.close()

    # Reading

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
            case m.Resync():
                await self._state(self._bound().state())
            case m.Refused():
                self._refuse(said)
            case m.Published(scan=scan):
                for news in list(self._news):
                    news.tell(scan)
            case LiveColumns() | m.LiveStarted() | m.LiveProgress() | m.LiveEnded():
                self._live.take(said)
            case m.Goodbye(reason=reason):
                raise NodeLost(f"{self._stream.url} ended the stream: {reason}")

    async def _refine(self, refinement: Refinement, size: int) -> None:
        replica, look = self._bound(), self._looking.get(refinement.look)
        if look is not None:
            look.tally.bytes_received += size
        self._applying = asyncio.get_running_loop().run_in_executor(None, replica.apply, refinement)
        applied = await asyncio.shield(self._applying)
        if applied is None:
            await self._state(replica.object())
            return
        self._refinements += 1
        self._samples += refinement.samples
        self._apply_s += applied.apply_s
        if look is not None:
            look.tally.add(refinement, applied)
        if refinement.generator is Generator.COARSE and replica.model.complete:
            await self._first_view(replica)

    async def _first_view(self, replica: Replica) -> None:
        if (waiting := self._opening.pop(replica.request, None)) is not None:
            _settle(waiting, replica.model)
        await self._stream.send(replica.acknowledge())

    def _bind(self, opened: m.Opened) -> None:
        self._check_asked(opened.request)
        self._replica = Replica(opened)
        for older in [request for request in self._looking if request < opened.request]:
            self._looking.pop(older).close(m.Updated(older, 0, "superseded"))

    async def _answer(self, updated: m.Updated, size: int) -> None:
        self._check_asked(updated.request)
        replica = self._bound()
        superseded = updated.reason == "superseded"  # may overtake the update in the air, so it says nothing of order
        lost = 0 if superseded else replica.missing(updated)
        self._updates += 1
        if (look := self._looking.pop(updated.request, None)) is not None:
            look.tally.bytes_received += size
            look.close(updated, lost)
        if lost:
            await self._state(replica.object())
        elif not superseded:
            await self._stream.send(replica.acknowledge())

    async def _state(self, state: m.State | None) -> None:
        if state is not None:
            self._resyncs += 1
            await self._stream.send(state)

    def _refuse(self, refused: m.Refused) -> None:
        error = RequestRefused(refused.code, refused.message)
        if (look := self._looking.pop(refused.request, None)) is not None:
            _settle(look.answer, error)
        elif (opening := self._opening.pop(refused.request, None)) is not None:
            _settle(opening, error)
        else:
            log.warning("%s, about request %d, which nobody waits for", error, refused.request)

    def _end(self, cause: Exception, on_purpose: bool = False) -> None:
        if self._ended is None:
            self._ended = cause
            for opening in self._opening.values():
                _settle(opening, cause)
            for look in self._looking.values():
                _settle(look.answer, cause)
            self._opening.clear()
            self._looking.clear()
            for news in list(self._news):
                news.end(None if on_purpose else cause)
            self._live.end(None if on_purpose else cause)

    # Asking

    async def _send(self, message: m.FromClient) -> None:
        if self._ended is not None:
            raise self._ended
        await self._stream.send(message)

    def _new_request(self) -> int:
        self._request += 1
        return self._request

    def _check_asked(self, request: int) -> None:
        if not 0 < request <= self._request:
            raise RemoteWireError(f"an answer to request {request}, which nobody made")

    def _bound(self) -> Replica:
        if self._replica is None:
            raise RemoteWireError("the node speaks of a scan before one is open")
        return self._replica

    def _opened_model(self) -> Model:
        if self.model is None:
            raise LocalWireError("no scan is open; await session.open(...) first")
        return self.model


def _settle(answer: asyncio.Future[Answer], value: Answer | Exception) -> None:
    """Give an answer to whoever waits for it, unless they were cancelled in this very turn of the loop."""
    if answer.done():
        return
    if isinstance(value, Exception):
        answer.set_exception(value)
    else:
        answer.set_result(value)


def _checked_look(look: m.Look) -> m.Look:
    try:
        plain = msgspec.to_builtins(look, enc_hook=float)  # numbers of numpy are numbers too
        return msgspec.convert(plain, m.Look)
    except (msgspec.ValidationError, TypeError, ValueError) as error:
        raise LocalWireError(f"look: {_plainly(str(error))}") from None


def _plainly(problem: str) -> str:
    """A message of msgspec, place first, as the caller wrote it: "max_wait_s: expected float >= 0.05"."""
    what, _, at = problem.partition(" - at ")
    place = re.sub("[A-Z]", lambda letter: f"_{letter[0].lower()}", at.strip("`").removeprefix("$").removeprefix("."))
    what = what.replace("`", "").replace("Expected", "expected")
    return f"{place}: {what}" if place else what
