"""The one thread that owns the scanner: it connects, sweeps when asked, assembles, and hands over finished grids.

A lost port or a faulty scanner never ends the thread: it tries again, ever more slowly. Columns are on their way to the
journal before anything else is done with them; a journal is removed once its grid is delivered, and so durable.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from typing import Literal

from drivers.discover import Arrivals
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
from node.assemble import Assembly
from node.axes import Axes
from node.journal import Journals
from node.resume import cut_lately, publish, resumed, resumed_by_itself
from node.running_sweep import RunningSweep
from node.turns import TurnEvents, TurnStarted, swept
from protocol.errors import DriverError, FoveascanError, LibraryError, PortLost, Unsupported
from protocol.scanner_messages import DeviceInfo, RangeColumn, SweepRequest, TextureColumn

log = logging.getLogger(__name__)

BACKOFF_S = (0.5, 8.0)
LISTEN_S = 1.0

Phase = Literal["no scanner", "connecting", "ready", "starting", "sweeping", "stopped"]


@dataclass(frozen=True, slots=True)
class CaptureStatus:
    """What the scanner is doing. progress: share of the sweep that is in; sweeps: finished ones; why: last trouble.

    From the moment that a sweep is asked for until it has ended, why says nothing of earlier ones.
    """

    phase: Phase
    progress: float = 0.0
    sweeps: int = 0
    why: str = ""

    @property
    def refusal(self) -> str:
        """Why no sweep can be asked for now; "" when one can."""
        match self.phase:
            case "ready":
                return ""
            case "no scanner":
                return "this node has no scanner: start it with --scanner ADDRESS"
            case "connecting":
                return f"the scanner is not connected: {self.why or 'it has not answered yet'}"
            case "stopped":
                return "the node is stopping"
            case _:
                return "a sweep is running already"


@dataclass(slots=True)
class SweepCounts:
    """What all sweeps took since the start: pieces of columns, columns asked for again, what could not be read."""

    range_columns: int = 0
    texture_columns: int = 0
    requested_columns: int = 0
    dropped_frames: int = 0
    dropped_bytes: int = 0
    interrupted: int = 0

    def take(self, event: SweepEvent) -> None:
        """Count what happens in a sweep."""
        match event:
            case RangeColumn():
                self.range_columns += 1
            case TextureColumn():
                self.texture_columns += 1
            case SweepFinished(report) | SweepInterrupted(report=report):
                self.requested_columns += report.requested_columns
                self.dropped_frames += report.dropped_frames
                self.dropped_bytes += report.dropped_bytes


@dataclass(frozen=True, slots=True)
class Manner:
    """How to sweep. apart : range and texture in turns of their own.  repairs : take spikes out, fill small holes."""

    request: SweepRequest = SweepRequest()
    apart: bool = False
    repairs: bool = True


@dataclass(frozen=True, slots=True)
class _Resume:
    """The order to go on with an interrupted sweep. by_itself : nobody asked, so the table must not turn anew."""

    sweep_id: str
    by_itself: bool = False


class Capture:
    """Runs sweeps in a thread of its own.

    open_port : opens the port, raising PortLost.
    deliver : takes each finished grid with its quality, in the capture thread, and returns once it is durable.
    watch : told of every event of a sweep, in the capture thread. A sweep whose grid is not delivered ends in
    SweepInterrupted for it, whatever the scanner said.
    sweeps : where columns are kept until their grid is delivered; without it, a cut sweep is lost.
    axes : what is known of scanners' axes, which grids are corrected for.
    """

    def __init__(
        self,
        open_port: Callable[[], Port],
        config: ScannerConfig,
        deliver: Callable[[Assembly], None],
        watch: Callable[[SweepEvent], None] = lambda event: None,
        sweeps: Journals | None = None,
        manner: Manner = Manner(),
        axes: Axes | None = None,
    ) -> None:
        self._open_port = open_port
        self._config = config
        self._deliver = deliver
        self._watch = watch
        self._sweeps = sweeps
        self._manner = manner
        self._axes = axes
        self._beat_s = time.monotonic()
        self.counts = SweepCounts()  # of the capture thread; others only look
        self._stop = threading.Event()
        self._lock = threading.Lock()  # held for a moment, to look at or exchange what follows
        self._order: Manner | _Resume | None = None
        self._all_in = False  # of a sweep whose grid is being delivered: the next one may be asked for
        self._port: Port | None = None
        self._status = CaptureStatus("connecting")
        self._thread = threading.Thread(target=self._run, name="capture", daemon=True)

    @property
    def status(self) -> CaptureStatus:
        """What is going on now."""
        with self._lock:
            return self._now()

    @property
    def beat_s(self) -> float:
        """When the thread last showed that it gets on. [s, time.monotonic]"""
        return self._beat_s

    def sweep_like(self, manner: Manner) -> None:
        """How to sweep from the next sweep on."""
        self._manner = manner

    def start(self) -> None:
        """Begin to connect."""
        self._thread.start()

    def request_sweep(self) -> int:
        """Ask for a sweep. Returns which of the finished ones it will be, if all goes well: status.sweeps then.

        0, and nothing will come of it, when the scanner is not ready: see status.refusal.
        While the grid of the last sweep is being delivered the next one may be asked for: who hears of the new scan
        hears of it before the thread is done with it.
        """
        return self._request(self._manner)

    def request_resume(self, sweep_id: str) -> int:
        """Ask to go on with an interrupted sweep; 0 as for request_sweep. Raises LibraryError when unknown."""
        if self._sweeps is None:
            raise LibraryError("this node keeps no interrupted sweeps")
        self._sweeps.get(sweep_id)
        return self._request(_Resume(sweep_id))

    def end(self) -> None:
        """Have a running sweep and the thread end; returns at once."""
        self._stop.set()
        self._wake()

    def stop(self, timeout_s: float = 3.0) -> None:
        """End a running sweep and the thread."""
        self.end()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _request(self, order: Manner | _Resume) -> int:
        with self._lock:
            if self._order is not None or (self._status.refusal and not self._all_in):
                return 0
            self._order = order
            number = self._status.sweeps + 1 + self._all_in
        self._wake()
        return number

    def _now(self) -> CaptureStatus:
        """The status, for whoever holds the lock."""
        if self._order is not None and self._status.phase == "ready":
            return replace(self._status, phase="starting", why="")
        return self._status

    def _wake(self) -> None:
        """Have the thread look up from an idle port."""
        with self._lock:
            if self._port is not None:
                self._port.cancel()

    def _run(self) -> None:
        with closing(Arrivals()) as arrivals:
            self._connect(arrivals)
        self._status = replace(self._status, phase="stopped")

    def _connect(self, arrivals: Arrivals) -> None:
        """Serve the port, time and again until stopped; where it is away, sooner when something is plugged in."""
        failures = 0
        while not self._stop.is_set():
            try:
                self._serve_port()
                failures = 0
            except DriverError as error:
                if str(error) != self._status.why:
                    log.warning("scanner: %s", error)
                failures = 0 if self._status.phase in ("ready", "sweeping") else failures + 1
                with self._lock:
                    self._order = None  # for a scanner that went away: the next one must not turn unasked
                    self._status = replace(self._status, phase="connecting", progress=0.0, why=str(error))
            self._beat()
            backoff_s = min(BACKOFF_S[1], BACKOFF_S[0] * 2 ** min(failures, 8)) * random.uniform(0.5, 1.0)
            if arrivals.wait(backoff_s, self._stop):
                failures = 0  # it may take a moment until it can be opened

    def _beat(self) -> None:
        self._beat_s = time.monotonic()

    def _serve_port(self) -> None:
        """Connect and sweep as asked until stopped. Raises DriverError."""
        port = self._open_port()
        try:
            scanner = Scanner(port, self._config)
            info = scanner.hello()
            with self._lock:
                self._port = port
            self._status = replace(self._status, phase="ready", why="")
            self._obey(scanner, info, self._cut_lately(info))
            while not self._stop.is_set():
                self._beat()
                if (order := self._take_order()) is not None:
                    self._obey(scanner, info, order)
                else:
                    scanner.watch(LISTEN_S)
        finally:
            with self._lock:
                self._port = None
            port.close()

    def _take_order(self) -> Manner | _Resume | None:
        with self._lock:
            order, self._order = self._order, None
            if order is not None:
                self._status = replace(self._status, phase="sweeping", progress=0.0, why="")
            return order

    def _cut_lately(self, info: DeviceInfo) -> _Resume | None:
        """The order to go on with a sweep, if this very scanner was cut off in the middle of one just now."""
        sweep = self._sweeps and cut_lately(self._sweeps.interrupted(), info, time.time())
        return _Resume(sweep.id, by_itself=True) if sweep else None

    def _obey(self, scanner: Scanner, info: DeviceInfo, order: Manner | _Resume | None) -> None:
        """Do what was asked. Raises DriverError."""
        try:
            match order:
                case Manner(request, apart, repairs):
                    if self._sweeps is not None:
                        self._sweeps.require_room()
                    running = RunningSweep(self._sweeps, info, repairs=repairs, axes=self._axes)
                    self._run_sweep(swept(scanner, request, self._stop, apart=apart), running)
                case _Resume():
                    self._resume(scanner, info, order)
        except LibraryError as error:
            self._end(str(error))

    def _resume(self, scanner: Scanner, info: DeviceInfo, order: _Resume) -> None:
        """Go on with a sweep, or finish one that lacks nothing. Raises DriverError, LibraryError."""
        assert self._sweeps is not None
        sweep = self._sweeps.get(order.sweep_id)
        self._status = replace(self._status, phase="sweeping", progress=sweep.held / sweep.expected)
        held = list(self._sweeps.columns(sweep.id))
        if sweep.is_complete:
            with self._delivering():
                publish(self._sweeps, sweep, self._deliver, self._manner.repairs, self._axes)
            return
        if order.by_itself:
            events = resumed_by_itself(scanner, sweep, held, self._stop)
        else:
            events = resumed(scanner, info, sweep, held, self._stop)
        repairs = self._manner.repairs
        running = RunningSweep(self._sweeps, info, sweep.id, held, repairs=repairs, axes=self._axes)
        self._run_sweep(events, running)

    def _run_sweep(self, events: TurnEvents, running: RunningSweep) -> None:
        """One sweep, from its header to the grid that it makes. Raises DriverError.

        However it ends, its columns are a scan or an interrupted sweep then, and `watch` knows.
        """
        try:
            self._follow(events, running)
        except FoveascanError as error:
            running.leave(str(error))
            self.counts.interrupted += 1
            stays_ready = not isinstance(error, DriverError) or isinstance(error, Unsupported)
            if stays_ready:
                self._end(str(error))
            self._watch(SweepInterrupted(str(error), None, SweepReport()))
            if not stays_ready:
                raise

    def _follow(self, events: TurnEvents, running: RunningSweep) -> None:
        """Hand every event to whom it concerns. Raises FoveascanError."""
        with closing(events):
            for event in events:
                self._beat()
                if isinstance(event, TurnStarted):
                    running.begin_turn(event)
                    continue
                self.counts.take(event)
                match event:
                    case SweepStarted(header):
                        running.begin(header)
                        for shown in (event, *running.held):
                            self._watch(shown)
                        continue
                    case RangeColumn() | TextureColumn():
                        running.take(event)
                    case SweepProgress(share):
                        running.flush()
                        self._status = replace(self._status, progress=share)
                    case SweepFinished(report):
                        with self._delivering():
                            running.finish(self._deliver, report)
                    case SweepInterrupted(cause=PortLost() as cause):
                        raise cause
                    case SweepInterrupted(reason):
                        running.leave(reason)
                        self.counts.interrupted += 1
                        self._end(f"sweep interrupted: {reason}")
                self._watch(event)

    @contextmanager
    def _delivering(self) -> Iterator[None]:
        """While the grid of a sweep that is all in is being delivered; ready when it is."""
        self._all_in = True
        try:
            yield
            with self._lock:
                self._status, self._all_in = CaptureStatus("ready", 0.0, self._status.sweeps + 1), False
        finally:
            self._all_in = False

    def _end(self, why: str) -> None:
        log.warning("%s", why)
        self._status = replace(self._status, phase="ready", progress=0.0, why=why)
