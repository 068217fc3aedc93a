"""A sweep in turns of its own for range and for texture, put together by the encoder.

Some scanners see one thing at a time: range in the dark, texture by light. Such a one is asked for a range-only sweep,
then for a texture-only one, and so on for as many passes as are wanted. What comes out is one sweep: its header has
both channels, and columns are named and counted as if the table had simply turned on. The scanner's own count confirms
every turn. TurnStarted tells the journal which turn runs, so that it can go on after a cut.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace

from drivers.ledger import Ledger
from drivers.scanner import (
    Scanner,
    SweepEvent,
    SweepFinished,
    SweepInterrupted,
    SweepProgress,
    SweepReport,
    SweepStarted,
)
from protocol.errors import ScannerFault, Unsupported
from protocol.scanner_messages import Channel, Column, RangeColumn, SweepHeader, SweepRequest, TextureColumn

log = logging.getLogger(__name__)

LAPS_APART = 2  # a turn with a stride goes round twice
COUNT_LIMIT = 1 << 31
STOPPED = "stopped"  # how drivers.sweep calls the end that we asked for


@dataclass(frozen=True, slots=True)
class TurnStarted:
    """A turn of range or of texture begins. header : as the scanner told it.  pass_index : which pass it stands for."""

    header: SweepHeader
    pass_index: int


SweepEvents = Generator[SweepEvent, None, None]
TurnEvent = SweepEvent | TurnStarted
TurnEvents = Generator[TurnEvent, None, None]


def swept(scanner: Scanner, request: SweepRequest, stop: threading.Event, *, apart: bool) -> TurnEvents:
    """A sweep of range and texture, as Scanner.sweep tells it; in turns where wanted, or where nothing else goes.

    Raises DriverError as Scanner.sweep does, where the scanner refuses before the table turns.
    """
    if not apart:
        try:
            yield from scanner.sweep(request, stop)
            return
        except Unsupported as refusal:
            if not _takes_turns(scanner, request):
                raise
            log.info("range and texture are swept in turns of their own: %s", refusal)
    elif not _takes_turns(scanner, request):
        raise Unsupported("the scanner takes no turn of range or texture alone: set capture.apart = false")
    events = scanner.sweep(_turn_request(request, Channel.RANGE, 0), stop)
    first = _header_of(events)
    with closing(events):
        whole = _Whole(scanner, stop, replace(first, channels=Channel.BOTH, passes=request.passes))
        yield SweepStarted(whole.header)
        cut = yield from whole.turn(first, events, Channel.RANGE, 0)
    if cut is not None:
        yield cut
    else:
        yield from whole.rest(request)


def gone_on(
    scanner: Scanner,
    header: SweepHeader,
    turn: TurnStarted | None,
    held: Sequence[Column],
    stop: threading.Event,
    *,
    anew: bool,
) -> TurnEvents:
    """The rest of a sweep in turns that was cut.

    header : of the whole sweep.  turn : the one that was cut, where the scanner may still know it.  held : the columns
    kept.  anew : whether the table may be homed, to take again what the scanner knows no longer.
    Raises DriverError as Scanner.sweep does.
    """
    whole = _Whole(scanner, stop, header, held)
    yield SweepStarted(header)
    cut = (yield from whole.go_on(turn, held)) if turn is not None else _refusal("the scanner was switched off since")
    if cut is not None and isinstance(cut.cause, ScannerFault) and anew:
        cut = whole.why_not_anew()
    if cut is not None:
        yield cut
        return
    s = header.spec
    shape = s.width, s.height, s.texture_width, s.texture_height
    yield from whole.rest(SweepRequest(header.channels, header.passes, *shape, overlap=header.overlap))


def as_of_sweep(column: Column, turn: TurnStarted, header: SweepHeader) -> Column:
    """A column of one turn as the whole sweep names and counts it. Raises ScannerFault where counts end."""
    return _moved(column, turn.header, header, turn.pass_index)


def as_of_turn(column: Column, turn: TurnStarted, header: SweepHeader) -> Column:
    """Inverse of as_of_sweep."""
    return _moved(column, header, turn.header, -turn.pass_index)


def _moved(column: Column, before: SweepHeader, after: SweepHeader, passes: int) -> Column:
    laps = passes * LAPS_APART * before.counts_per_turn
    encoder = after.encoder_start + column.encoder - before.encoder_start + before.direction * laps
    if not -COUNT_LIMIT <= encoder < COUNT_LIMIT:
        raise ScannerFault(f"column {column.column} stands at count {encoder}, further than an encoder counts")
    return replace(column, sweep=after.sweep, pass_index=column.pass_index + passes, encoder=encoder)


def _is_of(column: Column, turn: TurnStarted) -> bool:
    """Whether a column of the whole sweep came in this turn, or in the overlap that follows it."""
    passes = range(turn.pass_index, turn.pass_index + 1 + (turn.header.overlap > 0))
    return column.CHANNEL in turn.header.channels and column.pass_index in passes


def _takes_turns(scanner: Scanner, request: SweepRequest) -> bool:
    """Hear from the scanner, before the table turns, whether it takes range alone and texture alone."""
    try:
        for channel in (Channel.TEXTURE, Channel.RANGE):
            scanner.configure(_turn_request(request, channel, 0))
    except Unsupported as refusal:
        log.info("%s", refusal)
        return False
    return True


def _turn_request(request: SweepRequest, channel: Channel, pass_index: int) -> SweepRequest:
    """What to ask for one turn. Several passes tell more than an overlap, so there is none then."""
    overlap, stride = request.overlap if request.passes == 1 else 0, request.stride if pass_index == 0 else 1
    return replace(request, channels=channel, passes=1, overlap=overlap, stride=stride)


class _Whole:
    """The sweep that the turns make up. header : with both channels.  held : its columns that were kept before."""

    def __init__(
        self, scanner: Scanner, stop: threading.Event, header: SweepHeader, held: Sequence[Column] = ()
    ) -> None:
        self._scanner = scanner
        self._stop = stop
        self._reports: list[SweepReport] = []
        self._bytes = 0
        self.header = header
        self._ledger = Ledger(header)
        for column in held:
            self._take(column)

    def rest(self, request: SweepRequest) -> TurnEvents:
        """Turn after turn, range, texture, range, ..., until nothing is missing."""
        while (place := self._next_turn()) is not None:
            if self._stop.is_set():
                yield SweepInterrupted(STOPPED, None, self._report())
                return
            channel, pass_index = place
            events = self._scanner.sweep(_turn_request(request, channel, pass_index), self._stop)
            cut = yield from self.turn(_header_of(events), events, channel, pass_index)
            if cut is not None:
                yield cut
                return
        yield SweepFinished(self._report())

    def go_on(self, turn: TurnStarted, held: Sequence[Column]) -> Generator[TurnEvent, None, SweepInterrupted | None]:
        """The rest of the turn that was cut. Returns what interrupted it, if something did."""
        before = [as_of_turn(column, turn, self.header) for column in held if _is_of(column, turn)]
        events = self._scanner.resume(turn.header, before, self._stop)
        return (yield from self.turn(turn.header, events, turn.header.channels, turn.pass_index))

    def why_not_anew(self) -> SweepInterrupted | None:
        """Home the table. Returns what speaks against taking again what is missing. Raises DriverError."""
        if self._next_turn() is None:
            return _refusal("every column is there, and the scanner does not confirm them: sweep anew")
        if self._scanner.calibrate().calibration != self.header.calibration:
            return _refusal("the scanner was calibrated anew since")
        return None

    def turn(
        self, header: SweepHeader, events: SweepEvents, channel: Channel, pass_index: int
    ) -> Generator[TurnEvent, None, SweepInterrupted | None]:
        """One turn, its columns as those of the whole. Returns what interrupted it, if something did."""
        with closing(events):
            if header != _turn_of(self.header, channel, header):
                return _refusal("the scanner sweeps otherwise than before")
            turn = TurnStarted(header, pass_index)
            yield turn
            for event in events:
                match event:
                    case RangeColumn() | TextureColumn():
                        column = as_of_sweep(event, turn, self.header)
                        if self._take(column):
                            yield column
                    case SweepProgress():
                        yield SweepProgress(self._ledger.held / self._ledger.expected, self._bytes)
                    case SweepFinished(report):
                        self._reports.append(report)
                    case SweepInterrupted(reason, cause, report):
                        self._reports.append(report)
                        return SweepInterrupted(reason, cause, self._report())
        return None

    def _next_turn(self) -> tuple[Channel, int] | None:
        """Channel and pass of the first turn that something is missing of."""
        last = self.header.passes - 1  # its overlap is named as one more
        missing = {(run.channel, min(run.pass_index, last)) for run in self._ledger.missing()}
        return min(missing, key=lambda place: (place[1], place[0]), default=None)

    def _take(self, column: Column) -> bool:
        """Whether a column is new."""
        is_new = self._ledger.take(column)
        if is_new:
            self._bytes += len(column.data)
        return is_new

    def _report(self) -> SweepReport:
        """What all turns took together."""
        counts = ("duplicates", "strays", "requested_columns", "dropped_bytes", "elapsed_s", "dropped_frames")
        total = {name: sum(getattr(report, name) for report in self._reports) for name in counts}
        return SweepReport(self._ledger.expected, self._ledger.held, digest=self._ledger.digest, **total)


def _header_of(events: SweepEvents) -> SweepHeader:
    """What the scanner is about to sweep, which is the first that it says. Raises DriverError."""
    started = next(events)
    assert isinstance(started, SweepStarted)
    return started.header


def _turn_of(whole: SweepHeader, channel: Channel, named: SweepHeader) -> SweepHeader:
    """What the header of a turn must be, but for number and start of the sweep, which are as `named`."""
    turn = replace(whole, channels=channel, passes=1)
    return replace(turn, sweep=named.sweep, encoder_start=named.encoder_start)


def _refusal(reason: str) -> SweepInterrupted:
    return SweepInterrupted(reason, ScannerFault(reason), SweepReport())
