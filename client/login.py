"""A line to a node that we trust, with the token it gave us: what every request of ours goes through."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import aiohttp

from client.credentials import find_credential
from client.discovery import NodeAddress, located
from client.errors import NodeNotTrusted
from client.trust import KeyPin, certificate_pin

LOOPBACK = frozenset({"127.0.0.1", "::1", "localhost"})
TIMEOUT = aiohttp.ClientTimeout(total=None, sock_connect=10)


@asynccontextmanager
async def logged_in(
    node: NodeAddress | str,
    token: str | None = None,
    fingerprint: str | None = None,
    timeout: aiohttp.ClientTimeout = TIMEOUT,
) -> AsyncIterator[tuple[str, aiohttp.ClientSession]]:
    """The node's URL, and a session that shows it the token and takes no other node for it.

    token, fingerprint : None: what pairing has kept. Raises NodeLost, NodeNotTrusted, AccessError, LocalWireError.
    """
    url, parts = located(node)
    is_tls = parts.scheme == "https"
    known = find_credential(url, node.id if isinstance(node, NodeAddress) else None) if is_tls else None
    trust: aiohttp.Fingerprint | bool = True
    if fingerprint is not None:
        trust = certificate_pin(fingerprint)
    elif known is not None and known.key:
        trust = KeyPin(bytes.fromhex(known.key))
    token = token or (known.token if known else None)
    if token and not is_tls and parts.host not in LOOPBACK:
        raise NodeNotTrusted(f"a token is not sent in the clear: use https://, not {url}")
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    connector = aiohttp.TCPConnector(ssl=trust)
    async with aiohttp.ClientSession(connector=connector, headers=headers, timeout=timeout) as http:
        yield url, http
