from __future__ import annotations

import msgspec
import numpy as np
import pytest
from aiohttp import web

from client import RequestRefused
from client.shared import open_shared
from protocol.errors import RemoteWireError
from protocol.refinement import Refinement
from tests.client.scripted_node import SPEC, Planner, serving, synthetic_grid, until_gone

AT_ONCE_BYTES = 1 << 18  # more than asyncio reads of a socket at a time


def framed(*refinements: Refinement) -> bytes:
    parts = [refinement.to_bytes() for refinement in refinements]
    return b"".join(len(part).to_bytes(4, "little") + part for part in parts)


def routes(planner: Planner, fovea: bytes, status: int = 200) -> list[web.RouteDef]:
    """What a node answers who is asked by plain HTTP."""
    coarse = framed(*planner.first_view())

    async def describe(request: web.Request) -> web.Response:
        return web.json_response(msgspec.to_builtins(planner.info))

    async def first_view(request: web.Request) -> web.Response:
        return web.Response(body=coarse)

    async def look(request: web.Request) -> web.Response:
        return web.Response(body=fovea, status=status)

    scan = f"/v1/scans/{planner.info.id}"
    return [
        web.get("/v1/scans/latest", describe), web.get(f"{scan}/coarse", first_view), web.get(f"{scan}/fovea", look),
    ]  # fmt: skip


async def test_an_answer_that_comes_in_many_pieces_is_read_to_its_end() -> None:
    planner = Planner(synthetic_grid())
    fovea = framed(planner.range_fovea(self_contained=True))
    body = fovea * (AT_ONCE_BYTES // len(fovea) + 1)  # what is sent again changes nothing
    async with serving(until_gone, *routes(planner, body)) as url, open_shared(url) as viewer:
        assert await viewer.look(0.4, 0.4) == len(body)
        assert viewer.model.holdings.digest() == planner.holdings.digest()
        assert np.array_equal(viewer.model.range_steps[16:32, 24:48], planner.grid.range_steps[16:32, 24:48])


async def test_a_refusal_is_said_with_the_node_s_reason() -> None:
    refusal = b'{"code": "bad request", "message": "fovea: u is missing"}'
    async with serving(until_gone, *routes(Planner(synthetic_grid()), refusal, 400)) as url, open_shared(url) as viewer:
        with pytest.raises(RequestRefused, match="u is missing") as refused:
            await viewer.look(0.4, 0.4)
        assert refused.value.code == "bad request"


@pytest.mark.parametrize(("said", "match"), [(b"\x05\x00\x00", "cut short"), (b"\x05\x00\x00\x00abcde", "cut short")])
async def test_what_is_no_refinement_is_refused(said: bytes, match: str) -> None:
    async with serving(until_gone, *routes(Planner(synthetic_grid()), said)) as url, open_shared(url) as viewer:
        with pytest.raises(RemoteWireError, match=match):
            await viewer.look(0.4, 0.4)
        assert viewer.model.range_steps.shape == (SPEC.height, SPEC.width)


@pytest.mark.parametrize("said", [[], {"id": "x"}, {"id": 5}])
async def test_what_describes_no_scan_is_refused(said: object) -> None:
    async def describe(request: web.Request) -> web.Response:
        return web.json_response(said)

    async with serving(until_gone, web.get("/v1/scans/latest", describe)) as url:
        with pytest.raises(RemoteWireError, match="describes scan latest"):
            async with open_shared(url):
                pass
