from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.self_pipe import SelfPipe

LONG_S = 60


@pytest.fixture
def line() -> Iterator[tuple[int, int]]:
    """Where one reads, and where another writes."""
    ends = os.pipe()
    yield ends
    for end in ends:
        os.close(end)


def test_a_wait_ends_when_there_is_something_to_read_or_the_time_is_over(line: tuple[int, int]) -> None:
    waiting = SelfPipe(line[0])
    assert not waiting.wait(0.0) and not waiting.wait(0.01)
    os.write(line[1], b"x")
    assert waiting.wait(LONG_S) and waiting.wait(LONG_S)
    waiting.close()


def test_a_wake_ends_one_wait_the_one_that_runs_or_else_the_next(line: tuple[int, int]) -> None:
    waiting = SelfPipe(line[0])
    threading.Timer(0.05, waiting.wake).start()
    assert not waiting.wait(LONG_S)
    waiting.wake()
    os.write(line[1], b"x")
    assert not waiting.wait(LONG_S) and waiting.wait(LONG_S)
    waiting.close()


def test_once_closed_it_writes_to_nothing_that_was_opened_since(line: tuple[int, int], tmp_path: Path) -> None:
    waiting = SelfPipe(line[0])
    waiting.close()
    waiting.close()
    with open(tmp_path / "one", "wb"), open(tmp_path / "two", "wb"):  # under the numbers of the pipe
        waiting.wake()
    assert waiting.is_closed and [path.read_bytes() for path in tmp_path.iterdir()] == [b"", b""]
