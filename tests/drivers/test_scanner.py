"""The driver against the simulated scanner, in one thread and in a time of its own: no test here waits."""

import math
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers.scanner import (
    Scanner,
    ScannerConfig,
    SweepEvent,
    SweepFinished,
    SweepInterrupted,
    SweepProgress,
    SweepStarted,
)
from protocol.errors import LocalWireError, PortLost, ScannerFault
from protocol.framing import FRAME_OVERHEAD, encode_frame
from protocol.grid import Grid, GridSpec
from protocol.scanner_messages import (
    COLUMN_OVERHEAD,
    Channel,
    Fault,
    RangeColumn,
    Reset,
    State,
    SweepRequest,
    TextureColumn,
)
from simulators.carriers import Line, MemoryPort, clean_line
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable

W, H, WT, HT = 48, 600, 64, 400  # columns of two pieces each
SIZE_BYTES = W * H * 2 + WT * HT * 3


def specimen() -> Specimen:
    rng = np.random.default_rng(5)
    steps = rng.integers(0, 60000, (H, W)).astype(np.uint16)
    return Specimen("noise", Grid(GridSpec(W, H, WT, HT, 0.01, 1.0, theta0_rad=0.3), steps,
                                  rng.integers(0, 256, (HT, WT, 3)).astype(np.uint8)))  # fmt: skip


class Bench:
    """A scanner with known truth, its port, and the driver."""

    def __init__(
        self,
        *,
        config: ScannerConfig | None = None,
        turn_s: float = 1.0,
        jitter_counts: float = 0.0,
        home_encoder: int = 0,
        rate_bytes_s: float = math.inf,
        to_node: Line = clean_line,
        **kinds: Any,
    ) -> None:
        self.specimen = specimen()
        table = Turntable(self.specimen, turn_s=turn_s, jitter_counts=jitter_counts, home_encoder=home_encoder)
        self.device = SimulatedScanner(table, **kinds)
        self.port = MemoryPort(self.device, rate_bytes_s=rate_bytes_s, to_node=to_node)
        self.scanner = Scanner(self.port, config, clock=self.port.clock)

    def sweep(
        self,
        request: SweepRequest | None = None,
        stop: threading.Event | None = None,
        at_event: Callable[[int, SweepEvent], object] = lambda count, event: None,
    ) -> SweepEvent:
        """Runs a sweep. Returns its last event; columns go into `range_steps` and `texture`, counts into `seen`."""
        self.range_steps = np.zeros_like(self.specimen.grid.range_steps)
        self.texture = np.zeros_like(self.specimen.grid.texture)
        self.seen, self.pieces = Counter[type](), Counter[tuple[Channel, int, int, int]]()
        for count, event in enumerate(self.scanner.sweep(request or SweepRequest(), stop)):
            self.seen[type(event)] += 1
            if isinstance(event, SweepStarted):
                self.header = event.header
            elif isinstance(event, RangeColumn | TextureColumn):
                target: Any = self.range_steps if isinstance(event, RangeColumn) else self.texture
                target[event.row0 : event.row0 + event.rows, event.column] = event.samples
                self.pieces[event.CHANNEL, event.pass_index, event.column, event.row0] += 1
            at_event(count, event)
        return event

    def is_exact(self) -> bool:
        truth = self.specimen.grid
        return np.array_equal(self.range_steps, truth.range_steps) and np.array_equal(self.texture, truth.texture)


def greeted(**kinds: Any) -> Bench:
    bench = Bench(**kinds)
    bench.scanner.hello()
    return bench


DAMAGES = ["lose", "flip", "noise", "twice", "gone"]


class Damage:
    """A line that spoils some of its portions, the same ones every time."""

    def __init__(self, share: float, kinds: list[str], seed: int = 3) -> None:
        self.rng, self.share, self.kinds = np.random.default_rng(seed), share, kinds

    def __call__(self, data: bytes) -> bytes:
        if not data or self.rng.random() > self.share:
            return data
        at = int(self.rng.integers(len(data)))
        match self.rng.choice(self.kinds):
            case "lose":
                return data[:at] + data[at + 40 :]
            case "flip":
                return data[:at] + bytes([data[at] ^ 0x40]) + data[at + 1 :]
            case "noise":
                return data[:at] + self.rng.bytes(50) + data[at:]
            case "twice":
                return data + data
        return b""


def test_hello_tells_who_is_there() -> None:
    bench = Bench(serial_number="A7", boot_id=77)
    info = bench.scanner.hello()
    assert (info.serial_number, info.boot_id) == ("A7", 77)
    assert info.counts_per_turn % (2 * W) == info.counts_per_turn % (2 * WT) == 0


def test_calibrate_homes_the_table() -> None:
    bench = greeted(calibration=99, home_encoder=1000)
    report = bench.scanner.calibrate()
    assert (report.calibration, report.home_encoder) == (99, 1000)
    assert bench.device.state is State.IDLE


def test_a_sweep_brings_the_truth_piece_by_piece() -> None:
    bench = greeted()
    last = bench.sweep()
    assert bench.is_exact()
    assert isinstance(last, SweepFinished)
    assert last.report.received == last.report.expected == 2 * (W + WT)
    assert last.report.duplicates == last.report.requested_columns == last.report.dropped_bytes == 0
    assert set(bench.pieces.values()) == {1}
    assert bench.header.spec == bench.specimen.grid.spec
    assert bench.seen[SweepStarted] == 1 and bench.seen[SweepProgress] >= 3


def test_sweeps_follow_each_other() -> None:
    bench = greeted()
    for _ in range(3):
        assert isinstance(bench.sweep(), SweepFinished)
        assert bench.is_exact()


@pytest.mark.parametrize("channels", [Channel.RANGE, Channel.TEXTURE])
def test_a_sweep_of_one_channel_brings_that_channel(channels: Channel) -> None:
    bench = greeted()
    assert isinstance(bench.sweep(SweepRequest(channels)), SweepFinished)
    assert {channel for channel, *_ in bench.pieces} == {channels}


def test_several_passes_bring_every_column_of_every_pass() -> None:
    bench = greeted()
    assert isinstance(bench.sweep(SweepRequest(passes=3)), SweepFinished)
    assert bench.is_exact()
    assert {pass_index for _, pass_index, *_ in bench.pieces} == {0, 1, 2}
    assert len(bench.pieces) == 3 * 2 * (W + WT)


def test_jittered_columns_carry_the_angle_they_were_seen_at() -> None:
    bench = greeted(jitter_counts=40.0, home_encoder=-500)
    columns: list[SweepEvent] = []
    bench.sweep(at_event=lambda _, event: columns.append(event))
    seen = [event for event in columns if isinstance(event, RangeColumn) and event.row0 == 0]
    assert len({event.encoder - bench.header.encoder_start for event in seen}) == W
    for event in seen:
        truth = bench.specimen.range_column(float(bench.header.angle_rad(event.encoder)))
        np.testing.assert_array_equal(event.samples, truth[: event.rows])


@pytest.mark.parametrize("kinds", [*([kind] for kind in DAMAGES), DAMAGES])
def test_a_damaged_line_still_brings_the_truth(kinds: list[str]) -> None:
    bench = greeted(rate_bytes_s=300_000)
    bench.port._to_node = Damage(0.2, kinds)
    bench.port._to_scanner = Damage(0.2, kinds, seed=4)
    last = bench.sweep()
    assert isinstance(last, SweepFinished) and bench.is_exact()
    assert set(bench.pieces.values()) == {1}
    if {"lose", "flip", "gone"} & set(kinds):
        assert last.report.requested_columns > 0


def test_what_got_lost_early_is_asked_for_while_the_table_still_turns() -> None:
    bench = greeted(turn_s=4.0, retention_columns=60)  # at the end only the last half turn is held
    bench.port._to_node = Damage(0.05, ["lose"])
    last = bench.sweep()
    assert isinstance(last, SweepFinished) and bench.is_exact()
    assert last.report.requested_columns > 0


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


def test_watching_an_idle_scanner_hears_its_errors_and_its_unplugging() -> None:
    bench = greeted()
    bench.scanner.watch(1.0)
    assert bench.port.clock() == pytest.approx(1.0, abs=0.02)
    bench.port.cancel()
    bench.scanner.watch(60.0)
    assert bench.port.clock() < 2.0
    bench.device._link.send(Fault(3, "jam"))
    with pytest.raises(ScannerFault, match="jam"):
        bench.scanner.watch(1.0)
    assert isinstance(bench.sweep(), SweepFinished)
    bench.port.unplug()
    with pytest.raises(PortLost):
        bench.scanner.watch(60.0)


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


def test_a_sweep_long_after_the_last_one_starts_without_haste() -> None:
    bench = greeted()
    bench.sweep()
    bench.port._now_s += 3600.0
    sent: list[bytes] = []

    def overhear(data: bytes) -> bytes:
        sent.append(data)
        return data

    bench.port._to_scanner = overhear
    assert isinstance(bench.sweep(), SweepFinished)
    assert len({data for data in sent if data[3] == Reset.TYPE}) == 1


def test_a_request_the_scanner_cannot_do_is_a_fault_with_its_reason() -> None:
    bench = greeted()
    with pytest.raises(ScannerFault, match="width is 48, not 50"):
        bench.sweep(SweepRequest(width=50))
    assert isinstance(bench.sweep(SweepRequest(width=48)), SweepFinished)


def test_a_port_without_a_scanner_is_a_fault_that_names_it() -> None:
    bench = Bench(to_node=lambda data: b"")
    with pytest.raises(ScannerFault, match="memory: no answer to Hello; is a scanner connected"):
        bench.scanner.hello()


def test_a_scanner_of_another_version_is_a_fault_that_names_both() -> None:
    def of_version_9(data: bytes) -> bytes:
        return data and encode_frame(0x02, b"", seq=0, session=int.from_bytes(data[6:8], "little"), version=9)

    bench = Bench(to_node=of_version_9)
    with pytest.raises(ScannerFault, match="speaks link version 9, this node 1.1"):
        bench.scanner.hello()


def test_a_sweep_needs_a_greeting() -> None:
    with pytest.raises(LocalWireError, match="hello"):
        Bench().sweep()


def test_greeting_again_during_a_sweep_and_sweeping_anew() -> None:
    bench = greeted(turn_s=10.0)
    bench.sweep(at_event=lambda count, _: bench.port.cancel(), stop=_set())
    assert bench.scanner.hello() == bench.device.info
    assert isinstance(bench.sweep(), SweepFinished) and bench.is_exact()


def _set() -> threading.Event:
    stop = threading.Event()
    stop.set()
    return stop
