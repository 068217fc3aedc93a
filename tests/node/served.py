"""The node's HTTP side over a library, asked without a network."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from typing import cast

from aiohttp.test_utils import TestClient, TestServer
from aiohttp.web import Application, Request

from node.capture import Capture
from node.coarse import FIRST_VIEW_BYTES
from node.config import Config, Server
from node.exhibits import Exhibits
from node.library import Library
from node.live import Live
from node.serve import NodeServer
from protocol.messages import PROTOCOL, ServerInfo

Client = TestClient[Request, Application]


@asynccontextmanager
async def served(
    library: Library, capture: object = None, *, shared_cache: bool = False
) -> AsyncIterator[tuple[Client, NodeServer]]:
    """Whom to ask, and what is asked. capture : what stands for the scanner's thread; None: there is none."""
    config = Config(server=Server(insecure=True, shared_cache=shared_cache))
    info = ServerInfo(PROTOCOL, "id", "name", "0")
    with closing(Exhibits(library, FIRST_VIEW_BYTES, workers=2)) as exhibits:
        server = NodeServer(config, info, exhibits, Live(lambda: None), cast("Capture | None", capture))
        async with TestClient(TestServer(server._app)) as client:
            yield client, server
