"""What carries a simulated scanner's bytes: memory with a time of its own, or a pty as slow as its baud rate."""

from __future__ import annotations

import math
import os
import select
import threading
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from protocol.errors import PortLost
from simulators.faults import Unplugged
from simulators.pace import Pace

_READ_BYTES = 65536
PORTION_BYTES = 3000  # handed to the line at once; with a frame more, a pty takes it whole
_BITS_PER_BYTE = 10  # start, eight data, stop



class Device(Protocol):
    """The end of a line that a carrier serves: a SimulatedScanner, or one with faults on the way.

    portion_bytes : most bytes that arrive at once, if that is bounded.
    """

    portion_bytes: int | None

    def receive_data(self, data: bytes, now_s: float) -> None:
        """Take bytes from the node."""
        ...

    def step(self, now_s: float) -> None:
        """Let the time become now_s."""
        ...

    def data_to_send(self, max_bytes: int) -> bytes:
        """About `max_bytes` for the node. Raises Unplugged."""
        ...

    def wait_s(self, now_s: float) -> float:
        """How long it can do without being stepped. [s]"""
        ...


class ServedPort(Protocol):
    """The device's end of a carrier: a PtyPort, a TcpListener, a UsbTestbed, a UsbDouble."""

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """What the node wrote; b"" when the time is over or `cancel` was called."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of `data`."""
        ...

    def hang_up(self) -> None:
        """Pull the plug."""
        ...

    def plug_in(self) -> None:
        """Put it in again."""
        ...

    def cancel(self) -> None:
        """Wake whoever reads or writes."""
        ...


Line = Callable[[bytes], bytes]


def clean_line(data: bytes) -> bytes:
    """A line that changes nothing."""
    return data


class MemoryPort:
    """The node's port to a simulated scanner in the same thread, in a time that passes only while somebody reads.

    `clock` tells that time. rate_bytes_s : speed towards the node.  to_node, to_scanner : what happens to bytes on the
    way, for lines that lose or change some. Satisfies drivers.port.Port.
    """

    name = "memory"

    def __init__(
        self,
        scanner: Device,
        *,
        rate_bytes_s: float = math.inf,
        step_s: float = 0.005,
        to_node: Line = clean_line,
        to_scanner: Line = clean_line,
    ) -> None:
        self._scanner = scanner
        self._portion_bytes = int(min(rate_bytes_s * step_s, _READ_BYTES))
        self._step_s = step_s
        self._to_node, self._to_scanner = to_node, to_scanner
        self._now_s = 0.0
        self._arrived = b""
        self._is_cancelled = threading.Event()
        self._is_unplugged = False

    def clock(self) -> float:
        """The time on this port. [s]"""
        return self._now_s

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read; time passes in steps until bytes arrive or `timeout_s` is over."""
        until_s = self._now_s + timeout_s
        if not self._arrived:
            self._check_plugged()
        while not self._arrived and self._now_s < until_s and not self._is_cancelled.is_set():
            self._pass_time(min(self._step_s, until_s - self._now_s))
        self._is_cancelled.clear()
        size = min(max_bytes, self._scanner.portion_bytes or max_bytes)
        data, self._arrived = self._arrived[:size], self._arrived[size:]
        return data

    def write(self, data: bytes) -> None:
        """As Port.write."""
        self._check_plugged()
        self._scanner.receive_data(self._to_scanner(data), self._now_s)

    def cancel(self) -> None:
        """As Port.cancel."""
        self._is_cancelled.set()

    def close(self) -> None:
        """As Port.close."""
        self._is_unplugged = True

    def unplug(self) -> None:
        """Pull the plug: every later use raises PortLost."""
        self._is_unplugged = True

    def replugged(self, after_s: float = 0.0) -> MemoryPort:
        """A new port to the same scanner, so much later."""
        port = MemoryPort(self._scanner, step_s=self._step_s, to_node=self._to_node, to_scanner=self._to_scanner)
        port._portion_bytes, port._now_s = self._portion_bytes, self._now_s + after_s
        return port

    def _pass_time(self, dt_s: float) -> None:
        before_s, self._now_s = self._now_s, self._now_s + dt_s
        if self._now_s == before_s:  # a step too short for the clock to show
            self._now_s = math.nextafter(before_s, math.inf)
        if self._is_unplugged:
            return
        self._scanner.step(self._now_s)
        try:
            data = self._scanner.data_to_send(self._portion_bytes)
        except Unplugged as pulled:
            data, self._is_unplugged = pulled.data, True
        self._arrived += self._to_node(data)

    def _check_plugged(self) -> None:
        if self._is_unplugged:
            raise PortLost(f"{self.name}: unplugged")


class TerminalPort:
    """The scanner's end of a serial line: a terminal that an heir opens, read and written at the pace of a rate."""

    def __init__(self, name: str, rate_bytes_s: float) -> None:
        self.name = name
        self._pace = Pace(rate_bytes_s)
        self._wake_read, self._wake_write = os.pipe()
        self._master = -1  # while the plug is out

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read."""
        ready, _, _ = select.select([self._master, self._wake_read], [], [], max(timeout_s, 0.0))
        if self._wake_read in ready:
            os.read(self._wake_read, 1)
        return os.read(self._master, max_bytes) if self._master in ready else b""

    def write(self, data: bytes) -> None:
        """Send `data` at the pace of the line; waits while nobody reads, until `cancel`. (A new reader starts by
        emptying the line, so this waits for it at longest.)"""
        rest = memoryview(data)
        while rest:
            woken, _, _ = select.select([self._wake_read], [self._master], [])
            if woken:
                return
            with suppress(BlockingIOError):
                rest = rest[os.write(self._master, rest) :]
        self._pace.wait(len(data))

    def cancel(self) -> None:
        """As Port.cancel."""
        os.write(self._wake_write, b"x")

    def hang_up(self) -> None:
        """Pull the plug."""
        raise NotImplementedError

    def close(self) -> None:
        """Hang up for good."""
        if self._master >= 0:
            self.hang_up()
        for descriptor in (self._wake_read, self._wake_write):
            os.close(descriptor)


class PtyPort(TerminalPort):
    """The scanner's end of a pseudo terminal that lets bytes through no faster than a serial line of `baud`.

    link_path : a symbolic link that leads to the node's end; it exists as long as this is open.
    """

    def __init__(self, link_path: Path, baud: int = 3_000_000) -> None:
        _check_free(link_path)
        super().__init__(str(link_path), baud / _BITS_PER_BYTE)
        self._link_path = link_path
        self._slave = -1
        self.plug_in()

    def plug_in(self) -> None:
        """Make a line and the link that leads to it."""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self._target = os.ttyname(self._slave)
        _replace_link(self._link_path, self._target)

    def hang_up(self) -> None:
        """What pulling the plug looks like: the line is gone, and so is the link."""
        with suppress(OSError):
            if os.readlink(self._link_path) == self._target:
                os.unlink(self._link_path)
        for descriptor in (self._master, self._slave):
            os.close(descriptor)
        self._master = self._slave = -1


def serve(scanner: Device, port: ServedPort, stop: threading.Event, portion_bytes: int = PORTION_BYTES) -> None:
    """Run a scanner on a port until `stop` is set (and the port's `cancel` called, to be heard at once)."""
    while not stop.is_set():
        now_s = time.monotonic()
        data = port.read(_READ_BYTES, scanner.wait_s(now_s))
        now_s = time.monotonic()
        if data:
            scanner.receive_data(data, now_s)
        scanner.step(now_s)
        try:
            _write(port, scanner.data_to_send(portion_bytes), scanner.portion_bytes)
        except Unplugged as pulled:
            port.write(pulled.data)
            port.hang_up()
            stop.wait(pulled.away_s)
            port.plug_in()


def _write(port: ServedPort, data: bytes, portion_bytes: int | None) -> None:
    """Whole frames, unless in portions: where this process is kept waiting, its line pauses between frames."""
    for at in range(0, len(data), portion_bytes or len(data) or 1):
        port.write(data[at : at + (portion_bytes or len(data))])


def _check_free(path: Path) -> None:
    """Raise FileExistsError where something stands that no scanner left behind."""
    if os.path.lexists(path) and not path.is_symlink():
        raise FileExistsError(f"{path} exists and is no symbolic link; choose another path")


def _replace_link(path: Path, target: str) -> None:
    """Make `path` a symbolic link to `target`, in one step."""
    fresh = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        os.symlink(target, fresh)
        os.replace(fresh, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error  # not what it leads to
