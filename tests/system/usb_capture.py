"""The node's capture thread on USB, as pytest; run by test_usb.py under umockdev's preload, nightly on a kernel."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from drivers.discover import config_for, open_port
from drivers.scanner import SweepEvent, SweepInterrupted
from node.assemble import Assembly
from node.capture import Capture
from node.journal import Journals
from protocol.framing import USB_PAYLOAD_MAX
from protocol.grid import Grid
from protocol.scanner_messages import RangeColumn, TextureColumn
from simulators.carriers import serve
from tests.system.fault_rig import Bench
from tests.system.usb_bed import usb_bed

AWAY_S = 0.6
RECOVERED_S = 20.0  # two seconds on a machine that is not loaded: `foveascan bench capture` measures it
WAIT_S = 20.0

Told = list[tuple[float, SweepEvent]]


@contextmanager
def scanner(bench: Bench) -> Iterator[str]:
    """The device, served by a thread; the address the node opens."""
    stop = threading.Event()
    with closing(usb_bed(rate_bytes_s=1e6)) as bed:
        thread = threading.Thread(target=serve, args=(bench.scanner(), bed, stop))
        thread.start()
        try:
            yield f"{bed.identity.address}:{bed.identity.serial_number}"
        finally:
            stop.set()
            bed.cancel()
            thread.join(10)


@contextmanager
def capturing(address: str, folder: Path) -> Iterator[tuple[Capture, queue.Queue[Grid], Told]]:
    """A capture thread, the grids it delivers, and everything it tells, with the time."""
    grids: queue.Queue[Grid] = queue.Queue()
    told: Told = []

    def watch(event: SweepEvent) -> None:
        told.append((time.monotonic(), event))

    def deliver(assembly: Assembly) -> None:
        grids.put(assembly.grid)

    capture = Capture(lambda: open_port(address), config_for(address), deliver, watch, Journals(folder))
    capture.start()
    try:
        while capture.status.phase != "ready":
            time.sleep(0.01)
        yield capture, grids, told
    finally:
        capture.stop()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_sweep_goes_on_soon_after_the_plug_came_back(seed: int, tmp_path: Path) -> None:
    bench = Bench(f"unplug={AWAY_S}", seed, tmp_path, turn_s=0.3, payload_max=USB_PAYLOAD_MAX)
    with scanner(bench) as address, capturing(address, tmp_path / "sweeps") as (capture, grids, told):
        assert capture.request_sweep()
        grid = grids.get(timeout=WAIT_S)
    truth = bench.specimen.grid
    assert np.array_equal(grid.range_steps, truth.range_steps) and np.array_equal(grid.texture, truth.texture)
    (cut_s,) = [at_s for at_s, event in told if isinstance(event, SweepInterrupted)]
    again_s = min(at for at, event in told if at > cut_s and isinstance(event, RangeColumn | TextureColumn))
    assert again_s - (cut_s + AWAY_S) < RECOVERED_S


def test_a_device_that_starts_anew_leaves_a_cut_sweep_and_can_sweep_again(tmp_path: Path) -> None:
    bench = Bench("reset", 3, tmp_path, turn_s=0.3, payload_max=USB_PAYLOAD_MAX)
    with scanner(bench) as address, capturing(address, tmp_path / "sweeps") as (capture, grids, told):
        assert capture.request_sweep()
        until_s = time.monotonic() + WAIT_S
        while not any(isinstance(event, SweepInterrupted) for _, event in told) and time.monotonic() < until_s:
            time.sleep(0.02)
        while not capture.request_sweep() and time.monotonic() < until_s:
            time.sleep(0.02)
        grid = grids.get(timeout=WAIT_S)
    assert np.array_equal(grid.range_steps, bench.specimen.grid.range_steps)
    (kept,) = Journals(tmp_path / "sweeps").interrupted()
    assert not kept.is_complete
