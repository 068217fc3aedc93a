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
from collections.abc import Callable, Generator, Iterable, Iterator

from drivers.port import Port
from drivers.sweep import (
    Collector,
    ScannerConfig,
    SweepEvent,
    SweepFinished,
    SweepInterrupted,
    SweepProgress,
    SweepReport,
    SweepStarted,
)
from protocol.errors import LocalWireError, PortLost, ScannerFault, Unsupported
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
    DeviceInfo,
    Fault,
    NakCode,
    Order,
    RangeColumn,
    Reset,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
    TextureColumn,
)

_READ_BYTES = 262_144
_COLUMNS = (RangeColumn, TextureColumn)
_LOOK_UP_S = 0.1  # how long a wait for bytes may keep us from the stop flag

__all__ = [
    "Scanner",
    "ScannerConfig",
    "SweepEvent",
    "SweepFinished",
    "SweepInterrupted",
    "SweepProgress",
    "SweepReport",
    "SweepStarted",
]


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
        self._is_doubtful = False  # whether the last sweep broke

    def hello(self) -> DeviceInfo:
        """Open a session. Raises PortLost, or ScannerFault when nothing answers or it speaks another version."""
        session = 1 + secrets.randbelow(65535)
        config = self._config
        self._info, self._is_doubtful = None, False
        link = ScannerLink(Role.HOST, session=session, payload_max=config.payload_max, window_bytes=config.window_bytes)
        self._link = link
        link.tick(self._clock())
        link.greet()
        self._silent_s, self._frames_heard = 0.0, 0
        while self._info is None:
            self._info = self._await_greeting()
        return self._info

    def calibrate(self) -> Calibration:
        """Home the table; after a sweep that broke, the scanner is greeted first, as in `configure`.

        Raises PortLost, or ScannerFault when the scanner refuses, fails or falls silent.
        """
        if self._is_doubtful:
            self.hello()
        self._send(Calibrate())
        while True:
            report = self._await_command()
            if isinstance(report, Calibration):
                return report

    def configure(self, request: SweepRequest) -> None:
        """Tell the scanner how the next sweep shall be; whatever it was doing is dropped.

        After a sweep that broke, it is greeted first: it may have started anew and know us no longer.
        Raises PortLost or ScannerFault, which is Unsupported when it cannot sweep so.
        """
        if self._is_doubtful:
            self.hello()
        for command in (Reset(), request):
            self._command(command)

    def sweep(self, request: SweepRequest, stop: threading.Event | None = None) -> Generator[SweepEvent, None, None]:
        """One sweep, event by event; whatever the scanner was doing is dropped first. Setting `stop` ends it.

        Raises PortLost or ScannerFault when it does not even start, Unsupported when it cannot sweep so.
        """
        self.configure(request)
        self._sweep = self._sweep % 65535 + 1
        header = self._start()
        yield SweepStarted(header)
        yield from self._collect(self._collector(header), stop or threading.Event())

    def resume(
        self, header: SweepHeader, held: Iterable[Column], stop: threading.Event | None = None
    ) -> Generator[SweepEvent, None, None]:
        """Go on with a sweep that this scanner began since it was switched on; `held` is what came of it before.

        Events as from `sweep`, SweepStarted included and columns held excluded. A scanner that knows the sweep no
        longer refuses, which is SweepInterrupted.
        """
        collector = self._collector(header)
        for column in held:
            collector.take_column(column)
        self._silent_s = 0.0  # an idle scanner need not have said anything until now
        collector.ask()
        yield SweepStarted(header)
        yield from self._collect(collector, stop or threading.Event())

    def watch(self, timeout_s: float) -> None:
        """Keep an ear on an idle scanner: returns when something was heard, at the port's `cancel`, or in time.

        Raises PortLost as soon as it is unplugged, ScannerFault when it reports an error.
        """
        self._flush()
        self._read(timeout_s)
        while (event := self._greeted.next_event()) is not None:
            if isinstance(event, Command):
                self._greeted.accept(event)
            self._flush()
            self._raise_fault(event)

    def close(self) -> None:
        """Let go of the port."""
        self._port.close()

    # -- a sweep that runs ---------------------------------------------------------------------------------------

    def _collector(self, header: SweepHeader) -> Collector:
        assert self._info is not None
        is_live = self._info.order is Order.LIVE
        self._greeted.tick(self._clock())
        return Collector(self._greeted, header, self._config, is_live, self._clock())

    def _collect(self, collector: Collector, stop: threading.Event) -> Iterator[SweepEvent]:
        """Columns and progress until the sweep is over; what is due is looked up once for all that one read brought."""
        link = self._greeted
        try:
            while not collector.is_over:
                event = link.next_event()
                if isinstance(event, _COLUMNS):
                    if collector.take_column(event):
                        yield event
                elif event is not None:
                    yield from self._answering(collector.take(event))
                else:
                    yield from self._answering(collector.look_up(self._clock(), stop.is_set(), self._silence_s()))
                    if not collector.is_over:
                        self._await_bytes(self._clock() + _LOOK_UP_S)
        except PortLost as error:
            yield collector.interrupt(str(error), error)
        finally:
            if not collector.is_over:  # the caller walked away
                self._wave_off(collector.sweep)

    def _answering(self, outcomes: Iterator[SweepEvent]) -> Iterator[SweepEvent]:
        """The same events, each told to the caller after the scanner got its answer: the caller may not come back."""
        for outcome in outcomes:
            self._is_doubtful |= isinstance(outcome, SweepInterrupted) and outcome.cause is not None
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
                fault = Unsupported if code is NakCode.UNSUPPORTED else ScannerFault
                raise fault(f"{name}: {type(message).__name__} refused, {code.name.lower()}: {text}")
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
        while (event := link.next_event()) is None and self._clock() < until_s:
            self._await_bytes(until_s)
        self._flush()
        return event

    def _await_bytes(self, until_s: float) -> None:
        """Write what is to be written, and wait for bytes, or until the link has something to do. Raises PortLost."""
        self._flush()
        self._read(min(until_s, self._greeted.next_deadline() or until_s) - self._clock())

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
