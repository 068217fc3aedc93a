from __future__ import annotations

import pytest

from node.rate import SAMPLE_BYTES_MIN, RateControl, Sending


def test_budget_is_bandwidth_times_the_time_that_is_left() -> None:
    rate = RateControl(100_000)
    assert rate.budget_bytes(0.5) == 50_000
    rate.acknowledged(100_000, 1.0, 0.0)
    rate.pinged(0.1)
    rate.encoded(0.05)
    rate.acknowledged(100, 0.1 + 0.02, 0.02)
    assert rate.budget_bytes(0.5) == pytest.approx(100_000 * (0.5 - 0.1 - 0.05 - 0.02), abs=1)


def test_no_time_no_bytes() -> None:
    rate = RateControl(100_000)
    rate.pinged(0.6)
    assert rate.budget_bytes(0.5) == 0


def test_bandwidth_follows_what_large_updates_show() -> None:
    rate = RateControl(1_000_000)
    for _ in range(40):
        rate.acknowledged(20_000, 1.0, 0.0)
    assert rate.bandwidth_bytes_s == pytest.approx(20_000, rel=0.05)


def test_the_first_transfer_replaces_the_guess() -> None:
    rate = RateControl(1_000_000)
    rate.acknowledged(12_000, 6.0, 0.0)
    assert rate.bandwidth_bytes_s == 2_000


def test_small_updates_say_nothing_about_bandwidth() -> None:
    rate = RateControl(50_000)
    rate.acknowledged(50_000, 1.0, 0.0)
    rate.acknowledged(1000, 3.0, 0.0)
    assert rate.bandwidth_bytes_s == 50_000


def test_bandwidth_never_rises_by_more_than_half_at_once() -> None:
    rate = RateControl(10_000)
    rate.acknowledged(10**9, 0.001, 0.0)
    assert rate.bandwidth_bytes_s <= 15_000
    rate.acknowledged(10_000, 0.0, 0.0)
    assert rate.bandwidth_bytes_s <= 22_500


def in_two(ahead: int, gap_s: float, rest: int) -> Sending:
    sending = Sending(100.0)
    sending.sent(ahead)
    sending.goes_on(100.0 + gap_s)
    sending.sent(rest)
    return sending


def test_what_was_sent_at_once_took_as_long_as_it_took() -> None:
    sending = Sending(100.0)
    sending.sent(10_000)
    sending.sent(5_000)
    assert sending.fastest(102.0) == (15_000, 2.0)


@pytest.mark.parametrize("gap_s", [0.0, 0.05, 0.1, 0.3, 5.0])
def test_a_link_is_as_fast_as_it_is_whatever_came_ahead(gap_s: float) -> None:
    """20 kB ahead take 0.1 s at 200 kB/s, 40 kB after them 0.2 s more, from the end of the gap on or of the 20 kB."""
    found = in_two(20_000, gap_s, 40_000).fastest(100.0 + max(gap_s, 0.1) + 0.2)
    assert found is not None
    assert found[0] / found[1] == pytest.approx(200_000)


def test_a_short_rest_does_not_tell() -> None:
    assert in_two(100_000, 3.0, SAMPLE_BYTES_MIN - 1).fastest(104.0) is None
    assert in_two(100_000, 3.0, 0).fastest(103.0) is None
