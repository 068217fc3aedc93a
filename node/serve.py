"""HTTP and the stream on one port: what clients may ask, turned into calls on library, scanner and connections."""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
import time
from contextlib import suppress
from dataclasses import asdict

from aiohttp import WSCloseCode, web
from aiohttp.typedefs import Handler
from msgspec import structs

from node.access import Access
from node.audit import NODE, Audit, Who
from node.audit_routes import SCAN, AuditRoutes
from node.auth import CHALLENGE, LOGIN, Auth, Refusal
from node.axis_routes import AxisRoutes
from node.bodies import NodeStatus, SweepAsked
from node.capture import Capture, CaptureStatus
from node.config import Config
from node.connection import Connection, House
from node.derive import Derivation
from node.durable import NoRoom
from node.ending import AUDIT_BY_S, GOODBYES_BY_S, Ending
from node.endpoints import place_of, route
from node.exchange_routes import ExchangeRoutes
from node.exhibits import Exhibits
from node.gate import Gate
from node.health_routes import HealthRoutes
from node.library_routes import LibraryRoutes
from node.live import Live
from node.metrics import Metrics
from node.openapi import described
from node.page import Page
from node.pairing import PairingRoutes
from node.proxy import believe
from node.rest import harden, refusal, said
from node.retention import delete, expired_in
from node.scan_routes import ScanRoutes
from node.sealed import HAS_DIED, has_died
from node.shared import SharedFoveae
from node.tls import Tls
from protocol import messages as m
from protocol.errors import AccessError, ConfigError, LibraryError

log = logging.getLogger(__name__)

NOT_SENT_LOW_WATER_BYTES = 16 * 1024
SEND_BUFFER_BYTES = 64 * 1024
WRITE_LIMIT_BYTES = 16 * 1024
HEARTBEAT_S = 20.0
BODY_MAX_BYTES = 1 << 16
GOODBYE_S = 1.0  # then who does not read is hung up on
ACCESS_S = 0.5  # between looks at what other processes changed of tokens and certificate
RETAIN_S = 600.0  # between looks at what was kept long enough
KEEP_USED_S = 300.0  # between writing down when tokens were used
RENEW_S = 3600.0  # between looks at the certificate
REQUESTS_S = 1.0  # that requests in work get to end when the node stops
ANSWERED = web.RequestKey("answered", bool)  # the head of the answer is made
KEPT_HEADERS = ("Allow", "Retry-After")  # of an error that is put in our words


class NodeServer:
    """The node as clients see it; everything here runs in one event loop."""

    def __init__(
        self,
        config: Config,
        info: m.ServerInfo,
        exhibits: Exhibits,
        live: Live,
        capture: Capture | None,
        access: Access | None = None,
        tls: Tls | None = None,
    ) -> None:
        if not config.server.insecure and (access is None or tls is None):
            raise ConfigError("server.insecure: without --insecure a node needs tokens and a certificate")
        self._config = config
        self._info = info
        self._exhibits = exhibits
        self._live = live
        self._capture = capture
        self._is_stopping = False
        self._ending = Ending()
        self._tls = tls
        self._access = access
        self.audit = Audit(exhibits.library.folder, config.audit.bytes_max)
        audit_routes = AuditRoutes(self.audit, exhibits.library.folder, config.audit.bytes_max)
        self._auth = Auth(access, self._refused)
        c = config.server
        self._shared = SharedFoveae(exhibits, shared_cache=c.shared_cache, is_open=c.insecure)
        self._connections: dict[Connection, asyncio.Transport] = {}
        self._hanging_up: set[asyncio.Task[None]] = set()
        self._drawing: set[asyncio.Task[None]] = set()
        self._requests: dict[int, web.Request] = {}  # those in work, by their id()
        self._gate = Gate(config.limits, is_open=c.insecure, proxies=c.trusted_proxies)
        self._metrics = Metrics()
        exhibits.tell(self._metrics.encoded)
        middlewares = [believe(c.trusted_proxies), self._count, _explain, self._gate.admit, self._auth.admit]
        self._app = web.Application(middlewares=middlewares, client_max_size=BODY_MAX_BYTES)
        self._app.on_response_prepare.extend((_harden, audit_routes.witness))
        self._app.on_cleanup.append(self._close_audit)
        pairing = PairingRoutes(access, tls, self.audit, self._refused, info.id, info.name, self._expel)
        health = HealthRoutes(
            self._metrics, exhibits, capture, tls, self.audit, self._gate,
            lambda: len(self._connections), lambda: self._is_stopping, info.version, lambda: self._config.retention,
        )  # fmt: skip
        self.derivation = Derivation(exhibits, self.publish, self.audit)
        self._app.add_routes(ExchangeRoutes(exhibits, self.publish).routes())  # before /v1/scans/{scan}
        self._app.add_routes([
            *Page().routes(),
            route("GET /openapi.json", self._describe),
            route("GET /v1/node", self._node),
            route("POST /v1/sweeps", self._sweep),
            route("GET /v1/stream", self._stream),
            *ScanRoutes(exhibits, self._shared).routes(),
            *self._shared.routes(),
            *LibraryRoutes(exhibits.library, capture, self._forget).routes(),
            *self.derivation.routes(),
            *AxisRoutes(exhibits.library).routes(),
            *pairing.routes(),
            *audit_routes.routes(),
            *health.routes(),
        ])  # fmt: skip
        self._runner = web.AppRunner(self._app, access_log=None, handle_signals=False, shutdown_timeout=REQUESTS_S)

    async def start(self) -> tuple[str, int]:
        """Begin to listen. Returns the address bound. Raises OSError when it cannot be."""
        await self._runner.setup()
        server, context = self._config.server, self._tls.context if self._tls else None
        host, port = await self._gate.open(self._runner, server.host, server.port, context)
        self._watching = [asyncio.create_task(self._watch_access()), asyncio.create_task(self._retain())]
        self._draw_newest()
        self.audit.note("started", NODE, what=self._info.version)
        return host, port

    async def stop(self, ending: Ending | None = None) -> None:
        """Tell every client, hang up on those that do not listen, then stop listening.

        ending : the time that there is, where it runs already.
        """
        self._ending = ending or self._ending
        self._is_stopping = True
        for task in self._watching:
            task.cancel()
        await self._say_goodbye()
        await self._gate.close()
        for line in self._connections.values():
            line.abort()
        await self.derivation.stop(self._ending.left_s(GOODBYES_BY_S))
        self.audit.note("stopped", NODE)
        await self._runner.cleanup()

    async def _say_goodbye(self) -> None:
        """Have every stream read why it ends: who reads slowly is waited for, who does not read is hung up on."""
        why = "the node is stopping", WSCloseCode.GOING_AWAY
        goodbyes = [asyncio.ensure_future(connection.close(*why)) for connection in self._connections]
        if not goodbyes:
            return
        left_s = self._ending.left_s(GOODBYES_BY_S)
        _, slow = await asyncio.wait(goodbyes, timeout=min(GOODBYE_S, left_s))
        for line in self._connections.values():
            if not line.is_closing() and line.get_write_buffer_size():
                line.abort()
        if slow:
            await asyncio.wait(slow, timeout=self._ending.left_s(GOODBYES_BY_S))

    async def _watch_access(self) -> None:
        """Notice what commands beside this process revoke, and certificates that were renewed or are due."""
        renewed_s = kept_s = time.monotonic()
        while True:
            await asyncio.sleep(ACCESS_S)
            try:
                self._expel()
                if self._tls is not None and time.monotonic() - renewed_s > RENEW_S:
                    renewed_s = time.monotonic()
                    await asyncio.to_thread(self._tls.refresh)
                if self._access is not None and time.monotonic() - kept_s > KEEP_USED_S:
                    kept_s = time.monotonic()
                    await asyncio.to_thread(self._access.keep_last_used)
            except AccessError as error:
                log.error("%s", error)

    def _expel(self) -> None:
        """End what those are doing whose login was revoked, streams with a word of it."""
        for connection, line in self._connections.items():
            if not self._auth.stands(connection.login) and not connection.is_ending:
                self._hanging_up.add(task := asyncio.create_task(self._hang_up(connection, line)))
                task.add_done_callback(self._hanging_up.discard)
        self._auth.expel()

    async def _hang_up(self, connection: Connection, line: asyncio.Transport) -> None:
        log.warning("ended a stream whose login was revoked")
        try:
            async with asyncio.timeout(GOODBYE_S):
                await connection.close("the login was revoked", WSCloseCode.POLICY_VIOLATION)
        except TimeoutError:
            line.abort()

    def _refused(self, who: Who, why: Refusal, what: str) -> None:
        """Somebody was turned away."""
        self.audit.refuse(who, f"{why}: {what}" if what else why)
        self._metrics.refused(why)

    @web.middleware
    async def _count(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Count every request and its answer."""
        status, size_bytes = 500, 0
        self._requests[id(request)] = request
        try:
            response = await handler(request)
            status, size_bytes = response.status, response.content_length or 0
            return response
        except web.HTTPException as redirect:
            status = redirect.status
            raise
        finally:
            del self._requests[id(request)]
            self._metrics.answered(request.method, place_of(request), status, size_bytes)

    async def _close_audit(self, app: web.Application) -> None:
        await asyncio.to_thread(self.audit.close, self._ending.left_s(AUDIT_BY_S))
        if self._access is not None:
            with suppress(AccessError, TimeoutError):  # it was said while the node ran; the disk is slow
                async with asyncio.timeout(self._ending.left_s(AUDIT_BY_S)):
                    await asyncio.to_thread(self._access.keep_last_used)

    def swept(self, scan_id: str, sweep: int = 0) -> None:
        """A sweep has become a scan: note it, tell every client, and see whether it is to be a sphere, too.

        sweep : which of the node's finished ones it is, 0 for one that an earlier run of the node took.
        """
        self.audit.note("scanned", NODE, scan=scan_id)
        self.publish(m.Published(scan_id, sweep))
        if self._config.library.spheres:
            self.derivation.consider(scan_id)

    def use(self, config: Config) -> None:
        """Go on with other settings, of those that `node.reload` lets change. Raises AccessError, and changes none."""
        if self._tls is not None:
            self._tls.use(config.server)
        self._gate.use(config.limits)
        self._config = config

    def publish(self, news: m.Published) -> None:
        """Tell every client of a new scan."""
        for connection in self._connections:
            connection.publish(news)
        self._draw_newest()

    def _draw_newest(self) -> None:
        """Have the picture ready that a page will ask for first."""

        async def draw() -> None:
            with suppress(LibraryError):
                await self._exhibits.picture("latest")

        self._drawing.add(task := asyncio.create_task(draw()))
        task.add_done_callback(self._drawing.discard)

    def _forget(self, scan_id: str) -> None:
        """A scan was deleted: nothing made of it is kept here any longer."""
        self._exhibits.forget(scan_id)
        self._shared.void()
        for connection in self._connections:
            connection.forget(scan_id)

    async def _retain(self) -> None:
        """Delete what the rules of retention say, now and then, as long as the node runs."""
        while True:
            try:
                rules, library = self._config.retention, self._exhibits.library
                for one in await asyncio.to_thread(expired_in, library, rules, self._open_scans()):
                    if one.id not in self._open_scans():
                        await asyncio.to_thread(delete, library, one)
                        self._forget(one.id)
                        log.warning("retention: deleted %s %s: %s", one.kind, one.id, one.why)
                        self.audit.note("expired", NODE, **{one.kind: one.id}, what=one.why)
            except LibraryError as error:
                log.error("retention: %s", error)
            await asyncio.sleep(RETAIN_S)

    def _open_scans(self) -> frozenset[str]:
        """Every scan that somebody looks at or fetches now."""
        streams = (connection.scan_id for connection in self._connections)
        return frozenset(filter(None, (*streams, *(request.get(SCAN) for request in self._requests.values()))))

    def show_live(self) -> None:
        """Send every client that watches what is new in the running sweep."""
        for connection in self._connections:
            connection.show_live()

    # -- what may be asked -----------------------------------------------------------------------------------------

    async def _describe(self, request: web.Request) -> web.Response:
        return web.Response(body=described(self._info.version), content_type="application/json")

    async def _node(self, request: web.Request) -> web.Response:
        node = NodeStatus(
            **structs.asdict(self._info), capture=self._capture_status(), problems=self._exhibits.library.problems,
            shared_encodes=self._shared.encodes, surveying=self._exhibits.surveying,
        )  # fmt: skip
        return said(node)

    async def _sweep(self, request: web.Request) -> web.Response:
        if self._capture is None or not (number := self._capture.request_sweep()):
            raise web.HTTPConflict(text=self._capture_status().refusal or "the scanner was busy: try again")
        return said(SweepAsked(**asdict(self._capture_status()), sweep=number), 202)

    async def _stream(self, request: web.Request) -> web.WebSocketResponse:
        if len(self._connections) >= self._config.server.max_clients:
            there = f"{len(self._connections)} clients are there"
            text = f"{there}, all that server.max_clients allows: try again later"
            raise web.HTTPServiceUnavailable(text=text, headers={"Retry-After": "10"})
        stream = web.WebSocketResponse(
            protocols=(m.PROTOCOL,), max_msg_size=m.TEXT_MAX, heartbeat=HEARTBEAT_S, compress=False,
            writer_limit=WRITE_LIMIT_BYTES, autoping=False,
        )  # fmt: skip
        await stream.prepare(request)
        line = request.transport
        if line is None:  # gone again already
            return stream
        _bound_buffers(line)
        c = self._config
        house = House(
            self._exhibits, self._live, self._info, self.audit, self._metrics,
            c.planner.cold_start_bytes_s, c.limits.messages_s,
        )  # fmt: skip
        connection = Connection(stream, request[LOGIN], request.remote or "", house)
        self._connections[connection] = line
        self._exhibits.expect_looks(len(self._connections))
        try:
            await connection.run()
        finally:
            del self._connections[connection]
            stream._cancel_heartbeat()  # aiohttp begins it anew for what comes while it closes, and keeps all for it
        return stream

    def _capture_status(self) -> CaptureStatus:
        return self._capture.status if self._capture else CaptureStatus("no scanner")


def _bound_buffers(transport: asyncio.Transport) -> None:
    """Keep little between us and a slow client, so that a click overtakes what was meant for an older one."""
    transport.set_write_buffer_limits(high=WRITE_LIMIT_BYTES)
    line = transport.get_extra_info("socket")
    line.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if hasattr(socket, "TCP_NOTSENT_LOWAT"):
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, NOT_SENT_LOW_WATER_BYTES)


async def _harden(request: web.Request, response: web.StreamResponse) -> None:
    request[ANSWERED] = True
    harden(response)


@web.middleware
async def _explain(request: web.Request, handler: Handler) -> web.StreamResponse:
    """Errors as one JSON object: what is wrong, and where it can be known, the cure. A bug is a line in the log."""
    try:
        return await handler(request)
    except NoRoom as error:
        return refusal(507, str(error))
    except LibraryError as error:
        return refusal(503, HAS_DIED) if has_died(error) else refusal(404, str(error))
    except AccessError as error:
        log.error("%s", error)
        return refusal(503, "who may come in cannot be read")
    except web.HTTPException as error:
        if error.status < 400:
            raise
        answer = refusal(error.status, _what(request, error))
        answer.headers.update({name: error.headers[name] for name in KEPT_HEADERS if name in error.headers})
        if error.status == 401:
            answer.headers.update(CHALLENGE)
        return answer
    except Exception as error:
        if isinstance(error, ConnectionError) or ANSWERED in request:
            raise  # nobody is there to be told, or half an answer is on its way
        incident = secrets.token_hex(4)
        where = f"{request.method} {place_of(request)}"
        log.error("incident %s: %s: %s: %s", incident, where, type(error).__name__, error)
        return refusal(500, f"the node has failed at this: its log says how, at {incident}")


def _what(request: web.Request, error: web.HTTPException) -> str:
    """What is wrong, in our words where aiohttp has none but the status."""
    if error.text and error.text != f"{error.status}: {error.reason}":
        return error.text
    if error.status == 404:
        return f"nothing is at {request.path[:100]}"
    if error.status == 405:
        return f"{request.path[:100]} takes no {request.method}"
    return error.reason
