"""What goes out to one client: messages, and updates one at a time; its acknowledgements tell how quick the link is."""

from __future__ import annotations

import asyncio
import time

from aiohttp import web

from node.metrics import Metrics
from node.rate import RateControl, Sending
from protocol import messages as m
from protocol.live import LiveColumns
from protocol.session import Phase, Session


class Outbox:
    """The sending half of a stream.

    rate : what is known of the link.   is_free : set while nothing that was sent waits for its acknowledgement.
    """

    def __init__(
        self, socket: web.WebSocketResponse, session: Session, metrics: Metrics, cold_start_bytes_s: float
    ) -> None:
        self._socket, self._session, self._metrics = socket, session, metrics
        self.rate = RateControl(cold_start_bytes_s)
        self.is_free = asyncio.Event()
        self._sending = Sending(time.monotonic())

    async def send(self, said: m.FromNode | LiveColumns) -> None:
        """Send a message, unless goodbye was said: nobody waits for it any more then."""
        if self._session.phase is Phase.CLOSED:
            return
        wire = self._session.send(said)
        if isinstance(wire, str):
            await self._socket.send_str(wire)
        else:
            await self.send_bytes(wire)

    async def send_bytes(self, data: bytes) -> None:
        """Send what is a message already."""
        self._sending.sent(len(data))
        self._metrics.sent(len(data))
        await self._socket.send_bytes(data)

    def begin(self) -> None:
        """What is sent from now on is an update, which the client will acknowledge."""
        self.is_free.clear()
        self._sending = Sending(time.monotonic())

    def go_on(self) -> None:
        """The rest of an update that was begun ahead of its end is sent from now on."""
        self._sending.goes_on(time.monotonic())

    def acknowledged(self, apply_s: float) -> None:
        """The client has what was sent, and took so long to apply it: learn how quick the link is."""
        if not self.is_free.is_set() and (fastest := self._sending.fastest(time.monotonic())):
            self.rate.acknowledged(*fastest, apply_s)
            self._metrics.measured(self.rate.bandwidth_bytes_s)
