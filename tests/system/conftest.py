"""Whole nodes: the real daemon between a simulated scanner and a real client."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.system.line import RunningNode, run_line


@pytest.fixture(scope="session")
def head_node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    """A node with the generated head at S; tests only look, so one serves them all."""
    with ExitStack() as stack:
        yield run_line(stack, tmp_path_factory.mktemp("head"), "--specimen", "head")


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Callable[..., RunningNode]]:
    """Brings up a line of its own: line("--specimen", "sphere", ...)."""
    with ExitStack() as stack:
        yield lambda *simulate: run_line(stack, tmp_path, *simulate)
