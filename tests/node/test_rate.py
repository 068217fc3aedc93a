from __future__ import annotations

import pytest

from node.rate import RateControl


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
