"""Whole scans as files: fetched from a node, and sent to one."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import aiohttp

from client.discovery import NodeAddress, located
from client.login import logged_in
from client.rest import bounded_body, check_granted, reply
from client.trust import trouble
from exchange.formats import suffix_of
from exchange.whole_file import whole_file
from protocol.errors import RemoteWireError

CHUNK_BYTES = 1 << 18
FILE_BYTES_MAX = 1 << 33  # an STL of L has 840 MB
CREATED = 201
TIMEOUT = aiohttp.ClientTimeout(total=None, sock_connect=10, sock_read=600)  # a node writes a file before it sends it

Moved = Callable[[int, int | None], object]
"""Told the bytes moved so far, and those in all where they are known."""


async def fetch_scan(
    node: NodeAddress | str, scan: str, path: str | Path, *, token: str | None = None, moved: Moved
) -> int:
    """Write a node's scan ("latest" or an id) to a file, in the format its suffix names. Returns its size in bytes.

    Raises ExchangeError for a suffix we do not know, what `connect` raises, and OSError; then the file is what it was
    before.
    """
    return await _fetch(node, f"/v1/scans/{scan}{suffix_of(path)}", Path(path), token, moved)


async def fetch_sweep(node: NodeAddress | str, sweep: str, path: Path, *, token: str | None = None) -> int:
    """Write what there is of a sweep that was cut to an .npz. sweep : its id. Returns its size in bytes.

    Raises what `fetch_scan` raises.
    """
    return await _fetch(node, f"/v1/sweeps/{sweep}.npz", path, token, lambda done, total: None)


async def _fetch(node: NodeAddress | str, what: str, path: Path, token: str | None, moved: Moved) -> int:
    async with _request("GET", node, what, token) as response:
        await check_granted(response)
        with whole_file(path) as file:
            async for chunk in response.content.iter_chunked(CHUNK_BYTES):
                file.write(chunk)
                moved(file.tell(), response.content_length)
                if file.tell() > FILE_BYTES_MAX:
                    raise RemoteWireError(f"{response.url} sends more than {FILE_BYTES_MAX} bytes")
            return file.tell()


class Taken(NamedTuple):
    """A scan that a node has taken. is_new : it had no such scan before."""

    scan: str
    is_new: bool


async def send_scan(node: NodeAddress | str, file: BinaryIO, *, token: str | None = None, moved: Moved) -> Taken:
    """Add a native grid (.npz, open at its start) to a node's library.

    Raises what `connect` raises; then the node has nothing of it.
    """
    size = file.seek(0, 2)
    file.seek(0)

    async def chunks() -> AsyncIterator[bytes]:
        while chunk := file.read(CHUNK_BYTES):
            yield chunk
            moved(file.tell(), size)

    headers = {"Content-Length": str(size), "Content-Type": "application/zip"}
    async with _request("POST", node, "/v1/scans", token, data=chunks(), headers=headers) as response:
        said = reply(response.status, await bounded_body(response))
    if not isinstance(said, dict) or not isinstance(said.get("id"), str):
        raise RemoteWireError("the node took the scan and did not say its id")
    return Taken(str(said["id"]), response.status == CREATED)


@asynccontextmanager
async def _request(
    method: str,
    node: NodeAddress | str,
    path: str,
    token: str | None,
    data: AsyncIterator[bytes] | None = None,
    headers: dict[str, str] | None = None,
) -> AsyncIterator[aiohttp.ClientResponse]:
    try:
        async with (
            logged_in(node, token, timeout=TIMEOUT) as (url, http),
            http.request(method, f"{url}{path}", data=data, headers=headers) as response,
        ):
            yield response
    except (aiohttp.ClientError, TimeoutError, ConnectionError) as error:
        raise trouble(located(node)[0], error) from error
