"""Where the axes of this node's scanners are, over HTTP: told, found by a sweep of a round body, and forgotten.

    GET    /v1/axes              what is known, the newest first
    POST   /v1/axes              {"scan": .., "diameterMm": ..}: find the axis of the scanner that swept that body
    DELETE /v1/axes/{scanner}    correct that scanner's sweeps no longer
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import asdict
from typing import Annotated

import msgspec
from aiohttp import web
from msgspec import Meta, Struct

from node.audit_routes import SCAN, WHAT
from node.auth import require
from node.axes import Axes, KnownAxis
from node.axis_fit import NotCalibrated, estimate
from node.library import Library
from node.library_routes import explained
from protocol.quality import AxisOffset, FoundAxis

AT_ONCE = 1


class Wanted(Struct, frozen=True, forbid_unknown_fields=True, rename="camel"):
    """The sweep that tells an axis, and the diameter of the body in it. [mm]"""

    scan: Annotated[str, Meta(max_length=200)]
    diameter_mm: Annotated[float, Meta(ge=1, le=2000)]


class AxisRoutes:
    """The routes above, on what a library keeps."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._axes: Axes = library.axes
        self._place = asyncio.Semaphore(AT_ONCE)

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [
            web.get("/v1/axes", self._told),
            web.post("/v1/axes", self._calibrate),
            web.delete("/v1/axes/{scanner}", self._forget),
        ]

    async def _told(self, request: web.Request) -> web.Response:
        return _json([_said(known) for known in reversed(self._axes.known())])

    async def _calibrate(self, request: web.Request) -> web.Response:
        require(request, "operate")
        wanted = _decoded(await request.read())
        if self._place.locked():
            raise web.HTTPServiceUnavailable(text="busy with another calibration: try again later")
        async with self._place:
            request[SCAN] = scan_id = self._library.resolve(wanted.scan, ("cylinder",))
            try:
                found = await asyncio.to_thread(found_by, self._library, scan_id, wanted.diameter_mm)
            except NotCalibrated as problem:
                raise web.HTTPUnprocessableEntity(text=str(problem)) from problem
            with explained():
                await asyncio.to_thread(self._axes.keep, found)
        axis = found.estimate.axis
        request[WHAT] = f"{found.scanner}: {axis.lateral_mm:.3f} mm, {axis.radial_mm:.3f} mm"
        return _json(_said(found), status=201)

    async def _forget(self, request: web.Request) -> web.Response:
        require(request, "operate")
        scanner = request.match_info["scanner"]
        with explained():
            if not await asyncio.to_thread(self._axes.forget, scanner):
                raise web.HTTPNotFound(text=f"no axis of scanner {scanner[:200]!r} is known")
        request[WHAT] = scanner[:200]
        return web.Response(status=204)


def found_by(library: Library, scan_id: str, diameter_mm: float) -> KnownAxis:
    """The axis of the scanner that swept a round body; nothing is kept.

    Raises LibraryError where the scan is unknown, NotCalibrated where it does not tell.
    """
    scan = library.open(scan_id)
    about = scan.about
    if not about.scanner or scan.spec.geometry != "cylinder":
        raise NotCalibrated("that is no sweep of which the scanner is known: sweep the body anew")
    corrected_by = about.quality.axis if about.quality else None
    estimated = estimate(scan.grid, diameter_mm, corrected_by)
    return KnownAxis(about.scanner, about.settings, estimated, scan_id, diameter_mm, time.time())


def _said(known: KnownAxis) -> FoundAxis:
    e = known.estimate
    return FoundAxis(
        known.scanner, AxisOffset(**asdict(e.axis)), e.lateral_error_mm, e.radial_error_mm, e.lean_error_rad,
        e.side_error_rad, e.noise_mm, e.uneven_mm, e.off_centre_mm, known.scan, known.diameter_mm,
        known.calibrated_unix_s,
    )  # fmt: skip


def _decoded(body: bytes) -> Wanted:
    try:
        return msgspec.json.decode(body, type=Wanted)
    except (msgspec.DecodeError, UnicodeDecodeError) as problem:
        raise web.HTTPBadRequest(text=f"calibrate: {problem}") from problem


def _json(value: object, status: int = 200) -> web.Response:
    return web.Response(body=msgspec.json.encode(value), content_type="application/json", status=status)
