"""The driver joined to a simulated scanner with known truth, in one thread and in a time of its own."""

import math
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.scanner import Scanner, ScannerConfig, SweepEvent, SweepStarted
from protocol.grid import Grid, GridSpec
from protocol.scanner_messages import Channel, RangeColumn, SweepRequest, TextureColumn
from simulators.carriers import Line, MemoryPort, clean_line
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable

W, H, WT, HT = 48, 600, 64, 400  # columns of two pieces each
SIZE_BYTES = W * H * 2 + WT * HT * 3


def specimen() -> Specimen:
    rng = np.random.default_rng(5)
    steps = rng.integers(0, 60000, (H, W)).astype(np.uint16)
    return Specimen("noise", Grid(GridSpec(W, H, WT, HT, 0.01, 1.0, theta0_rad=0.3), steps,
                                  rng.integers(0, 256, (HT, WT, 3)).astype(np.uint8)))  # fmt: skip


class Bench:
    """A scanner with known truth, its port, and the driver."""

    def __init__(
        self,
        *,
        config: ScannerConfig | None = None,
        turn_s: float = 1.0,
        jitter_counts: float = 0.0,
        home_encoder: int = 0,
        rate_bytes_s: float = math.inf,
        to_node: Line = clean_line,
        **kinds: Any,
    ) -> None:
        self.specimen = specimen()
        table = Turntable(self.specimen, turn_s=turn_s, jitter_counts=jitter_counts, home_encoder=home_encoder)
        self.device = SimulatedScanner(table, **kinds)
        self.port = MemoryPort(self.device, rate_bytes_s=rate_bytes_s, to_node=to_node)
        self.scanner = Scanner(self.port, config, clock=self.port.clock)

    def sweep(
        self,
        request: SweepRequest | None = None,
        stop: threading.Event | None = None,
        at_event: Callable[[int, SweepEvent], object] = lambda count, event: None,
    ) -> SweepEvent:
        """Runs a sweep. Returns its last event; columns go into `range_steps` and `texture`, counts into `seen`."""
        self.range_steps = np.zeros_like(self.specimen.grid.range_steps)
        self.texture = np.zeros_like(self.specimen.grid.texture)
        self.seen, self.pieces = Counter[type](), Counter[tuple[Channel, int, int, int]]()
        for count, event in enumerate(self.scanner.sweep(request or SweepRequest(), stop)):
            self.seen[type(event)] += 1
            if isinstance(event, SweepStarted):
                self.header = event.header
            elif isinstance(event, RangeColumn | TextureColumn):
                target: Any = self.range_steps if isinstance(event, RangeColumn) else self.texture
                target[event.row0 : event.row0 + event.rows, event.column] = event.samples
                self.pieces[event.CHANNEL, event.pass_index, event.column, event.row0] += 1
            at_event(count, event)
        return event

    def is_exact(self) -> bool:
        truth = self.specimen.grid
        return np.array_equal(self.range_steps, truth.range_steps) and np.array_equal(self.texture, truth.texture)


def greeted(**kinds: Any) -> Bench:
    bench = Bench(**kinds)
    bench.scanner.hello()
    return bench


DAMAGES = ["lose", "flip", "noise", "twice", "gone"]


class Damage:
    """A line that spoils some of its portions, the same ones every time."""

    def __init__(self, share: float, kinds: list[str], seed: int = 3) -> None:
        self.rng, self.share, self.kinds = np.random.default_rng(seed), share, kinds

    def __call__(self, data: bytes) -> bytes:
        if not data or self.rng.random() > self.share:
            return data
        at = int(self.rng.integers(len(data)))
        match self.rng.choice(self.kinds):
            case "lose":
                return data[:at] + data[at + 40 :]
            case "flip":
                return data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :]
            case "noise":
                return data[:at] + self.rng.bytes(50) + data[at:]
            case "twice":
                return data + data
        return b""


def already_set() -> threading.Event:
    stop = threading.Event()
    stop.set()
    return stop
