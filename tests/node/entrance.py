"""A node's server with TLS and logins, in this process, and who may come in."""

from __future__ import annotations

import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from dataclasses import dataclass
from pathlib import Path

import aiohttp

from client.trust import certificate_pin
from node.access import Access, access_folder
from node.coarse import FIRST_VIEW_BYTES
from node.config import Config, Limits, Retention, Server
from node.exhibits import Exhibits
from node.library import About, Library
from node.live import Live
from node.serve import NodeServer
from node.tls import Tls
from protocol import messages as m
from protocol import pairing
from tests.node.scans import make_grid

ANY_PORT = Server(listen="127.0.0.1:0")
LIMITS, KEEP_ALL = Limits(), Retention()
INFO = m.ServerInfo(m.PROTOCOL, "n1", "<node & co>", "0", login=True)


@dataclass
class Entrance:
    """What a test needs of it. scan : an id in its library."""

    url: str
    server: NodeServer
    access: Access
    tls: Tls
    library: Library
    scan: str
    http: aiohttp.ClientSession

    def offer(self, name: str = "somebody", role: pairing.Role = "view") -> str:
        """A pairing code."""
        return self.access.offer(role, name, time.time())

    def token(self, role: pairing.Role, name: str = "") -> str:
        """A login, by its name or that of its role."""
        key = pairing.key_of(pairing.parse_code(self.offer(name or role, role)))
        made = self.access.redeem(lambda other: other == key, time.time())
        assert made is not None
        return made[0]

    def ask(self, method: str, path: str, token: str = "", **more: object) -> aiohttp.client._RequestContextManager:
        """A request of nobody, or of whoever has a token; redirects are not followed."""
        headers = {"Authorization": f"Bearer {token}"} if token else {}
        headers |= more.pop("headers", {})  # type: ignore[call-overload]
        return self.http.request(method, self.url + path, headers=headers, allow_redirects=False, **more)  # type: ignore[arg-type]


@asynccontextmanager
async def entrance(
    folder: Path, settings: Server = ANY_PORT, limits: Limits = LIMITS, retention: Retention = KEEP_ALL
) -> AsyncIterator[Entrance]:
    """A node without a scanner, with one scan."""
    config = Config(server=settings, limits=limits, retention=retention)
    with closing(Library(folder)) as library, closing(Exhibits(library, FIRST_VIEW_BYTES, workers=1)) as exhibits:
        scan = library.add(make_grid(40, 24), About(1e9)).id
        place = access_folder(folder)
        access, tls = Access(place), Tls(config.server, place, INFO.id)
        server = NodeServer(config, INFO, exhibits, Live(lambda: None), None, access, tls)
        _, port = await server.start()
        try:
            connector = aiohttp.TCPConnector(ssl=certificate_pin(tls.fingerprint))
            async with aiohttp.ClientSession(connector=connector) as http:
                yield Entrance(f"https://127.0.0.1:{port}", server, access, tls, library, scan, http)
        finally:
            await server.stop()
