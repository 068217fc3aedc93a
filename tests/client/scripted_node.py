"""A node that does what a test says: one synthetic scan, refinements made by the protocol's own functions, a script."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, replace

import numpy as np
from aiohttp import WSMsgType, web

from client import Session as ClientSession
from client import connect
from protocol import messages as m
from protocol.codec import LOSSLESS, RangeCodec, TextureCodec, encode_mask, encode_range, encode_texture
from protocol.grid import VOID, BoolArray, Grid, GridSpec, ImageArray, StepArray, dequantise, quantise
from protocol.holdings import ChannelHoldings, Holdings, range_rank, texture_rank
from protocol.lattice import Channel, Parameters, build_lattice
from protocol.live import LiveColumns
from protocol.reconstruct import Selection, content_hashes, cut, range_patch, select
from protocol.refinement import Generator, Refinement
from protocol.session import Role, Session

SPEC = GridSpec(96, 64, 256, 128, step_mm=0.01, pitch_mm=0.5, z_max_mm=32.0)
COARSE_SPACING = 8
QUANTUM = 5
WINDOW = Parameters(2, 3, 2, 3, 2, 178145, 178145)
FILLER = 12345


def synthetic_grid() -> Grid:
    """Hills with a crease, a void patch and a striped texture, the same every time."""
    row, column = np.mgrid[: SPEC.height, : SPEC.width]
    turn = 2 * np.pi * column / SPEC.width
    steps = 9000 + 800 * np.sin(3 * turn) * np.cos(row / 9) + 300 * (row > 30)
    range_steps = np.rint(steps).astype(np.uint16)
    range_steps[18:27, 25:41] = VOID
    y, x = np.mgrid[: SPEC.texture_height, : SPEC.texture_width]
    texture = np.stack([x % 256, (x + y) % 256, (y * 3) % 256], axis=2).astype(np.uint8)
    return Grid(SPEC, range_steps, texture)


class Planner:
    """The node's side of one opening: makes refinements of the grid and keeps the holdings they lead to."""

    def __init__(self, grid: Grid, epoch: int = 1) -> None:
        self.grid = grid
        self.epoch = epoch
        self.seq = 0
        height, width = SPEC.height // COARSE_SPACING, SPEC.width // COARSE_SPACING
        self.info = m.ScanInfo(
            id="synthetic",
            width=SPEC.width,
            height=SPEC.height,
            texture_width=SPEC.texture_width,
            texture_height=SPEC.texture_height,
            coarse_width=width,
            coarse_height=height,
            coarse_texture_width=SPEC.texture_width // COARSE_SPACING,
            coarse_texture_height=SPEC.texture_height // COARSE_SPACING,
            step_mm=SPEC.step_mm,
            pitch_mm=SPEC.pitch_mm,
            z_max_mm=SPEC.z_max_mm,
            theta0_rad=SPEC.theta0_rad,
        )
        self.shapes = self.info.shapes()
        self.holdings = Holdings.coarse(self.shapes)

    def opened(self, request: int) -> m.Opened:
        return m.Opened(request, self.epoch, self.info)

    def first_view(self) -> list[Refinement]:
        """Range and texture: every eighth sample."""
        steps, void = self.coarse_range()
        payload = encode_range(steps, RangeCodec.HTJ2K, QUANTUM)
        colour = self.coarse_texture()
        texels = encode_texture(colour, TextureCodec.HTJ2K, LOSSLESS)
        samples = colour.shape[0] * colour.shape[1]
        coarse = Generator.COARSE
        return [
            self._numbered(coarse, Channel.RANGE, RangeCodec.HTJ2K, QUANTUM, steps.size, payload, encode_mask(void)),
            self._numbered(coarse, Channel.TEXTURE, TextureCodec.HTJ2K, LOSSLESS, samples, texels),
        ]

    def coarse_range(self) -> tuple[StepArray, BoolArray]:
        """Samples of the first view, voids filled, and where they are."""
        half = COARSE_SPACING // 2
        steps = self.grid.range_steps[half::COARSE_SPACING, half::COARSE_SPACING].copy()
        void = steps == VOID
        steps[void] = FILLER
        return steps, void

    def coarse_texture(self) -> ImageArray:
        half = COARSE_SPACING // 2
        return np.ascontiguousarray(self.grid.texture[half::COARSE_SPACING, half::COARSE_SPACING])

    def range_fovea(
        self, parameters: Parameters = WINDOW, quantum: int = 1, look: int = 0, self_contained: bool = False
    ) -> Refinement:
        """A fovea of range; the planner's holdings take it in."""
        selection, adopted = self._select(Channel.RANGE, parameters, range_rank(quantum), self_contained)
        lattice = selection.lattice
        rows = lattice.y.border[selection.y.sample] // 2
        columns = lattice.x.border[selection.x.sample] // 2 % SPEC.width
        samples = self.grid.range_steps[np.ix_(rows, columns)].copy()
        samples[samples == VOID] = FILLER
        void = (np.asarray(cut(self.grid.range_steps, selection)) == VOID) & selection.adopted_cells()
        patch = range_patch(selection, dequantise(quantise(samples, quantum), quantum))
        patch[void] = VOID
        held = self.holdings.channels[Channel.RANGE]
        if self_contained:
            selection, adopted = _finer_only(selection, held, range_rank(quantum))
        held.adopt(lattice, adopted, range_rank(quantum))
        self.holdings.add_content(selection.adopted_blocks(), content_hashes(patch, selection))
        payload = encode_range(samples, RangeCodec.HTJ2K, quantum)
        fovea = self._numbered(
            Generator.FOVEA, Channel.RANGE, RangeCodec.HTJ2K, quantum, samples.size, payload, encode_mask(void)
        )
        return replace(fovea, parameters=parameters, look=look, self_contained=self_contained)

    def texture_fovea(self, parameters: Parameters = WINDOW, quality: int = LOSSLESS, look: int = 0) -> Refinement:
        """A fovea of texture: of each cell the texel at its centre."""
        selection, adopted = self._select(Channel.TEXTURE, parameters, texture_rank(quality), False)
        lattice = selection.lattice
        rows = (lattice.y.border[:-1] + lattice.y.border[1:])[selection.y.sample] // 4
        columns = (lattice.x.border[:-1] + lattice.x.border[1:])[selection.x.sample] // 4 % SPEC.texture_width
        texels = np.ascontiguousarray(self.grid.texture[np.ix_(np.minimum(rows, SPEC.texture_height - 1), columns)])
        self.holdings.channels[Channel.TEXTURE].adopt(lattice, adopted, texture_rank(quality))
        payload = encode_texture(texels, TextureCodec.HTJ2K, quality)
        samples = texels.shape[0] * texels.shape[1]
        fovea = self._numbered(Generator.FOVEA, Channel.TEXTURE, TextureCodec.HTJ2K, quality, samples, payload)
        return replace(fovea, parameters=parameters, look=look)

    def _select(self, channel: Channel, parameters: Parameters, rank: int, fresh: bool) -> tuple[Selection, BoolArray]:
        shape = self.shapes[channel]
        held = ChannelHoldings.coarse(shape) if fresh else self.holdings.channels[channel]
        chosen = select(build_lattice(shape, parameters), held, rank)
        assert chosen is not None, "the client holds all of this already"
        return chosen

    def _numbered(
        self,
        generator: Generator,
        channel: Channel,
        codec: int,
        quality: int,
        samples: int,
        payload: bytes,
        mask: bytes = b"",
    ) -> Refinement:
        self.seq += 1
        return Refinement(generator, channel, self.epoch, self.seq - 1, 0, codec, quality, samples, payload, mask)


def _finer_only(selection: Selection, held: ChannelHoldings, rank: int) -> tuple[Selection, BoolArray]:
    """What a client that holds `held` adopts of a selection over all of the lattice's blocks."""
    finer = held.adoptable(selection.lattice, rank)
    rows = np.isin(
        selection.lattice.y.start, np.unique(selection.y.start + np.cumsum(selection.y.size) - selection.y.size)
    )
    columns = np.isin(
        selection.lattice.x.start, np.unique(selection.x.start + np.cumsum(selection.x.size) - selection.x.size)
    )
    return replace(selection, adopted=finer[np.ix_(rows, columns)]), finer


@dataclass
class Line:
    """The node's end of one stream."""

    socket: web.WebSocketResponse
    session: Session
    authorization: str | None = None  # what the client showed

    async def say(self, *said: m.FromNode | Refinement | LiveColumns) -> None:
        for one in said:
            data = self.session.send(one)
            await (self.socket.send_str(data) if isinstance(data, str) else self.socket.send_bytes(data))

    async def hear(self) -> m.Message:
        """The next message; ConnectionError when the client is gone."""
        frame = await self.socket.receive()
        if frame.type is not WSMsgType.TEXT:
            raise ConnectionError
        message = self.session.receive(frame.data)
        assert not isinstance(message, Refinement | LiveColumns)
        return message

    async def gone(self) -> int | None:
        """Wait until the client has closed the stream; the code it gave."""
        while (await self.socket.receive()).type in (WSMsgType.TEXT, WSMsgType.BINARY):
            pass
        return self.socket.close_code


Script = Callable[[Line], Awaitable[None]]
INFO = m.ServerInfo(m.PROTOCOL, "0123", "scripted", "0")


async def greet(line: Line) -> m.Hello:
    """Let the client in."""
    await line.say(INFO)
    hello = await line.hear()
    assert isinstance(hello, m.Hello)
    await line.say(m.Welcome("admin"))
    return hello


async def show(line: Line, planner: Planner) -> m.Ack:
    """Let the client in, open its scan, send the first view, hear the acknowledgement."""
    await greet(line)
    asked = await line.hear()
    assert isinstance(asked, m.Open)
    await line.say(planner.opened(asked.request), *planner.first_view())
    ack = await line.hear()
    assert isinstance(ack, m.Ack)
    return ack


def updated(planner: Planner, request: int, **fields: object) -> m.Updated:
    """The closing message of an update that is complete."""
    return m.Updated(request, planner.seq, "complete", **fields)  # type: ignore[arg-type]


@asynccontextmanager
async def serving(script: Script, *routes: web.RouteDef) -> AsyncIterator[str]:
    """A node on loopback that runs the script on every stream; yields its URL, raises what the script raised."""
    failures: list[BaseException] = []

    async def stream(request: web.Request) -> web.WebSocketResponse:
        socket = web.WebSocketResponse(protocols=(m.PROTOCOL,))
        await socket.prepare(request)
        try:
            await script(Line(socket, Session(Role.NODE), request.headers.get("Authorization")))
        except ConnectionError:
            pass
        except BaseException as error:
            failures.append(error)
            raise
        return socket

    app = web.Application()
    app.add_routes([web.get("/v1/stream", stream), *routes])
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    try:
        yield f"http://127.0.0.1:{runner.addresses[0][1]}"
    finally:
        await runner.cleanup()
    if failures:
        raise failures[0]


@contextmanager
def serving_in_thread(script: Script, *routes: web.RouteDef) -> Iterator[str]:
    """The same for tests that have no event loop of their own."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    served = serving(script, *routes)
    try:
        yield asyncio.run_coroutine_threadsafe(served.__aenter__(), loop).result(10)
    finally:
        asyncio.run_coroutine_threadsafe(served.__aexit__(None, None, None), loop).result(10)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def show_and_answer(line: Line) -> None:
    """The whole of a sound node: the first view, then every look with full detail in the window."""
    planner = Planner(synthetic_grid())
    await show(line, planner)
    while True:
        look = await line.hear()
        if isinstance(look, m.Look):
            fovea = planner.range_fovea(look=look.request), planner.texture_fovea(look=look.request)
            await line.say(*fovea, updated(planner, look.request, error_max_mm=0.0, texture_db=100.0))


@asynccontextmanager
async def session_with(script: Script, *routes: web.RouteDef) -> AsyncIterator[ClientSession]:
    async with serving(script, *routes) as url, connect(url) as session:
        yield session


async def hear_look(line: Line) -> m.Look:
    look = await line.hear()
    assert isinstance(look, m.Look)
    return look


async def until_gone(line: Line) -> None:
    await line.gone()
