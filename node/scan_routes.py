"""The scans there are, over HTTP: listed, told of one by one, and seen coarsely.

    GET /v1/scans                  the newest first
    GET /v1/scans/{scan}           what is known of one
    GET /v1/scans/{scan}/coarse    its first view
    GET /v1/scans/{scan}/picture   a picture of that
"""

from __future__ import annotations

from aiohttp import web
from msgspec import structs

from node.audit_routes import SCAN
from node.bodies import CoarseQuery, ListedScan, ScanDetail
from node.endpoints import is_scan, route
from node.exhibits import Exhibits
from node.first_view import scan_info
from node.library import ScanSummary
from node.rest import query_of, said
from node.scan_quality import told
from node.sealed import has_died
from node.shared import SharedFoveae
from protocol.errors import LibraryError


class ScanRoutes:
    """The routes above."""

    def __init__(self, exhibits: Exhibits, shared: SharedFoveae) -> None:
        self._exhibits = exhibits
        self._shared = shared

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [
            route("GET /v1/scans", self._scans),
            route("GET /v1/scans/{scan}", self._scan),
            route("GET /v1/scans/{scan}/coarse", self._coarse),
            route("GET /v1/scans/{scan}/picture", self._picture),
        ]

    async def _scans(self, request: web.Request) -> web.Response:
        return said([_listed(scan) for scan in self._exhibits.library.scans()])

    async def _scan(self, request: web.Request) -> web.Response:
        scan, _ = await self._exhibits.open(request.match_info["scan"], "htj2k")
        request[SCAN] = scan.id
        quality = told(scan.about.quality) if scan.about.quality else None
        known = structs.asdict(scan_info(scan))
        return said(ScanDetail(**known, quality=quality, note=scan.about.note, made_from=scan.about.made_from))

    async def _coarse(self, request: web.Request) -> web.Response:
        """The first view as its two refinements, one behind the other, each behind its length (u32, little-endian)."""
        codec = query_of(request, CoarseQuery).codec
        scan, view = await self._exhibits.open(request.match_info["scan"], codec)
        request[SCAN] = scan.id
        body = b"".join(len(part).to_bytes(4, "little") + part for part in view.refinements(0))
        headers = self._shared.cache_headers(request, scan)
        return web.Response(body=body, content_type="application/octet-stream", headers=headers)

    async def _picture(self, request: web.Request) -> web.Response:
        """Nothing where there is no such scan: a page asks before it knows, and browsers complain of any failure."""
        scan = request.match_info["scan"]
        try:
            request[SCAN], picture = await self._exhibits.picture(scan)
        except LibraryError as error:
            if has_died(error) or not is_scan(scan):
                raise
            return web.Response(status=204)
        return web.Response(body=picture, content_type="image/webp")


def _listed(scan: ScanSummary) -> ListedScan:
    s, about = scan.spec, scan.about
    return ListedScan(
        scan.id, about.created_unix_s, about.source, about.name, s.width, s.height, s.texture_width, s.texture_height,
        s.geometry, about.made_from, scan.subject, scan.body_site,
    )  # fmt: skip
