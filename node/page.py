"""The browser page: what the package's build put into client/viewer/dist, read once and served from memory."""

from __future__ import annotations

import base64
import gzip
import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

from aiohttp import web

from node.endpoints import route

DIST = Path(__file__).resolve().parents[1] / "client" / "viewer" / "dist"
MEDIA_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".wasm": "application/wasm",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",  # licences of others' work in the page; offline copies have them, too
}
# The build writes a hash of its content into every name but the page's own.
FOR_EVER = "public, max-age=31536000, immutable"
ASK_AGAIN = "no-cache"
POLICY = (
    "default-src 'none'; script-src 'self'{more}; worker-src 'self'; connect-src 'self'; style-src 'self'; "
    "img-src 'self' data: blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
WITHIN = re.compile(rb"<script>(.+?)</script>", re.DOTALL)
NOT_BUILT = "The page is not built: run `make`, or install the wheel. The command `foveascan look` works anyway.\n"


@dataclass(frozen=True, slots=True)
class _File:
    media_type: str
    body: bytes
    packed: bytes
    tag: str
    policy: str


class Page:
    """The page and its parts. folder : what the build wrote; where there is none, the page says so."""

    def __init__(self, folder: Path = DIST) -> None:
        self._files = {path.name: _read(path) for path in _built(folder)}

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [route("GET /", self._page), route("GET /assets/{name}", self._asset)]

    async def _page(self, request: web.Request) -> web.Response:
        page = self._files.get("index.html")
        if page is None:
            return web.Response(text=NOT_BUILT)
        return _respond(request, page, ASK_AGAIN)

    async def _asset(self, request: web.Request) -> web.Response:
        file = self._files.get(request.match_info["name"])
        if file is None:
            raise web.HTTPNotFound(text="no such part of the page: load it again")
        return _respond(request, file, FOR_EVER)


def _built(folder: Path) -> list[Path]:
    return [path for path in folder.glob("*") if path.suffix in MEDIA_TYPES]


def _read(path: Path) -> _File:
    body = path.read_bytes()
    # A worker takes its policy from its own script's response: WASM may be compiled there and nowhere else.
    more = " 'wasm-unsafe-eval'" if path.name.startswith("worker-") else "".join(map(_named, WITHIN.findall(body)))
    packed = path.with_name(f"{path.name}.gz")
    return _File(
        MEDIA_TYPES[path.suffix],
        body,
        packed.read_bytes() if packed.exists() else gzip.compress(body),
        f'"{hashlib.sha256(body).hexdigest()[:32]}"',
        POLICY.format(more=more),
    )


def _named(script: bytes) -> str:
    """A script that stands within the page, as the policy names what may run."""
    return f" 'sha256-{base64.b64encode(hashlib.sha256(script).digest()).decode()}'"


def _respond(request: web.Request, file: _File, cache: str) -> web.Response:
    headers = {
        "Content-Type": file.media_type,
        "Cache-Control": cache,
        "Content-Security-Policy": file.policy,
        "Cross-Origin-Opener-Policy": "same-origin",
        "ETag": file.tag,
        "Vary": "Accept-Encoding",
    }
    if request.headers.get("If-None-Match") == file.tag:
        return web.Response(status=304, headers=headers)
    if "gzip" in request.headers.get("Accept-Encoding", ""):
        return web.Response(body=file.packed, headers={**headers, "Content-Encoding": "gzip"})
    return web.Response(body=file.body, headers=headers)
