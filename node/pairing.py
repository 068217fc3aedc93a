"""Letting clients in, and out again, over HTTP.

    GET    /pair               a page for browsers: type the code, get a cookie
    POST   /pair               that page's form sends the code itself
    POST   /v1/pair            a client proves a code and gets a token
    POST   /v1/codes           (admin) a new code
    GET    /v1/codes           (admin) which wait
    GET    /v1/tokens          (admin) who is paired
    DELETE /v1/tokens/{name}   (admin) revoke

Guessing is hopeless (80 bits) and still stopped: an address that fails ADDRESS_FAILURES times waits, and CODE_FAILURES
failures, wherever from, void every code that waits. Then somebody at the node makes a new one.
"""

from __future__ import annotations

import asyncio
import hmac
import html
import logging
import time
from collections.abc import Callable

from aiohttp import web

from node.access import Access, Token
from node.attempts import Attempts
from node.audit import NODE, Audit, Who
from node.auth import COOKIE, LOGIN, Refusal, asker
from node.bodies import ListedCode, ListedToken, NewCode, Offered
from node.endpoints import FORM, route
from node.rest import decoded, refusal, said
from node.tls import Tls
from protocol import pairing
from protocol.errors import AccessError, LocalWireError

log = logging.getLogger(__name__)

ADDRESS_FAILURES, WITHIN_S = 5, 300.0
CODE_FAILURES = 20
COOKIE_S = 400 * 86400  # browsers keep none longer
BODY_MAX_BYTES = 4096
REFUSED = "no such code waits: it is wrong, used, expired, or came through somebody in between; make a new one"
LOCKED = "too many wrong codes from there: wait five minutes"
NO_LOGIN = "this node was started with --insecure and knows no logins"
POLICY = "default-src 'none'; style-src 'unsafe-inline'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Pair with {name}</title>
<style>body{{font:1rem/1.5 system-ui;max-width:36rem;margin:3rem auto;padding:0 1rem;color-scheme:light dark}}
code{{overflow-wrap:anywhere}}input,button{{font:inherit;padding:.5rem}}input{{width:100%;box-sizing:border-box}}
[role=alert]{{border-left:.3rem solid #b00020;padding-left:.8rem}}</style></head><body>
<h1>Pair with {name}</h1>
{trouble}<p>This takes a code. Whoever looks after the node makes one, in its page under "Administration" or on its
machine with <code>foveascan pair --role view --name NAME</code>, and gets a fingerprint with it.</p>
<ol><li>Open your browser's certificate view (the sign left of the address). Its SHA-256 fingerprint must be the one
that <em>came with the code</em>. If it is another, somebody is in between: stop. The node says<br>
<code>{fingerprint}</code></li>
<li><form method="post" action="/pair"><label>The code <input name="code" autocomplete="off" required autofocus
autocapitalize="characters" spellcheck="false" maxlength="40" placeholder="ABCD-EFGH-IJKL-MNOP"></label>
<p><button>Pair this browser</button></p></form></li></ol></body></html>
"""


class PairingRoutes:
    """The routes above. access, tls : None without login. audit : told who is let in and put out.

    refused : told of everybody turned away.  revoked : called after a token was revoked."""

    def __init__(
        self,
        access: Access | None,
        tls: Tls | None,
        audit: Audit,
        refused: Callable[[Who, Refusal, str], object],
        node_id: str,
        name: str,
        revoked: Callable[[], object],
    ) -> None:
        self._access = access
        self._tls = tls
        self._audit = audit
        self._refused = refused
        self._node_id = node_id
        self._name = name
        self._revoked = revoked
        self._failures = Attempts(ADDRESS_FAILURES, WITHIN_S)
        self._wrong_codes = 0

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [
            route("GET /pair", self._page),
            route("POST /pair", self._pair_browser),
            route("POST /v1/pair", self._pair_client),
            route("POST /v1/codes", self._offer),
            route("GET /v1/codes", self._codes),
            route("GET /v1/tokens", self._tokens),
            route("DELETE /v1/tokens/{name}", self._revoke),
        ]

    # -- pairing ---------------------------------------------------------------------------------------------------

    async def _page(self, request: web.Request) -> web.Response:
        self._known()
        return self._show()

    async def _pair_client(self, request: web.Request) -> web.Response:
        access, tls = self._known()
        body = await _bounded(request)
        if self._is_locked(request):
            return _wait(refusal(429, LOCKED))
        asked = decoded(body, pairing.PairRequest)
        own = tls.fingerprint

        def is_proven(key: bytes) -> bool:
            return hmac.compare_digest(pairing.client_proof(key, own, asked.nonce), asked.proof)

        made = await asyncio.to_thread(access.redeem, is_proven, time.time())
        if made is None:
            await self._failed(request, access)
            return refusal(403, REFUSED)
        text, token, key = made
        self._paired(request, token)
        proof = pairing.node_proof(key, own, asked.nonce, text, token.role)
        return said(pairing.Paired(text, token.name, token.role, self._node_id, proof))

    async def _pair_browser(self, request: web.Request) -> web.Response:
        access, _ = self._known()
        await _bounded(request)
        if self._is_locked(request):
            return _wait(self._show(LOCKED, 429))
        form = await request.post() if request.content_type == FORM else {}
        try:
            typed = pairing.key_of(pairing.parse_code(str(form.get("code", ""))))
        except LocalWireError as error:
            return self._show(str(error), 400)
        made = await asyncio.to_thread(access.redeem, lambda key: hmac.compare_digest(key, typed), time.time())
        if made is None:
            await self._failed(request, access)
            return self._show(REFUSED, 403)
        text, token, _ = made
        self._paired(request, token)
        response = web.Response(status=303, headers={"Location": "/"})
        response.set_cookie(COOKIE, text, max_age=COOKIE_S, path="/", secure=True, httponly=True, samesite="Strict")
        return response

    def _is_locked(self, request: web.Request) -> bool:
        """Whether too many wrong codes came from there; then that is noted, too."""
        if not self._failures.is_locked(request.remote or "", time.monotonic()):
            return False
        log.warning("pairing: %s is locked", request.remote)
        self._refused(asker(request), "locked", "too many wrong codes")
        return True

    async def _failed(self, request: web.Request, access: Access) -> None:
        self._failures.failed(request.remote or "", time.monotonic())
        self._wrong_codes += 1
        log.warning("pairing: a wrong code from %s", request.remote)
        self._refused(asker(request), "code", "")
        if self._wrong_codes >= CODE_FAILURES:
            self._wrong_codes = 0
            voided = await asyncio.to_thread(access.void_codes)
            log.warning("pairing: %d wrong codes; %d that waited are void now", CODE_FAILURES, voided)
            self._audit.note("codes voided", NODE, what=f"{voided} after {CODE_FAILURES} wrong ones")

    def _paired(self, request: web.Request, token: Token) -> None:
        self._wrong_codes = 0
        log.warning("pairing: a client paired from %s with the role %s", request.remote, token.role)
        self._audit.note("paired", Who(token.name, token.role, request.remote or ""))

    def _show(self, trouble: str = "", status: int = 200) -> web.Response:
        _, tls = self._known()
        page = PAGE.format(
            name=html.escape(self._name),
            trouble=f'<p role="alert">{html.escape(trouble)}</p>\n' if trouble else "",
            fingerprint=pairing.fingerprint_text(tls.fingerprint),
        )
        headers = {"Content-Security-Policy": POLICY, "Referrer-Policy": "same-origin"}  # else its form says no Origin
        return web.Response(text=page, status=status, content_type="text/html", headers=headers)

    # -- looking after it ------------------------------------------------------------------------------------------

    async def _offer(self, request: web.Request) -> web.Response:
        access, tls = self._known()
        asked = decoded(await _bounded(request), NewCode)
        try:
            now_s, valid_s = time.time(), 60 * asked.minutes
            code = await asyncio.to_thread(access.offer, asked.role, asked.name, now_s, valid_s)
        except AccessError as error:
            raise web.HTTPConflict(text=str(error)) from error
        self._audit.note("code offered", asker(request), what=f"{asked.name}: {asked.role}")
        return said(Offered(code, tls.fingerprint, now_s + valid_s), 201)

    async def _tokens(self, request: web.Request) -> web.Response:
        access, _ = self._known()
        used, own = access.last_used.of, request[LOGIN].token
        listed = [ListedToken(t.name, t.role, t.created_unix_s, used(t.digest), t == own) for t in access.tokens()]
        return said(listed)

    async def _codes(self, request: web.Request) -> web.Response:
        access, _ = self._known()
        return said([ListedCode(code.name, code.role, code.expires_unix_s) for code in access.codes(time.time())])

    async def _revoke(self, request: web.Request) -> web.Response:
        access, _ = self._known()
        name = request.match_info["name"]
        if not await asyncio.to_thread(access.revoke, name):
            raise web.HTTPNotFound(text="nobody of that name is paired")
        self._audit.note("revoked", asker(request), what=name)
        self._revoked()
        return web.Response(status=204)

    def _known(self) -> tuple[Access, Tls]:
        if self._access is None or self._tls is None:
            raise web.HTTPConflict(text=NO_LOGIN)
        return self._access, self._tls


def _wait(locked: web.Response) -> web.Response:
    locked.headers["Retry-After"] = f"{WITHIN_S:.0f}"
    return locked


async def _bounded(request: web.Request) -> bytes:
    """The body, kept by the request for whoever reads it again. Raises 413."""
    if (request.content_length or 0) > BODY_MAX_BYTES:
        raise web.HTTPRequestEntityTooLarge(BODY_MAX_BYTES, request.content_length or 0)
    body = await request.read()
    if len(body) > BODY_MAX_BYTES:
        raise web.HTTPRequestEntityTooLarge(BODY_MAX_BYTES, len(body))
    return body
