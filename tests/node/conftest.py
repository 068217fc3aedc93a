"""What tests of many files share: a scan to plan on; a capture thread and the plug of its scanner; whether
anything can be mounted."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from node.library import Scan
from tests.node.capturing import Node, Plug
from tests.node.scans import keep, make_grid
from tests.node.sealed_places import require_mounts


@pytest.fixture(scope="session")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Small, with voids; a scan never changes, so one serves all."""
    return keep(make_grid(), tmp_path_factory.mktemp("library"))


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


@pytest.fixture
def mounts() -> None:
    """Skips where nothing can be mounted."""
    require_mounts()
