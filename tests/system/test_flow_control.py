"""A sweep beside clients that look as fast as they can, and a table that waits for a node that cannot keep up."""

from __future__ import annotations

import asyncio
import math
import queue
import random
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from client import Session, connect
from client.errors import NodeLost
from client.transfer import fetch_scan
from exchange.native import read_native
from node import background_writer
from node.assemble import Assembly
from node.capture import Capture
from node.journal import Journals
from simulators.faults import FaultyScanner
from tests.system.fault_rig import Bench, Line, bumpy, pty, usb
from tests.system.line import RunningNode
from tests.system.test_soak import S
from tests.system.usb_bed import HAS_USB

CLIENTS = 16
WINDOW_BYTES = 16384
STANDS_S = 0.5  # a table that waits no longer may only wait for its turn
CARRIERS = {"usb": usb} if HAS_USB else {"pty": pty}  # usb: in the process that test_usb.py starts


async def look_on(url: str, number: int) -> None:
    rng = random.Random(number)
    async with connect(url) as session:
        await session.open()
        while True:
            await session.look(rng.random(), rng.random())


async def sweep_beside(url: str) -> tuple[str, int]:
    """A sweep while 16 clients look: the scan, and how many columns the node asked for again."""
    async with connect(url) as session:
        published = session.published()
        looking = [asyncio.create_task(look_on(url, number)) for number in range(CLIENTS)]
        try:
            await until_updated(session, looking)
            await session.start_sweep()
            async with asyncio.timeout(120):
                async for scan in published:
                    if (quality := await session.quality(scan)) is not None:  # else a sphere made of an earlier sweep
                        break
        finally:
            for task in looking:
                task.cancel()
            ended = await asyncio.gather(*looking, return_exceptions=True)
        assert all(isinstance(end, asyncio.CancelledError | NodeLost) for end in ended), ended
    assert quality is not None and quality.dropped_bytes == 0
    return scan, quality.requested_columns


async def until_updated(session: Session, looking: list[asyncio.Task[None]]) -> None:
    """Let the clients come in before the sweep begins."""
    await session.open()
    for _ in range(20):
        await session.look(random.random(), random.random())
    assert not any(task.done() for task in looking)


@pytest.mark.skipif(HAS_USB, reason="the daemon is a process of its own")
def test_sixteen_clients_that_look_cost_a_sweep_no_column(line: Callable[..., RunningNode], tmp_path: Path) -> None:
    node = line("--specimen", "sphere", "--size", "S")
    scan, requested = asyncio.run(sweep_beside(node.url))
    assert requested == 0
    asyncio.run(fetch_scan(node.url, scan, tmp_path / "scan.npz", moved=lambda moved, total: None))
    with open(tmp_path / "scan.npz", "rb") as file:
        assert np.array_equal(read_native(file)[1].range_steps, node.truth.range_steps)


class Watched(FaultyScanner):
    """A scanner that says when its table stands in a sweep because there is no credit."""

    def __init__(self, plain: FaultyScanner, seed: int) -> None:
        super().__init__(plain._boot, plain._faults, seed)
        self.stands = threading.Event()
        self._since_s = math.inf

    def step(self, now_s: float) -> None:
        """As SimulatedScanner.step."""
        self._since_s = min(self._since_s, now_s) if self.device._is_starved() else math.inf
        if now_s - self._since_s > STANDS_S:
            self.stands.set()
        super().step(now_s)


@pytest.mark.parametrize("carrier", CARRIERS)
def test_a_disk_slower_than_the_line_stops_the_table_and_loses_nothing(
    carrier: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    append = background_writer.append_whole
    scanners: list[Watched] = []
    waits: list[bool] = []

    def slowly(file: int, piece: bytes) -> None:
        if not waits:
            waits.append(scanners[0].stands.wait(60))
        append(file, piece)

    monkeypatch.setattr(background_writer, "append_whole", slowly)
    monkeypatch.setattr(background_writer, "WAITING_BYTES_MAX", 1 << 16)

    class Slow(Bench):
        def scanner(self) -> FaultyScanner:
            scanners.append(Watched(super().scanner(), self.seed))
            return scanners[-1]

    made: queue.Queue[Assembly] = queue.Queue()
    bench = Slow("", 1, tmp_path, specimen=bumpy(S))
    with CARRIERS[carrier](bench) as running:
        assembly = swept(running, made, tmp_path)
    assert waits == [True]
    assert np.array_equal(assembly.grid.range_steps, bench.specimen.grid.range_steps)
    assert np.array_equal(assembly.grid.texture, bench.specimen.grid.texture)
    assert (assembly.quality.requested_columns, assembly.quality.dropped_bytes) == (0, 0)


def swept(running: Line, made: queue.Queue[Assembly], folder: Path) -> Assembly:
    config = replace(running.config, window_bytes=WINDOW_BYTES)  # less than the line itself holds
    capture = Capture(running.open_port, config, made.put, sweeps=Journals(folder / "sweeps"))
    capture.start()
    try:
        while not capture.request_sweep():
            time.sleep(0.01)
        return made.get(timeout=90)
    finally:
        capture.stop()
