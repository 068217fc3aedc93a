"""Scans as files over HTTP: GET one in a format of the exchange, POST a native grid to add it to the library.

A file is written whole before its first byte is sent, and received whole before it is read: in a nameless temporary
file on the library's disk, which a crash cannot leave behind. So a half import is never seen, and neither direction
holds more than a band or a chunk beside the scan itself. At most EXPORTS_MAX and one import at a time; a reader or
sender that stalls for STALL_S loses its place.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import BinaryIO

from aiohttp import ClientError, web

from exchange.errors import ExchangeError
from exchange.formats import MEDIA_TYPES, writer_of
from exchange.native import Scanned, read_native, write_native
from node.audit_routes import SCAN
from node.bodies import Kept
from node.endpoints import route
from node.exhibits import Exhibits
from node.library import About, Scan
from node.library_routes import explained
from node.rest import said
from node.spool import CHUNK_BYTES, STALL_S, disk_trouble, send, spool
from protocol import messages as m

IMPORT_BYTES_MAX = 1 << 29
ARRAY_BYTES_MAX = 1 << 28
EXPORTS_MAX = 2
SLOWEST_BYTES_S = 16384  # who sends slower for long keeps the one place for imports from others


class ExchangeRoutes:
    """The two routes. published : told of each scan that was imported."""

    def __init__(self, exhibits: Exhibits, published: Callable[[m.Published], object]) -> None:
        self._exhibits = exhibits
        self._published = published
        self._exporting = asyncio.Semaphore(EXPORTS_MAX)
        self._importing = asyncio.Semaphore(1)

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application, before any route that takes /v1/scans/{anything}."""
        return [
            route("GET /v1/scans/{scan}.{format}", self._export),
            route("POST /v1/scans", self._import),
        ]

    async def _export(self, request: web.Request) -> web.StreamResponse:
        _check_free(self._exporting)
        async with self._exporting:
            scan_id = self._exhibits.library.resolve(request.match_info["scan"])
            request[SCAN] = scan_id
            suffix = f".{request.match_info['format']}"
            scan = await asyncio.to_thread(self._exhibits.library.open, scan_id)
            with spool(self._exhibits.library.folder) as file:
                await asyncio.to_thread(_write, scan, suffix, file)
                return await send(request, file, f"{scan_id}{suffix}", MEDIA_TYPES[suffix])

    async def _import(self, request: web.Request) -> web.Response:
        _check_free(self._importing)
        async with self._importing:
            with spool(self._exhibits.library.folder) as file:
                await _receive(request, file)
                found = await asyncio.to_thread(_read, file)
            before = {scan.id for scan in self._exhibits.library.scans()}
            scan = await self._keep(found)
        request[SCAN] = scan.id
        self._published(m.Published(scan.id))
        return said(Kept(scan.id), 200 if scan.id in before else 201)

    async def _keep(self, found: Scanned) -> Scan:
        with explained():
            about = About(time.time(), "import", found.name, note=found.note)
            return await asyncio.to_thread(self._exhibits.library.add, found.grid, about)


def _check_free(places: asyncio.Semaphore) -> None:
    if places.locked():
        raise web.HTTPServiceUnavailable(text="busy with other files: try again later", headers={"Retry-After": "5"})


def _write(scan: Scan, suffix: str, file: BinaryIO) -> None:
    try:
        if suffix == ".npz":
            write_native(scan.grid, file, note=scan.about.note)
        else:
            writer_of(suffix)(scan.grid, file)
        file.flush()
    except ExchangeError as problem:
        raise web.HTTPUnprocessableEntity(text=str(problem)) from problem
    except OSError as problem:
        raise disk_trouble(problem) from problem


async def _receive(request: web.Request, file: BinaryIO) -> None:
    """The whole body into a file. Raises an HTTP error for one that is too long, stalls, or ends early."""
    _check_length(request.content_length or 0)
    received, begun_s = 0, time.monotonic()
    try:
        while True:
            patience_s = STALL_S + received / SLOWEST_BYTES_S - (time.monotonic() - begun_s)
            async with asyncio.timeout(min(STALL_S, patience_s)):
                chunk = await request.content.read(CHUNK_BYTES)
            if not chunk:
                break
            received += len(chunk)
            _check_length(received)
            await asyncio.to_thread(file.write, chunk)
    except TimeoutError:
        raise web.HTTPRequestTimeout(text=f"nothing came for {STALL_S:g} s, or hardly anything for longer") from None
    except (ClientError, web.RequestPayloadError) as problem:
        raise web.HTTPBadRequest(text=f"the upload ended early: {problem}") from problem
    except OSError as problem:
        raise disk_trouble(problem) from problem


def _check_length(size_bytes: int) -> None:
    if size_bytes > IMPORT_BYTES_MAX:
        raise web.HTTPRequestEntityTooLarge(IMPORT_BYTES_MAX, size_bytes, text=f"at most {IMPORT_BYTES_MAX} bytes")


def _read(file: BinaryIO) -> Scanned:
    file.seek(0)
    try:
        return read_native(file, array_bytes_max=ARRAY_BYTES_MAX)
    except ExchangeError as problem:
        raise web.HTTPUnprocessableEntity(text=str(problem)) from problem
