"""The driver against the simulated scanner, in one thread and in a time of its own: no test here waits."""


import numpy as np
import pytest

from drivers.scanner import SweepEvent, SweepFinished, SweepProgress, SweepStarted
from protocol.errors import LocalWireError, PortLost, ScannerFault
from protocol.framing import encode_frame
from protocol.scanner_messages import Channel, Fault, RangeColumn, Reset, State, SweepRequest
from tests.drivers.bench import DAMAGES, WT, Bench, Damage, W, already_set, greeted


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
    bench.sweep(at_event=lambda count, _: bench.port.cancel(), stop=already_set())
    assert bench.scanner.hello() == bench.device.info
    assert isinstance(bench.sweep(), SweepFinished) and bench.is_exact()


