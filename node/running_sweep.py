"""A sweep on its way from the scanner to a grid, or to the interrupted sweeps, whichever comes first."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from drivers.scanner import SweepReport
from node.assemble import Assembler, Assembly
from node.axes import Axes
from node.journal import Journal, Journals
from node.resume import add_column, assembled, assembler_of
from node.turns import TurnStarted
from protocol.errors import RemoteWireError, ScannerFault
from protocol.scanner_messages import Column, DeviceInfo, Outcome, SweepEnd, SweepHeader


class RunningSweep:
    """A sweep on its way: every column goes to the journal, then to the assembler.

    sweeps : where journals are; None: nothing is kept.  info : the scanner.
    sweep_id, held : the interrupted sweep that goes on, and its columns; None and nothing for a new one.
    repairs : whether spikes are taken out and small holes filled.  axes : what is known of the scanner's axis.
    """

    def __init__(
        self,
        sweeps: Journals | None,
        info: DeviceInfo,
        sweep_id: str | None = None,
        held: Sequence[Column] = (),
        *,
        repairs: bool = True,
        axes: Axes | None = None,
    ) -> None:
        self.held = held
        self._repairs = repairs
        self._axes = axes
        self._sweeps = sweeps
        self._info = info
        self._sweep_id = sweep_id
        self._journal: Journal | None = None
        self._header: SweepHeader | None = None
        self._has_turns = False
        self._assembler: Assembler | None = None

    def begin(self, header: SweepHeader) -> None:
        """Make room for it. Raises ScannerFault where it fits no grid, LibraryError where it fits no disk."""
        try:
            self._assembler = assembler_of(header)
        except ValueError as error:
            raise ScannerFault(f"the scanner's sweep makes no sense: {error}") from error
        self._header = header
        if self._sweeps is not None and self._sweep_id is not None:
            self._journal = self._sweeps.reopen(self._sweep_id)
        elif self._sweeps is not None:
            self._journal = self._sweeps.begin(self._info, header, time.time())
        for column in self.held:
            self._assemble(column)

    def take(self, column: Column) -> None:
        """Keep a column. Raises ScannerFault where it fits no grid, LibraryError where it fits no disk."""
        if self._journal is not None:
            self._journal.add(column)
        self._assemble(column)

    def begin_turn(self, turn: TurnStarted) -> None:
        """The columns that follow are of this turn. Raises LibraryError where it fits no disk."""
        self._has_turns = True
        if self._journal is not None:
            self._journal.begin_turn(turn)

    def flush(self) -> None:
        """See to it that what was taken gets to the disk. Raises LibraryError."""
        if self._journal is not None:
            self._journal.flush()

    def finish(self, deliver: Callable[[Assembly], None], report: SweepReport) -> None:
        """Every column is in: deliver the grid. Raises FoveascanError; then the journal is still there."""
        assert self._assembler is not None and self._header is not None
        self.flush()
        assembly = assembled(
            self._assembler, self._info, self._header, self._axes, repairs=self._repairs, apart=self._has_turns
        )
        quality = replace(
            assembly.quality, requested_columns=report.requested_columns, dropped_bytes=report.dropped_bytes
        )
        if self._journal is not None:
            self._journal.confirm(SweepEnd(self._header.sweep, Outcome.COMPLETE, report.received, report.digest))
            self._journal.close()
        deliver(replace(assembly, quality=quality))
        if self._journal is not None and self._sweeps is not None:
            self._sweeps.discard(self._journal)
            self._journal = None

    def leave(self, why: str) -> None:
        """It ended early: what was kept of it is an interrupted sweep from now on."""
        if self._journal is not None and self._sweeps is not None:
            self._sweeps.keep(self._journal, why)
            self._journal = None

    def _assemble(self, column: Column) -> None:
        assert self._assembler is not None
        try:
            add_column(self._assembler, column)
        except RemoteWireError as error:
            raise ScannerFault(f"the scanner's sweep makes no sense: {error}") from error
