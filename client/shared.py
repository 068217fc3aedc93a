"""A viewer without a session: first view and foveae by plain HTTP, which caches in between may share.

The node knows nothing of such a viewer. What comes is planned over the first view alone, and adopted where it is finer
than what the model holds.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import aiohttp

from client.login import logged_in
from client.model import Model
from client.rest import ask, bounded_body, check_granted, checked
from client.trust import trouble
from protocol.errors import RemoteWireError
from protocol.messages import ScanInfo
from protocol.refinement import Refinement

BODY_MAX_BYTES = 64 << 20
LENGTH_BYTES = 4


class SharedViewer:
    """See `open_shared`. model : as Session's; hits : answers that a cache says it gave."""

    def __init__(self, http: aiohttp.ClientSession, url: str, model: Model) -> None:
        self.model = model
        self.hits = 0
        self._http = http
        self._url = url

    async def look(self, u: float, v: float, **asked: float | str) -> int:
        """Refine round (u, v). Returns the bytes received.

        asked : window, texture_db, range_mm, max_bytes, alpha, scale, codec, as for Session.look.
        Raises what `open_shared` raises.
        """
        place = f"{self._url}/v1/scans/{self.model.info.id}/fovea"
        body = await self._body(place, {"u": u, "v": v, **asked})
        for refinement in refinements_in(body):
            self.model.apply(refinement)
        return len(body)

    async def _body(self, url: str, query: dict[str, Any]) -> bytes:
        try:
            async with self._http.get(url, params=query) as response:
                await check_granted(response)
                self.hits += response.headers.get("X-Cache-Status") == "HIT"
                return await bounded_body(response, BODY_MAX_BYTES)
        except (aiohttp.ClientError, OSError) as error:
            raise trouble(self._url, error) from error


@asynccontextmanager
async def open_shared(
    url: str, scan: str = "latest", codec: str = "htj2k", token: str | None = None
) -> AsyncIterator[SharedViewer]:
    """A viewer of one scan of the node (or the cache before it) at url, its first view in.

    token : None: what pairing has kept. Raises NodeLost, NodeNotTrusted, RequestRefused, RemoteWireError.
    """
    async with logged_in(url, token) as (url, http):
        viewer = SharedViewer(http, url, await _described(http, url, scan))
        place = f"{viewer._url}/v1/scans/{viewer.model.info.id}/coarse"
        for refinement in refinements_in(await viewer._body(place, {"codec": codec})):
            viewer.model.apply(refinement)
        yield viewer


async def _described(http: aiohttp.ClientSession, url: str, scan: str) -> Model:
    said = await ask(http, "GET", f"{url}/v1/scans/{scan}")
    return Model(checked(said, ScanInfo, f"{url} describes scan {scan}"))


def refinements_in(body: bytes) -> list[Refinement]:
    """The refinements of an HTTP answer, each behind its length. Raises RemoteWireError."""
    found, at = [], 0
    while at < len(body):
        size = int.from_bytes(body[at : at + LENGTH_BYTES], "little")
        at += LENGTH_BYTES
        if size > len(body) - at:
            raise RemoteWireError("refinements are cut short")
        found.append(Refinement.from_bytes(body[at : at + size]))
        at += size
    return found
