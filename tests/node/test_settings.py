"""Settings that are read reach the part that goes by them: what is set, and what is not."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import aiohttp
import numpy as np
import pytest

from client import connect
from drivers.discover import config_for
from drivers.port import Port
from drivers.scanner import ScannerConfig
from drivers.serial_port import SerialPort
from node import daemon
from node.config import Capture, Config, Discovery, FirstView, Library, Server
from node.daemon import start_node
from node.derive import Derivation
from node.repair import undone
from protocol.grid import Grid, GridSpec
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable
from tests.node.capturing import WAIT_S, Plug

OTHER_BAUD, OTHER_STALE_S, OTHER_BYTES = 921_600, 7.5, 1024


def noise() -> Grid:
    """Full of spikes, and of so much detail that a first view takes what it may."""
    rng = np.random.default_rng(1)
    spec = GridSpec(width=160, height=96, texture_width=256, texture_height=128, step_mm=0.05, pitch_mm=1.0)
    texture = rng.integers(0, 256, (spec.texture_height, spec.texture_width, 3)).astype(np.uint8)
    return Grid(spec, rng.integers(20000, 40000, (spec.height, spec.width)).astype(np.uint16), texture)


TRUTH = noise()


@dataclass
class Seen:
    """What the parts of one node were told, and what it made of a sweep."""

    bauds: set[int] = field(default_factory=set)
    quiet_s: list[float] = field(default_factory=list)
    announced: list[str] = field(default_factory=list)
    considered: list[str] = field(default_factory=list)
    scan: str = ""
    grid: Grid | None = None
    first_view_bytes: int = 0


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Seen:
    """The node's own parts, at work, with what they are told written down."""
    seen = Seen()

    def open_port(address: str, baud: int) -> Port:
        seen.bauds.add(baud)
        return SerialPort(address, baud)

    def told(address: str, quiet_s: float) -> ScannerConfig:
        seen.quiet_s.append(quiet_s)
        return config_for(address, quiet_s)

    @asynccontextmanager
    async def announced(name: str, *rest: object) -> AsyncIterator[None]:
        seen.announced.append(name)
        yield

    monkeypatch.setattr(daemon, "open_port", open_port)
    monkeypatch.setattr(daemon, "config_for", told)
    monkeypatch.setattr(daemon, "Advertisement", announced)
    monkeypatch.setattr(Derivation, "consider", lambda self, scan: seen.considered.append(scan))
    return seen


async def sweep_once(config: Config, seen: Seen) -> None:
    """A node with these settings, swept once by a client, and what its first view takes over HTTP."""
    async with asyncio.timeout(WAIT_S * 3):
        async with aiohttp.ClientSession() as http, AsyncExitStack() as stack:
            node = await start_node(config, stack)
            async with connect(node.url) as session:
                published = session.published()
                while (await (await http.get(f"{node.url}/v1/node")).json())["capture"]["phase"] != "ready":
                    await asyncio.sleep(0.02)
                await session.start_sweep()
                seen.scan = await anext(published)
            answer = await http.get(f"{node.url}/v1/scans/{seen.scan}/coarse")
            seen.first_view_bytes = len(await answer.read())
            seen.grid = node.exhibits.library.open(seen.scan).grid


def config(folder: Path, capture: Capture, first_view: FirstView, spheres: bool, discovery: Discovery) -> Config:
    return Config(
        capture=capture, server=Server(listen="127.0.0.1:0", insecure=True), first_view=first_view,
        library=Library(str(folder / "library"), spheres), discovery=discovery,
    )  # fmt: skip


async def test_a_node_goes_by_its_defaults(plug: Plug, tmp_path: Path, seen: Seen) -> None:
    plug.plug(SimulatedScanner(Turntable(Specimen("noise", TRUTH), turn_s=0.2)))
    capture = Capture(scanner=str(tmp_path / "tty"))
    await sweep_once(config(tmp_path, capture, FirstView(), True, Discovery(name="room 2")), seen)
    assert seen.bauds == {3_000_000} and seen.quiet_s == [2.0]
    assert seen.grid is not None and seen.grid.repairs.size, "noise has spikes"
    assert np.array_equal(undone(seen.grid).range_steps, TRUTH.range_steps)
    assert OTHER_BYTES < seen.first_view_bytes <= 32768
    assert seen.considered == [seen.scan] and seen.announced == ["room 2"]


async def test_a_node_goes_by_what_is_set_instead(plug: Plug, tmp_path: Path, seen: Seen) -> None:
    plug.plug(SimulatedScanner(Turntable(Specimen("noise", TRUTH), turn_s=0.2)))
    capture = Capture(str(tmp_path / "tty"), baud=OTHER_BAUD, stale_s=OTHER_STALE_S, repair=False)
    await sweep_once(config(tmp_path, capture, FirstView(OTHER_BYTES), False, Discovery(enabled=False)), seen)
    assert seen.bauds == {OTHER_BAUD} and seen.quiet_s == [OTHER_STALE_S]
    assert seen.grid is not None and not seen.grid.repairs.size
    assert np.array_equal(seen.grid.range_steps, TRUTH.range_steps), "as it was measured"
    assert 0 < seen.first_view_bytes <= OTHER_BYTES
    assert seen.considered == [] and seen.announced == []
