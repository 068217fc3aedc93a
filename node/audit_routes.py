"""What goes to the audit log of everything that is asked over HTTP, by one table; and the log itself, for admins.

    GET /v1/audit?limit=100&since=2026-11-22&scan=..&by=..&refused=1

An answer counts from its head on: a download that was cut off has shown something too. A stream's doings are noted by
node.connection, who comes in by node.pairing, who is refused by node.auth.
"""

from __future__ import annotations

import asyncio
from itertools import islice
from pathlib import Path

import msgspec
from aiohttp import web

from node.audit import Audit, Event, begins_a_time, done_trail, read_trail, refused_trail
from node.auth import asker, place_of, require

LIMIT, LIMIT_MAX = 100, 1000
QUERY_KEYS = frozenset({"limit", "since", "scan", "by", "refused"})

SCAN = web.RequestKey("scan", str)  # the id that a request turned out to be about
WHAT = web.RequestKey("what", str)  # more of what it did, for the log

AUDITED: dict[tuple[str, str], Event] = {
    ("GET", "/v1/scans"): "listed",
    ("POST", "/v1/scans"): "imported",
    ("GET", "/v1/scans/{scan}"): "seen",
    ("GET", "/v1/auth"): "seen",  # by way of a cache
    ("GET", "/v1/scans/{scan}/coarse"): "seen",
    ("GET", "/v1/scans/{scan}/fovea/{epoch}/{range}/{texture}"): "seen",
    ("GET", "/v1/scans/{scan}.{format}"): "exported",
    ("POST", "/v1/scans/{scan}/derive"): "derived",
    ("GET", "/v1/scans/{scan}/sidecar"): "read",
    ("PATCH", "/v1/scans/{scan}/sidecar"): "changed",
    ("POST", "/v1/scans/{scan}/verify"): "verified",
    ("DELETE", "/v1/scans/{scan}"): "deleted",
    ("POST", "/v1/sweeps"): "sweep asked",
    ("POST", "/v1/sweeps/{sweep}/resume"): "sweep resumed",
    ("GET", "/v1/sweeps/{sweep}.npz"): "sweep exported",
    ("DELETE", "/v1/sweeps/{sweep}"): "sweep deleted",
}
"""What a request that was answered well has done."""
SELDOM: frozenset[Event] = frozenset({"listed", "seen"})  # asked for again and again while somebody looks


class AuditRoutes:
    """The route above, and the eye on all others. audit : where what they do is noted.

    library, bytes_max : where that is read, as for Audit.
    """

    def __init__(self, audit: Audit, library: Path, bytes_max: int) -> None:
        self._audit = audit
        self._done = done_trail(library, bytes_max)
        self._refused = refused_trail(library)

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [web.get("/v1/audit", self._read)]

    async def witness(self, request: web.Request, response: web.StreamResponse) -> None:
        """Note what an answer, whose head is about to be sent, has done or is going to show."""
        event = AUDITED.get((request.method.replace("HEAD", "GET"), place_of(request)))
        if event is None or not 200 <= response.status < 300:
            return
        scan = request.get(SCAN) or request.match_info.get("scan", "")
        if event in SELDOM:
            self._audit.note_seen(event, asker(request), scan)
        else:
            what = request.get(WHAT) or request.match_info.get("format", "")
            self._audit.note(event, asker(request), scan=scan, sweep=request.match_info.get("sweep", ""), what=what)

    async def _read(self, request: web.Request) -> web.Response:
        require(request, "admin")
        query = request.query
        if unknown := set(query) - QUERY_KEYS:
            known = ", ".join(sorted(QUERY_KEYS))
            raise web.HTTPBadRequest(text=f"unknown: {', '.join(sorted(unknown))}; known: {known}")
        limit = _limit(query.get("limit", str(LIMIT)))
        if not begins_a_time(query.get("since", "")):
            raise web.HTTPBadRequest(text="since: expected the beginning of a time, such as 2026-11-22")
        trail = self._refused if query.get("refused", "0") == "1" else self._done
        found = read_trail(trail, since=query.get("since", ""), scan=query.get("scan", ""), by=query.get("by", ""))
        entries = await asyncio.to_thread(lambda: list(islice(found, limit)))
        return web.Response(body=msgspec.json.encode(entries), content_type="application/json")


def _limit(text: str) -> int:
    if text.isascii() and text.isdigit() and len(text) <= 4 and 1 <= int(text) <= LIMIT_MAX:
        return int(text)
    raise web.HTTPBadRequest(text=f"limit: expected 1..{LIMIT_MAX}, got {text[:20]!r}")
