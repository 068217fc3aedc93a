"""Requests beside the stream: JSON over HTTP, every failure as one of our errors."""

from __future__ import annotations

from typing import Any

import aiohttp
import msgspec

from client.errors import RequestRefused
from client.trust import trouble
from protocol.errors import RemoteWireError

BODY_MAX_BYTES = 4 << 20
TIMEOUT = aiohttp.ClientTimeout(total=30)


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


async def bounded_body(response: aiohttp.ClientResponse) -> bytes:
    """All a node sends, of a bounded length. Raises RemoteWireError when it goes on beyond that."""
    body = bytearray()
    async for chunk in response.content.iter_any():
        body += chunk
        if len(body) > BODY_MAX_BYTES:
            raise RemoteWireError(f"{response.url} sends more than {BODY_MAX_BYTES} bytes")
    return bytes(body)


def reply(status: int, body: bytes) -> Any:
    """The JSON of an answer. Raises RequestRefused for a refusal, RemoteWireError for anything that is no JSON."""
    try:
        said = msgspec.json.decode(body)
    except (msgspec.DecodeError, UnicodeError) as problem:
        raise RemoteWireError(f"HTTP {status} without a JSON body: {problem}") from None
    if status >= 400:
        error = said if isinstance(said, dict) else {}
        raise RequestRefused(str(error.get("code", f"HTTP {status}")), str(error.get("message", "")))
    return said
