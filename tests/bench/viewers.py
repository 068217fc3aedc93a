"""Light viewers: real streams to a real node, whose ends decode nothing, so that hundreds fit beside it.

Instead of proving by a digest what an update left them with, they state that they hold the first view alone. So every
click costs the node its whole patch, as if that viewer had never looked there.

As a program: reads one JSON object on standard input (see `Orders`), prints one (see `Report`).
"""

from __future__ import annotations

import asyncio
import itertools
import sys
import time

import aiohttp
import msgspec
import numpy as np

from protocol import messages as m
from protocol.holdings import Holdings
from protocol.lattice import Channel

GIVE_UP_S = 30.0


class Orders(msgspec.Struct):
    """How many viewers open the newest scan, of whom how many click every `period_s` at one of the places.

    stall_s : of every two such times, during the second there is a viewer more, that asks and never reads.
    """

    url: str
    viewers: int
    clickers: int
    seconds: float
    places: list[tuple[float, float]]
    period_s: float = 0.5
    stall_s: float | None = None
    seed: int = 7


class Report(msgspec.Struct):
    """latencies_s : from each click to the last byte of the first answer that came for it or for a later one.

    clicked_s : when each of these clicks was made, from the first one of all on.
    late_s : how late each click was made.  cpu_s : processor time of the viewers themselves, while they clicked.
    """

    latencies_s: list[float]
    clicked_s: list[float]
    superseded: int
    size_bytes: int
    late_s: list[float]
    cpu_s: float
    errors: list[str]


class Viewer:
    """One stream with the newest scan open."""

    def __init__(self, stream: aiohttp.ClientWebSocketResponse) -> None:
        self._stream = stream
        self._state: m.State | None = None
        self._waiting: dict[int, float] = {}
        self._request = 0
        self.latencies_s: list[float] = []
        self.clicked_s: list[float] = []
        self.late_s: list[float] = []
        self.superseded = 0
        self.size_bytes = 0

    async def open(self) -> None:
        """Greet, and take the first view."""
        await self._next()
        await self._say(m.Hello(m.PROTOCOL, "load", geometries=("cylinder", "sphere")))
        await self._next()
        await self._say(m.Open(self._number(), "latest"))
        while not isinstance(opened := await self._next(), m.Opened):
            pass
        held = Holdings.coarse(opened.scan.shapes())
        statement = m.Statement(*(held.channels[channel].to_runs() for channel in Channel))
        for _ in Channel:
            await self._next()
        self._state = m.State(opened.epoch, 2, statement)
        await self._say(self._state)

    async def click(self, u: float, v: float) -> None:
        """Look somewhere, without waiting."""
        number = self._number()
        self._waiting[number] = time.monotonic()
        await self._say(m.Look(number, u, v))

    async def listen(self) -> None:
        """Take what comes, until cancelled."""
        while True:
            match await self._next():
                case m.Updated(request=request, reason=reason, next_seq=next_seq):
                    if reason == "superseded":
                        self.superseded += 1
                        continue
                    now_s = time.monotonic()
                    for older in [number for number in self._waiting if number <= request]:
                        self.clicked_s.append(self._waiting.pop(older))
                        self.latencies_s.append(now_s - self.clicked_s[-1])
                    assert self._state is not None
                    self._state = msgspec.structs.replace(self._state, next_seq=next_seq)
                    await self._say(self._state)
                case m.Refused(code=code, message=message):
                    raise RuntimeError(f"refused: {code}: {message}")

    async def settle(self) -> None:
        """Wait for the answers to all clicks."""
        async with asyncio.timeout(GIVE_UP_S):
            while self._waiting:
                await asyncio.sleep(0.01)

    def _number(self) -> int:
        self._request += 1
        return self._request

    async def _say(self, message: m.FromClient) -> None:
        await self._stream.send_str(m.encode_message(message))

    async def _next(self) -> m.Message | None:
        frame = await self._stream.receive()
        if frame.type is aiohttp.WSMsgType.BINARY:
            self.size_bytes += len(frame.data)
            return None
        if frame.type is not aiohttp.WSMsgType.TEXT:
            raise RuntimeError(f"the stream ended: {self._stream.close_code}, {frame.extra}")
        return m.decode_message(frame.data)


async def view(orders: Orders) -> Report:
    """Carry out orders."""
    connector = aiohttp.TCPConnector(limit=0)
    async with asyncio.timeout(orders.seconds + 4 * GIVE_UP_S), aiohttp.ClientSession(connector=connector) as http:
        viewers = [await _opened(http, orders.url) for _ in range(orders.viewers)]
        clickers = viewers[: orders.clickers]
        listeners = [asyncio.create_task(viewer.listen()) for viewer in viewers]
        if orders.stall_s is not None:
            listeners.append(asyncio.create_task(_stall(orders.url, orders.stall_s)))
        begun_s, first_s = time.process_time(), time.monotonic()
        errors = await asyncio.gather(
            *(_click(viewer, number, orders) for number, viewer in enumerate(clickers)), return_exceptions=True
        )
        broken = [task.exception() for task in listeners if task.done()]
        for task in listeners:
            task.cancel()
        return Report(
            [latency for viewer in clickers for latency in viewer.latencies_s],
            [clicked_s - first_s for viewer in clickers for clicked_s in viewer.clicked_s],
            sum(viewer.superseded for viewer in clickers),
            sum(viewer.size_bytes for viewer in viewers),
            [late for viewer in clickers for late in viewer.late_s],
            time.process_time() - begun_s,
            [repr(error) for error in (*errors, *broken) if error is not None],
        )


async def _opened(http: aiohttp.ClientSession, url: str) -> Viewer:
    viewer = Viewer(await _stream(http, url))
    await viewer.open()
    return viewer


async def _stream(http: aiohttp.ClientSession, url: str) -> aiohttp.ClientWebSocketResponse:
    return await http.ws_connect(f"{url}/v1/stream", protocols=(m.PROTOCOL,), max_msg_size=1 << 26)


async def _stall(url: str, stall_s: float) -> None:
    """During every second stall_s, a viewer that asks for everything at once, and reads none of it."""
    began_s = time.monotonic()
    for turn in itertools.count(1):
        await asyncio.sleep(max(began_s + (2 * turn - 1) * stall_s - time.monotonic(), 0.0))
        async with aiohttp.ClientSession() as http:
            viewer = await _opened(http, url)
            for place in np.linspace(0.05, 0.95, 50):
                await viewer.click(float(place), 0.5)
            await asyncio.sleep(max(began_s + 2 * turn * stall_s - time.monotonic(), 0.0))


async def _click(viewer: Viewer, number: int, orders: Orders) -> None:
    """Click in time, whether or not answers came; the first click of each viewer at a time of its own."""
    draw = np.random.default_rng((orders.seed, number))
    began_s = time.monotonic() + orders.period_s * number / max(orders.clickers, 1)
    for turn in range(int(orders.seconds / orders.period_s)):
        due_s = began_s + turn * orders.period_s
        await asyncio.sleep(max(0.0, due_s - time.monotonic()))
        viewer.late_s.append(time.monotonic() - due_s)
        await viewer.click(*orders.places[draw.integers(len(orders.places))])
    await viewer.settle()


def main() -> None:
    """What the program does."""
    orders = msgspec.json.decode(sys.stdin.buffer.read(), type=Orders)
    sys.stdout.buffer.write(msgspec.json.encode(asyncio.run(view(orders))))


if __name__ == "__main__":
    main()
