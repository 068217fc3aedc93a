"""A short run of the fuzzing that `foveascan bench fuzz` does at length; the same inputs every time."""

from __future__ import annotations

import os

import pytest

from simulators.usb_testbed import PRELOAD, is_available
from tests.fuzz.campaign import GROWN_MB_MAX
from tests.fuzz.parsers import targets
from tests.fuzz.ports import PORTS, attack
from tests.fuzz.target import Found, Target, fuzz

INPUTS, MESSAGES = 60, 600


@pytest.fixture(scope="module")
def parsers(tmp_path_factory: pytest.TempPathFactory) -> list[Target]:
    return list(targets(tmp_path_factory.mktemp("fuzz")))


@pytest.mark.filterwarnings("ignore")  # of readers about bytes that are none of theirs
def test_parsers_raise_nothing_but_our_errors(parsers: list[Target]) -> None:
    for target in parsers:
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
