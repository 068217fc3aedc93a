"""The whole line over USB, emulated or a kernel's: `foveascan simulate`, the daemon on libusb, the public client."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from client.transfer import fetch_scan
from exchange.native import read_native
from foveascan import PROGRAM, started
from protocol.grid import Grid
from simulators.usb_preload import PRELOAD, is_available
from tests.system.line import RunningNode, run_line
from tests.system.usb_bed import CONTROLLERS

SEED = 7
Swept = Callable[..., tuple[RunningNode, Grid]]


@pytest.fixture(autouse=True)
def _preload() -> None:
    if not is_available() and not CONTROLLERS and "CI" not in os.environ:
        pytest.skip(f"no {PRELOAD} here; as root: apt-get install umockdev libusb-1.0-0")


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder of a short name: umockdev puts a socket there, and a socket's path holds 107 bytes."""
    with tempfile.TemporaryDirectory(prefix="fs-") as name:
        yield Path(name)


@pytest.fixture
def swept(folder: Path) -> Swept:
    """Sweeps a generated head over a kind of line; the node, and the scan as a client fetches it."""

    def sweep(link: str, *simulate: str) -> tuple[RunningNode, Grid]:
        place = folder / link
        place.mkdir()
        with ExitStack() as stack:
            chosen = [*line_of(link, place / "scanner"), "--specimen", "head", "--seed", str(SEED), *simulate]
            node = run_line(stack, place, *chosen)
            asyncio.run(fetch_scan(node.url, "latest", place / "scan.npz", moved=lambda moved, total: None))
            with open(place / "scan.npz", "rb") as file:
                return node, read_native(file)[1]

    return sweep


def line_of(link: str, path: Path) -> list[str]:
    """How a scanner is simulated: on emulated lines, but on a kernel's where it has device controllers."""
    if CONTROLLERS:
        return ["--link", {"usb": "gadget", "pty": "acm"}[link], "--path", CONTROLLERS[0]]
    return ["--link", link, "--path", str(path)]


def test_one_seed_gives_one_scan_over_a_serial_line_and_over_usb(swept: Swept) -> None:  # AT-02
    (node, serial), (_, usb) = swept("pty"), swept("usb")
    assert np.array_equal(serial.range_steps, usb.range_steps) and np.array_equal(serial.texture, usb.texture)
    assert np.array_equal(usb.range_steps, node.truth.range_steps)


def test_one_seed_gives_one_scan_of_a_jittering_encoder_too(swept: Swept) -> None:  # AT-02
    (_, serial), (_, usb) = (swept(link, "--jitter", "6") for link in ("pty", "usb"))
    assert np.array_equal(serial.range_steps, usb.range_steps) and np.array_equal(serial.texture, usb.texture)


@pytest.mark.parametrize(("link", "channels"), [("usb", "any"), ("usb", "apart"), ("pty", "apart")])
def test_a_bad_line_costs_the_scan_nothing(swept: Swept, link: str, channels: str) -> None:  # AT-03
    node, grid = swept(link, "--channels", channels, "--faults", "loss=0.05,flip=0.02,truncate=0.01,unplug=0.5")
    assert np.array_equal(grid.range_steps, node.truth.range_steps)
    assert np.array_equal(grid.texture, node.truth.texture)


def test_the_doctor_examines_a_scanner_on_usb(folder: Path) -> None:
    with started("simulate", *line_of("usb", folder / "usb"), "--turn", "0.2", "--json") as (_, ready):
        chosen = ("doctor", "--link", ready["path"], "--json")
        environment = {**os.environ, **ready.get("environment", {})}
        ran = subprocess.run(
            [*PROGRAM, *chosen], env=environment, capture_output=True, text=True, timeout=60, check=False
        )
    findings = [json.loads(line) for line in ran.stdout.splitlines()]
    assert [finding for finding in findings if finding["state"] != "ok"] == [] and ran.returncode == 0
    assert {"greeting", "a sweep", "stopping"} <= {finding["check"] for finding in findings}
