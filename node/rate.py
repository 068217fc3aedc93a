"""How many bytes a client can be sent in the time it is willing to wait.

Source: Cheng, Basu, Pan 2003, Eq. (15), with REQUIREMENTS F-15: bytes = B (T - RTT_min - p95 of encoding - apply time).
"""

from __future__ import annotations

from collections import deque
from itertools import accumulate

import numpy as np

SAMPLE_BYTES_MIN = 8192  # shorter transfers say more about latency than about bandwidth
WEIGHT = 0.3  # of the newest sample
RISE_MAX = 1.5
BANDWIDTH_BYTES_S = (1e3, 1e9)
ENCODES_KEPT = 32
PERCENTILE = 95


class Sending:
    """The bytes of one update on their way, sent in one go or, when it was begun ahead of its end, in two."""

    def __init__(self, now_s: float) -> None:
        self._parts = [(now_s, 0)]

    def goes_on(self, now_s: float) -> None:
        """The rest is sent from now on."""
        self._parts.append((now_s, 0))

    def sent(self, size_bytes: int) -> None:
        """So much more was handed over."""
        began_s, before = self._parts[-1]
        self._parts[-1] = began_s, before + size_bytes

    def fastest(self, now_s: float) -> tuple[int, float] | None:
        """How many bytes took how long; None where that tells nothing of the link, which stood still meanwhile.

        If the beginning was still on its way when the rest was sent, all of it tells, else the rest does: the faster.
        """
        if len(self._parts) > 1 and self._parts[-1][1] < SAMPLE_BYTES_MIN:
            return None
        totals = accumulate(size_bytes for _, size_bytes in reversed(self._parts))
        spans = [(total, now_s - began_s) for total, (began_s, _) in zip(totals, reversed(self._parts), strict=True)]
        return max(spans, key=lambda span: span[0] / max(span[1], 1e-9))


class RateControl:
    """What is known of one client's link. Times are in seconds, of any clock that only moves forward."""

    def __init__(self, cold_start_bytes_s: float) -> None:
        self.bandwidth_bytes_s = cold_start_bytes_s
        self._is_guess = True
        self._round_trip_s: float | None = None
        self._apply_s = 0.0
        self._encode_s: deque[float] = deque(maxlen=ENCODES_KEPT)

    @property
    def round_trip_s(self) -> float:
        """Shortest round trip seen; 0 before the first."""
        return self._round_trip_s or 0.0

    def pinged(self, round_trip_s: float) -> None:
        """A message of no size came back."""
        self._round_trip_s = min(self._round_trip_s or round_trip_s, round_trip_s)

    def encoded(self, seconds: float) -> None:
        """An update took so long to plan and encode."""
        self._encode_s.append(seconds)

    def acknowledged(self, size_bytes: int, elapsed_s: float, apply_s: float) -> None:
        """size_bytes were acknowledged elapsed_s after the first was sent; apply_s of that went into applying them."""
        self._apply_s = apply_s
        travel_s = elapsed_s - apply_s - self.round_trip_s
        if size_bytes < SAMPLE_BYTES_MIN and not self._is_guess:
            if elapsed_s > apply_s:
                self.pinged(elapsed_s - apply_s)
            return
        sample = size_bytes / travel_s if travel_s > 0 else self.bandwidth_bytes_s * RISE_MAX
        sample = min(sample, self.bandwidth_bytes_s * RISE_MAX)
        weight = 1.0 if self._is_guess else WEIGHT  # the first view already tells more than any configured value
        self._is_guess = False
        mixed = (1 - weight) * self.bandwidth_bytes_s + weight * sample
        self.bandwidth_bytes_s = min(max(mixed, BANDWIDTH_BYTES_S[0]), BANDWIDTH_BYTES_S[1])

    def budget_bytes(self, wait_s: float) -> int:
        """What can arrive and be drawn within wait_s; 0 when nothing can."""
        encode_s = float(np.percentile(self._encode_s, PERCENTILE)) if self._encode_s else 0.0
        return max(int(self.bandwidth_bytes_s * (wait_s - self.round_trip_s - encode_s - self._apply_s)), 0)
