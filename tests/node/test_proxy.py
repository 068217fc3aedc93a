"""Whom a request is from, with proxies in between; and what only a cache that is trusted may keep."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from aiohttp import web
from aiohttp.test_utils import make_mocked_request

from node.config import Server
from node.proxy import FORWARDED, IS_PROXIED, believe
from tests.node.entrance import Entrance, entrance

OURS = "127.0.0.1"


@pytest.mark.parametrize(
    ("remote", "headers", "client"),
    [
        ("192.0.2.1", [], "192.0.2.1"),
        ("192.0.2.1", ["198.51.100.7"], "192.0.2.1"),
        (OURS, [], OURS),
        (OURS, ["198.51.100.7"], "198.51.100.7"),
        (OURS, ["10.0.0.9, 198.51.100.7"], "198.51.100.7"),
        (OURS, ["10.0.0.9", "198.51.100.7, 127.0.0.1"], "198.51.100.7"),
        (OURS, ["10.0.0.9, who knows"], OURS),
        ("::ffff:127.0.0.1", ["2001:db8::7"], "2001:db8::7"),
        (OURS, ["127.0.0.1"], OURS),
    ],
)
async def test_the_last_address_that_is_no_proxy_of_ours_counts(remote: str, headers: list[str], client: str) -> None:
    pairs = [(FORWARDED, text) for text in headers]
    request = make_mocked_request("GET", "/", headers=pairs).clone(remote=remote)
    seen: list[str | None] = []

    async def handler(asked: web.Request) -> web.Response:
        seen.append(asked.remote)
        return web.Response()

    await believe([OURS])(request, handler)
    assert seen == [client]
    assert request[IS_PROXIED] == remote.endswith(OURS)


@pytest.fixture(params=["127.0.0.1", "192.0.2.1"], ids=["trusted", "not trusted"])
async def node(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Entrance]:
    settings = Server(listen="127.0.0.1:0", trusted_proxies=(request.param,), shared_cache=True)
    async with entrance(tmp_path / "library", settings) as node:
        yield node


async def test_only_a_trusted_cache_is_told_that_it_may_keep_something(
    node: Entrance, request: pytest.FixtureRequest
) -> None:
    token = node.token("view")
    is_trusted = "not" not in request.node.callspec.id
    for path, is_kept in ((f"/v1/scans/{node.scan}/coarse", True), ("/v1/scans/latest/coarse", False)):
        async with node.ask("GET", path, token) as answer:
            assert (answer.status, answer.headers["Cache-Control"]) == (200, "no-store")
            assert answer.headers.get("X-Accel-Expires") == ("86400" if is_trusted and is_kept else None)


@pytest.mark.parametrize("path", ["", "/", "/v1/scans/latest/coarse", "/v1/scans/{0}/coarse", "/v1/scans/{scan}"])
async def test_a_cache_is_told_to_hand_out_only_what_it_may_keep(node: Entrance, path: str) -> None:
    place = path.replace("{0}", "0" * 32).replace("{scan}", node.scan)
    async with node.ask("GET", "/v1/auth", node.token("view"), headers={"X-Original-URI": place}) as answer:
        assert answer.status == 403


async def test_a_cache_is_told_who_may_have_what_it_keeps(node: Entrance) -> None:
    kept = {"X-Original-URI": f"/v1/scans/{node.scan}/coarse?codec=htj2k"}
    async with node.ask("GET", "/v1/auth", headers=kept) as answer:
        assert answer.status == 401
    async with node.ask("GET", "/v1/auth", node.token("view"), headers=kept) as answer:
        assert (answer.status, await answer.read()) == (204, b"")
