from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from node.axis import Axis
from node.library import About, Library
from node.scan_quality import ScanQuality
from protocol.grid import Grid
from tests.node.round_bodies import corrected, swept
from tests.node.served import Client, served

TRUE = Axis(0.8, -0.5, 0.004, -0.003, 75.0)


class Case:
    """A library, and who asks about it."""

    def __init__(self, library: Library, client: Client) -> None:
        self.library, self.client = library, client

    def add(self, grid: Grid, axis: Axis | None = None, scanner: str = "SIM-0001") -> str:
        quality = ScanQuality(1.0, axis=axis)
        return self.library.add(grid, About(0.0, quality=quality, scanner=scanner, settings=5)).id

    async def ask(self, method: str, path: str, body: object = None) -> tuple[int, Any]:
        answer = await self.client.request(method, path, json=body)
        return answer.status, await answer.json() if answer.status != 204 else None

    async def calibrate(self, scan: str, diameter_mm: float = 80.0) -> tuple[int, Any]:
        return await self.ask("POST", "/v1/axes", {"scan": scan, "diameterMm": diameter_mm})


@asynccontextmanager
async def _case(folder: Path) -> AsyncIterator[Case]:
    library = Library(folder)
    async with served(library) as (client, _):
        yield Case(library, client)
    library.close()


@pytest.fixture
async def case(tmp_path: Path) -> AsyncIterator[Case]:
    async with _case(tmp_path) as case:
        yield case


async def test_an_axis_is_found_kept_told_and_forgotten(case: Case) -> None:
    assert await case.ask("GET", "/v1/axes") == (200, [])
    scan = case.add(swept(TRUE, noise_mm=0.02))
    status, found = await case.calibrate(scan[:8])
    assert status == 201 and found["scanner"] == "SIM-0001" and found["scan"] == scan and found["diameterMm"] == 80
    assert found["axis"]["lateralMm"] == pytest.approx(0.8, abs=0.01)
    assert found["axis"]["radialMm"] == pytest.approx(-0.5, abs=0.002)
    assert 0 < found["lateralErrorMm"] < 0.01 and found["noiseMm"] == pytest.approx(0.02, rel=0.1)
    assert await case.ask("GET", "/v1/axes") == (200, [found])
    axis, trouble = case.library.axes.of("SIM-0001", 5)
    assert axis is not None and not trouble and axis.lateral_mm == found["axis"]["lateralMm"]
    assert await case.ask("DELETE", "/v1/axes/SIM-0001") == (204, None)
    assert await case.ask("GET", "/v1/axes") == (200, [])
    status, said = await case.ask("DELETE", "/v1/axes/SIM-0001")
    assert status == 404 and "no axis of scanner 'SIM-0001'" in said["message"]


async def test_a_scanner_may_be_called_anything(case: Case) -> None:
    await case.calibrate(case.add(swept(TRUE), scanner="a/b %20ü"))
    assert await case.ask("DELETE", "/v1/axes/a%2Fb%20%2520%C3%BC") == (204, None)
    assert case.library.axes.known() == ()


async def test_a_sweep_that_does_not_tell_is_refused_and_what_was_known_stays(case: Case) -> None:
    await case.calibrate(case.add(swept(TRUE)))
    before = case.library.axes.known()
    status, said = await case.calibrate(case.add(swept(TRUE, noise_mm=1.0)))
    assert status == 422 and "is it round, matt" in said["message"]
    assert case.library.axes.known() == before


async def test_a_sweep_corrected_by_what_was_known_tells_the_same(case: Case) -> None:
    grid = swept(TRUE, noise_mm=0.01)
    _, first = await case.calibrate(case.add(grid))
    axis = case.library.axes.known()[0].estimate.axis
    status, again = await case.calibrate(case.add(corrected(grid, axis), axis))
    assert status == 201 and again["axis"]["radialMm"] == pytest.approx(first["axis"]["radialMm"], abs=0.002)
    assert again["axis"]["lateralMm"] == pytest.approx(first["axis"]["lateralMm"], abs=0.005)


async def test_a_scan_of_no_known_scanner_tells_no_axis(case: Case) -> None:
    status, said = await case.calibrate(case.add(swept(TRUE), scanner=""))
    assert status == 422 and "sweep the body anew" in said["message"]


@pytest.mark.parametrize(
    "body, status, why",
    [
        ({"scan": "latest"}, 400, "diameterMm"),
        ({"scan": "latest", "diameterMm": 0.5}, 400, "Expected `float` >= 1"),
        ({"scan": "latest", "diameterMm": 80, "radius": 3}, 400, "unknown field"),
        ([], 400, "Expected `object`"),
        ({"scan": "f" * 32, "diameterMm": 80}, 404, "no scan"),
        ({"scan": "latest", "diameterMm": 80}, 404, "there is no scan yet"),
    ],
)
async def test_what_makes_no_sense_is_refused(case: Case, body: object, status: int, why: str) -> None:
    got, said = await case.ask("POST", "/v1/axes", body)
    assert got == status and why in said["message"]


async def test_a_scan_says_what_it_was_corrected_for(case: Case) -> None:
    grid = swept(TRUE)
    scan = case.add(grid, TRUE)
    _, said = await case.ask("GET", f"/v1/scans/{scan}")
    assert said["quality"]["axis"] == {
        "lateralMm": 0.8, "radialMm": -0.5, "leanRad": 0.004, "sideRad": -0.003, "heightMm": 75.0,
    }  # fmt: skip
    trouble = ScanQuality(1.0, axis_trouble="not corrected, for a reason")
    other = case.library.add(Grid(grid.spec, np.roll(grid.range_steps, 9), grid.texture), About(0.0, quality=trouble))
    _, said = await case.ask("GET", f"/v1/scans/{other.id}")
    assert said["quality"]["complaints"] == ["not corrected, for a reason"] and "axis" not in said["quality"]
