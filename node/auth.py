"""Who may do what. The one place where logins stand: every request passes `Auth.admit`, streams too.

A login is a token (node.access), shown as `Authorization: Bearer`, as the subprotocol `foveascan.token.<token>` of a
stream, or as a cookie that the pairing page set. Which role a request needs is in the table of `node.endpoints`; what
is not there needs `OTHERWISE`. A node with --insecure, which serves loopback only, lets everybody do everything.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

from aiohttp import web
from aiohttp.typedefs import Handler
from yarl import URL

from node.access import Access, Token
from node.attempts import Attempts
from node.audit import Who
from node.config import is_loopback
from node.endpoints import endpoint_of, place_of
from protocol.errors import AccessError
from protocol.pairing import Role as Role

log = logging.getLogger(__name__)

COOKIE = "__Host-foveascan"
SUBPROTOCOL = "foveascan.token."
STREAM = "/v1/stream"
OTHERWISE: Role = "view"  # so nobody finds out what there is not
CHALLENGE = {"WWW-Authenticate": "Bearer"}
SAFE = frozenset({"GET", "HEAD"})
RANK: dict[Role | None, int] = {None: -1, "monitor": 0, "view": 1, "operate": 2, "admin": 3}
WRONG_TOKENS, WITHIN_S = 20, 60.0

Refusal = Literal["no token", "wrong token", "locked", "origin", "role", "code"]
"""Why somebody was refused."""


@dataclass(frozen=True, slots=True)
class Login:
    """Who asks: the name given when paired, and what they may do; role None: nobody we know."""

    name: str
    role: Role | None
    token: Token | None = None


LOGIN: web.RequestKey[Login] = web.RequestKey("login", Login)
NOBODY = Login("nobody", None)
EVERYBODY = Login("anybody", "admin")


class Auth:
    """Decides who asks. access : the tokens; None: no login is needed.  refused : told of everybody turned away."""

    def __init__(
        self,
        access: Access | None,
        refused: Callable[[Who, Refusal, str], object] = lambda who, why, what: None,
    ) -> None:
        self._access = access
        self._refused = refused
        self._wrong = Attempts(WRONG_TOKENS, WITHIN_S)
        self._at_work: dict[asyncio.Task[object], Login] = {}

    @web.middleware
    async def admit(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Give every request its login, or refuse it."""
        request[LOGIN] = NOBODY
        self._check_origin(request)
        request[LOGIN] = login = self._identify(request)
        place, endpoint = place_of(request), endpoint_of(request)
        least = endpoint.role if endpoint else OTHERWISE
        if login.role is None and least is not None:
            if place == "/":
                raise web.HTTPSeeOther("/pair")
            self._refused(asker(request), "no token", f"{request.method} {place}")
            raise web.HTTPUnauthorized(text="this node wants a login: pair with it first")
        task = asyncio.current_task()
        assert task is not None
        if place != STREAM:
            self._at_work[task] = login
        try:
            if RANK[login.role] < RANK[least]:
                raise web.HTTPForbidden(text=f"this needs the role {least}")
            return await handler(request)
        except web.HTTPForbidden:
            self._refused(asker(request), "role", f"{request.method} {place}")
            raise
        finally:
            self._at_work.pop(task, None)

    def stands(self, login: Login) -> bool:
        """Whether a login has not been revoked since; when that cannot be read, none stands."""
        if self._access is None or login.token is None:
            return True
        try:
            return login.token in self._access.tokens()
        except AccessError as error:
            log.error("%s", error)
            return False

    def expel(self) -> None:
        """End the requests of those whose login was revoked. Streams are ended by the server, with a word of it.

        But the one that asks for this: who revokes himself hears that it is done.
        """
        for task, login in self._at_work.items():
            if task is not asyncio.current_task() and not self.stands(login):
                log.warning("ended a request whose login was revoked")
                task.cancel()

    def _identify(self, request: web.Request) -> Login:
        if self._access is None:
            return EVERYBODY
        text = _token_shown(request)
        if text is None:
            return NOBODY
        token = self._access.find(text)
        if token is not None:
            self._access.last_used.note(token.digest, time.time())
            return Login(token.name, token.role, token)
        address, now_s = request.remote or "", time.monotonic()
        if self._wrong.is_locked(address, now_s):
            self._refused(Who(NOBODY.name, "", address), "locked", "too many wrong tokens")
            raise web.HTTPTooManyRequests(
                text="too many wrong tokens: wait a minute", headers={"Retry-After": f"{WITHIN_S:.0f}"}
            )
        self._wrong.failed(address, now_s)
        log.warning("a wrong or revoked token from %s", address)
        self._refused(Who(NOBODY.name, "", address), "wrong token", "")
        return NOBODY

    def _check_origin(self, request: web.Request) -> None:
        """Raises 403 for what another site's page had a browser ask."""
        if why := self._foreign(request):
            self._refused(asker(request), "origin", why)
            raise web.HTTPForbidden(text=why)

    def _foreign(self, request: web.Request) -> str:
        own = f"{request.scheme}://{request.host}"
        origin = request.headers.get("Origin")
        if origin is None and COOKIE in request.cookies and _changes(request):
            return "a browser says where a request comes from, and this one does not"
        if origin is not None and origin != own:
            return "the request comes from the page of another site"
        if self._access is None and not _is_loopback_name(request.host):
            return "without login only requests to this very machine are answered"
        return ""


def asker(request: web.Request) -> Who:
    """Whoever asks, for the audit log."""
    login = request[LOGIN]
    return Who(login.name, login.role or "", request.remote or "")


def _token_shown(request: web.Request) -> str | None:
    kind, _, text = request.headers.get("Authorization", "").partition(" ")
    if kind.lower() == "bearer":
        return text.strip()
    for offered in request.headers.get("Sec-WebSocket-Protocol", "").split(","):
        if offered.strip().startswith(SUBPROTOCOL):
            return offered.strip().removeprefix(SUBPROTOCOL)
    return request.cookies.get(COOKIE)


def _changes(request: web.Request) -> bool:
    return request.method not in SAFE or "Upgrade" in request.headers


@lru_cache(maxsize=64)
def _is_loopback_name(host: str) -> bool:
    """Whether a Host header names this machine itself: else a page whose name leads here would be let in."""
    try:
        return is_loopback(URL(f"http://{host}").host or "")
    except (ValueError, IndexError):  # IndexError: aio-libs/yarl#1822
        return False
