"""A sweep inside a simulated scanner: which columns were exposed, wait to be sent, and are held to be sent again."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from protocol.scanner_messages import (
    Channel,
    Column,
    ColumnRun,
    Order,
    Outcome,
    RangeColumn,
    SweepEnd,
    SweepHeader,
    TextureColumn,
)
from simulators.turntable import Exposure, Turntable

_OUTBOX_COLUMNS = 64
_TURN_COLUMNS = 1 << 16
_COARSEST = 16  # columns apart, in the first portion of a buffered sweep
_COLUMN_OF: dict[Channel, type[RangeColumn] | type[TextureColumn]] = {
    Channel.RANGE: RangeColumn,
    Channel.TEXTURE: TextureColumn,
}
Key = tuple[Channel, int, int]


class Sweep:
    """One sweep: its columns exposed, waiting, sent and held.

    order : live, what is exposed waits to be sent at once, and the table stops while too much waits; or buffered, the
    table turns to the end first, and then what the memory of `retention_columns` holds is sent coarse to fine.
    """

    def __init__(self, header: SweepHeader, table: Turntable, retention_columns: int, order: Order) -> None:
        self.header = header
        self._is_buffered = order is Order.BUFFERED
        self.is_announced = False
        self.owes_end = True
        self._table = table
        self._retention_columns = retention_columns
        self._passes = {channel: len(header.columns_in(channel)) for channel in _COLUMN_OF}
        self._piece_rows = {channel: header.shape(channel)[2] for channel in _COLUMN_OF}
        self._outcome = Outcome.COMPLETE
        self._waiting: deque[Exposure] = deque()
        self._again: deque[Exposure] = deque()
        self._pieces: deque[Column] = deque()
        self._is_first_time = True
        self._held: dict[Key, Exposure] = {}
        self._exposed: set[Key] = set()
        self._sent: set[Key] = set()
        self._is_sorted = False
        self._count = 0
        self._digest = 0

    @property
    def head(self) -> Column | None:
        """The piece to be sent next, columns asked for again going first."""
        if not self._pieces and (self._again or self._waiting):
            exposure = (self._again or self._waiting).popleft()
            key = (exposure.channel, exposure.pass_index, exposure.column)
            is_too_far = exposure.pass_index >= self._passes[exposure.channel]  # the table overshot
            self._is_first_time = key not in self._sent and not is_too_far
            self._sent.add(key)
            self._pieces.extend(self._cut(exposure))
        return self._pieces[0] if self._pieces else None

    def take(self) -> Column:
        """Hand the head over."""
        piece = self._pieces.popleft()
        if self._is_first_time:
            self._count += 1
            self._digest = (self._digest + piece.checksum) % 2**32
        return piece

    def expose(self, dt_s: float) -> None:
        """Let the table turn as far as there is room."""
        room = _TURN_COLUMNS if self._is_buffered else _OUTBOX_COLUMNS - len(self._waiting)
        for exposure in self._table.step(dt_s, max(0, room)):
            self._keep(exposure)
        if self._is_buffered and not self._table.is_moving and not self._is_sorted:
            self._is_sorted = True
            self._waiting.extend(sorted(self._held.values(), key=_coarseness))

    def _keep(self, exposure: Exposure) -> None:
        """Remember what was seen."""
        key = (exposure.channel, exposure.pass_index, exposure.column)
        if not self._is_buffered:
            self._waiting.append(exposure)
        self._exposed.add(key)
        self._held[key] = exposure
        if len(self._held) > self._retention_columns:
            del self._held[next(iter(self._held))]

    def cut_short(self) -> None:
        """Send nothing more but the end."""
        self._outcome = Outcome.STOPPED
        self.is_announced = self.owes_end = True
        self._waiting.clear()
        self._again.clear()
        self._pieces.clear()

    def send_again(self, runs: tuple[ColumnRun, ...]) -> list[ColumnRun]:
        """Queue what is still held of these columns; returns those exposed once and held no longer."""
        self.owes_end = True
        gone: list[ColumnRun] = []
        for run in runs:
            for column in range(run.first, run.first + run.count):
                key = (run.channel, run.pass_index, column)
                if key in self._held:
                    self._again.append(self._held[key])
                elif key in self._exposed:
                    gone.append(ColumnRun(run.channel, run.pass_index, column, 1))
        return gone

    def end(self) -> SweepEnd:
        """What SWEEP_END says now."""
        return SweepEnd(self.header.sweep, self._outcome, self._count, self._digest)

    def _cut(self, exposure: Exposure) -> Iterator[Column]:
        """The pieces of one column."""
        samples, piece_of = self._table.samples(exposure), _COLUMN_OF[exposure.channel]
        rows = self._piece_rows[exposure.channel]
        for row0 in range(0, len(samples), rows):
            data = samples[row0 : row0 + rows].tobytes()
            yield piece_of(
                self.header.sweep, exposure.pass_index, exposure.column, row0, exposure.encoder, exposure.time_us, data
            )


def _coarseness(exposure: Exposure) -> tuple[int, int, int, int]:
    """Sort key of a buffered sweep: pass by pass, the columns 16 apart first, then those halfway between, and so on."""
    level = _COARSEST
    while exposure.column % level:
        level //= 2
    return exposure.pass_index, -level, exposure.channel, exposure.column
