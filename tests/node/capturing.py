"""A capture thread on a pseudo terminal: the scanner at its end, the plug between them, and all that was told."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from drivers.scanner import ScannerConfig, SweepEvent, SweepInterrupted, SweepProgress
from drivers.serial_port import SerialPort
from node.assemble import Assembly
from node.axes import Axes
from node.capture import Capture
from node.journal import Journals
from node.repair import undone
from node.scan_quality import ScanQuality
from protocol.grid import Grid, GridSpec
from simulators.carriers import PtyPort, serve
from simulators.faults import FaultyScanner
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable

SPEC = GridSpec(width=48, height=30, texture_width=64, texture_height=40, step_mm=0.05, pitch_mm=1.0, theta0_rad=0.3)
FAST_BAUD = 100_000_000
WAIT_S = 20.0


def truth() -> Grid:
    rng = np.random.default_rng(1)
    range_steps = rng.integers(0, 60000, (SPEC.height, SPEC.width)).astype(np.uint16)
    return Grid(SPEC, range_steps, rng.integers(0, 256, (SPEC.texture_height, SPEC.texture_width, 3)).astype(np.uint8))


TRUTH = truth()


def device(turn_s: float = 0.2, home_encoder: int = 0, **kinds: Any) -> SimulatedScanner:
    return SimulatedScanner(Turntable(Specimen("noise", TRUTH), turn_s=turn_s, home_encoder=home_encoder), **kinds)


class Plug:
    """A simulated scanner in a thread of its own, plugged in and pulled out at will."""

    def __init__(self, link: Path) -> None:
        self._link = link
        self._port: PtyPort | None = None

    def plug(self, scanner: SimulatedScanner | FaultyScanner) -> None:
        self._stop = threading.Event()
        self._port = PtyPort(self._link, FAST_BAUD)
        self._thread = threading.Thread(target=serve, args=(scanner, self._port, self._stop))
        self._thread.start()

    def pull(self) -> None:
        if self._port is not None:
            self._stop.set()
            self._port.cancel()
            self._thread.join()
            self._port.close()
            self._port = None


class Node:
    """A capture thread, its journals, and all that it told."""

    def __init__(self, link: Path, folder: Path) -> None:
        self.grids: queue.Queue[Grid] = queue.Queue()
        self.events: queue.Queue[SweepEvent] = queue.Queue()
        self.sweeps = Journals(folder)
        self.axes = Axes(folder.parent)
        self.deliver: Callable[[Grid], None] = self.grids.put
        self.qualities: list[ScanQuality] = []
        self.capture = Capture(
            lambda: SerialPort(str(link)), ScannerConfig(progress_s=0.02), self.take, self.events.put, self.sweeps,
            axes=self.axes,
        )  # fmt: skip

    def take(self, assembly: Assembly) -> None:
        self.deliver(assembly.grid)
        self.qualities.append(assembly.quality)

    def wait_for(self, kind: type[SweepEvent]) -> Any:
        while not isinstance(event := self.events.get(timeout=WAIT_S), kind):
            pass
        return event

    def wait_until(self, phase: str, why: str = "") -> None:
        end_s = time.monotonic() + WAIT_S
        while self.capture.status.phase != phase or why not in self.capture.status.why:
            assert time.monotonic() < end_s, self.capture.status
            time.sleep(0.005)

    def sweep_until_columns(self, share: float = 0.2) -> None:
        self.wait_until("ready")
        assert self.capture.request_sweep()
        while self.wait_for(SweepProgress).share < share:
            pass


def is_truth(grid: Grid) -> bool:
    """Whether this is what stood on the table; noise has spikes, so it is repaired."""
    measured = undone(grid)
    return np.array_equal(measured.range_steps, TRUTH.range_steps) and np.array_equal(grid.texture, TRUTH.texture)


def cut(plug: Plug, node: Node, scanner: SimulatedScanner) -> str:
    """A sweep that was interrupted by a pulled plug, and another scanner in its place."""
    plug.plug(device(turn_s=1.0))
    node.sweep_until_columns()
    plug.pull()
    node.wait_for(SweepInterrupted)
    plug.plug(scanner)
    node.wait_until("ready")
    (sweep,) = node.sweeps.interrupted()
    return sweep.id
