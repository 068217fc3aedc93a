from __future__ import annotations

import pytest

from node import attempts
from node.attempts import Attempts


def test_an_address_is_locked_after_its_limit_until_its_failures_are_old() -> None:
    wrong = Attempts(3, 60)
    for now_s in (0.0, 10.0, 20.0):
        assert not wrong.is_locked("10.0.0.1", now_s)
        wrong.failed("10.0.0.1", now_s)
    assert wrong.is_locked("10.0.0.1", 59.9)
    assert not wrong.is_locked("10.0.0.2", 59.9)
    assert not wrong.is_locked("10.0.0.1", 60.0)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("fe80::1%eth0", "fe80::2%eth0", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("::ffff:10.0.0.1", "10.0.0.1", True),
    ],
)
def test_a_network_of_one_host_counts_as_one(one: str, other: str, same: bool) -> None:
    wrong = Attempts(1, 60)
    wrong.failed(one, 0)
    assert wrong.is_locked(other, 0) == same


def test_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attempts, "ADDRESSES_MAX", 10)
    wrong = Attempts(1, 60)
    for number in range(100):
        wrong.failed(f"10.0.0.{number}", 0)
    assert not wrong.is_locked("10.0.0.0", 0)
    assert wrong.is_locked("10.0.0.99", 0)
