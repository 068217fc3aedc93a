"""Who asks through a reverse proxy: where it is trusted, the address that it names counts, not its own."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from ipaddress import IPv4Address, IPv6Address, ip_address

from aiohttp import web
from aiohttp.typedefs import Handler, Middleware

FORWARDED = "X-Forwarded-For"
IS_PROXIED = web.RequestKey("is_proxied", bool)  # a trusted proxy asks for somebody

Address = IPv4Address | IPv6Address


def believe(proxies: Iterable[str]) -> Middleware:
    """A middleware, the first of all: `request.remote` is the client's address also behind one of these proxies."""
    trusted = frozenset(ip_address(proxy) for proxy in proxies)

    @web.middleware
    async def unveil(request: web.Request, handler: Handler) -> web.StreamResponse:
        request[IS_PROXIED] = _parsed(request.remote or "") in trusted
        if request[IS_PROXIED] and (client := _client(request.headers.getall(FORWARDED, []), trusted)):
            request = request.clone(remote=str(client))
        return await handler(request)

    return unveil


def _client(headers: list[str], trusted: frozenset[Address]) -> Address | None:
    """The last address that is none of the proxies: what stands before it anybody may have written."""
    for part in reversed(",".join(headers).split(",")):
        address = _parsed(part.strip())
        if address not in trusted:
            return address
    return None


@lru_cache(maxsize=256)
def _parsed(text: str) -> Address | None:
    try:
        address = ip_address(text)
    except ValueError:
        return None
    return getattr(address, "ipv4_mapped", None) or address
