"""One client's stream: reads what it asks, answers the newest look, one update at a time.

Three tasks share a connection. The reader takes messages as they come and never waits for anything slow; the sender
opens scans and answers looks, one update unacknowledged at a time. A newer look supersedes one that is not sent yet.
The third shows a running sweep to a client that watches, in small messages that a look may overtake.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from functools import partial

from aiohttp import WSCloseCode, WSMessage, WSMsgType, web

from node.answer import Answer
from node.audit import Audit, Who
from node.auth import Login
from node.bound import AnyUpdate, Bound
from node.bucket import Bucket
from node.exhibits import Exhibits
from node.live import Live, Place
from node.metrics import Metrics
from node.outbox import Outbox
from protocol import messages as m
from protocol.errors import CodecError, LatticeError, LibraryError, RemoteWireError
from protocol.grid import Geometry
from protocol.session import Phase, Role, Session

log = logging.getLogger(__name__)

OPENS_MAX = 4
HELLO_S = 10.0
ACK_S = 60.0
CLOSE_S = 2.0
CLOSE_REASON_MAX = 120  # of 123 bytes
QUOTED = re.compile("""['"].*['"]""", re.DOTALL)  # what a client said is told to it alone: it may be about a patient


@dataclass(frozen=True, slots=True)
class House:
    """What a stream works with. cold_start_bytes_s, messages_s : as configured."""

    exhibits: Exhibits
    live: Live
    info: m.ServerInfo
    audit: Audit
    metrics: Metrics
    cold_start_bytes_s: float
    messages_s: float


class Connection:
    """One stream from its greeting to its end."""

    def __init__(
        self,
        socket: web.WebSocketResponse,
        login: Login,
        address: str,
        house: House,
    ) -> None:
        self._socket = socket
        self.login = login
        self._audit = house.audit
        self._metrics = house.metrics
        self._who = Who(login.name, login.role or "", address)
        self._exhibits = house.exhibits
        self._live = house.live
        self._place: Place | None = None
        self._live_news = asyncio.Event()
        self._info = house.info
        self._session = Session(Role.NODE)
        self._outbox = Outbox(socket, self._session, house.metrics, house.cold_start_bytes_s)
        self._messages = Bucket(house.messages_s, time.monotonic())
        self._codecs: tuple[m.CodecName, ...] = ("htj2k",)
        self._geometries: tuple[Geometry, ...] = ()
        self._bound: Bound | None = None
        self._is_gone = False
        self._epoch = 0
        self._opens: deque[m.Open] = deque()
        self._look: m.Look | None = None
        self._running: Answer | None = None
        self._gave_way = False
        self._news: deque[m.Published] = deque(maxlen=16)
        self._work = asyncio.Event()

    async def run(self) -> None:
        """Serve until the client goes. Never raises for what the client does."""
        await self._outbox.send(self._info)
        try:
            if not await self._let_in():
                return
            async with asyncio.TaskGroup() as tasks:
                senders = [tasks.create_task(self._answer()), tasks.create_task(self._show_live())]
                await self._read()
                for sender in senders:
                    sender.cancel()
        except* RemoteWireError as errors:
            await self._turn_away(str(errors.exceptions[0]), WSCloseCode.PROTOCOL_ERROR)
        except* (ConnectionError, TimeoutError):
            pass

    @property
    def is_ending(self) -> bool:
        """Whether goodbye was said."""
        return self._session.phase is Phase.CLOSED or self._socket.closed

    @property
    def scan_id(self) -> str | None:
        """The scan that is open."""
        return self._bound.scan.id if self._bound else None

    def forget(self, scan_id: str) -> None:
        """A scan was deleted: nothing more of it is shown, what the client has cannot be called back."""
        if self.scan_id == scan_id:
            self._bound, self._is_gone = None, True

    def publish(self, news: m.Published) -> None:
        """Tell the client of a new scan, when it is listening."""
        self._news.append(news)
        self._work.set()

    def show_live(self) -> None:
        """There is news of the running sweep."""
        self._live_news.set()

    async def close(self, reason: str, code: WSCloseCode) -> None:
        """Say goodbye and end the stream."""
        if self._session.phase is Phase.READY:
            with suppress(ConnectionError):  # gone already
                await self._outbox.send(m.Goodbye(reason))
        await self._socket.close(code=code, message=_cut(reason))

    # -- reading ---------------------------------------------------------------------------------------------------

    async def _let_in(self) -> bool:
        async with _patience(HELLO_S, "hello"):
            message = await self._receive()
        if message is None:
            return False
        assert isinstance(message, m.Hello)  # the session lets nothing else through
        if message.protocol != m.PROTOCOL:
            await self._outbox.send(m.Refused(0, "bad request", f"this node speaks {m.PROTOCOL}"))
            return False
        self._codecs, self._geometries = message.codecs, message.geometries
        assert self.login.role is not None and self.login.role != "monitor"  # Auth.admit lets nobody else come here
        await self._outbox.send(m.Welcome(self.login.role))
        return True

    async def _read(self) -> None:
        while (message := await self._receive()) is not None:
            match message:
                case m.Open():
                    if len(self._opens) >= OPENS_MAX:
                        await self._outbox.send(m.Refused(message.request, "busy", "too many scans are being opened"))
                    else:
                        self._opens.append(message)
                        self._work.set()
                case m.Look():
                    await self._take_look(message)
                case m.Cancel():
                    await self._forget(message.request)
                case m.Ack():
                    await self._take_ack(message)
                case m.State():
                    await self._take_state(message)
                case m.Envelope():
                    await self._outbox.send(await self._enveloped(message.request))
                case m.Watch(live=live):
                    self._place = Place() if live else None
                    if live:
                        self._audit.note_seen("watched", self._who)
                    self._live_news.set()

    async def _enveloped(self, request: int) -> m.Enveloped | m.Refused:
        if self._bound is None:
            return m.Refused(request, "not open", "open a scan first")
        try:
            return await self._exhibits.work(partial(self._bound.enveloped, request))
        except LatticeError as error:
            return m.Refused(request, "bad request", str(error))

    async def _receive(self) -> m.Message | None:
        """The next message, or None when the stream has ended. Raises RemoteWireError."""
        frame = await self._next_frame()
        if frame.type is WSMsgType.TEXT:
            said = self._session.receive(frame.data)
            return said if isinstance(said, m.Message) else None
        if frame.type is WSMsgType.BINARY:
            raise RemoteWireError("a client sends no binary messages")
        if frame.type is WSMsgType.ERROR:
            raise RemoteWireError(f"bad frame: {self._socket.exception()}")
        return None

    async def _next_frame(self) -> WSMessage:
        """The next frame that is more than a sign of life; those count all the same.

        Who says more than messages_s allow is read no faster: the rest waits in the sockets, at the sender's expense.
        """
        while True:
            while wait_s := self._messages.take(time.monotonic()):
                await asyncio.sleep(wait_s)
            frame = await self._socket.receive()
            if frame.type is WSMsgType.PING:
                await self._socket.pong(frame.data)
            elif frame.type is not WSMsgType.PONG:
                return frame

    async def _take_look(self, look: m.Look) -> None:
        if self._look is not None:
            await self._outbox.send(self._superseded(self._look))
        self._look = look
        self._work.set()

    async def _forget(self, request: int) -> None:
        if self._look is not None and self._look.request == request:
            look, self._look = self._look, None
            await self._outbox.send(self._superseded(look))
        if self._running is not None and self._running.look.request == request:
            self._running.is_wanted = False

    async def _take_ack(self, ack: m.Ack) -> None:
        bound = self._bound
        if bound is None or ack.epoch != bound.epoch or ack.next_seq != bound.next_seq:
            return  # of an update that a newer opening has overtaken
        self._outbox.acknowledged(ack.apply_ms / 1000)
        if ack.digest != bound.state.holdings.digest():
            await self._outbox.send(m.Resync(bound.epoch, "digests differ"))
            return
        self._outbox.is_free.set()

    async def _take_state(self, said: m.State) -> None:
        bound = self._bound
        if bound is None or said.epoch != bound.epoch:
            return
        bound.adopt_word(said)
        self._outbox.is_free.set()

    # -- answering -------------------------------------------------------------------------------------------------

    async def _answer(self) -> None:
        while True:
            await self._work.wait()
            self._work.clear()
            while self._news:
                await self._outbox.send(self._news.popleft())
            while self._opens:
                await self._open(self._opens.popleft())
            if self._look is not None:
                await self._await_ack()
                await self._answer_look()
                if self._opens or self._look is not None or self._news:
                    self._work.set()

    async def _await_ack(self) -> None:
        if self._bound is not None:
            async with _patience(ACK_S, "ack"):
                await self._outbox.is_free.wait()

    async def _open(self, wanted: m.Open) -> None:
        try:
            scan_id = self._exhibits.library.resolve(wanted.scan, self._geometries)
            scan, view = await self._exhibits.open(scan_id, self._codecs[0], wanted.profile)
            if scan.spec.geometry not in self._geometries:
                raise LibraryError(f"scan {scan.id} is a {scan.spec.geometry}, which this client cannot show")
            self._epoch = (self._epoch + 1) & 0xFFFF
            bound = Bound(self._epoch, scan, view.state)
            if wanted.holdings is not None:
                bound.adopt_holdings(wanted.holdings)
        except LibraryError as error:
            await self._outbox.send(m.Refused(wanted.request, "not found", str(error)[:500]))
            return
        self._bound = bound
        self._audit.note("opened", self._who, scan=scan.id)
        self._metrics.opened()
        self._outbox.is_free.clear()
        await self._outbox.send(m.Opened(wanted.request, bound.epoch, view.info))
        if wanted.holdings is not None:
            self._outbox.is_free.set()
            return
        bound.next_seq = 2
        self._outbox.begin()
        for refinement in view.refinements(bound.epoch):
            await self._outbox.send_bytes(refinement)

    async def _answer_look(self) -> None:
        """When it is our turn among all streams, plan what is the newest look by then; send what comes of it."""
        started_s = time.monotonic()
        async with self._exhibits.turn() as is_pressing:
            look, self._look, bound = self._look, None, self._bound
            if look is None:  # cancelled while it waited
                return
            if bound is not None:
                answer = Answer(look, bound, self._outbox, self._exhibits, self._metrics, self._is_overtaken)
                planned = await self._planned(answer, is_pressing)
        if bound is None:
            why = "the scan was deleted: open another" if self._is_gone else "open a scan first"
            await self._outbox.send(m.Refused(look.request, "not open", why))
        elif isinstance(planned, m.Refused | m.Updated):
            await self._outbox.send(planned)
        else:
            spent_s = time.monotonic() - started_s
            self._outbox.rate.encoded(spent_s)
            await answer.send(planned, spent_s)

    async def _planned(self, answer: Answer, hurried: bool) -> AnyUpdate | m.Refused | m.Updated:
        """What answers a look, or what is said instead."""
        self._running = answer
        try:
            update = await answer.plan(self._codecs, hurried)
        except (LatticeError, CodecError) as error:
            return m.Refused(answer.look.request, "bad request", str(error)[:500])
        finally:
            self._running = None
        self._gave_way = update.reason == "superseded"
        return self._superseded(answer.look) if self._gave_way or not answer.is_wanted else update

    def _is_overtaken(self) -> bool:
        """A newer look stops one, but no two in a row: who clicks faster than we plan gets something, too."""
        return self._look is not None and not self._gave_way

    def _superseded(self, look: m.Look) -> m.Updated:
        self._metrics.updated("superseded")
        next_seq = self._bound.next_seq if self._bound else 0
        return m.Updated(look.request, next_seq, "superseded")

    # -- a sweep that runs -----------------------------------------------------------------------------------------

    async def _show_live(self) -> None:
        """Send what is new in the running sweep, as long as the client watches."""
        while True:
            await self._live_news.wait()
            self._live_news.clear()
            while (place := self._place) is not None and (news := self._live.next(place)):
                for said in news:
                    await self._outbox.send(said)

    async def _turn_away(self, why: str, code: WSCloseCode) -> None:
        log.warning("stream ended: %s", QUOTED.sub("...", why))
        if not self._socket.closed:
            with suppress(TimeoutError):  # one that does not read either
                async with asyncio.timeout(CLOSE_S):
                    await self._socket.close(code=code, message=_cut(why))


@asynccontextmanager
async def _patience(wait_s: float, expected: str) -> AsyncIterator[None]:
    """Raises RemoteWireError when a client does not say what is expected of it in time."""
    try:
        async with asyncio.timeout(wait_s):
            yield
    except TimeoutError:
        raise RemoteWireError(f"no {expected} within {wait_s:g} s") from None


def _cut(reason: str) -> bytes:
    """As much of a reason as fits a close frame, whole characters only."""
    return reason.encode()[:CLOSE_REASON_MAX].decode(errors="ignore").encode()
