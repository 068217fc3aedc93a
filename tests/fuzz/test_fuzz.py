"""A short run of the fuzzing that `foveascan bench fuzz` does at length; the same inputs every time."""

from __future__ import annotations

import os
import subprocess
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from foveascan import PROGRAM
from simulators.usb_preload import PRELOAD, is_available
from tests.fuzz.campaign import GROWN_MB_MAX
from tests.fuzz.parsers import targets
from tests.fuzz.ports import PORTS, attack
from tests.fuzz.target import Found, Target, fuzz

INPUTS, MESSAGES = 60, 600
PARTS = 8  # all parsers in one test take longer than one may where much else runs


@pytest.fixture(scope="module")
def parsers(tmp_path_factory: pytest.TempPathFactory) -> list[Target]:
    return list(targets(tmp_path_factory.mktemp("fuzz")))


@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.filterwarnings("ignore")  # of readers about bytes that are none of theirs
def test_parsers_raise_nothing_but_our_errors(parsers: list[Target], part: int) -> None:
    for target in parsers[part::PARTS]:
        fuzz(target, INPUTS)


def test_what_a_parser_may_not_raise_is_found() -> None:
    def parse(data: bytes) -> None:
        if b"\xff\xff" in data:
            raise KeyError("found")

    with pytest.raises(KeyError, match="found"):
        fuzz(Target("wrong", (b"abc",), parse), 500)
    calls = 0

    def parse_late(data: bytes) -> None:
        nonlocal calls
        calls += 1
        if calls > 100:
            raise KeyError("late")

    with pytest.raises(Found, match=r"wrong: KeyError: 'late', of b"):
        fuzz(Target("wrong", (b"abc",), parse_late), 200, drawn=10)


@pytest.mark.parametrize("port", PORTS)
def test_hostile_messages_stop_nobody(port: str) -> None:
    if port == "usb" and not is_available() and "CI" not in os.environ:
        pytest.skip(f"no {PRELOAD} here; as root: apt-get install umockdev libusb-1.0-0")
    record = attack(port, MESSAGES, 1)
    assert record["messages"] >= MESSAGES
    assert record["failures"] == [] and record["served"] > 0
    assert record["grown_mb"] <= GROWN_MB_MAX


def test_a_campaign_that_is_ended_ends_its_node() -> None:
    marker = f"FOVEASCAN_CAMPAIGN={uuid.uuid4()}"
    name, _, value = marker.partition("=")
    command = [*PROGRAM, "bench", "fuzz", "--target", "http", "--count", "10000000"]
    with subprocess.Popen(command, env={**os.environ, name: value}, stderr=subprocess.DEVNULL) as campaign:
        try:
            wait_until(lambda: any("serve" in started for started in started_with(marker)))
        finally:
            campaign.terminate()
    assert started_with(marker) == []


def started_with(marker: str) -> list[list[str]]:
    """The arguments of every process with this in its environment."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is somebody else's
            if marker.encode() in (folder / "environ").read_bytes():
                found.append((folder / "cmdline").read_text().split("\0"))
    return found


def wait_until(holds: Callable[[], bool]) -> None:
    """Wait for it, at most a minute."""
    until_s = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.1)
