"""How fast somebody may go on asking: token buckets, one alone or one for each address."""

from __future__ import annotations

import math
from collections import OrderedDict

ADDRESSES_MAX = 4096
BURST_S = 2.0  # as much as comes in so long may come at once


class Bucket:
    """Lets through `rate_s` a second, and BURST_S of that at once."""

    def __init__(self, rate_s: float, now_s: float) -> None:
        self._rate_s = rate_s
        self._held = BURST_S * rate_s
        self._at_s = now_s

    def take(self, now_s: float) -> float:
        """Count one. Returns 0.0, or how long to wait before the next; then it was not counted. [s]"""
        self._held = min(BURST_S * self._rate_s, self._held + (now_s - self._at_s) * self._rate_s)
        self._at_s = now_s
        if self._held < 1:
            return (1 - self._held) / self._rate_s
        self._held -= 1
        return 0.0


class Buckets:
    """One for each address, of which those are forgotten that asked for nothing the longest."""

    def __init__(self, rate_s: float) -> None:
        self._rate_s = rate_s
        self._buckets: OrderedDict[str, Bucket] = OrderedDict()

    def take(self, address: str, now_s: float) -> float:
        """As Bucket.take, for an address."""
        bucket = self._buckets.get(address) or Bucket(self._rate_s, now_s)
        self._buckets[address] = bucket
        self._buckets.move_to_end(address)
        while len(self._buckets) > ADDRESSES_MAX:
            self._buckets.popitem(last=False)
        return bucket.take(now_s)


def whole_seconds(wait_s: float) -> str:
    """A wait as Retry-After has it."""
    return str(max(1, math.ceil(wait_s)))
