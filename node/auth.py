"""Who may do what. The one place where logins stand: HTTP requests pass `admit`, streams pass `admit_stream`.

So far there is one way in: a node on loopback that was started with `--insecure` lets everybody do everything.
"""

from __future__ import annotations

from typing import Literal

from aiohttp import web
from aiohttp.typedefs import Handler

from node.config import Server
from protocol.errors import ConfigError
from protocol.messages import Hello

Role = Literal["view", "operate", "admin"]
ROLE: web.RequestKey[Role] = web.RequestKey("role", str)  # type: ignore[arg-type]
RANK = {"view": 0, "operate": 1, "admin": 2}


class Auth:
    """Decides the role of whoever asks."""

    def __init__(self, server: Server) -> None:
        if not server.insecure:
            raise ConfigError("server.insecure: logins are not there yet; start with --insecure, on loopback only")

    @property
    def needs_token(self) -> bool:
        """Whether a client must present a token."""
        return False

    def admit_stream(self, hello: Hello) -> Role | None:
        """Role of a client that presents itself on a stream, or None for nobody."""
        return "admin"

    @web.middleware
    async def admit(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Give every HTTP request its role."""
        request[ROLE] = "admin"
        return await handler(request)


def require(request: web.Request, role: Role) -> None:
    """Raise 403 unless whoever asks has at least this role."""
    if RANK[request[ROLE]] < RANK[role]:
        raise web.HTTPForbidden(text=f"this needs the role {role}")
