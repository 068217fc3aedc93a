"""How fast a simulated line carries bytes, whatever it runs on."""

from __future__ import annotations

import time

CATCH_UP_S = 0.02  # a sleep that came back late may be made good up to this


class Pace:
    """Bytes at a rate. rate_bytes_s : bytes a second; infinite: none is waited for."""

    def __init__(self, rate_bytes_s: float) -> None:
        self._rate_bytes_s = rate_bytes_s
        self._free_s = 0.0

    def wait(self, size_bytes: int) -> None:
        """Sleep as long as the line needs for that many bytes."""
        now_s = time.monotonic()
        self._free_s = max(self._free_s, now_s - CATCH_UP_S) + size_bytes / self._rate_bytes_s
        if self._free_s > now_s:
            time.sleep(self._free_s - now_s)
