"""A conversation with one node: open a scan, look at it, hear of new ones.

One task reads the stream and is the only one that changes the model: refinements are applied one after the other, in
a worker thread, so that the event loop stays free. Whoever asked for something waits on a future of that request.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple
from weakref import WeakSet

import aiohttp
import msgspec

from client.discovery import NodeAddress
from client.errors import NodeLost, RequestRefused
from client.model import Applied, Model
from client.news import News
from client.replica import Replica
from client.stream import Stream, open_stream
from client.update import Tally, Update
from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError
from protocol.holdings import LevelArray, RankArray
from protocol.lattice import Channel
from protocol.refinement import Generator, Refinement
from protocol.session import Said

REPLY_MAX_BYTES = 4 << 20
HTTP_TIMEOUT = aiohttp.ClientTimeout(total=30)

log = logging.getLogger(__name__)


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

    def supersede(self) -> None:
        self.answer.set_result(self.tally.close(m.Updated(self.tally.request, 0, "superseded")))


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
        """What both ends agree we hold of a channel, as copies. Raises LocalWireError when no scan is open."""
        held = self._opened_model().holdings.channels[Channel[channel.upper()]]
        return Held(held.level.copy(), held.rank.copy())

    async def open(self, scan: str = "latest") -> Model:
        """Bind a scan ("latest" or an id) to the session and return its model once the first view is in.

        Looks that are not answered yet end as superseded. Raises RequestRefused for an unknown scan.
        """
        request = self._new_request()
        answer: asyncio.Future[Model] = asyncio.get_running_loop().create_future()
        self._opening[request] = answer
        try:
            await self._send(m.Open(request, scan))
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
        profile: Literal["default"] = "default",
        parameters: m.LookParameters | Mapping[str, Any] | None = None,
    ) -> Update:
        """Refine the model round (u, v), both in [0, 1), and return once it holds what was asked for.

        window : share of the area.      texture_db, range_mm : stop at this quality in it, or at a budget of
        max_wait_s or max_bytes, whichever comes first; fill : spend what is left of it on the periphery.
        parameters : explicit sampling instead of the node's choice, as LookParameters or as the mapping of its JSON.
        A newer look supersedes an older one, which then returns early with reason "superseded".
        Raises LocalWireError for values out of bounds, RequestRefused, NodeLost, RemoteWireError.
        """
        self._opened_model()
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
                profile,
                parameters,  # type: ignore[arg-type]  # a mapping is converted by the check
            )  # fmt: skip
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

    async def scans(self) -> list[dict[str, Any]]:
        """The scans in the node's library, newest first, as GET /v1/scans describes them."""
        return list(await self._ask("GET", "/v1/scans"))

    async def scanner(self) -> dict[str, Any]:
        """What the node's scanner is doing: phase, progress 0..1, sweeps finished, why the last one failed."""
        return dict((await self._ask("GET", "/v1/node"))["capture"])

    async def start_sweep(self) -> dict[str, Any]:
        """Start a sweep. Returns at once with what POST /v1/sweeps says; the scan is announced by `published`."""
        return dict(await self._ask("POST", "/v1/sweeps"))

    async def close(self) -> None:
        """End the session; whoever still waits gets NodeLost. `connect` does this at the end of its block."""
        self._reader.cancel()
        await asyncio.gather(self._reader, return_exceptions=True)
        if self._applying is not None:
            await asyncio.wait([self._applying])
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
        waiting = self._opening.pop(replica.request, None)
        if waiting is not None:
            waiting.set_result(replica.model)
        await self._stream.send(replica.acknowledge())

    def _bind(self, opened: m.Opened) -> None:
        self._check_asked(opened.request)
        self._replica = Replica(opened)
        for older in [request for request in self._looking if request < opened.request]:
            self._looking.pop(older).supersede()

    async def _answer(self, updated: m.Updated, size: int) -> None:
        self._check_asked(updated.request)
        replica = self._bound()
        superseded = updated.reason == "superseded"  # may overtake the update in the air, so it says nothing of order
        lost = 0 if superseded else replica.missing(updated)
        self._updates += 1
        if (look := self._looking.pop(updated.request, None)) is not None:
            look.tally.bytes_received += size
            look.answer.set_result(look.tally.close(updated, lost))
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
            look.answer.set_exception(error)
        elif (opening := self._opening.pop(refused.request, None)) is not None:
            opening.set_exception(error)
        else:
            log.warning("%s, about request %d, which nobody waits for", error, refused.request)

    def _end(self, cause: Exception, on_purpose: bool = False) -> None:
        if self._ended is None:
            self._ended = cause
            for opening in self._opening.values():
                opening.set_exception(cause)
            for look in self._looking.values():
                look.answer.set_exception(cause)
            self._opening.clear()
            self._looking.clear()
            for news in list(self._news):
                news.end(None if on_purpose else cause)

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

    async def _ask(self, method: str, path: str) -> Any:
        """JSON of an HTTP request. Raises RequestRefused, NodeLost, RemoteWireError."""
        try:
            async with self._http.request(method, f"{self._stream.url}{path}", timeout=HTTP_TIMEOUT) as response:
                return _reply(response.status, await _bounded_body(response))
        except (aiohttp.ClientError, OSError) as error:
            raise NodeLost(f"lost {self._stream.url}: {error}") from error


def _checked_look(look: m.Look) -> m.Look:
    try:
        return msgspec.convert(msgspec.to_builtins(look), m.Look)
    except (msgspec.ValidationError, TypeError) as error:
        raise LocalWireError(f"look: {error}") from None


async def _bounded_body(response: aiohttp.ClientResponse) -> bytes:
    body = bytearray()
    async for chunk in response.content.iter_any():
        body += chunk
        if len(body) > REPLY_MAX_BYTES:
            raise RemoteWireError(f"{response.url} sends more than {REPLY_MAX_BYTES} bytes")
    return bytes(body)


def _reply(status: int, body: bytes) -> Any:
    try:
        reply = msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeError) as error:
        raise RemoteWireError(f"HTTP {status} without a JSON body: {error}") from None
    if status >= 400:
        said = reply if isinstance(reply, dict) else {}
        raise RequestRefused(str(said.get("code", f"HTTP {status}")), str(said.get("message", "")))
    return reply
