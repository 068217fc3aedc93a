"""A short run of the fuzzing that `foveascan bench fuzz` does at length; the same inputs every time."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.fuzz.campaign import GROWN_MB_MAX
from tests.fuzz.parsers import Target, fuzz, targets
from tests.fuzz.ports import PORTS, attack

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


@pytest.mark.parametrize("port", PORTS)
def test_hostile_messages_stop_nobody(port: str, tmp_path: Path) -> None:
    record = attack(port, MESSAGES, 1)
    assert record["messages"] >= MESSAGES
    assert record["failures"] == [] and record["served"] > 0
    assert record["grown_mb"] <= GROWN_MB_MAX
