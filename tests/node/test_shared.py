"""Self-contained foveae over HTTP: plans, canonical URLs, shared encodes, what may be cached, what is refused."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from client.shared import open_shared
from node.library import About, Library
from tests.node.scans import make_grid
from tests.node.served import Client, served

GRID = make_grid()


@pytest.fixture(params=[False, True], ids=["private", "shared"])
async def node(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[Client]:
    library = Library(tmp_path)
    library.add(GRID, About(0.0))
    async with served(library, shared_cache=request.param) as (client, server):
        server._shared.cached = request.param  # type: ignore[attr-defined]
        client.node = server  # type: ignore[attr-defined]
        yield client


async def plan(node: Client, query: str) -> str:
    response = await node.get(f"/v1/scans/latest/fovea?{query}", allow_redirects=False)
    assert response.status == 303
    assert response.headers["Cache-Control"] == "no-store"
    return response.headers["Location"]


async def encodes(node: Client) -> int:
    return int((await (await node.get("/v1/node")).json())["sharedEncodes"])


async def test_a_plan_leads_to_a_url_that_names_every_parameter(node: Client) -> None:
    place = await plan(node, "u=0.6&v=0.4")
    assert place == await plan(node, "u=0.6&v=0.4")
    response = await node.get(place)
    assert response.status == 200
    shared = node.node._shared.cached  # type: ignore[attr-defined]
    cache = "public, max-age=86400, immutable" if shared else "no-store"
    assert response.headers["Cache-Control"] == cache


async def test_the_same_url_gives_the_same_bytes_after_they_were_forgotten(node: Client) -> None:
    place = await plan(node, "u=0.6&v=0.4")
    first = await (await node.get(place)).read()
    node.node._shared._bodies.clear()  # type: ignore[attr-defined]
    again = await (await node.get(place)).read()
    assert first == again


async def test_many_at_once_cost_one_encode(node: Client) -> None:
    before = await encodes(node)
    places = await asyncio.gather(*(plan(node, "u=0.3&v=0.4") for _ in range(8)))
    bodies = await asyncio.gather(*(node.get(place) for place in places))
    assert len({place for place in places}) == 1
    assert {response.status for response in bodies} == {200}
    assert await encodes(node) == before + 1


async def test_a_viewer_without_a_session_reaches_the_quality(node: Client) -> None:
    url = str(node.make_url("/"))
    async with open_shared(url) as viewer:
        size = await viewer.look(0.6, 0.4, range_mm=0.05)
        assert size > 0
        before = viewer.model.range_steps.copy()
        levels = viewer.model.holdings.channels[0].level.copy()  # type: ignore[index]
        await viewer.look(0.6, 0.4, range_mm=0.05)
        np.testing.assert_array_equal(viewer.model.range_steps, before)
        await viewer.look(0.65, 0.42)
        assert (viewer.model.holdings.channels[0].level <= levels).all()  # type: ignore[index]


BAD_QUERIES = ["u=1.5&v=0.2", "v=0.2", "u=nan&v=0.2", "u=.5&v=.5&p=3", "u=.5&v=.5&codec=gif", "u=.5&v=.5&max_bytes=-1"]
MADE_UP = ["1", "2.0.0.1.1.0.0.1x", "2.0.0.99.99.0.0.1", "2.0.0.1.1.0.0.99999999999", "02.0.0.1.1.0.0.1"]


@pytest.mark.parametrize("query", BAD_QUERIES)
async def test_a_bad_query_is_refused(node: Client, query: str) -> None:
    response = await node.get(f"/v1/scans/latest/fovea?{query}", allow_redirects=False)
    assert response.status == 400
    assert (await response.json())["message"]


@pytest.mark.parametrize("part", MADE_UP)
async def test_a_made_up_url_is_refused(node: Client, part: str) -> None:
    *_, scan, _, epoch, _, _ = (await plan(node, "u=0.6&v=0.4")).split("/")
    response = await node.get(f"/v1/scans/{scan}/fovea/{epoch}/{part}/-")
    assert response.status == 400


async def test_an_unknown_scan_and_an_old_epoch_lead_nowhere(node: Client) -> None:
    assert (await node.get("/v1/scans/none/fovea?u=0.5&v=0.5")).status == 404
    *front, _, r, t = (await plan(node, "u=0.6&v=0.4")).split("/")
    assert (await node.get("/".join([*front, "00000000", r, t]))).status == 410


async def test_what_the_latest_scan_means_is_kept_by_no_cache(node: Client) -> None:
    scan = (await (await node.get("/v1/scans")).json())[0]["id"]
    shared = node.node._shared.cached  # type: ignore[attr-defined]
    cache = "public, max-age=86400, immutable" if shared else "no-store"
    place = await plan(node, "u=0.6&v=0.4")
    for asked in (f"/v1/scans/{scan}/coarse", place):
        assert (await node.get(asked)).headers["Cache-Control"] == cache
        response = await node.get(asked.replace(scan, "latest"))
        assert (response.status, response.headers["Cache-Control"]) == (200, "no-store")
