"""What goes to the audit log of everything that is asked over HTTP; and the log itself, for admins.

    GET /v1/audit?limit=100&since=2026-11-22&scan=..&by=..&refused=1

An answer counts from its head on: a download that was cut off has shown something too. A stream's doings are noted by
node.connection, who comes in by node.pairing, who is refused by node.auth.
"""

from __future__ import annotations

import asyncio
from http import HTTPStatus
from itertools import islice
from pathlib import Path

from aiohttp import web

from node.audit import Audit, Event, done_trail, read_trail, refused_trail
from node.auth import asker
from node.bodies import AuditQuery
from node.endpoints import endpoint_of, route
from node.rest import query_of, said

SCAN = web.RequestKey("scan", str)  # the id that a request turned out to be about
WHAT = web.RequestKey("what", str)  # more of what it did, for the log

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
        return [route("GET /v1/audit", self._read)]

    async def witness(self, request: web.Request, response: web.StreamResponse) -> None:
        """Note what an answer, whose head is about to be sent, has done or is going to show."""
        event = endpoint.event if (endpoint := endpoint_of(request)) else None
        if event is None or not 200 <= response.status < 300:
            return
        scan = request.get(SCAN) or request.match_info.get("scan", "")
        if event in SELDOM and response.status == HTTPStatus.NO_CONTENT:
            return  # nothing is shown
        if event in SELDOM:
            self._audit.note_seen(event, asker(request), scan)
        else:
            what = request.get(WHAT) or request.match_info.get("format", "")
            self._audit.note(event, asker(request), scan=scan, sweep=request.match_info.get("sweep", ""), what=what)

    async def _read(self, request: web.Request) -> web.Response:
        query = query_of(request, AuditQuery)
        trail = self._refused if query.refused else self._done
        found = islice(read_trail(trail, since=query.since, scan=query.scan, by=query.by), query.limit)
        return said(await asyncio.to_thread(list, found))
