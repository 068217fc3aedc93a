"""Scans made of scans: a cylinder as a sphere, or a sphere as a cylinder, each kept as a scan of its own.

A scan never changes, so what is made of it stands beside it, and says of which scans it was made and how. That happens
when somebody asks, over HTTP, and by itself with a sweep that saw nearly all of a closed object.
"""

from __future__ import annotations

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Iterator

from aiohttp import web

from exchange.closing import closes
from exchange.errors import ExchangeError
from exchange.formats import ReadOptions, as_wanted
from exchange.native import Scanned
from exchange.sweeps import Sweep
from node import bodies
from node.audit import NODE, Audit
from node.audit_routes import SCAN, WHAT
from node.endpoints import route
from node.exhibits import Exhibits
from node.library import About, Library, Scan
from node.rest import decoded, said
from protocol import messages as m
from protocol.errors import LibraryError

log = logging.getLogger(__name__)

AT_ONCE = 1


class Stopping(Exception):
    """The node ends, and with it what it was working on."""


def derive(library: Library, scan_id: str, wanted: bodies.Derivation, progress: Callable[[float], object]) -> Scan:
    """Make a scan of a scan, safe on disk before this returns. progress : told the share done; may raise.

    Raises LibraryError for one that is unknown or cannot be kept, ExchangeError for one that cannot be made so.
    """
    others: dict[str, float] = {}
    for other, tip_deg in _tipped(wanted):
        others.setdefault(library.resolve(other), tip_deg)  # one that lay on its side has seen both ends
    sweeps = tuple(Sweep(library.open(other).grid, tip_deg) for other, tip_deg in others.items())
    options = ReadOptions(
        geometry=wanted.geometry, caps=wanted.caps, centre_mm=wanted.centre_height_mm, sweeps=sweeps
    )
    source = library.open(scan_id)
    if wanted.geometry == source.spec.geometry:
        other = "cylinder" if wanted.geometry == "sphere" else "sphere"
        raise ExchangeError(f"scan: is a {wanted.geometry} already: name another (--scan ID), or --geometry {other}")
    found = Scanned(source.about.name, source.grid, source.about.note)
    made = as_wanted(found, options, progress)
    about = About(time.time(), "derived", made.name, note=made.note, made_from=(scan_id, *others))
    return library.add(made.grid, about)


def _tipped(wanted: bodies.Derivation) -> Iterator[tuple[str, float]]:
    """The other sweeps that are wanted, and how far the object was tipped over its front in each."""
    if wanted.top is not None:
        yield wanted.top, wanted.tip_deg
    if wanted.bottom is not None:
        yield wanted.bottom, -wanted.tip_deg


class Derivation:
    """Derives one scan at a time; everything here runs in one event loop.

    published : told of each.  audit : where those are noted that nobody asked for.
    """

    def __init__(self, exhibits: Exhibits, published: Callable[[m.Published], object], audit: Audit) -> None:
        self._exhibits = exhibits
        self._audit = audit
        self._published = published
        self._place = asyncio.Semaphore(AT_ONCE)
        self._stopping = threading.Event()
        self._tasks: set[asyncio.Task[None]] = set()

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [route("POST /v1/scans/{scan}/derive", self._derive)]

    def consider(self, scan_id: str) -> None:
        """Make a sphere of a new sweep, if it saw a closed object; later, beside everything else."""
        task = asyncio.create_task(self._close(scan_id))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def stop(self, within_s: float | None = None) -> None:
        """Leave what is not finished."""
        self._stopping.set()
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=within_s)

    async def _close(self, scan_id: str) -> None:
        library = self._exhibits.library
        async with self._place:
            try:
                if await asyncio.to_thread(lambda: closes(library.open(scan_id).grid)):
                    scan = await self._made(scan_id, bodies.Derivation("sphere"))
                    self._audit.note("derived", NODE, scan=scan.id, what=f"of {scan_id}")
                    log.info("scan published, too: %s", scan.about.note)
            except (ExchangeError, LibraryError) as problem:
                log.warning("the scan is not kept as a sphere: %s", problem)
            except Stopping:
                pass

    async def _derive(self, request: web.Request) -> web.Response:
        wanted = decoded(await request.read(), bodies.Derivation)
        if self._place.locked():
            raise web.HTTPServiceUnavailable(text="busy with another scan: try again later")
        async with self._place:
            source = self._exhibits.library.resolve(request.match_info["scan"])
            try:
                scan = await self._made(source, wanted)
            except ExchangeError as problem:
                raise web.HTTPUnprocessableEntity(text=str(problem)) from problem
            except Stopping:
                raise web.HTTPServiceUnavailable(text="the node is stopping") from None
        request[SCAN], request[WHAT] = scan.id, f"of {source}"
        return said(bodies.Derived(scan.id, scan.spec.geometry, scan.about.note), 201)

    async def _made(self, scan_id: str, wanted: bodies.Derivation) -> Scan:
        scan = await asyncio.to_thread(derive, self._exhibits.library, scan_id, wanted, self._go_on)
        self._published(m.Published(scan.id, made_from=scan.about.made_from))
        return scan

    def _go_on(self, share: float) -> None:
        if self._stopping.is_set():
            raise Stopping
