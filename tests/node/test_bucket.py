"""Token buckets: so many at once, so many a second, and how long to wait."""

from __future__ import annotations

import pytest

from node import bucket
from node.bucket import BURST_S, Bucket, Buckets, whole_seconds


def test_a_burst_passes_and_then_the_rate() -> None:
    tokens = Bucket(10, now_s=0.0)
    assert [tokens.take(0.0) for _ in range(int(BURST_S * 10))] == [0.0] * 20
    assert tokens.take(0.0) == pytest.approx(0.1)
    assert tokens.take(0.1) == 0.0
    assert tokens.take(0.1) > 0
    assert sum(tokens.take(100.0) == 0.0 for _ in range(30)) == 20  # what was not used does not add up for ever


def test_addresses_do_not_share(monkeypatch: pytest.MonkeyPatch) -> None:
    tokens = Buckets(0.5)
    assert (tokens.take("a", 0.0), tokens.take("a", 0.0) > 0, tokens.take("b", 0.0)) == (0.0, True, 0.0)
    monkeypatch.setattr(bucket, "ADDRESSES_MAX", 2)
    tokens.take("c", 0.0)
    assert tokens.take("b", 0.0) > 0  # asked lately, so remembered


def test_waits_are_whole_seconds() -> None:
    assert [whole_seconds(wait_s) for wait_s in (0.01, 1.0, 1.2)] == ["1", "1", "2"]
