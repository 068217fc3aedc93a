"""The device's end of two bulk endpoints, as a carrier's port: what it sends waits there, and so does what came."""

from __future__ import annotations

import threading
import time
from collections import deque

from simulators.pace import Pace

OUT_WAITING_BYTES = 1 << 20


class UsbPipes:
    """For UsbTestbed and UsbGadget, which move what is in `_out` and `_in` under `_changed`, and say `_fetched`.

    stalls : halts to come, each before a transfer.  waited_s : for the node to fetch what the device has to send.
    rate_bytes_s : speed towards the node.
    """

    def __init__(self, rate_bytes_s: float) -> None:
        self.stalls = 0
        self.waited_s = 0.0
        self._pace = Pace(rate_bytes_s)
        lock = threading.RLock()
        self._changed, self._drained = threading.Condition(lock), threading.Condition(lock)
        self._out: deque[memoryview] = deque()
        self._in: deque[bytes] = deque()
        self._is_cancelled = False

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """What the node wrote, one transfer or one packet at a time."""
        with self._changed:
            self._changed.wait_for(lambda: self._in or self._is_cancelled, max(timeout_s, 0.0))
            self._is_cancelled = False
            return self._in.popleft() if self._in else b""

    def write(self, data: bytes) -> None:
        """Send `data` as packets, the last one short; waits while the node does not fetch them, until `cancel`."""
        if not data:
            return
        with self._changed:
            if self._waiting_bytes() >= OUT_WAITING_BYTES:  # then until there is room for many: fewer wake-ups
                began_s = time.monotonic()
                self._drained.wait_for(lambda: self._waiting_bytes() <= OUT_WAITING_BYTES // 2 or self._is_cancelled)
                self.waited_s += time.monotonic() - began_s
            self._out.append(memoryview(data))
            self._sent()
        self._pace.wait(len(data))

    def cancel(self) -> None:
        """Wake who waits in read or write."""
        with self._changed:
            self._is_cancelled = True
            self._changed.notify_all()
            self._drained.notify_all()

    def _sent(self) -> None:
        """Something is in `_out` that was not; `_changed` is held."""
        self._changed.notify_all()

    def _fetched(self) -> None:
        """Something was in `_out` that is not any more; `_changed` is held."""
        if self._waiting_bytes() <= OUT_WAITING_BYTES // 2:
            self._drained.notify_all()

    def _waiting_bytes(self) -> int:
        return sum(map(len, self._out))
