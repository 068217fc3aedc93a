"""The page over HTTP: policy, caching, packed bodies."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from aiohttp import web
from aiohttp.test_utils import TestClient, TestServer

from node.page import Page

Client = TestClient[web.Request, web.Application]
SCRIPT = b"console.log(1)"


@pytest.fixture
def dist(tmp_path: Path) -> Path:
    (tmp_path / "index.html").write_text("<!doctype html>")
    (tmp_path / "main-ABC.js").write_bytes(SCRIPT)
    (tmp_path / "main-ABC.js.gz").write_bytes(gzip.compress(SCRIPT))
    (tmp_path / "worker-DEF.js").write_bytes(SCRIPT)
    (tmp_path / ".stamp").write_text("not for anybody")
    return tmp_path


def client_of(folder: Path) -> Client:
    app = web.Application()
    app.add_routes(Page(folder).routes())
    return TestClient(TestServer(app), auto_decompress=False)


async def test_parts_are_packed_where_asked_for_and_kept_for_ever(dist: Path) -> None:
    async with client_of(dist) as client:
        packed = await client.get("/assets/main-ABC.js", headers={"Accept-Encoding": "gzip"})
        assert packed.headers["Content-Encoding"] == "gzip"
        assert gzip.decompress(await packed.read()) == SCRIPT
        assert "immutable" in packed.headers["Cache-Control"]
        plain = await client.get("/assets/main-ABC.js", headers={"Accept-Encoding": "identity"})
        assert "Content-Encoding" not in plain.headers
        assert await plain.read() == SCRIPT
        assert plain.content_type == "text/javascript"


async def test_the_page_is_asked_for_again_and_answered_by_304(dist: Path) -> None:
    async with client_of(dist) as client:
        first = await client.get("/")
        assert first.headers["Cache-Control"] == "no-cache"
        again = await client.get("/", headers={"If-None-Match": first.headers["ETag"]})
        assert again.status == 304


async def test_wasm_may_be_compiled_in_the_worker_only(dist: Path) -> None:
    async with client_of(dist) as client:
        for path, allowed in (("/", False), ("/assets/main-ABC.js", False), ("/assets/worker-DEF.js", True)):
            policy = (await client.get(path)).headers["Content-Security-Policy"]
            assert policy.startswith("default-src 'none'")
            assert ("'wasm-unsafe-eval'" in policy) == allowed
            assert "'unsafe-eval'" not in policy and "unsafe-inline" not in policy


async def test_nothing_but_built_parts_is_served(dist: Path) -> None:
    async with client_of(dist) as client:
        for path in ("/assets/.stamp", "/assets/..%2f..%2fetc%2fpasswd", "/assets/other.js"):
            assert (await client.get(path)).status == 404


async def test_without_a_build_the_page_says_what_to_do(tmp_path: Path) -> None:
    async with client_of(tmp_path) as client:
        assert "run `make`" in await (await client.get("/")).text()
        answer = await client.get("/", headers={"Host": "127.0.0.1:x"})
        assert answer.status == 200 and "run `make`" in await answer.text()
