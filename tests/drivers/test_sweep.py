"""Sweeps that do not go straight to their end: cut, silent, stopped, slow, gone on with. No test here waits."""

import threading

import pytest

from drivers.scanner import Scanner, ScannerConfig, SweepEvent, SweepFinished, SweepInterrupted, SweepStarted
from protocol.errors import PortLost, ScannerFault
from protocol.framing import FRAME_OVERHEAD
from protocol.scanner_messages import COLUMN_OVERHEAD, Fault, RangeColumn, Reset, State, SweepRequest, TextureColumn
from simulators.carriers import MemoryPort, clean_line
from simulators.scanner import SimulatedScanner
from simulators.turntable import Turntable
from tests.drivers.bench import WT, Bench, Damage, W, greeted


def test_columns_the_scanner_no_longer_holds_interrupt_the_sweep() -> None:
    bench = greeted(turn_s=0.05, retention_columns=4)
    damage = Damage(0.5, ["lose"])
    bench.port._to_node = lambda data: damage(data) if len(data) > 200 else data
    last = bench.sweep()
    assert isinstance(last, SweepInterrupted) and "holds them no longer" in last.reason
    assert last.report.received < last.report.expected


def test_a_line_that_never_carries_a_column_interrupts_the_sweep() -> None:
    bench = greeted()
    columns = (RangeColumn.TYPE, TextureColumn.TYPE)
    bench.port._to_node = lambda data: data if len(data) < 200 and data[3:4] and data[3] not in columns else b""
    last = bench.sweep()
    assert isinstance(last, SweepInterrupted)
    assert bench.seen[RangeColumn] == 0


def test_a_silent_scanner_interrupts_the_sweep_after_the_quiet_time() -> None:
    bench = greeted(config=ScannerConfig(quiet_s=1.0))
    silent_s: list[float] = []

    def fall_silent(count: int, event: SweepEvent) -> None:
        if count == 20:
            bench.port._to_node = lambda data: b""
            silent_s.append(bench.port.clock())

    last = bench.sweep(at_event=fall_silent)
    assert isinstance(last, SweepInterrupted) and "silent" in last.reason
    assert isinstance(last.cause, ScannerFault)
    assert 1.0 <= bench.port.clock() - silent_s[0] <= 1.5


def test_a_scanner_that_started_anew_in_a_sweep_sweeps_again_without_being_asked_twice() -> None:
    bench = greeted(config=ScannerConfig(quiet_s=1.0))

    def start_anew(count: int, _: SweepEvent) -> None:
        if count == 20:
            bench.port._scanner = SimulatedScanner(Turntable(bench.specimen), boot_id=2)

    assert isinstance(bench.sweep(at_event=start_anew), SweepInterrupted)
    assert isinstance(bench.sweep(), SweepFinished) and bench.is_exact()


def test_a_pulled_plug_interrupts_the_sweep_and_says_so() -> None:
    bench = greeted()
    last = bench.sweep(at_event=lambda count, _: bench.port.unplug() if count == 20 else None)
    assert isinstance(last, SweepInterrupted) and isinstance(last.cause, PortLost)
    with pytest.raises(PortLost):
        bench.scanner.hello()


def test_an_error_of_the_scanner_interrupts_the_sweep_with_its_words() -> None:
    bench = greeted()
    last = bench.sweep(at_event=lambda count, _: bench.device._link.send(Fault(3, "jam")) if count == 20 else None)
    assert isinstance(last, SweepInterrupted) and last.reason == "scanner error 3: jam"
    assert isinstance(last.cause, ScannerFault)


def test_a_caller_that_leaves_at_the_last_event_has_answered_the_scanner() -> None:
    bench = greeted()
    for event in bench.scanner.sweep(SweepRequest()):
        if isinstance(event, SweepFinished):
            break
    bench.device.step(bench.port.clock())
    assert bench.device._link.commands_pending == 0


def cut_at(bench: Bench, count: int) -> list[RangeColumn | TextureColumn]:
    """Sweep, and lose the line after some events. Returns the columns that came."""
    columns = []
    for number, event in enumerate(bench.scanner.sweep(SweepRequest())):
        if isinstance(event, SweepStarted):
            bench.header = event.header
        elif isinstance(event, RangeColumn | TextureColumn):
            columns.append(event)
        if number == count:
            bench.port.unplug()
    bench.port = MemoryPort(bench.device)
    bench.port._now_s = 100.0
    bench.scanner = Scanner(bench.port, clock=bench.port.clock)
    return columns


@pytest.mark.parametrize("count", [1, 60, 190])
def test_a_sweep_goes_on_where_the_line_was_lost(count: int) -> None:
    bench = greeted(rate_bytes_s=300_000)
    held = cut_at(bench, count)
    bench.scanner.hello()
    events = list(bench.scanner.resume(bench.header, held))
    assert isinstance(events[0], SweepStarted) and isinstance(events[-1], SweepFinished)
    columns = [event for event in events if isinstance(event, RangeColumn | TextureColumn)]
    names = {(column.CHANNEL, column.column, column.row0) for column in (*held, *columns)}
    assert len(held) + len(columns) == len(names) == 2 * (W + WT)


def test_a_sweep_that_the_scanner_forgot_does_not_go_on() -> None:
    bench = greeted(rate_bytes_s=300_000)
    held = cut_at(bench, 60)
    bench.scanner.hello()
    bench.scanner._command(Reset())
    last = list(bench.scanner.resume(bench.header, held))[-1]
    assert isinstance(last, SweepInterrupted) and "refused" in last.reason


def test_a_scanner_that_was_idle_for_long_is_heard_before_it_is_given_up() -> None:
    bench = greeted(rate_bytes_s=300_000)
    held = cut_at(bench, 60)
    bench.scanner.hello()
    bench.scanner._command(Reset())
    until_s = bench.port.clock() + 10
    while bench.port.clock() < until_s:
        bench.scanner.watch(1.0)
    last = list(bench.scanner.resume(bench.header, held))[-1]
    assert isinstance(last, SweepInterrupted) and "refused" in last.reason


def test_a_scanner_that_did_not_answer_whether_it_goes_on_can_be_homed() -> None:
    bench = greeted(rate_bytes_s=300_000)
    held = cut_at(bench, 60)
    bench.scanner.hello()
    bench.scanner._command(Reset())
    bench.port._to_node = lambda data: b""
    last = list(bench.scanner.resume(bench.header, held))[-1]
    assert isinstance(last, SweepInterrupted) and "silent" in last.reason
    bench.port._to_node = clean_line
    assert bench.scanner.calibrate().calibration == bench.header.calibration


def test_stop_ends_the_sweep_and_the_scanner_is_free_again() -> None:
    bench, stop = greeted(turn_s=10.0), threading.Event()
    last = bench.sweep(stop=stop, at_event=lambda count, _: stop.set() if count == 20 else None)
    assert isinstance(last, SweepInterrupted) and last.reason == "stopped" and last.cause is None
    assert last.report.received < last.report.expected
    assert isinstance(bench.sweep(), SweepFinished)


def test_a_caller_that_walks_away_stops_the_table() -> None:
    bench = greeted(turn_s=10.0)
    events = bench.scanner.sweep(SweepRequest())
    while not isinstance(next(events), RangeColumn):
        pass
    events.close()
    bench.port.read(65536, 0.5)
    assert bench.device.state is State.HOLDING
    assert isinstance(bench.sweep(), SweepFinished)


def test_a_slow_caller_makes_the_table_wait_and_loses_nothing() -> None:
    window_bytes = 4096
    bench = greeted(config=ScannerConfig(window_bytes=window_bytes), turn_s=0.01)
    taken: list[int] = []

    def check_how_far_ahead(_: int, event: SweepEvent) -> None:
        if isinstance(event, RangeColumn | TextureColumn):
            taken.append(FRAME_OVERHEAD + COLUMN_OVERHEAD + len(event.data))
        bench.device.step(bench.port.clock())
        assert bench.device._link.sent_bytes - sum(taken) <= window_bytes

    assert isinstance(bench.sweep(at_event=check_how_far_ahead), SweepFinished)
    assert bench.is_exact()


def test_a_caller_that_pauses_for_long_is_no_silent_scanner() -> None:
    bench = greeted()

    def pause(count: int, _: SweepEvent) -> None:
        bench.port._now_s += 30.0 if count in (20, 60) else 0.0

    last = bench.sweep(at_event=pause)
    assert isinstance(last, SweepFinished) and bench.is_exact()
