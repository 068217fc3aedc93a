"""Who computes while columns come fast."""

import threading
import time

import pytest

from drivers.scanner import SweepEvent, SweepFinished, SweepInterrupted, SweepReport
from node.right_of_way import FAST_BYTES_S, PORTION_BYTES, REST, STILL_S, WAIT_MAX_S, WAIT_S, RightOfWay
from protocol.scanner_messages import RangeColumn

COLUMN = RangeColumn(1, 0, 0, 0, 0, 0, bytes(8192))


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def pass_columns(way: RightOfWay, clock: Clock, rate_bytes_s: float) -> None:
    for _ in range(4 * PORTION_BYTES // len(COLUMN.data)):
        clock.now_s += len(COLUMN.data) / rate_bytes_s
        way.watch(COLUMN)


@pytest.mark.parametrize(("rate_bytes_s", "is_taken"), [(300e3, False), (35e6, True)])
def test_columns_go_first_only_where_they_come_fast(rate_bytes_s: float, is_taken: bool) -> None:
    clock = Clock()
    way = RightOfWay(clock)
    pass_columns(way, clock, rate_bytes_s)
    assert way.is_taken == is_taken
    clock.now_s += STILL_S
    assert not way.is_taken


@pytest.mark.parametrize("end", [SweepFinished(SweepReport()), SweepInterrupted("stopped", None, SweepReport())])
def test_a_sweep_that_was_fast_goes_first_to_its_end_however_slow_it_gets(end: SweepEvent) -> None:
    clock = Clock()
    way = RightOfWay(clock)
    pass_columns(way, clock, 35e6)
    pass_columns(way, clock, 0.5 * FAST_BYTES_S)
    assert way.is_taken
    way.watch(end)
    assert not way.is_taken
    pass_columns(way, clock, 0.5 * FAST_BYTES_S)
    assert not way.is_taken


def test_columns_that_were_kept_waiting_and_come_at_once_make_no_fast_sweep() -> None:
    clock = Clock()
    way = RightOfWay(clock)
    for _ in range(3):
        pass_columns(way, clock, 0.25 * FAST_BYTES_S)
        clock.now_s += 4 * PORTION_BYTES / (0.25 * FAST_BYTES_S)  # of what came meanwhile nothing was read
        pass_columns(way, clock, 35e6)
        assert not way.is_taken


def test_a_sweep_after_another_is_measured_anew() -> None:
    clock = Clock()
    way = RightOfWay(clock)
    pass_columns(way, clock, 300e3)
    way.watch(SweepFinished(SweepReport()))
    pass_columns(way, clock, 35e6)
    assert way.is_taken


def test_without_columns_nobody_waits_for_anybody() -> None:
    way, inside = RightOfWay(), threading.Barrier(2, timeout=5)

    def compute() -> None:
        with way.given():
            inside.wait()

    other = threading.Thread(target=compute)
    other.start()
    compute()
    other.join()


def test_beside_fast_columns_one_computes_at_a_time_and_after_a_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    way, waited = RightOfWay(clock), list[float]()
    pass_columns(way, clock, 35e6)
    began_s, last_s = clock.now_s, clock.now_s

    def sleep(time_s: float) -> None:
        pass_columns(way, clock, 35e6)

    monkeypatch.setattr(time, "sleep", sleep)
    for _ in range(3):
        with way.given():
            waited.append(clock.now_s - last_s)
            last_s = clock.now_s
            assert way._one.locked()
    assert all(WAIT_S <= wait_s < 2 * WAIT_S for wait_s in waited) and clock.now_s > began_s


@pytest.mark.parametrize(("took_s", "rests_s"), [(0.2, 0.2 * REST), (5.0, WAIT_MAX_S)])
def test_a_pause_is_as_long_as_what_was_computed_before_it_asks_for_and_no_longer_than_anybody_waits(
    took_s: float, rests_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    way = RightOfWay(clock)
    monkeypatch.setattr(time, "sleep", lambda time_s: pass_columns(way, clock, 35e6))
    pass_columns(way, clock, 35e6)
    with way.given():
        clock.now_s += took_s
        pass_columns(way, clock, 35e6)
    began_s = clock.now_s
    with way.given():
        assert 0.9 * rests_s < clock.now_s - began_s < rests_s + 0.2


def test_whoever_waits_goes_on_when_the_sweep_is_over() -> None:
    way = RightOfWay()
    way._taken_until_s = time.monotonic() + 0.05
    began_s = time.monotonic()
    with way.given():
        assert not way.is_taken and time.monotonic() - began_s >= 0.05
