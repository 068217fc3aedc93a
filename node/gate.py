"""The way in: how many connections there may be, from where, and how long one may keep us waiting.

    before the first request    more connections than there may be are closed; handshake and head take head_s at most
    a request                   its address has so many in work and so many a second, a small body takes body_s at most
    a stream                    its address has so many
    afterwards                  who does not take what we send for stall_s is cut off; idle connections last keep_s

Near a limit, connections are still answered, 429 or 503 with Retry-After, and closed then. Behind a proxy that the
configuration trusts, requests count for the address that it names. A node without logins serves this machine alone, so
there one address stands for everybody and only what counts for all is limited.
"""

from __future__ import annotations

import asyncio
import logging
import os
import resource
import socket
import ssl
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from typing import Any

from aiohttp import ClientError, web
from aiohttp.typedefs import Handler

from node.attempts import place_of_address
from node.auth import STREAM
from node.bucket import Buckets, whole_seconds
from node.config import Limits
from node.endpoints import place_of
from node.rest import harden, refusal

log = logging.getLogger(__name__)

SURPLUS = 16  # connections above a limit that are told so
BACKLOG = 128
SWEEP_S = 1.0
STREAM_S = 10.0  # after which somebody may have closed one
READ_BYTES = 1 << 15  # what one connection may have us hold of what it sends
FILES_BESIDE = 128  # descriptors for all that is no connection
UPLOADS = frozenset({("POST", "/v1/scans")})  # these look after their bodies themselves


class Line(web.RequestHandler):
    """One connection. place : what its address counts as.  is_surplus : it is only told that there are too many."""

    def __init__(self, gate: Gate, place: str, is_surplus: bool, server: web.Server, **more: Any) -> None:
        super().__init__(server, loop=asyncio.get_running_loop(), **more)
        self._gate = gate
        self.place = place
        self.is_surplus = is_surplus
        self.has_asked = False
        self.is_counted = True
        self.opened_s = self.moved_s = time.monotonic()
        self.unsent = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:  # noqa: D102  # as asyncio has it
        super().connection_made(transport)
        self._gate.lines.add(self)
        self.opened_s = time.monotonic()

    def connection_lost(self, exc: BaseException | None) -> None:  # noqa: D102  # as asyncio has it
        super().connection_lost(exc)
        self._gate.leave(self)

    def data_received(self, data: bytes) -> None:  # noqa: D102  # as asyncio has it
        try:
            super().data_received(data)
        except IndexError:  # of a target that is no URL (aio-libs/yarl#1822)
            log.warning("what came is no request: its target is no URL")
            self.force_close()

    def handle_error(
        self, request: web.BaseRequest, status: int = 500, exc: BaseException | None = None, message: str | None = None
    ) -> web.StreamResponse:
        """What is no HTTP, in the words and with the headers of every other error. Closes the connection."""
        log.warning("what came from %s is no request: %s", request.remote, type(exc).__name__)
        if request.writer.output_size > 0:
            raise ConnectionError("half an answer is on its way")
        answer = refusal(status, "that is no HTTP" if status == 400 else HTTPStatus(status).phrase)
        harden(answer)
        answer.force_close()
        return answer


class Gate:
    """Where connections come in. For one event loop.

    is_open : no logins, so no addresses to tell apart.  proxies : addresses that stand for many.
    """

    def __init__(self, limits: Limits, *, is_open: bool, proxies: tuple[str, ...] = ()) -> None:
        self._limits = limits
        self._is_open = is_open
        self._proxies = frozenset(map(place_of_address, proxies))
        self._most = limits.connections
        self._by_place: Counter[str] = Counter()
        self._in_work: Counter[str] = Counter()
        self._streams: Counter[str] = Counter()
        self._rates = Buckets(limits.requests_s_per_address)
        self._tasks: set[asyncio.Task[None]] = set()
        self._listeners: list[socket.socket] = []
        self.lines: set[Line] = set()
        self.turned_away = 0  # connections that were closed without a word

    def use(self, limits: Limits) -> None:
        """Go on with other limits. What stands stays: nobody is hung up on for being one too many."""
        if limits.requests_s_per_address != self._limits.requests_s_per_address:
            self._rates = Buckets(limits.requests_s_per_address)
        self._limits, self._most = limits, _most_connections(limits)

    async def open(self, runner: web.AppRunner, host: str, port: int, tls: ssl.SSLContext | None) -> tuple[str, int]:
        """Begin to listen. Returns the address bound. Raises OSError when it cannot be."""
        self._most = _most_connections(self._limits)
        found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
        try:
            for family, (address, _, *more) in dict.fromkeys((family, where) for family, _, _, _, where in found):
                listener = socket.create_server((address, port, *more), family=family, backlog=BACKLOG)
                listener.setblocking(False)
                self._listeners.append(listener)
                port = listener.getsockname()[1]  # the same for all where any free one is taken
        except OSError as error:
            await self.close()
            place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
            raise OSError(error.errno, os.strerror(error.errno or 0), place) from error
        for listener in self._listeners:
            self._spawn(self._accept(listener, runner, tls))
        self._spawn(self._watch())
        return str(self._listeners[0].getsockname()[0]), port

    async def close(self) -> None:
        """Listen no more."""
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        for listener in self._listeners:
            listener.close()

    def leave(self, line: Line) -> None:
        """A connection has ended; harmless when repeated."""
        self.lines.discard(line)
        if line.is_counted:
            line.is_counted = False
            self._by_place[line.place] -= 1
            if not self._by_place[line.place]:
                del self._by_place[line.place]

    @property
    def connections(self) -> int:
        """How many there are."""
        return self._by_place.total()

    @web.middleware
    async def admit(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Let a request in, or say when to come again."""
        line = request.protocol
        if isinstance(line, Line):
            line.has_asked = True
            if line.is_surplus:
                line.close()
                raise web.HTTPServiceUnavailable(text="too many connections: try again later", headers=_after(5.0))
        with self._at_work(place_of_address(request.remote or ""), place_of(request) == STREAM):
            if (request.method, place_of(request)) not in UPLOADS:
                await self._read_body(request)
            return await handler(request)

    @contextmanager
    def _at_work(self, place: str, is_stream: bool) -> Iterator[None]:
        if self._is_open:
            yield
            return
        if wait_s := self._rates.take(place, time.monotonic()):
            raise web.HTTPTooManyRequests(text="too many requests from there: wait a moment", headers=_after(wait_s))
        limits = self._limits
        in_work, most, name, wait_s = self._in_work, limits.requests_per_address, "requests", 1.0
        if is_stream:
            in_work, most, name, wait_s = self._streams, limits.streams_per_address, "streams", STREAM_S
        if in_work[place] >= most:
            raise web.HTTPTooManyRequests(text=f"too many {name} from there at once", headers=_after(wait_s))
        in_work[place] += 1
        try:
            yield
        finally:
            in_work[place] -= 1
            if not in_work[place]:
                del in_work[place]

    async def _read_body(self, request: web.Request) -> None:
        """Have the whole of a small body, which the request keeps. Raises 400, 408, 413."""
        if not request.can_read_body:
            return
        try:
            async with asyncio.timeout(self._limits.body_s):
                await request.read()
        except TimeoutError:
            request.protocol.close()
            raise web.HTTPRequestTimeout(text=f"its body took longer than {self._limits.body_s:g} s") from None
        except (ClientError, web.RequestPayloadError) as error:
            raise web.HTTPBadRequest(text=f"the request ended early: {error}") from error

    # -- connections -----------------------------------------------------------------------------------------------

    async def _accept(self, listener: socket.socket, runner: web.AppRunner, tls: ssl.SSLContext | None) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                line, peer = await loop.sock_accept(listener)
            except OSError as error:  # gone again before we came to it, or no descriptor is left
                log.warning("a connection could not be accepted: %s", error.strerror or error)
                await asyncio.sleep(0.1)
                continue
            place = place_of_address(peer[0])
            if self._too_many(place, SURPLUS):
                self.turned_away += 1
                line.close()
                continue
            is_surplus = self._too_many(place, 0)
            self._by_place[place] += 1
            self._spawn(self._greet(line, place, is_surplus, runner, tls))

    def _too_many(self, place: str, surplus: int) -> bool:
        if self.connections >= self._most - SURPLUS + surplus:
            return True
        if self._is_open or place in self._proxies:
            return False
        return self._by_place[place] >= self._limits.connections_per_address + surplus

    async def _greet(
        self, line: socket.socket, place: str, is_surplus: bool, runner: web.AppRunner, tls: ssl.SSLContext | None
    ) -> None:
        server = runner.server
        assert server is not None
        settings = {"access_log": None, "keepalive_timeout": self._limits.keep_s, "read_bufsize": READ_BYTES}
        handler = Line(self, place, is_surplus, server, **settings)
        patience = {"ssl_handshake_timeout": self._limits.head_s} if tls else {}
        try:
            await asyncio.get_running_loop().connect_accepted_socket(lambda: handler, line, ssl=tls, **patience)
        except (OSError, ssl.SSLError, TimeoutError):  # it spoke no TLS, or trusts us not
            line.close()
            self.leave(handler)
        except asyncio.CancelledError:
            line.close()
            self.leave(handler)
            raise

    async def _watch(self) -> None:
        """Cut off whoever keeps us waiting."""
        while True:
            await asyncio.sleep(SWEEP_S)
            now_s = time.monotonic()
            for line in list(self.lines):
                if line.transport is not None and self._is_stalled(line, line.transport, now_s):
                    line.transport.abort()

    def _is_stalled(self, line: Line, transport: asyncio.Transport, now_s: float) -> bool:
        if not line.has_asked:
            return now_s - line.opened_s > self._limits.head_s
        unsent = transport.get_write_buffer_size()
        if unsent == 0 or unsent != line.unsent:
            line.unsent, line.moved_s = unsent, now_s
        return now_s - line.moved_s > self._limits.stall_s

    def _spawn(self, work: Any) -> None:
        self._tasks.add(task := asyncio.create_task(work))
        task.add_done_callback(self._tasks.discard)


def _most_connections(limits: Limits) -> int:
    """As many as are wanted, or as this process may have files for."""
    return min(limits.connections, _descriptors(limits.connections + FILES_BESIDE) - FILES_BESIDE)


def _after(wait_s: float) -> dict[str, str]:
    return {"Retry-After": whole_seconds(wait_s)}


def _descriptors(wanted: int) -> int:
    """How many files this process may have open, after asking for so many."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return wanted
    most = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
    with suppress(OSError, ValueError):  # a sandbox may forbid it
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
        return most
    return soft
