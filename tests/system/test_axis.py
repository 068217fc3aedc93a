"""A scanner whose axis is off centre: its scans are off, it is calibrated by a post, and then they are not."""

from __future__ import annotations

import asyncio
import io
import json
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest

from client import connect
from exchange.formats import read_scan
from foveascan import main, started
from protocol.grid import VOID, Grid
from simulators.shapes import POST_RADIUS_MM
from tests.waiting import PATIENCE_S

OFF = "--axis=0.8,-0.5,0.2,-0.15"
NOISE_MM = 0.02  # of a sample
FAULTS = ("--faults", "noise=10")  # steps of 0.002 mm


class Place:
    """A node, and a scanner that is told what stands on its table."""

    def __init__(self, folder: Path, url: str) -> None:
        self.folder, self.url = folder, url

    @contextmanager
    def standing(self, specimen: str) -> Iterator[Grid]:
        """While something stands on the table: its truth. Before, the node has seen the last thing taken away."""
        truth = self.folder / f"{specimen}.npz"
        what = ("--specimen", specimen, "--truth", str(truth), OFF, *FAULTS, "--link-rate", "10e6", "--turn", "0.1")
        with started("simulate", "--path", str(self.folder / "scanner"), *what, "--json"):
            asyncio.run(self._until("ready"))
            yield read_scan(truth).grid
        asyncio.run(self._until("connecting"))

    async def _until(self, phase: str) -> None:
        async with connect(self.url) as session, asyncio.timeout(PATIENCE_S):
            while (await session.scanner())["phase"] != phase:
                await asyncio.sleep(0.02)

    def command(self, *arguments: str) -> tuple[int, str, str]:
        """A command of foveascan: its status, what it says, and what it says is wrong."""
        out, err = io.StringIO(), io.StringIO()
        with redirect_stdout(out), redirect_stderr(err):
            status = main([*arguments, "--node", self.url])
        return status, out.getvalue(), err.getvalue()

    def scanned(self) -> tuple[Grid, dict[str, Any], str]:
        """A sweep: the scan, its quality, and what `scan` says of it."""
        status, said, wrong = self.command("scan", "--json")
        assert status == 0, wrong
        told = json.loads(said.splitlines()[-1])
        path = self.folder / "scan.npz"
        assert self.command("export", str(path), "--scan", told["scan"])[0] == 0
        return read_scan(path).grid, told["quality"], told["scan"]

    def quality(self, scan: str) -> dict[str, Any]:
        """What the API says of a scan."""

        async def asked() -> dict[str, Any]:
            async with aiohttp.ClientSession() as http, http.get(f"{self.url}/v1/scans/{scan}") as answer:
                return dict((await answer.json())["quality"])

        return asyncio.run(asked())


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    serve = ["serve", "--scanner", str(tmp_path / "scanner"), "--library", str(tmp_path / "library")]
    with started(*serve, "--listen", "127.0.0.1:0", "--insecure", "--json") as (_, ready):
        yield Place(tmp_path, ready["url"])


def off_mm(grid: Grid, truth: Grid) -> np.ndarray:
    """Errors of range where both are measured, but for the edges of the sphere, where a row is 1.7 mm high."""
    both = (grid.range_steps != VOID) & (truth.range_steps > 0.8 * truth.range_steps.max())
    assert both.mean() > 0.5
    return np.asarray(np.abs(grid.range_steps.astype(int) - truth.range_steps)[both] * truth.spec.step_mm)


def test_a_calibrated_scanner_measures_within_its_noise(place: Place) -> None:
    with place.standing("sphere") as sphere:
        grid, quality, scan = place.scanned()
        assert np.median(off_mm(grid, sphere)) > 0.4 and quality["axis"] is None
        status, _, wrong = place.command("calibrate", "--diameter", "160", "--scan", scan)
        assert status == 1 and "foveascan: the node refused" in wrong
        assert "no scanner's axis is known" in place.command("calibrate", "--list")[1]

    with place.standing("post"):
        status, said, wrong = place.command("calibrate", "--diameter", f"{2 * POST_RADIUS_MM}")
        assert status == 0, wrong
        assert "axis of SIM-0001: 0.60" in said and "leaning 0.20 and -0.15 degrees" in said  # at the middle height
        assert "sweeps of SIM-0001 are corrected for that from now on" in said
        status, _, wrong = place.command("calibrate", "--diameter", "95", "--scan", "latest")
        assert status == 1 and "measure its diameter again" in wrong

    with place.standing("sphere") as sphere:
        grid, quality, scan = place.scanned()
        after_mm = off_mm(grid, sphere)
        assert np.median(after_mm) < NOISE_MM and np.percentile(after_mm, 95) < 3 * NOISE_MM
        assert quality["axis"]["lateral_mm"] == pytest.approx(0.6, abs=0.01)
        assert place.quality(scan)["axis"]["lateralMm"] == quality["axis"]["lateral_mm"]
        known = json.loads(place.command("calibrate", "--list", "--json")[1])
        assert known["scanner"] == "SIM-0001" and known["axis"] == quality["axis"]
        assert place.command("calibrate", "--forget", "SIM-0001")[0] == 0
        assert "no scanner's axis is known" in place.command("calibrate", "--list")[1]
