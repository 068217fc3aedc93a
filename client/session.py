"""A conversation with one node: open a scan, look at it, hear of new ones.

This half asks; client.reader takes the answers and keeps the model.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from typing import Any, Literal, NamedTuple, overload
from urllib.parse import quote

import aiohttp
import msgspec
import numpy as np
from numpy.typing import NDArray

from client.classic_model import ClassicModel
from client.discovery import NodeAddress
from client.errors import NodeLost
from client.live import LiveFrame
from client.login import logged_in
from client.model import Model
from client.news import News
from client.reader import Reader, Stats
from client.rest import ask, checked
from client.stream import Stream, open_stream
from client.update import Update
from protocol import messages as m
from protocol.errors import CodecError, LatticeError, LocalWireError, RemoteWireError
from protocol.holdings import LevelArray, RankArray
from protocol.inflate import inflate
from protocol.lattice import Channel
from protocol.quality import ScanQuality
from protocol.sphere import click_of


class Held(NamedTuple):
    """Holdings of a channel, block by block: level (0 = every sample) and rank (larger = better)."""

    level: LevelArray
    rank: RankArray


@asynccontextmanager
async def connect(
    node: NodeAddress | str, token: str | None = None, fingerprint: str | None = None
) -> AsyncIterator[Session]:
    """A session with a node, given by what `discover` found or by its URL (https://HOST:PORT).

    token, fingerprint : what shows us to the node, and the SHA-256 of the certificate that shows it to us; without
    them, what `pair` or `foveascan join` has kept.
    Raises NodeLost when there is none, NodeNotTrusted (before anything is asked) when it is another, RequestRefused
    when it lets us not in, RemoteWireError when it speaks otherwise.
    """
    async with logged_in(node, token, fingerprint) as (url, http):
        stream, info = await open_stream(http, url)
        session = Session(http, stream, info)
        try:
            yield session
        finally:
            await session.close()


class _Assessed(msgspec.Struct):
    """What is read of GET /v1/scans/{id}; a node of an earlier version says no quality."""

    quality: ScanQuality | None = None


class _Scanner(msgspec.Struct):
    """What is read of a scanner's status; a node of a later version may say more."""

    phase: str
    progress: float
    sweeps: int
    why: str


class _Started(_Scanner):
    """What is read of the answer to POST /v1/sweeps. sweep : which of the finished ones it will be."""

    sweep: int


class _Resumed(msgspec.Struct):
    """The same of the answer to POST /v1/sweeps/{sweep}/resume."""

    sweep: int


class InterruptedSweep(msgspec.Struct, rename="camel"):
    """A sweep that was cut, as GET /v1/sweeps lists it.

    started, ended : Unix time [s].  why : what cut it.  held, expected : pieces of columns.  scanner : serial number.
    complete : whether nothing is missing, so that no scanner is needed to make a scan of it.
    """

    id: str
    started: float
    ended: float
    why: str
    held: int
    expected: int
    complete: bool
    scanner: str
    width: int
    height: int
    texture_width: int
    texture_height: int

    @property
    def percent(self) -> int:
        """How much of it is kept, rounded down."""
        return 100 * self.held // max(self.expected, 1)


class _Node(msgspec.Struct):
    """What is read of GET /v1/node."""

    capture: _Scanner


class Session:
    """See `connect`. node : who answers."""

    def __init__(self, http: aiohttp.ClientSession, stream: Stream, node: m.ServerInfo) -> None:
        self.node = node
        self._http = http
        self._stream = stream
        self._reader = Reader(stream)

    @property
    def model(self) -> Model | None:
        """The scan that is open; None before the first."""
        return self._reader.model

    @property
    def stats(self) -> Stats:
        """What this session has carried so far."""
        return self._reader.stats

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
        request = self._reader.new_request()
        with self._reader.opening(request) as answer:
            await self._send(m.Open(request, scan, profile=profile))
            return await answer

    async def error_envelope(self) -> NDArray[np.float32]:
        """How far off the model's range still is, by the node's account. (blocks_y, blocks_x) float32 [mm]

        The largest error of every 8 x 8 block that is measured. Raises LocalWireError when no scan is open,
        RequestRefused for the classic profile, RemoteWireError for an answer that does not fit the scan.
        """
        model = self._opened_model()
        request = self._reader.new_request()
        with self._reader.enveloping(request) as answer:
            await self._send(m.Envelope(request))
            return error_envelope_mm(await answer, model)

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
        max_wait_s or max_bytes, whichever comes first; fill : spend what is left of it on the periphery. A limit that
        nothing fits in, as 0, still costs the answer that says so: about 120 bytes, at most 159.
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
        request = self._reader.new_request()
        look = _checked_look(m.Look(
            request, u, v, window, texture_db, range_mm, max_wait_s, max_bytes, fill, alpha, scale, bound,
            None if classic else parameters,  # type: ignore[arg-type]  # a mapping is converted by the check
            parameters if classic else None,  # type: ignore[arg-type]  # likewise
        ))  # fmt: skip
        with self._reader.looking(request) as answer:
            try:
                await self._send(look)
                return await answer
            except asyncio.CancelledError:
                if self._reader.is_looking(request):
                    with suppress(NodeLost):
                        await self._send(m.Cancel(request))
                raise

    async def look_direction(self, theta_v: float, theta_h: float, **wanted: Any) -> Update:
        """Refine a spherical model round a direction from its centre, and return once it holds what was asked for.

        theta_v : polar angle [rad], 0 straight up to pi.  theta_h : angle round the axis, counter-clockwise from above.
        wanted : as for `look`; window is a share of all directions. On a pole all sides are refined alike.
        Raises what `look` raises, and LocalWireError for a model that is no sphere or a direction that is none.
        """
        spec = self._opened_model().spec
        if spec.geometry != "sphere":
            raise LocalWireError(f"the scan is a {spec.geometry}, not a sphere: look(u, v)")
        try:
            u, v = click_of(theta_v, theta_h, spec.theta0_rad)
        except LatticeError as error:
            raise LocalWireError(f"look: {error}") from None
        return await self.look(u, v, **wanted)

    def published(self) -> News:
        """Scans published from now on: `async for scan in session.published()`.

        Each is its id, a text that also says which sweep it is, or of which scans it was made (client.news.NewScan).
        """
        return self._reader.published()

    async def live(self) -> AsyncGenerator[LiveFrame, None]:
        """The sweep that runs, else the next one, as it comes in: `async for frame in session.live()`.

        Frames follow each other as fast as they are read; the last one says how the sweep ended. Watching costs the
        link two bytes a cell and three a texel of the first view, once in a sweep. Raises what ends the session.
        """
        feed = self._reader.live
        feed.watchers += 1
        try:
            if feed.watchers == 1:
                await self._send(m.Watch(True))
            async for frame in feed.frames():
                yield frame
        finally:
            feed.watchers -= 1
            if not feed.watchers:
                feed.forget()
                if self._reader.ended is None:
                    with suppress(NodeLost):
                        await self._send(m.Watch(False))

    async def scans(self) -> list[dict[str, Any]]:
        """The scans in the node's library, newest first, as GET /v1/scans describes them."""
        said = await ask(self._http, "GET", f"{self._stream.url}/v1/scans")
        return checked(said, list[dict[str, Any]], f"{self._stream.url} lists its scans")

    async def quality(self, scan: str) -> ScanQuality | None:
        """What a scan is worth; None of one that came as a file. scan : an id or "latest"."""
        said = await ask(self._http, "GET", f"{self._stream.url}/v1/scans/{scan}")
        return checked(said, _Assessed, f"{self._stream.url} describes the quality of scan {scan}").quality

    async def scanner(self) -> dict[str, Any]:
        """What the node's scanner is doing, as GET /v1/node says under "capture": phase, progress, sweeps, why."""
        said = await ask(self._http, "GET", f"{self._stream.url}/v1/node")
        checked(said, _Node, f"{self._stream.url} describes its scanner")
        return dict(said["capture"])

    async def start_sweep(self) -> dict[str, Any]:
        """Start a sweep. Returns at once with what POST /v1/sweeps says; the scan is announced by `published`.

        Its `sweep` is the answer's "sweep".
        """
        said = await ask(self._http, "POST", f"{self._stream.url}/v1/sweeps")
        checked(said, _Started, f"{self._stream.url} starts a sweep")
        return dict(said)

    async def sweeps(self) -> list[InterruptedSweep]:
        """The sweeps that were cut and did not become scans, oldest first."""
        said = await ask(self._http, "GET", f"{self._stream.url}/v1/sweeps")
        return checked(said, list[InterruptedSweep], f"{self._stream.url} lists the sweeps that were cut")

    async def resume_sweep(self, sweep: str) -> dict[str, Any]:
        """Go on with one of them: its id. Returns at once, and is followed, as `start_sweep`."""
        said = await ask(self._http, "POST", f"{self._stream.url}/v1/sweeps/{quote(sweep, safe='')}/resume")
        checked(said, _Resumed, f"{self._stream.url} goes on with a sweep")
        return dict(said)

    async def delete_sweep(self, sweep: str) -> None:
        """Delete one of them for good: its id. Raises RequestRefused when there is none such."""
        await ask(self._http, "DELETE", f"{self._stream.url}/v1/sweeps/{quote(sweep, safe='')}")

    async def close(self) -> None:
        """End the session; whoever still waits gets NodeLost. `connect` does this at the end of its block."""
        await self._reader.close()
        await self._stream.close()

    async def _send(self, message: m.FromClient) -> None:
        if (cause := self._reader.ended) is not None:
            raise cause
        try:
            await self._stream.send(message)
        except NodeLost as lost:
            await self._reader.read_out()
            raise self._reader.ended or lost from None

    def _opened_model(self) -> Model:
        if self.model is None:
            raise LocalWireError("no scan is open; await session.open(...) first")
        return self.model


def _checked_look(look: m.Look) -> m.Look:
    try:
        plain = msgspec.to_builtins(look, enc_hook=float)  # numbers of numpy are numbers too
        _require_finite(plain)
        return msgspec.convert(plain, m.Look)
    except (msgspec.ValidationError, TypeError, ValueError) as error:
        raise LocalWireError(f"look: {_plainly(str(error))}") from None


def _require_finite(plain: Any, name: str = "") -> None:
    """Raise ValueError for a number that is none, which passes every bound."""
    if isinstance(plain, dict):
        for key, value in plain.items():
            _require_finite(value, key)
    elif isinstance(plain, float) and not math.isfinite(plain):
        raise ValueError(f"expected a finite number - at `$.{name}`")


def _plainly(problem: str) -> str:
    """A message of msgspec, place first, as the caller wrote it: "max_wait_s: expected float >= 0.05"."""
    what, _, at = problem.partition(" - at ")
    place = re.sub("[A-Z]", lambda letter: f"_{letter[0].lower()}", at.strip("`").removeprefix("$").removeprefix("."))
    what = what.replace("`", "").replace("Expected", "expected")
    return f"{place}: {what}" if place else what


def error_envelope_mm(said: m.Enveloped, model: Model) -> NDArray[np.float32]:
    """The errors of an `enveloped`. (blocks_y, blocks_x) float32 [mm]. Raises RemoteWireError where they do not fit."""
    shape = model.shapes[Channel.RANGE].blocks
    size = 2 * shape[0] * shape[1]
    try:
        errors = inflate(said.errors, size, "enveloped")
    except CodecError as error:
        raise RemoteWireError(str(error)) from None
    if len(errors) != size:
        raise RemoteWireError(f"enveloped: {len(errors)} bytes of errors for {shape} blocks")
    return np.frombuffer(errors, "<u2").reshape(shape).astype(np.float32) * np.float32(model.info.step_mm)
