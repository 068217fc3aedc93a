"""A scanner behind a port: greet it, home it, sweep with it. Blocking, for one thread.

    scanner = Scanner(SerialPort("/dev/ttyACM0"))
    info = scanner.hello()
    for event in scanner.sweep(SweepRequest(), stop):
        ...

Every piece of a column is yielded once, whole and inside the announced shape; what got lost on the way is asked for
again. Exactly one SweepFinished or SweepInterrupted ends a sweep that has started.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace

from drivers.ledger import Ledger
from drivers.port import Port
from protocol.errors import DriverError, LocalWireError, PortLost, ScannerFault
from protocol.framing import SERIAL_PAYLOAD_MAX, Dropped
from protocol.scanner_link import (
    Accepted,
    Command,
    Event,
    HostCommand,
    Refused,
    Role,
    ScannerLink,
    Unanswered,
    WrongVersion,
)
from protocol.scanner_messages import (
    MAJOR,
    MINOR,
    Calibrate,
    Calibration,
    Column,
    ColumnRun,
    ColumnsGone,
    DeviceInfo,
    Fault,
    Order,
    Outcome,
    RangeColumn,
    RequestColumns,
    Reset,
    SweepEnd,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
    TextureColumn,
)

_READ_BYTES = 65536
_LOOK_UP_S = 0.1  # how long a wait for bytes may keep us from the stop flag
_ROUNDS_MAX = 5  # requests in a row that bring nothing


@dataclass(frozen=True, slots=True)
class ScannerConfig:
    """How to talk to a scanner.

    window_bytes : how far the scanner may run ahead of us.     quiet_s : a scanner silent for longer is stale.
    progress_s : time between SweepProgress events.             payload_max : longest payload read. [bytes]
    """

    window_bytes: int = 65536
    quiet_s: float = 2.0
    progress_s: float = 0.25
    payload_max: int = SERIAL_PAYLOAD_MAX


@dataclass(frozen=True, slots=True)
class SweepReport:
    """What a sweep took: column pieces expected, received, received twice, belonging nowhere; columns asked for again;
    bytes that could not be read; and its time."""

    expected: int = 0
    received: int = 0
    duplicates: int = 0
    strays: int = 0
    requested_columns: int = 0
    dropped_bytes: int = 0
    elapsed_s: float = 0.0


@dataclass(frozen=True, slots=True)
class SweepStarted:
    """The scanner told what it is about to sweep."""

    header: SweepHeader


@dataclass(frozen=True, slots=True)
class SweepProgress:
    """Share of the sweep that is in, 0..1, and its sample bytes so far."""

    share: float
    received_bytes: int


@dataclass(frozen=True, slots=True)
class SweepFinished:
    """Every column of every pass was yielded, and together they are what the scanner sent."""

    report: SweepReport


@dataclass(frozen=True, slots=True)
class SweepInterrupted:
    """The sweep ended early. cause : what broke it, or None when the caller's stop did."""

    reason: str
    cause: DriverError | None
    report: SweepReport


SweepEvent = SweepStarted | Column | SweepProgress | SweepFinished | SweepInterrupted


class Scanner:
    """The scanner at the other end of a port; call `hello` first, and again after any DriverError."""

    def __init__(
        self, port: Port, config: ScannerConfig | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._port = port
        self._config = config or ScannerConfig()
        self._clock = clock
        self._link: ScannerLink | None = None
        self._info: DeviceInfo | None = None
        self._sweep = secrets.randbelow(65535)
        self._silent_s = 0.0
        self._frames_heard = 0

    def hello(self) -> DeviceInfo:
        """Open a session. Raises PortLost, or ScannerFault when nothing answers or it speaks another version."""
        session = 1 + secrets.randbelow(65535)
        config = self._config
        self._info = None
        link = ScannerLink(Role.HOST, session=session, payload_max=config.payload_max, window_bytes=config.window_bytes)
        self._link = link
        link.tick(self._clock())
        link.greet()
        self._silent_s, self._frames_heard = 0.0, 0
        while self._info is None:
            self._info = self._await_greeting()
        return self._info

    def calibrate(self) -> Calibration:
        """Home the table. Raises PortLost, or ScannerFault when the scanner refuses, fails or falls silent."""
        self._send(Calibrate())
        while True:
            report = self._await_command()
            if isinstance(report, Calibration):
                return report

    def sweep(self, request: SweepRequest, stop: threading.Event | None = None) -> Generator[SweepEvent, None, None]:
        """One sweep, event by event; whatever the scanner was doing is dropped first. Setting `stop` ends it.

        Raises PortLost or ScannerFault when it does not even start.
        """
        self._sweep = self._sweep % 65535 + 1
        for command in (Reset(), request):
            self._command(command)
        header = self._start()
        yield SweepStarted(header)
        yield from self._collect(header, stop or threading.Event())

    def close(self) -> None:
        """Let go of the port."""
        self._port.close()

    # -- a sweep that runs ---------------------------------------------------------------------------------------

    def _collect(self, header: SweepHeader, stop: threading.Event) -> Iterator[SweepEvent]:
        """Columns and progress until the sweep is over."""
        assert self._info is not None
        is_live = self._info.order is Order.LIVE
        collector = _Collector(self._greeted, header, self._config, is_live, self._clock())
        try:
            while not collector.is_over:
                event = self._next_event(self._clock() + _LOOK_UP_S)
                if isinstance(event, RangeColumn | TextureColumn):
                    if collector.take_column(event):
                        yield event
                elif event is not None:
                    yield from self._answering(collector.take(event))
                yield from self._answering(collector.look_up(self._clock(), stop.is_set(), self._silence_s()))
        except PortLost as error:
            yield collector.interrupt(str(error), error)
        finally:
            if not collector.is_over:  # the caller walked away
                self._wave_off(header.sweep)

    def _answering(self, outcomes: Iterator[SweepEvent]) -> Iterator[SweepEvent]:
        """The same events, each told to the caller after the scanner got its answer: the caller may not come back."""
        for outcome in outcomes:
            self._flush()
            yield outcome

    def _wave_off(self, sweep: int) -> None:
        """Tell the scanner to stop, without waiting to be heard."""
        self._send(SweepStop(sweep))
        try:
            self._flush()
        except PortLost:
            return  # nobody is left to be told; the next call on the port says so

    def _start(self) -> SweepHeader:
        """Start the sweep; its header may overtake the answer to the command."""
        self._send(SweepStart(self._sweep))
        while True:
            header = self._await_command()
            if isinstance(header, SweepHeader) and header.sweep == self._sweep:
                return header

    # -- commands ------------------------------------------------------------------------------------------------

    def _command(self, command: HostCommand) -> None:
        """Send a command and wait until it is accepted. Raises PortLost or ScannerFault."""
        link = self._greeted
        self._send(command)
        while True:
            event = self._next_event(self._clock() + _LOOK_UP_S)
            if isinstance(event, Accepted) and event.message is command:
                return
            if isinstance(event, Command):
                link.accept(event)
            self._raise_fault(event)

    def _await_command(self) -> object:
        """What the scanner wants next, accepted, or None after a short while.

        Raises PortLost, or ScannerFault when it refuses what we sent, fails, or falls silent.
        """
        link = self._greeted
        event = self._next_event(self._clock() + _LOOK_UP_S)
        self._raise_fault(event)
        if isinstance(event, Command):
            link.accept(event)
            return event.message
        if link.commands_pending == 0 and self._silence_s() > self._config.quiet_s:
            raise ScannerFault(f"{self._port.name}: silent for {self._config.quiet_s:g} s")
        return None

    def _send(self, command: HostCommand) -> None:
        """Hand a command to the link, which must know the time to count its patience."""
        self._greeted.tick(self._clock())
        self._greeted.send(command)

    def _await_greeting(self) -> DeviceInfo | None:
        event = self._next_event(self._clock() + _LOOK_UP_S)
        self._raise_fault(event)
        return event if isinstance(event, DeviceInfo) else None

    def _raise_fault(self, event: Event | None) -> None:
        """Raise ScannerFault where an event means that the scanner will not do what was asked."""
        name = self._port.name
        match event:
            case Refused(message, code, text):
                raise ScannerFault(f"{name}: {type(message).__name__} refused, {code.name.lower()}: {text}")
            case Unanswered(message):
                raise ScannerFault(f"{name}: no answer to {type(message).__name__}; is a scanner connected and on?")
            case WrongVersion(major):
                raise ScannerFault(f"{name}: the scanner speaks link version {major}, this node {MAJOR}.{MINOR}")
            case Command(message=Fault(code, text)):
                raise ScannerFault(f"{name}: scanner error {code}: {text}")

    # -- the line ------------------------------------------------------------------------------------------------

    @property
    def _greeted(self) -> ScannerLink:
        if self._link is None:
            raise LocalWireError("say hello first")
        return self._link

    def _next_event(self, until_s: float) -> Event | None:
        """The next event of the link, or None when none came in time. Raises PortLost."""
        link = self._greeted
        while (event := link.next_event()) is None:
            self._flush()
            now_s = self._clock()
            if now_s >= until_s:
                break
            self._read(min(until_s, link.next_deadline() or until_s) - now_s)
        self._flush()
        return event

    def _read(self, timeout_s: float) -> None:
        """Wait for bytes and hand them to the link."""
        link, began_s = self._greeted, self._clock()
        data = self._port.read(_READ_BYTES, max(timeout_s, 0.0))
        now_s = self._clock()
        self._silent_s = self._silence_s() + now_s - began_s
        if data:
            link.receive_data(data, now_s)
        link.tick(now_s)

    def _silence_s(self) -> float:
        """Time spent waiting since the last good frame; the caller's own pauses do not count. [s]"""
        if self._greeted.frames_heard != self._frames_heard:
            self._frames_heard, self._silent_s = self._greeted.frames_heard, 0.0
        return self._silent_s

    def _flush(self) -> None:
        data = self._greeted.data_to_send()
        if data:
            self._port.write(data)


class _Collector:
    """Decides what each event of a running sweep means, and when it is over."""

    def __init__(
        self, link: ScannerLink, header: SweepHeader, config: ScannerConfig, is_live: bool, now_s: float
    ) -> None:
        self.is_over = False
        self._link = link
        self._sweep = header.sweep
        self._config = config
        self._is_live = is_live
        self._ledger = Ledger(header)
        self._began_s = self._now_s = self._progress_s = now_s
        self._stop_s: float | None = None
        self._received_bytes = 0
        self._tally = SweepReport(expected=self._ledger.expected)
        self._held_at_end = -1
        self._rounds = 0

    def take_column(self, column: Column) -> bool:
        """Whether this piece is a new one of this sweep."""
        is_new = self._ledger.take(column)
        if is_new:
            self._received_bytes += len(column.data)
        return is_new

    def take(self, event: Event) -> Iterator[SweepEvent]:
        """Anything but a column."""
        match event:
            case Dropped(count=count):
                self._tally = replace(self._tally, dropped_bytes=self._tally.dropped_bytes + count)
            case Unanswered(RequestColumns()):
                yield self._break("no answer to a request for missing columns")
            case Refused(RequestColumns(), _, text):
                yield self._break(f"a request for missing columns was refused: {text}")
            case WrongVersion(major):
                yield self._break(f"the scanner speaks link version {major} now")
            case Command(message=message):
                self._link.accept(event)
                yield from self._take_command(message)

    def look_up(self, now_s: float, wants_stop: bool, silent_s: float) -> Iterator[SweepEvent]:
        """What is due by now: stopping, giving up on a silent scanner, progress, asking for lost columns."""
        self._now_s = now_s
        if self.is_over:
            return
        if wants_stop and self._stop_s is None:
            self._stop_s = now_s
            self._link.send(SweepStop(self._sweep))
        if self._stop_s is not None and now_s > self._stop_s + self._config.quiet_s:
            yield self.interrupt("stopped", None)
        elif self._is_silent(silent_s):
            yield self._break(f"silent for {self._config.quiet_s:g} s")
        elif now_s >= self._progress_s + self._config.progress_s:
            self._progress_s = now_s
            if self._is_live and self._link.commands_pending == 0:
                self._request(self._ledger.left_behind())
            yield SweepProgress(self._ledger.held / self._ledger.expected, self._received_bytes)

    def _is_silent(self, silent_s: float) -> bool:
        """Whether we should have heard something by now; a scanner that has ended may be waiting for our request."""
        is_our_turn = self._held_at_end >= 0 and self._link.commands_pending > 0
        return silent_s > self._config.quiet_s and not is_our_turn

    def interrupt(self, reason: str, cause: DriverError | None) -> SweepInterrupted:
        """The sweep is over, early."""
        self.is_over = True
        return SweepInterrupted(reason, cause, self._report())

    def _take_command(self, message: object) -> Iterator[SweepEvent]:
        match message:
            case ColumnsGone(sweep, runs) if sweep == self._sweep:
                self._ledger.give_up(runs)
            case Fault(code, text):
                yield self._break(f"scanner error {code}: {text}")
            case SweepEnd(sweep=sweep) if sweep == self._sweep:
                yield from self._take_end(message)

    def _take_end(self, end: SweepEnd) -> Iterator[SweepEvent]:
        """The scanner has sent all it was to send: finish, ask for what is missing, or give up."""
        if self._stop_s is not None:
            yield self.interrupt("stopped", None)
        elif end.outcome is not Outcome.COMPLETE:
            yield self._break(f"the scanner ended the sweep: {end.outcome.name.lower()}")
        elif missing := self._ledger.missing():
            self._rounds = self._rounds + 1 if self._ledger.held == self._held_at_end else 0
            self._held_at_end = self._ledger.held
            if self._rounds >= _ROUNDS_MAX:
                yield self._break("columns are missing and do not come when asked for")
            else:
                self._request(missing)
        elif lost := self._ledger.lost_columns():
            yield self._break(f"{lost} columns were lost and the scanner holds them no longer")
        elif (end.pieces, end.digest) != (self._ledger.expected, self._ledger.digest):
            yield self._break("the columns received are not those the scanner counted")
        else:
            self.is_over = True
            yield SweepFinished(self._report())

    def _request(self, runs: tuple[ColumnRun, ...]) -> None:
        if runs:
            self._link.send(RequestColumns(self._sweep, runs))
            asked = self._tally.requested_columns + sum(run.count for run in runs)
            self._tally = replace(self._tally, requested_columns=asked)

    def _break(self, reason: str) -> SweepInterrupted:
        return self.interrupt(reason, ScannerFault(reason))

    def _report(self) -> SweepReport:
        ledger = self._ledger
        return replace(
            self._tally,
            received=ledger.held,
            duplicates=ledger.duplicates,
            strays=ledger.strays,
            elapsed_s=self._now_s - self._began_s,
        )
