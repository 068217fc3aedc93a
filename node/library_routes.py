"""The library over HTTP: what is said of scans, deleting and checking them, and the sweeps that were interrupted.

    GET    /v1/scans/{scan}/sidecar     what is said of it, with its history; ETag is the revision
    PATCH  /v1/scans/{scan}/sidecar     change some of it (also its name); If-Match: "revision" guards against others
    POST   /v1/scans/{scan}/verify      read every sample and compare with the id
    DELETE /v1/scans/{scan}
    GET    /v1/sweeps                   interrupted sweeps, oldest first
    POST   /v1/sweeps/{sweep}/resume    go on with one, if the scanner agrees
    GET    /v1/sweeps/{sweep}.npz       what there is of it (node.partial)
    DELETE /v1/sweeps/{sweep}

A scan is named by its id. What only reads takes "latest" and the beginning of an id too; what changes or deletes a scan
does not, since they may stand for another one by the time that it is done.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import BinaryIO

from aiohttp import web
from msgspec.structs import asdict

from node.audit_routes import SCAN, WHAT
from node.auth import LOGIN
from node.bodies import ListedSweep, ResumedSweep, Verified
from node.capture import Capture, CaptureStatus
from node.durable import NoRoom
from node.endpoints import route
from node.journal import Interrupted
from node.library import Library, verify
from node.partial import write_partial
from node.rest import said
from node.sealed import HAS_DIED, has_died
from node.sidecar import BY_MAX, Conflict, Sidecar, changed_fields, decode_changes
from node.spool import send, spool
from protocol.errors import LibraryError


class LibraryRoutes:
    """The routes above. deleted : told the id of each scan that was deleted, in the event loop."""

    def __init__(
        self,
        library: Library,
        capture: Capture | None,
        deleted: Callable[[str], object] = lambda scan_id: None,
    ) -> None:
        self._library = library
        self._capture = capture
        self._deleted = deleted

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [
            route("GET /v1/scans/{scan}/sidecar", self._sidecar),
            route("PATCH /v1/scans/{scan}/sidecar", self._annotate),
            route("POST /v1/scans/{scan}/verify", self._verify),
            route("DELETE /v1/scans/{scan}", self._delete),
            route("GET /v1/sweeps", self._sweeps),
            route("POST /v1/sweeps/{sweep}/resume", self._resume),
            route("GET /v1/sweeps/{sweep}.npz", self._export_sweep),
            route("DELETE /v1/sweeps/{sweep}", self._delete_sweep),
        ]

    # -- scans -----------------------------------------------------------------------------------------------------

    async def _sidecar(self, request: web.Request) -> web.Response:
        scan_id = self._known(request)
        with explained():
            return _tagged(await asyncio.to_thread(self._library.sidecar, scan_id))

    async def _annotate(self, request: web.Request) -> web.Response:
        scan_id, revision = self._named(request), _revision(request)
        with explained():
            changes = decode_changes(await request.read())
            request[WHAT] = ", ".join(changed_fields(changes))
            by = f"{request[LOGIN].name} at {request.remote}"[:BY_MAX]
            return _tagged(await asyncio.to_thread(self._library.annotate, scan_id, changes, by, revision))

    async def _verify(self, request: web.Request) -> web.Response:
        scan_id = self._known(request)
        ((_, problem),) = await asyncio.to_thread(lambda: list(verify(self._library.folder, [scan_id])))
        return said(Verified(scan_id, problem is None, problem.reason if problem else ""))

    async def _delete(self, request: web.Request) -> web.Response:
        scan_id = self._named(request)
        with explained():
            await asyncio.to_thread(self._library.delete, scan_id)
        self._deleted(scan_id)
        return web.Response(status=204)

    def _named(self, request: web.Request) -> str:
        """The scan that is to be changed. Raises 400 unless it is named by its whole id, 404."""
        scan_id = self._known(request)
        if request.match_info["scan"] != scan_id:
            raise web.HTTPBadRequest(text="name the scan to change by its whole id: it may not be this one by now")
        return scan_id

    def _known(self, request: web.Request) -> str:
        """The scan that is asked for. Raises 404."""
        try:
            scan_id = self._library.summary(self._library.resolve(request.match_info["scan"])).id
        except LibraryError as error:
            raise web.HTTPNotFound(text=str(error)) from error
        request[SCAN] = scan_id
        return scan_id

    # -- sweeps ----------------------------------------------------------------------------------------------------

    async def _sweeps(self, request: web.Request) -> web.Response:
        return said([_listed(sweep) for sweep in self._library.sweeps.interrupted()])

    async def _resume(self, request: web.Request) -> web.Response:
        sweep = self._interrupted(request)
        if self._capture is None or not (number := self._capture.request_resume(sweep.id)):
            status = self._capture.status if self._capture else CaptureStatus("no scanner")
            raise web.HTTPConflict(text=status.refusal or "the scanner was busy: try again")
        return said(ResumedSweep(**asdict(_listed(sweep)), sweep=number), status=202)

    async def _delete_sweep(self, request: web.Request) -> web.Response:
        sweep = self._interrupted(request)
        with explained():
            await asyncio.to_thread(self._library.sweeps.delete, sweep.id)
        return web.Response(status=204)

    async def _export_sweep(self, request: web.Request) -> web.StreamResponse:
        sweep = self._interrupted(request)
        with spool(self._library.folder) as file:
            with explained():
                await asyncio.to_thread(self._write, sweep, file)
            return await send(request, file, f"interrupted-{sweep.id}.npz", "application/octet-stream")

    def _write(self, sweep: Interrupted, file: BinaryIO) -> None:
        write_partial(sweep, self._library.sweeps.columns(sweep.id), file)
        file.flush()

    def _interrupted(self, request: web.Request) -> Interrupted:
        """The sweep that is asked for. Raises 404."""
        try:
            return self._library.sweeps.get(request.match_info["sweep"])
        except LibraryError as error:
            raise web.HTTPNotFound(text=str(error)) from error


@contextmanager
def explained() -> Iterator[None]:
    """What a library cannot do, in the terms of HTTP."""
    try:
        yield
    except ValueError as error:
        raise web.HTTPBadRequest(text=str(error)) from error
    except Conflict as error:
        raise web.HTTPPreconditionFailed(text=str(error)) from error
    except NoRoom as error:
        raise web.HTTPInsufficientStorage(text=str(error)) from error
    except LibraryError as error:
        if has_died(error):
            raise web.HTTPServiceUnavailable(text=HAS_DIED) from error
        raise web.HTTPInternalServerError(text=str(error)) from error


def _revision(request: web.Request) -> int | None:
    """The revision a change is meant for. Raises 400."""
    tag = request.headers.get("If-Match", "*")
    if tag == "*":
        return None
    match = re.fullmatch('"([0-9]{1,9})"', tag)
    if match is None:
        raise web.HTTPBadRequest(text='If-Match: expected a revision such as "3"')
    return int(match[1])


def _tagged(sidecar: Sidecar) -> web.Response:
    response = said(sidecar)
    response.headers["ETag"] = f'"{sidecar.revision}"'
    return response


def _listed(sweep: Interrupted) -> ListedSweep:
    s = sweep.header.spec
    return ListedSweep(
        sweep.id, sweep.started_unix_s, sweep.ended_unix_s, sweep.why, sweep.held, sweep.expected, sweep.is_complete,
        sweep.damaged_bytes, sweep.size_bytes, sweep.info.serial_number,
        s.width, s.height, s.texture_width, s.texture_height,
    )  # fmt: skip
