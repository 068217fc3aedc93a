"""A capture thread and the plug of its scanner, for the tests of both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.node.capturing import Node, Plug


@pytest.fixture
def plug(tmp_path: Path) -> Iterator[Plug]:
    plug = Plug(tmp_path / "tty")
    yield plug
    plug.pull()


@pytest.fixture
def node(tmp_path: Path, plug: Plug) -> Iterator[Node]:
    node = Node(tmp_path / "tty", tmp_path / "sweeps")
    node.capture.start()
    yield node
    node.capture.stop()
