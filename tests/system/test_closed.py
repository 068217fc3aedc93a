"""Closed objects through the commands and a real node: swept, brought, derived, and looked at over a pole."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from exchange.formats import read_scan
from exchange.native import write_native
from foveascan import PROGRAM, main, started
from simulators.pebble import pebble
from simulators.shapes import cylinder
from tests.exchange.tipped import lying, swept

STONE = (240, 120, 240, 120)


@pytest.fixture
def url(tmp_path: Path) -> Iterator[str]:
    serve = ["serve", "--library", str(tmp_path / "library"), "--listen", "127.0.0.1:0", "--insecure", "--json"]
    with started(*serve) as (_, ready):
        yield ready["url"]


def told(capsys: pytest.CaptureFixture[str], *command: str) -> dict[str, str]:
    assert main([*command, "--json"]) == 0
    said: dict[str, str] = json.loads(capsys.readouterr().out.splitlines()[-1])
    for only_import in ("new", "sizeMm"):
        said.pop(only_import, None)
    return said


def test_a_cylinder_is_closed_here_as_on_the_node(tmp_path: Path, url: str, capsys: pytest.CaptureFixture[str]) -> None:
    with open(tmp_path / "can.npz", "wb") as file:
        write_native(cylinder((48, 40, 96, 64), 0), file, "can")
    at_node = ("--node", url)
    scan = told(capsys, "import", str(tmp_path / "can.npz"), *at_node)["scan"]
    to_sphere = ("--geometry", "sphere", "--caps", *at_node)
    here = told(capsys, "import", str(tmp_path / "can.npz"), *to_sphere)
    there = told(capsys, "derive", "--scan", scan[:8], *to_sphere)
    assert here == there and here["geometry"] == "sphere" and "made up" in here["note"]

    assert main(["derive", "--scan", there["scan"], "--geometry", "cylinder", *at_node]) == 0
    assert "A sphere as its axis sees it" in capsys.readouterr().out
    assert main(["scans", *at_node]) == 0
    assert " sphere  can\n" in capsys.readouterr().out
    told(capsys, "export", str(tmp_path / "closed.npz"), "--scan", there["scan"], *at_node)
    assert read_scan(tmp_path / "closed.npz").note == there["note"]


def test_a_lying_sweep_closes_a_standing_one_here_as_on_the_node(
    tmp_path: Path, url: str, capsys: pytest.CaptureFixture[str]
) -> None:
    stone = pebble(STONE, 0)
    upright = swept(stone, np.eye(3), np.zeros(3), STONE)
    laid = lying(stone, (4.0, -3.0, 2.0), np.array([1.0, -1.0, 50.0]), STONE)
    for name, grid in (("standing", upright), ("lying", laid)):
        with open(tmp_path / f"{name}.npz", "wb") as file:
            write_native(grid, file, name)
    standing, lying_ = str(tmp_path / "standing.npz"), str(tmp_path / "lying.npz")
    at_node = ("--node", url)
    first, second = (told(capsys, "import", file, *at_node)["scan"] for file in (standing, lying_))
    to_sphere = ("--geometry", "sphere", *at_node)
    here = told(capsys, "import", standing, "--top", lying_, "--bottom", lying_, *to_sphere)
    there = told(capsys, "derive", "--scan", first, "--top", second[:6], *to_sphere)
    assert here == there and "from other sweeps" in here["note"]
    assert main(["import", standing, "--bottom", lying_, *to_sphere]) == 1  # it lay over its front
    assert "tipped as said?" in capsys.readouterr().err
    assert main(["import", standing, "--top", str(tmp_path / "none.npz"), *to_sphere]) == 1
    assert "none.npz" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "cure"),
    [
        (("derive", "--centre-height", "900"), "not inside"),
        (("derive", "--geometry", "cylinder"), "cylinder already"),
        (("derive", "--geometry", "cylinder", "--caps"), "--geometry sphere"),
        (("derive", "--scan", "123456"), "no scan"),
    ],
)
def test_what_cannot_be_made_is_told_with_its_cure(
    tmp_path: Path, url: str, capsys: pytest.CaptureFixture[str], command: tuple[str, ...], cure: str
) -> None:
    with open(tmp_path / "can.npz", "wb") as file:
        write_native(cylinder((48, 40, 96, 64), 0), file)
    assert main(["import", str(tmp_path / "can.npz"), "--node", url]) == 0
    assert main([*command, "--node", url]) == 1
    assert cure in capsys.readouterr().err


def test_the_demo_looks_at_both_poles_of_a_closed_object() -> None:
    command = [*PROGRAM, "demo", "--specimen", "pebble", "--once", "--json"]
    ran = subprocess.run(command, capture_output=True, timeout=300)
    assert ran.returncode == 0, ran.stderr.decode()
    said = json.loads(ran.stdout)
    assert said["ok"] and said["closed"]["ok"] and said["scan"] != said["closed"]["scan"]
    heights = [update["v"] for update in said["closed"]["updates"]]
    assert heights[:2] == [0.005, 0.995] and len(heights) == 5
    for update in said["closed"]["updates"]:
        assert update["range_error_mm_p99"] <= 0.1 and update["texture_psnr_db"] >= 40
