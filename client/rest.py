"""Requests beside the stream: JSON over HTTP, every failure as one of our errors."""

from __future__ import annotations

from typing import Any, TypeVar

import aiohttp
import msgspec

from client.errors import RequestRefused
from client.trust import trouble
from protocol.errors import RemoteWireError

BODY_MAX_BYTES = 4 << 20
TIMEOUT = aiohttp.ClientTimeout(total=30)

Record = TypeVar("Record")


class ListedScan(msgspec.Struct, rename="camel"):
    """What is read of a scan in GET /v1/scans. created : Unix time [s]; sizes as in ScanInfo."""

    id: str
    name: str
    created: float
    width: int
    height: int
    texture_width: int
    texture_height: int
    geometry: str = "cylinder"


async def ask(
    http: aiohttp.ClientSession, method: str, url: str, body: object = None, timeout: aiohttp.ClientTimeout = TIMEOUT
) -> Any:
    """The JSON a node answers with. body : to be sent as JSON.

    Raises RequestRefused, NodeLost, NodeNotTrusted, RemoteWireError.
    """
    data = None if body is None else msgspec.json.encode(body)
    try:
        async with http.request(method, url, data=data, timeout=timeout) as response:
            return reply(response.status, await bounded_body(response))
    except (aiohttp.ClientError, OSError) as error:
        raise trouble(url, error) from error


async def bounded_body(response: aiohttp.ClientResponse, limit_bytes: int = BODY_MAX_BYTES) -> bytes:
    """All a node sends, of a bounded length. Raises RemoteWireError when it goes on beyond that."""
    body = bytearray()
    async for chunk in response.content.iter_any():
        body += chunk
        if len(body) > limit_bytes:
            raise RemoteWireError(f"{response.url} sends more than {limit_bytes} bytes")
    return bytes(body)


async def check_granted(response: aiohttp.ClientResponse) -> None:
    """Raises RequestRefused with the node's reason unless it grants what was asked for, RemoteWireError without one."""
    if response.status != 200:
        reply(response.status, await bounded_body(response))
        raise RemoteWireError(f"{response.url} answers with HTTP {response.status}, without what was asked for")


def reply(status: int, body: bytes) -> Any:
    """The JSON of an answer, None where it has none (204).

    Raises RequestRefused for a refusal, RemoteWireError for anything that is no JSON.
    """
    if status == 204:
        return None
    try:
        said = msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as problem:
        raise RemoteWireError(f"HTTP {status} without a JSON body: {problem}") from None
    if status >= 400:
        error = said if isinstance(said, dict) else {}
        raise RequestRefused(str(error.get("code", f"HTTP {status}")), str(error.get("message", "")))
    return said


def checked(said: object, kind: type[Record], what: str) -> Record:
    """What a node said, as a record of a kind. what : it is, for the message. Raises RemoteWireError for another."""
    try:
        return msgspec.convert(said, kind)
    except msgspec.ValidationError as problem:
        raise RemoteWireError(f"{what}: {problem}") from None
