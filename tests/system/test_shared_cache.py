"""A real nginx before the node: a ward of viewers costs the node one encode a place, and nobody else sees anything."""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import aiohttp
import numpy as np
import pytest
from yarl import URL

from client import connect, pair
from client.login import logged_in
from client.shared import open_shared
from foveascan import started
from node.access import Access
from protocol import pairing
from tests.system.line import RunningNode
from tests.system.needs import needs
from tests.system.nginx import nginx_before

pytestmark = needs("nginx")
VIEWERS = 32
PLACES = [(0.45, 0.4), (0.55, 0.45), (0.5, 0.6)]
SETTINGS = "[server]\ntrusted_proxies = [\"127.0.0.1\"]\nshared_cache = true\n"


@dataclass
class Ward:
    """A node behind nginx. own : the node's URL; url : nginx's; http : asks nginx, as whoever paired first."""

    own: str
    url: str
    access: Access
    http: aiohttp.ClientSession
    token: str
    scan: str = ""

    async def status(self, path: str, token: str | None = None) -> tuple[int, str]:
        """What nginx answers to a request for this path, and whether its cache did; token "": nobody asks."""
        shown = self.token if token is None else token
        headers = {"Authorization": f"Bearer {shown}" if shown else ""}
        async with self.http.get(URL(self.url + path, encoded=True), headers=headers) as answer:
            assert answer.headers["Cache-Control"] == "no-store"
            assert "X-Accel-Expires" not in answer.headers
            return answer.status, answer.headers.get("X-Cache-Status", "")

    async def encodes(self) -> int:
        async with self.http.get(f"{self.url}/v1/node") as answer:
            return int((await answer.json())["sharedEncodes"])

    async def fovea(self) -> str:
        """A canonical URL of a place."""
        place = f"{self.url}/v1/scans/{self.scan}/fovea?u=0.5&v=0.5"
        async with self.http.get(place, allow_redirects=False) as answer:
            assert answer.status == 303
            return answer.headers["Location"]

    def newcomer(self, name: str) -> str:
        """A token for somebody else."""
        key = pairing.key_of(pairing.parse_code(self.access.offer("view", name, time.time())))
        made = self.access.redeem(lambda other: other == key, time.time())
        assert made is not None
        return made[0]


@pytest.fixture
async def ward(head_node: RunningNode, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Ward]:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    async with running_ward(head_node, tmp_path) as ward:
        yield ward


@asynccontextmanager
async def running_ward(head_node: RunningNode, folder: Path) -> AsyncIterator[Ward]:
    library = Path(shutil.copytree(head_node.folder / "library", folder / "library"))
    (folder / "node.toml").write_text(SETTINGS)
    serve = ["serve", "--config", str(folder / "node.toml"), "--library", str(library), "--listen", "127.0.0.1:0"]
    with started(*serve, "--json") as (_, ready), nginx_before(ready["url"], library, folder) as url:
        access = Access(library / "access")
        known = await pair(url, access.offer("operate", "ward", time.time()))
        async with logged_in(url) as (_, http):
            ward = Ward(ready["url"], url, access, http, known.token)
            async with http.get(f"{url}/v1/scans") as answer:
                ward.scan = (await answer.json())[0]["id"]
            yield ward


async def test_32_viewers_of_the_same_places_cost_one_encode_each(ward: Ward) -> None:
    before = await ward.encodes()
    viewers = await asyncio.gather(*(look_at_all(ward.url) for _ in range(VIEWERS)))
    assert await ward.encodes() - before == len(PLACES)
    first = viewers[0][0]
    assert first.max() > 0
    for steps, _ in viewers:
        np.testing.assert_array_equal(steps, first)
    kept = VIEWERS * (len(PLACES) + 1) - (len(PLACES) + 1)  # each first view and fovea but the first of its kind
    assert sum(hits for _, hits in viewers) == kept


async def look_at_all(url: str) -> tuple[np.ndarray, int]:
    async with open_shared(url) as viewer:
        for u, v in PLACES:
            await viewer.look(u, v)
        return viewer.model.range_steps.copy(), viewer.hits


async def test_what_the_cache_holds_is_for_whom_the_node_lets_in_and_for_no_longer(ward: Ward) -> None:
    leaver = ward.newcomer("leaver")
    for path in (await ward.fovea(), f"/v1/scans/{ward.scan}/coarse"):
        assert await ward.status(path) == (200, "MISS")
        assert await ward.status(path) == await ward.status(path, leaver) == (200, "HIT")
        assert await ward.status(path, "") == (401, "")
        assert await ward.status(path, "x" * 43) == (401, "")
    ward.access.revoke("leaver")
    assert await ward.status(path, leaver) == (401, "")
    assert await ward.status(path) == (200, "HIT")


async def test_what_nobody_kept_is_asked_of_the_node(ward: Ward) -> None:
    assert await ward.status(f"/v1/scans/{ward.scan}") == (200, "")
    assert await ward.status(f"/v1/scans/{ward.scan}.stl", "") == (401, "")
    assert await ward.status("/v1/auth") == (403, "")
    async with ward.http.get(f"{ward.url}/foveascan-auth") as answer:
        assert answer.status == 404
    encoded = f"/v1/scans/%{ord(ward.scan[0]):x}{ward.scan[1:]}/coarse"
    for _ in range(2):
        assert await ward.status(encoded) == (200, "")


async def test_a_deleted_scan_is_gone_from_the_cache_as_well(ward: Ward) -> None:
    paths = [await ward.fovea(), f"/v1/scans/{ward.scan}/coarse"]
    for path in paths:
        await ward.status(path)
        assert await ward.status(path) == (200, "HIT")
    async with ward.http.delete(f"{ward.url}/v1/scans/{ward.scan}") as answer:
        assert answer.status == 204
    assert [await ward.status(path) for path in paths] == [(410, ""), (404, "")]


async def test_a_stream_goes_through_and_attempts_count_for_who_makes_them(ward: Ward) -> None:
    async with connect(ward.url) as session:
        model = await session.open()
        assert (await session.look(0.5, 0.5)).bytes_received > 0
        assert model.range_steps.any()
    headers = {"Authorization": "Bearer wrong", "X-Forwarded-For": "192.0.2.7"}
    for _ in range(20):
        async with ward.http.get(f"{ward.own}/v1/scans", headers=headers, ssl=False) as answer:
            assert answer.status == 401
    async with ward.http.get(f"{ward.own}/v1/scans", headers=headers, ssl=False) as answer:
        assert answer.status == 429
    assert await ward.status(f"/v1/scans/{ward.scan}", "wrong") == (401, "")
