"""Going on with a sweep that was cut, if the scanner agrees: the same one, and nothing has moved since.

A scanner that was not switched off still knows the sweep and sends what is missing. One that was, or that gave the
sweep up, is homed; if its calibration is the same, it sweeps again, and what was kept is kept (DESIGN 5).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace

from drivers.ledger import Ledger
from drivers.scanner import Scanner, SweepEvent, SweepFinished, SweepInterrupted, SweepReport, SweepStarted
from node.assemble import Assembler, Assembly
from node.axes import Axes
from node.journal import Interrupted, Journals
from node.resampling import Encoder
from node.turns import STOPPED, TurnEvents, TurnStarted, as_of_sweep, gone_on
from protocol.errors import FoveascanError, ScannerFault
from protocol.scanner_messages import (
    Column,
    DeviceInfo,
    RangeColumn,
    SweepHeader,
    SweepRequest,
    TextureColumn,
)

RESUME_WITHIN_S = 30.0  # a cut sweep goes on by itself this soon; later, whoever stood on the table may have left it


def resumed(
    scanner: Scanner, info: DeviceInfo, sweep: Interrupted, held: list[Column], stop: threading.Event
) -> TurnEvents:
    """What is missing of a sweep, as node.turns.swept would tell it; its columns fit the sweep's own header.

    info : the scanner that is there now.  held : the columns kept.  Raises DriverError as Scanner.sweep does.
    """
    if info.serial_number != sweep.info.serial_number:
        yield _refusal(f"it was begun by scanner {sweep.info.serial_number}, this is {info.serial_number}")
        return
    is_same_boot = info.boot_id == sweep.info.boot_id
    if sweep.turn is not None:
        turn = sweep.turn if is_same_boot else None
        yield from gone_on(scanner, sweep.header, turn, held, stop, anew=True)
        return
    yield SweepStarted(sweep.header)
    ledger = Ledger(sweep.header)
    for column in held:
        ledger.take(column)
    if is_same_boot:
        with closing(scanner.resume(sweep.header, held, stop)) as events:
            for event in events:
                if isinstance(event, SweepInterrupted) and isinstance(event.cause, ScannerFault):
                    break  # it gave the sweep up
                if isinstance(event, RangeColumn | TextureColumn):
                    ledger.take(event)
                if not isinstance(event, SweepStarted):
                    yield event
            else:
                return
    yield from _swept_again(scanner, sweep.header, ledger, stop)


def resumed_by_itself(
    scanner: Scanner, sweep: Interrupted, held: list[Column], stop: threading.Event
) -> TurnEvents:
    """As resumed, for a scanner that was cut off a moment ago: what it knows no longer is not taken again."""
    if sweep.turn is not None:
        return gone_on(scanner, sweep.header, sweep.turn, held, stop, anew=False)
    return scanner.resume(sweep.header, held, stop)


def cut_lately(sweeps: Sequence[Interrupted], info: DeviceInfo, now_unix_s: float) -> Interrupted | None:
    """The sweep that this scanner was in the middle of when the line, or the node, went away a moment ago."""
    for sweep in sweeps:
        is_same = (sweep.info.serial_number, sweep.info.boot_id) == (info.serial_number, info.boot_id)
        is_recent = 0 <= now_unix_s - sweep.ended_unix_s < RESUME_WITHIN_S
        if is_same and is_recent and sweep.why != STOPPED and not sweep.is_complete:
            return sweep
    return None


def publish_complete(
    sweeps: Journals, deliver: Callable[[Assembly], object], repairs: bool = True, axes: Axes | None = None
) -> list[str]:
    """Make scans of the complete sweeps that a crash kept from becoming ones. Returns what was done, or went wrong.

    deliver, repairs, axes : as for publish.
    """
    said = []
    for sweep in filter(lambda sweep: sweep.is_complete, sweeps.interrupted()):
        try:
            publish(sweeps, sweep, deliver, repairs, axes)
            said.append(f"published sweep {sweep.id}, which was complete")
        except (FoveascanError, ValueError) as error:
            said.append(f"could not publish sweep {sweep.id}: {error}")
    return said


def publish(
    sweeps: Journals,
    sweep: Interrupted,
    deliver: Callable[[Assembly], object],
    repairs: bool = True,
    axes: Axes | None = None,
) -> None:
    """Make a scan of one complete sweep.

    deliver : returns once it is durable.  repairs, axes : as for assembled.
    Raises FoveascanError, ValueError.
    """
    assembler = assembler_of(sweep.header)
    for column in sweeps.columns(sweep.id):
        add_column(assembler, column)
    apart = sweep.turn is not None
    deliver(assembled(assembler, sweep.info, sweep.header, axes, repairs=repairs, apart=apart))
    sweeps.delete(sweep.id)


def assembled(
    assembler: Assembler, info: DeviceInfo, header: SweepHeader, axes: Axes | None, *, repairs: bool, apart: bool
) -> Assembly:
    """What became of a sweep whose columns are all in, with who swept it. Raises IncompleteTurn.

    axes : what is known of the scanner's axis; the grid is corrected for it.  repairs : whether spikes are taken out
    and small holes filled.  apart : range and texture were not seen at the same time.
    """
    axis, trouble = axes.of(info.serial_number, header.calibration) if axes else (None, "")
    assembly = assembler.assembly(repairs=repairs, apart=apart, axis=axis)
    quality = replace(assembly.quality, axis_trouble=trouble)
    return replace(assembly, quality=quality, scanner=info.serial_number, settings=header.calibration)


def assembler_of(header: SweepHeader) -> Assembler:
    """What takes a sweep's columns. Raises ValueError where they make no grid."""
    encoder = Encoder(header.counts_per_turn, header.encoder_start, header.direction)
    return Assembler(header.spec, encoder, header.passes + 1)  # one more: an overlap, or what the table overshot


def add_column(assembler: Assembler, column: Column) -> None:
    """Hand a column of the link to an assembler. Raises RemoteWireError when it does not fit."""
    if isinstance(column, RangeColumn):
        assembler.add_range_bytes(column.encoder, column.row0, column.data)
    else:
        assembler.add_texture_bytes(column.encoder, column.row0, column.data)


def _swept_again(
    scanner: Scanner, header: SweepHeader, ledger: Ledger, stop: threading.Event
) -> Iterator[SweepEvent]:
    """Home the table and sweep once more, for the pieces that the ledger lacks."""
    if ledger.held == ledger.expected:
        yield _refusal("every column is there, and the scanner does not confirm them: sweep anew")
        return
    calibration = scanner.calibrate().calibration
    if calibration != header.calibration:
        yield _refusal("the scanner was calibrated anew since")
        return
    s = header.spec
    shape = s.width, s.height, s.texture_width, s.texture_height
    request = SweepRequest(header.channels, header.passes, *shape, overlap=header.overlap)
    with closing(scanner.sweep(request, stop)) as events:
        again = header
        for event in events:
            if isinstance(event, SweepStarted):
                again = event.header
                if _as_of(again, header) != header:
                    yield _refusal("the scanner sweeps otherwise than before")
                    return
            elif isinstance(event, RangeColumn | TextureColumn):
                column = as_of_sweep(event, TurnStarted(again, 0), header)
                if ledger.take(column):
                    yield column
                if ledger.held == ledger.expected:
                    yield SweepFinished(SweepReport(ledger.expected, ledger.held, digest=ledger.digest))
                    return
            else:
                yield event


def _refusal(reason: str) -> SweepInterrupted:
    return SweepInterrupted(reason, ScannerFault(reason), SweepReport())


def _as_of(again: SweepHeader, header: SweepHeader) -> SweepHeader:
    """The new sweep's header with all that may differ taken from the old one."""
    return replace(again, sweep=header.sweep, encoder_start=header.encoder_start)
