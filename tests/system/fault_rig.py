"""One sweep as the node's capture makes it, over any carrier, and how it ended: for the fault matrix and the soak.

In memory, time is the carrier's own and nothing waits; on a pty or USB a thread serves the scanner in real time.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from drivers.discover import open_port
from drivers.port import Port
from drivers.scanner import Scanner, ScannerConfig, SweepEvent, SweepFinished, SweepInterrupted, SweepStarted
from drivers.serial_port import SerialPort
from drivers.sweep import SweepReport
from drivers.tcp_port import TcpPort
from drivers.usb_port import UsbAddress, UsbPort
from node.assemble import Assembler, Assembly
from node.journal import Interrupted, Journal, Journals
from node.resume import add_column, assembler_of
from node.turns import TurnEvents, TurnStarted, gone_on, swept
from protocol.errors import DriverError, PortLost
from protocol.framing import USB_PAYLOAD_MAX
from protocol.grid import Grid, GridSpec
from protocol.scanner_messages import Channel, Column, DeviceInfo, Order, RangeColumn, SweepRequest, TextureColumn
from simulators.carriers import MemoryPort, PtyPort, ServedPort, serve
from simulators.faults import FaultyScanner, parse_faults
from simulators.scanner import ANY_CHANNELS, SimulatedScanner
from simulators.specimen import Specimen
from simulators.tcp_carrier import TcpListener
from simulators.turntable import Turntable
from simulators.usb_descriptors import CDC_IDENTITY, UsbIdentity
from simulators.usb_double import UsbDouble
from tests.system.usb_bed import CONTROLLERS, acm_bed, usb_bed

SPEC = GridSpec(48, 520, 96, 360, 0.01, 0.5)  # two pieces in each column, on serial
OVERLAP = 64
REQUEST = SweepRequest(overlap=OVERLAP)
PLUG_INS_MAX = 8
LOOKS_MAX, LOOK_S = 300, 0.1  # for a plug that is out; an emulated machine takes seconds to see it again
QUIET_S = 2.0 if CONTROLLERS else 0.8  # as a node has it, where a machine may be an emulated one
USB_CONFIG = ScannerConfig(quiet_s=QUIET_S, payload_max=USB_PAYLOAD_MAX, window_bytes=1 << 20)

Kind = Literal["scan", "interrupted", "refused"]


def bumpy(spec: GridSpec = SPEC) -> Specimen:
    """An object without symmetry, smooth enough to be seen between two columns, drawn at any size."""
    u, v = (np.arange(spec.width) + 0.5) / spec.width, np.arange(spec.height)[:, None] / spec.height
    shape = 5000 + 60 * np.sin(2 * np.pi * (u + v)) + 40 * np.cos(2 * np.pi * 2 * u) + 200 * v
    ut = (np.arange(spec.texture_width) + 0.5) / spec.texture_width
    vt = np.arange(spec.texture_height)[:, None] / spec.texture_height
    tones = (np.sin(2 * np.pi * (k * ut + (k % 2) * vt)) for k in (1, 3, 2))
    texture = np.stack([np.rint(120 + 90 * tone + 0 * vt) for tone in tones], axis=2)
    return Specimen("bumpy", Grid(spec, np.rint(shape).astype(np.uint16), texture.astype(np.uint8)))


@dataclass
class Bench:
    """A scanner with faults, and what the node needs to sweep with it."""

    faults: str
    seed: int
    folder: Path
    jitter_counts: float = 0.0
    specimen: Specimen = field(default_factory=bumpy)
    serial_number: str = "SIM-0001"
    turn_s: float = 0.1
    order: Order = Order.LIVE
    retention_columns: int = 65535
    payload_max: int = 1024
    place: int = 1  # where on the bus it is plugged in
    channels: tuple[Channel, ...] = ANY_CHANNELS  # what one turn takes

    def scanner(self) -> FaultyScanner:
        """The device on its bad day."""
        faults, flaws = parse_faults(self.faults, self.seed)

        def boot(boot_id: int) -> SimulatedScanner:
            table = Turntable(
                self.specimen, turn_s=self.turn_s, jitter_counts=self.jitter_counts, seed=self.seed, flaws=flaws
            )
            return SimulatedScanner(
                table, serial_number=self.serial_number, boot_id=boot_id, order=self.order,
                retention_columns=self.retention_columns, payload_max=self.payload_max, channels=self.channels,
            )  # fmt: skip

        return FaultyScanner(boot, faults, self.seed)


@dataclass
class Line:
    """How the node reaches the scanner, and by which clock."""

    open_port: Callable[[], Port]
    clock: Callable[[], float]
    wait: Callable[[float], object]
    config: ScannerConfig


@contextmanager
def memory(bench: Bench) -> Iterator[Line]:
    """A line in memory, in a time of its own."""
    ports = [MemoryPort(bench.scanner(), rate_bytes_s=2e6)]
    opened: list[MemoryPort] = []

    def open_port() -> MemoryPort:
        if opened:
            ports.append(ports[-1].replugged(after_s=0.2))
        opened.append(ports[-1])
        return ports[-1]

    yield Line(open_port, lambda: ports[-1].clock(), lambda wait_s: None, ScannerConfig())


@contextmanager
def pty(bench: Bench) -> Iterator[Line]:
    """A pseudo terminal as fast as the machine allows, served by a thread."""
    path = bench.folder / f"{bench.serial_number}.tty"
    with closing(PtyPort(path, 100_000_000)) as port, _served(bench, port):
        yield Line(lambda: SerialPort(str(path)), time.monotonic, time.sleep, ScannerConfig(quiet_s=QUIET_S))


@contextmanager
def tcp(bench: Bench) -> Iterator[Line]:
    """A TCP connection on this machine."""
    config = replace(USB_CONFIG, window_bytes=1 << 16)
    with closing(TcpListener(("127.0.0.1", 0))) as port, _served(replace(bench, payload_max=USB_PAYLOAD_MAX), port):
        yield Line(lambda: TcpPort(port.name), time.monotonic, time.sleep, config)


@contextmanager
def usb_double(bench: Bench) -> Iterator[Line]:
    """The driver for USB on a double of pyusb's backend."""
    double = UsbDouble(UsbIdentity(serial_number=bench.serial_number))
    with _served(replace(bench, payload_max=USB_PAYLOAD_MAX), double):
        address = UsbAddress(double.identity.vendor, double.identity.product, bench.serial_number)
        yield Line(lambda: UsbPort(address, double), time.monotonic, time.sleep, USB_CONFIG)


@contextmanager
def usb(bench: Bench) -> Iterator[Line]:
    """The driver for USB on the real libusb, with an emulated device or a gadget: see usb_bed.py."""
    if bench.faults == "dribble=1":  # every transfer costs the emulation a millisecond
        bench = replace(bench, faults="dribble=100")
    identity = UsbIdentity(serial_number=bench.serial_number)
    bench = replace(bench, payload_max=USB_PAYLOAD_MAX)
    with closing(usb_bed(identity, place=bench.place)) as bed, _served(bench, bed):
        address = UsbAddress.parse(f"{bed.identity.address}:{bench.serial_number}")
        yield Line(lambda: UsbPort(address), time.monotonic, time.sleep, USB_CONFIG)


@contextmanager
def acm(bench: Bench) -> Iterator[Line]:
    """A serial port on real USB; only where there is a device controller."""
    identity = replace(CDC_IDENTITY, serial_number=bench.serial_number)
    with closing(acm_bed(identity, bench.place)) as gadget, _served(bench, gadget):
        address = f"{gadget.name}:{bench.serial_number}"
        yield Line(lambda: open_port(address), time.monotonic, time.sleep, ScannerConfig(quiet_s=QUIET_S))


@contextmanager
def _served(bench: Bench, port: ServedPort) -> Iterator[None]:
    """A thread that runs the scanner at the far end of a line."""
    stop = threading.Event()
    thread = threading.Thread(target=serve, args=(bench.scanner(), port, stop))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        port.cancel()
        thread.join(20)
        assert not thread.is_alive()


@dataclass
class Ending:
    """What became of a sweep. kept : the sweeps that lie on disk, cut.  turns : which channel each of them took."""

    kind: Kind
    why: str = ""
    report: SweepReport = field(default_factory=SweepReport)
    assembly: Assembly | None = None
    kept: list[Interrupted] = field(default_factory=list)
    resumed: int = 0
    turns: list[Channel] = field(default_factory=list)

    def equals(self, truth: Grid) -> bool:
        """Whether this is a scan, and the same as without any fault."""
        grid = self.assembly.grid if self.assembly is not None else None
        return (
            grid is not None
            and np.array_equal(grid.range_steps, truth.range_steps)
            and np.array_equal(grid.texture, truth.texture)
        )


class Capturing:
    """What node.capture does with one sweep: hello, sweep, journal, go on after the plug was out, assemble."""

    def __init__(self, line: Line, folder: Path, request: SweepRequest = REQUEST) -> None:
        self._line = line
        self._request = request
        self._journals = Journals(folder / "sweeps")
        self._journal: Journal | None = None
        self._assembler: Assembler | None = None
        self._held: list[Column] = []
        self._cut: tuple[DeviceInfo, Any] | None = None
        self._turn: TurnStarted | None = None
        self._ending = Ending("refused")

    def run(self) -> Ending:
        """One sweep, to its end."""
        for _ in range(PLUG_INS_MAX):
            try:
                if self._once():
                    break
            except PortLost as lost:
                self._ending.why = str(lost)
            except DriverError as error:
                self._ending.why = str(error)
                break
        if self._journal is not None:
            self._journals.keep(self._journal, self._ending.why)
        self._ending.kept = self._journals.interrupted()
        return self._ending

    def _once(self) -> bool:
        """Open the port and sweep, or go on sweeping. Returns whether that was the end of it. Raises DriverError."""
        with closing(self._plugged_in()) as port:
            scanner = Scanner(port, self._line.config, clock=self._line.clock)
            info = scanner.hello()
            if self._cut is None:
                return self._follow(swept(scanner, self._request, threading.Event(), apart=False), info)
            before, header = self._cut
            if (before.serial_number, before.boot_id) != (info.serial_number, info.boot_id):
                self._ending.why = "another boot"
                return True
            self._ending.resumed += 1
            held = list(self._held)
            if self._turn is None:
                return self._follow(scanner.resume(header, held), info)
            return self._follow(gone_on(scanner, header, self._turn, held, threading.Event(), anew=False), info)

    def _plugged_in(self) -> Port:
        """The port, once it is there. Raises DriverError."""
        for _ in range(LOOKS_MAX):
            with suppress(PortLost):
                return self._line.open_port()
            self._line.wait(LOOK_S)
        return self._line.open_port()

    def _follow(self, events: TurnEvents | Generator[SweepEvent, None, None], info: DeviceInfo) -> bool:
        for event in events:
            match event:
                case TurnStarted(turn):
                    assert self._journal is not None
                    self._journal.begin_turn(event)
                    self._turn = event
                    self._ending.turns.append(turn.channels)
                case SweepStarted(header) if self._journal is None:
                    self._journal = self._journals.begin(info, header, time.time())
                    self._assembler = assembler_of(header)
                    self._cut, self._ending.kind = (info, header), "interrupted"
                case RangeColumn() | TextureColumn():
                    assert self._journal is not None and self._assembler is not None
                    self._journal.add(event)
                    self._held.append(event)
                    add_column(self._assembler, event)
                case SweepInterrupted(reason, cause, report):
                    self._ending.why, self._ending.report = reason, report
                    if isinstance(cause, PortLost):
                        raise cause
                case SweepFinished(report):
                    self._finish(report)
        return True

    def _finish(self, report: SweepReport) -> None:
        assert self._journal is not None and self._assembler is not None
        assembly = self._assembler.assembly(apart=self._turn is not None)
        self._ending = replace(self._ending, kind="scan", why="", report=report, assembly=assembly)
        self._journal.close()
        self._journals.discard(self._journal)
        self._journal = None
