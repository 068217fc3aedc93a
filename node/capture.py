"""The one thread that owns the scanner: it connects, sweeps when asked, assembles, and hands over finished grids.

A lost port or a faulty scanner never ends the thread: it tries again, ever more slowly.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from drivers.port import Port
from drivers.scanner import (
    Scanner,
    ScannerConfig,
    SweepEvent,
    SweepFinished,
    SweepInterrupted,
    SweepProgress,
    SweepReport,
    SweepStarted,
)
from node.assemble import Assembler, Encoder
from protocol.errors import DriverError, FoveascanError, PortLost, RemoteWireError, ScannerFault
from protocol.grid import Grid
from protocol.scanner_messages import RangeColumn, SweepHeader, SweepRequest, TextureColumn

log = logging.getLogger(__name__)

BACKOFF_S = (0.5, 8.0)
LISTEN_S = 1.0

Phase = Literal["no scanner", "connecting", "ready", "sweeping", "stopped"]


@dataclass(frozen=True, slots=True)
class CaptureStatus:
    """What the scanner is doing. progress: share of the sweep that is in; sweeps: finished ones; why: last trouble."""

    phase: Phase
    progress: float = 0.0
    sweeps: int = 0
    why: str = ""


class Capture:
    """Runs sweeps in a thread of its own.

    open_port : opens the port, raising PortLost.   deliver : takes each finished grid, in the capture thread.
    watch : told of every event of a sweep, in the capture thread. A sweep whose grid is not delivered ends in
    SweepInterrupted for it, whatever the scanner said.
    """

    def __init__(
        self,
        open_port: Callable[[], Port],
        config: ScannerConfig,
        deliver: Callable[[Grid], None],
        watch: Callable[[SweepEvent], None] = lambda event: None,
    ) -> None:
        self._open_port = open_port
        self._config = config
        self._deliver = deliver
        self._watch = watch
        self._beat_s = time.monotonic()
        self._stop = threading.Event()
        self._wanted = threading.Event()
        self._wake = threading.Event()
        self._status = CaptureStatus("connecting")
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    @property
    def status(self) -> CaptureStatus:
        """What is going on now."""
        return self._status

    @property
    def beat_s(self) -> float:
        """When the thread last showed that it gets on. [s, time.monotonic]"""
        return self._beat_s

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def request_sweep(self) -> bool:
        """Ask for a sweep; False when one is running or asked for already."""
        if self._status.phase == "sweeping" or self._wanted.is_set():
            return False
        self._wanted.set()
        self._wake.set()
        return True

    def stop(self, timeout_s: float = 3.0) -> None:
        """End a running sweep and the thread."""
        self._stop.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            try:
                self._serve_port()
                failures = 0
            except DriverError as error:
                if str(error) != self._status.why:
                    log.warning("scanner: %s", error)
                self._status = replace(self._status, phase="connecting", progress=0.0, why=str(error))
                failures += 1
            self._beat()
            self._stop.wait(min(BACKOFF_S[1], BACKOFF_S[0] * 2 ** min(failures, 8)) * random.uniform(0.5, 1.0))
        self._status = replace(self._status, phase="stopped")

    def _beat(self) -> None:
        self._beat_s = time.monotonic()

    def _serve_port(self) -> None:
        """Connect and sweep as asked until stopped. Raises DriverError."""
        port = self._open_port()
        try:
            scanner = Scanner(port, self._config)
            scanner.hello()
            self._status = replace(self._status, phase="ready", why="")
            while not self._stop.is_set():
                self._beat()
                self._wake.wait(LISTEN_S)
                self._wake.clear()
                if self._wanted.is_set() and not self._stop.is_set():
                    self._sweep(scanner)
        finally:
            port.close()

    def _sweep(self, scanner: Scanner) -> None:
        self._wanted.clear()
        self._status = replace(self._status, phase="sweeping", progress=0.0, why="")
        try:
            self._follow(scanner)
        except (RemoteWireError, ValueError) as error:  # a sweep that contradicts itself or fits no grid
            self._watch(SweepInterrupted(str(error), None, SweepReport()))
            raise ScannerFault(f"the scanner's sweep makes no sense: {error}") from error

    def _follow(self, scanner: Scanner) -> None:
        """One sweep, from its header to the grid that it makes."""
        assembler: Assembler | None = None
        for event in scanner.sweep(SweepRequest(), self._stop):
            self._beat()
            self._watch(event)
            match event:
                case SweepStarted(header):
                    assembler = Assembler(header.spec, encoder_of(header))
                case RangeColumn() if assembler:
                    assembler.add_range_column(event.encoder, event.row0, event.samples)
                case TextureColumn() if assembler:
                    assembler.add_texture_column(event.encoder, event.row0, event.samples)
                case SweepProgress(share):
                    self._status = replace(self._status, progress=share)
                case SweepFinished() if assembler:
                    self._finish(assembler)
                case SweepInterrupted(reason, cause):
                    self._interrupted(reason, cause)

    def _finish(self, assembler: Assembler) -> None:
        why = ""
        try:
            self._deliver(assembler.finish())
        except FoveascanError as error:
            why = str(error)
            log.error("the sweep was not kept: %s", error)
            self._watch(SweepInterrupted(why, None, SweepReport()))
        sweeps = self._status.sweeps + (not why)
        self._status = CaptureStatus("ready", 0.0, sweeps, why)

    def _interrupted(self, reason: str, cause: DriverError | None) -> None:
        log.warning("sweep interrupted: %s", reason)
        self._status = replace(self._status, phase="ready", progress=0.0, why=f"sweep interrupted: {reason}")
        if isinstance(cause, PortLost):
            raise cause


def encoder_of(header: SweepHeader) -> Encoder:
    """How a sweep's encoder counts become angles."""
    return Encoder(header.counts_per_turn, header.encoder_start, header.direction)
