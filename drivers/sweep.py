"""A running sweep on the node's side: its events, and what each thing heard from the scanner means for it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from drivers.ledger import Ledger
from protocol.errors import DriverError, ScannerFault
from protocol.framing import SERIAL_PAYLOAD_MAX, Dropped
from protocol.scanner_link import Command, Event, Refused, ScannerLink, Unanswered, WrongVersion
from protocol.scanner_messages import (
    Column,
    ColumnRun,
    ColumnsGone,
    Fault,
    Outcome,
    RequestColumns,
    SweepEnd,
    SweepHeader,
    SweepStop,
)

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
    bytes that could not be read; its time; the digest of what was received, as in SWEEP_END; and in how many stretches
    those bytes came."""

    expected: int = 0
    received: int = 0
    duplicates: int = 0
    strays: int = 0
    requested_columns: int = 0
    dropped_bytes: int = 0
    elapsed_s: float = 0.0
    digest: int = 0
    dropped_frames: int = 0


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


class Collector:
    """Decides what each event of a running sweep means, and when it is over."""

    def __init__(
        self, link: ScannerLink, header: SweepHeader, config: ScannerConfig, is_live: bool, now_s: float
    ) -> None:
        self.is_over = False
        self._link = link
        self.sweep = header.sweep
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

    def ask(self) -> None:
        """Ask for all that is missing, of a sweep that began before; where nothing is, for word that this is all."""
        self._request(self._ledger.missing() or self._ledger.first())

    def take(self, event: Event) -> Iterator[SweepEvent]:
        """Anything but a column."""
        match event:
            case Dropped(count=count):
                bytes_, frames = self._tally.dropped_bytes + count, self._tally.dropped_frames + 1
                self._tally = replace(self._tally, dropped_bytes=bytes_, dropped_frames=frames)
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
            self._link.send(SweepStop(self.sweep))
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
            case ColumnsGone(sweep, runs) if sweep == self.sweep:
                self._ledger.give_up(runs)
            case Fault(code, text):
                yield self._break(f"scanner error {code}: {text}")
            case SweepEnd(sweep=sweep) if sweep == self.sweep:
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
            cure = "sweep again; if it stays so, it keeps too few columns for a line that is cut for so long"
            yield self._break(f"{lost} columns were lost and the scanner holds them no longer: {cure}")
        elif (end.pieces, end.digest) != (self._ledger.expected, self._ledger.digest):
            yield self._break("the columns received are not those the scanner counted")
        else:
            self.is_over = True
            yield SweepFinished(self._report())

    def _request(self, runs: tuple[ColumnRun, ...]) -> None:
        if runs:
            self._link.send(RequestColumns(self.sweep, runs))
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
            digest=ledger.digest,
        )
