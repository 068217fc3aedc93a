"""Where the axes of this node's scanners are, over HTTP: told, found by a sweep of a round body, and forgotten.

    GET    /v1/axes              what is known, the newest first
    POST   /v1/axes              {"scan": .., "diameterMm": ..}: find the axis of the scanner that swept that body
    DELETE /v1/axes/{scanner}    correct that scanner's sweeps no longer
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import asdict

from aiohttp import web

from node.audit_routes import SCAN, WHAT
from node.axes import KnownAxis
from node.axis_fit import NotCalibrated, estimate
from node.bodies import AxisWanted
from node.endpoints import route
from node.library import Library
from node.library_routes import explained
from node.rest import decoded, said
from protocol.quality import AxisOffset, FoundAxis

AT_ONCE = 1


class AxisRoutes:
    """The routes above, on what a library keeps."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._place = asyncio.Semaphore(AT_ONCE)

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [
            route("GET /v1/axes", self._told),
            route("POST /v1/axes", self._calibrate),
            route("DELETE /v1/axes/{scanner}", self._forget),
        ]

    async def _told(self, request: web.Request) -> web.Response:
        return said([_as_told(known) for known in reversed(self._library.axes.known())])

    async def _calibrate(self, request: web.Request) -> web.Response:
        wanted = decoded(await request.read(), AxisWanted)
        if self._place.locked():
            raise web.HTTPServiceUnavailable(text="busy with another calibration: try again later")
        async with self._place:
            request[SCAN] = scan_id = self._library.resolve(wanted.scan, ("cylinder",))
            try:
                found = await asyncio.to_thread(found_by, self._library, scan_id, wanted.diameter_mm)
            except NotCalibrated as problem:
                raise web.HTTPUnprocessableEntity(text=str(problem)) from problem
            with explained():
                await asyncio.to_thread(self._library.axes.keep, found)
        axis = found.estimate.axis
        request[WHAT] = f"{found.scanner}: {axis.lateral_mm:.3f} mm, {axis.radial_mm:.3f} mm"
        return said(_as_told(found), 201)

    async def _forget(self, request: web.Request) -> web.Response:
        scanner = request.match_info["scanner"]
        with explained():
            was_known = await asyncio.to_thread(self._library.axes.forget, scanner)
        if not was_known:
            raise web.HTTPNotFound(text=f"no axis of scanner {scanner[:200]!r} is known")
        request[WHAT] = scanner
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


def _as_told(known: KnownAxis) -> FoundAxis:
    e = known.estimate
    return FoundAxis(
        known.scanner, AxisOffset(**asdict(e.axis)), e.lateral_error_mm, e.radial_error_mm, e.lean_error_rad,
        e.side_error_rad, e.noise_mm, e.uneven_mm, e.off_centre_mm, known.scan, known.diameter_mm,
        known.calibrated_unix_s,
    )  # fmt: skip
