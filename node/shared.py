"""Foveae as plain HTTP, for many viewers of the same places: each a function of its URL, so that caches can share it.

`GET .../fovea?u=..&v=..` plans over the first view alone and answers 303 to a canonical URL that names every parameter.
What stands there never changes: refinements that say they are self-contained, of which a client adopts what is finer
than what it holds. Requests for the same at the same time share one encode, and what was planned is kept for a while.

A cache of ours asks nobody who they are. So where there are logins, it asks us before it hands out what it keeps, by
`GET /v1/auth`; and only a cache that configuration names is told that it may keep anything, in a header that no other
cache reads. Browsers and whatever else is in between are told to keep nothing.

    /v1/scans/{scan}/fovea/{epoch}/{range}/{texture}
    range    spacing.block_x.block_y.blocks_wide.blocks_high.rho_x.rho_y.quantum        or -
    texture  spacing.block_x.block_y.blocks_wide.blocks_high.rho_x.rho_y.sixteenths.codec  or -
"""

from __future__ import annotations

import asyncio
import re
import secrets
from collections import OrderedDict
from collections.abc import Callable, Coroutine
from dataclasses import replace
from functools import partial
from typing import Any, Generic, TypeVar

from aiohttp import web
from msgspec import UNSET, structs

from node.audit_routes import SCAN
from node.bodies import FoveaQuery
from node.coded import Coded
from node.endpoints import route
from node.exhibits import Exhibits
from node.first_view import FirstView
from node.foveate import plan_update
from node.library import Scan
from node.proxy import IS_PROXIED
from node.refine_range import code_range_lattice
from node.refine_texture import code_texture_lattice
from node.rest import query_of
from node.wanted import Models, Wanted
from protocol import messages as m
from protocol.codec import SIXTEENTHS, TextureCodec
from protocol.errors import CodecError, LatticeError, LibraryError
from protocol.lattice import Channel, Parameters
from protocol.refinement import from_spacing_byte, spacing_byte

PLANS_KEPT = 1024
BODIES_KEPT = 256
MAX_AGE_S = 86400
NONE = "-"
ORIGINAL_URI = "X-Original-URI"
KEPT = re.compile(r"/v1/scans/([0-9a-f]{32})/(?:coarse|fovea/([0-9a-f]{8})/[0-9.-]+/[0-9.-]+)(?:\?[^#]*)?")
LATTICE_NUMBERS, RANGE_NUMBERS, TEXTURE_NUMBERS = 7, 8, 9
URL_PART_MAX = 4096

T = TypeVar("T")


class Once(Generic[T]):
    """Results by key: made once however many ask at the same time, the latest `kept` of them kept."""

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._results: OrderedDict[str, asyncio.Task[T]] = OrderedDict()

    async def get(self, key: str, make: Callable[[], Coroutine[Any, Any, T]]) -> T:
        """The result for a key; what fails is forgotten."""
        task = self._results.get(key)
        if task is None:
            task = self._results[key] = asyncio.create_task(make())
            while len(self._results) > self._kept:
                self._results.popitem(last=False)
        self._results.move_to_end(key)
        try:
            return await asyncio.shield(task)
        except Exception:
            self._results.pop(key, None)
            raise

    def clear(self) -> None:
        """Forget everything."""
        self._results.clear()


class SharedFoveae:
    """The routes of self-contained foveae. shared_cache : whether caches may keep answers; is_open : no logins here."""

    def __init__(self, exhibits: Exhibits, *, shared_cache: bool, is_open: bool) -> None:
        self._exhibits = exhibits
        self._shared_cache = shared_cache
        self._is_open = is_open
        self._epoch = secrets.token_hex(4)
        self._plans: Once[str] = Once(PLANS_KEPT)
        self._bodies: Once[bytes] = Once(BODIES_KEPT)
        self.encodes = 0

    def cache_headers(self, request: web.Request, scan: Scan) -> dict[str, str]:
        """What says who may keep an answer: nobody where `latest` or a shortened id was asked for."""
        if not self._shared_cache or request.match_info["scan"] != scan.id:
            return {}
        if self._is_open:
            return {"Cache-Control": f"public, max-age={MAX_AGE_S}, immutable"}
        return {"X-Accel-Expires": str(MAX_AGE_S)} if request[IS_PROXIED] else {}

    def routes(self) -> list[web.RouteDef]:
        """What to serve."""
        return [
            route("GET /v1/scans/{scan}/fovea", self._plan),
            route("GET /v1/scans/{scan}/fovea/{epoch}/{range}/{texture}", self._serve),
            route("GET /v1/auth", self.may_hand_out),
        ]

    def void(self) -> None:
        """A scan is gone: no URL given out so far leads anywhere any more."""
        self._epoch = secrets.token_hex(4)
        self._plans.clear()
        self._bodies.clear()

    async def may_hand_out(self, request: web.Request) -> web.Response:
        """A cache asks, before it hands out what it keeps: whether this client may have it, and it is still true."""
        kept = KEPT.fullmatch(request.headers.get(ORIGINAL_URI, ""))
        if kept is None or not self._stands(kept):
            raise web.HTTPForbidden(text=f"{ORIGINAL_URI} names nothing that a cache may hand out")
        request[SCAN] = kept[1]
        return web.Response(status=204)

    def _stands(self, kept: re.Match[str]) -> bool:
        """Whether a URL that we let caches keep is of a scan that was not deleted since."""
        if kept[2] not in (None, self._epoch):
            return False
        try:
            return self._exhibits.library.summary(kept[1]).id == kept[1]
        except LibraryError:
            return False

    async def _plan(self, request: web.Request) -> web.Response:
        query = query_of(request, FoveaQuery)
        look, codec = _look(query), query.codec
        scan, view = await self._exhibits.open(request.match_info["scan"], codec)
        key = f"{scan.id}?{request.query_string}"
        place = await self._plans.get(key, partial(self._make_plan, scan, view, look, codec))
        raise web.HTTPSeeOther(place)

    async def _make_plan(self, scan: Scan, view: FirstView, look: m.Look, codec: m.CodecName) -> str:
        models = Models(texture=self._exhibits.models(scan).texture)
        job = partial(plan_update, scan, view.state, Wanted(look, (codec,), look.max_bytes), models)
        update = await self._exhibits.work(job, "fovea")
        place = canonical_path(scan.id, self._epoch, update.coded)
        self.encodes += 1
        await self._bodies.get(place, partial(_ready, body_of(update.coded)))
        return place

    async def _serve(self, request: web.Request) -> web.Response:
        if request.match_info["epoch"] != self._epoch:
            raise web.HTTPGone(text="the library has changed since: ask for the place again")
        scan, view = await self._exhibits.open(request.match_info["scan"], "htj2k")
        request[SCAN] = scan.id
        job = partial(_encode, scan, view, request.match_info["range"], request.match_info["texture"])
        body = await self._bodies.get(request.path, partial(self._encode, job))
        headers = self.cache_headers(request, scan)
        return web.Response(body=body, content_type="application/octet-stream", headers=headers)

    async def _encode(self, job: Callable[[], bytes]) -> bytes:
        self.encodes += 1
        try:
            return await self._exhibits.work(job, "fovea")
        except (LatticeError, CodecError, ValueError) as error:
            raise web.HTTPBadRequest(text=f"no such fovea: {error}") from None


def canonical_path(scan_id: str, epoch: str, coded: tuple[Coded, ...]) -> str:
    """The URL that stands for planned refinements, at most one a channel."""
    parts = {"range": NONE, "texture": NONE}
    for one in coded:
        p = one.parameters
        numbers = [spacing_byte(p), p.block_x, p.block_y, p.blocks_wide, p.blocks_high, p.rho_x, p.rho_y]
        if one.channel is Channel.RANGE:
            numbers.append(int(one.quality))
        else:
            numbers += [round(one.quality * SIXTEENTHS), int(one.codec)]
        parts[one.channel.name.lower()] = ".".join(map(str, [*numbers, *(p.listed or ())]))
    return f"/v1/scans/{scan_id}/fovea/{epoch}/{parts['range']}/{parts['texture']}"


def body_of(coded: tuple[Coded, ...]) -> bytes:
    """Refinements one behind the other, each behind its length (u32, little-endian)."""
    refinements = (
        replace(one.refinement(0, seq, 0), self_contained=True).to_bytes() for seq, one in enumerate(coded)
    )
    return b"".join(len(data).to_bytes(4, "little") + data for data in refinements)


def _encode(scan: Scan, view: FirstView, range_part: str, texture_part: str) -> bytes:
    coded = []
    if range_part != NONE:
        lattice, (quantum,), listed = _numbers(range_part, RANGE_NUMBERS)
        coded.append(code_range_lattice(scan, view.state, _parameters(*lattice, listed=listed), quantum))
    if texture_part != NONE:
        lattice, (sixteenths, codec), listed = _numbers(texture_part, TEXTURE_NUMBERS)
        parameters = _parameters(*lattice, listed=listed)
        quality = sixteenths / SIXTEENTHS
        coded.append(code_texture_lattice(scan, view.state, parameters, quality, TextureCodec(codec)))
    return body_of(tuple(one for one in coded if one is not None))


def _parameters(
    spacing: int, x: int, y: int, wide: int, high: int, rho_x: int, rho_y: int, *, listed: tuple[int, ...] | None
) -> Parameters:
    return from_spacing_byte(spacing, Parameters(0, x, y, wide, high, rho_x, rho_y, listed))


def _numbers(text: str, count: int) -> tuple[list[int], list[int], tuple[int, ...] | None]:
    """A lattice's seven numbers, what more of the first `count` there is, and behind these the runs listed, if any."""
    found = text[:URL_PART_MAX].split(".")
    numbers = [int(part) for part in found if part.isascii() and part.isdigit() and len(part) <= 10]
    if len(numbers) < count or ".".join(map(str, numbers)) != text:
        raise ValueError(f"expected {count} numbers, and runs, got {text[:80]!r}")
    return numbers[:LATTICE_NUMBERS], numbers[LATTICE_NUMBERS:count], tuple(numbers[count:]) or None


def _look(query: FoveaQuery) -> m.Look:
    """What the query stands for."""
    fields = {name: value for name, value in structs.asdict(query).items() if value is not UNSET and name != "codec"}
    return m.Look(request=0, **fields)


async def _ready(body: bytes) -> bytes:
    return body

