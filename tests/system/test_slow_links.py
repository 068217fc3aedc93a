"""Clients on slow links: an update never takes more than the link carries in the time the client will wait (AT-12)."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import urlsplit

import pytest

from client import connect
from tests.system.line import RunningNode

CHUNK_BYTES = 512
BUFFER_BYTES = 4096
TOLERANCE = 1.25  # of the link's rate: what buffers between node and link hide from the estimate


@asynccontextmanager
async def shaped(url: str, rate_bytes_s: float) -> AsyncIterator[str]:
    """A TCP proxy before a node that hands its bytes on at a rate."""
    target = urlsplit(url)
    tasks: set[asyncio.Task[None]] = set()

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, rate: float | None) -> None:
        due = asyncio.get_running_loop().time()
        try:
            while data := await reader.read(CHUNK_BYTES if rate else 65536):
                writer.write(data)
                await writer.drain()
                if rate:
                    due = max(due, asyncio.get_running_loop().time()) + len(data) / rate
                    await asyncio.sleep(due - asyncio.get_running_loop().time())
        except ConnectionError:
            pass  # either end has gone, and the other one notices
        finally:
            writer.close()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        line.setblocking(False)
        await asyncio.get_running_loop().sock_connect(line, (target.hostname, target.port))
        from_node, to_node = await asyncio.open_connection(sock=line, limit=CHUNK_BYTES)
        for pumping in (pump(reader, to_node, None), pump(from_node, writer, rate_bytes_s)):
            tasks.add(asyncio.create_task(pumping))

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    async with server:
        yield f"http://127.0.0.1:{server.sockets[0].getsockname()[1]}"
        for task in tasks:
            task.cancel()


@pytest.mark.parametrize("wait_s", [0.5, 2])
@pytest.mark.parametrize("rate_bytes_s", [2_000, 8_000, 64_000])
async def test_an_update_fits_the_time_on_the_link(head_node: RunningNode, rate_bytes_s: int, wait_s: float) -> None:
    async with shaped(head_node.url, rate_bytes_s) as url, connect(url) as session:
        await session.open()
        for u, v in head_node.truth.clicks(2):
            update = await session.look(u, v, texture_db=60, max_wait_s=wait_s)
            if update.samples:
                assert update.bytes_received <= TOLERANCE * rate_bytes_s * wait_s
            else:
                assert update.reason == "byte limit"


async def test_more_bandwidth_more_detail(head_node: RunningNode) -> None:
    (u, v), *_ = head_node.truth.clicks(1)
    reached = []
    for rate_bytes_s in (4_000, 16_000, 64_000):
        async with shaped(head_node.url, rate_bytes_s) as url, connect(url) as session:
            model = await session.open()
            await session.look(u, v, texture_db=60, max_wait_s=1)
            reached.append(head_node.truth.compare(model, u, v)["texture_psnr_db"])
    assert reached == sorted(reached)
    assert reached[-1] > reached[0] + 1
