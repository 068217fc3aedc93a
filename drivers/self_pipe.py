"""Waiting for a descriptor in one thread, and ending that wait from another, by the self-pipe trick."""

from __future__ import annotations

import os
import select
import threading


class SelfPipe:
    """Waits for one descriptor to read from. Used by one thread; only `wake` may be called from another.

    By poll: select takes no descriptor above 1023, and a node with many clients has more.
    """

    def __init__(self, descriptor: int) -> None:
        self._woken, self._wake = os.pipe()
        self._closing = threading.Lock()  # else a wake may reach a file that was opened since, under the same number
        self._poll = select.poll()
        for end in (descriptor, self._woken):
            self._poll.register(end, select.POLLIN)

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called."""
        return self._woken < 0

    def wait(self, timeout_s: float) -> bool:
        """Whether there is something to read, if only the end: False when the time is over or `wake` was called."""
        ready = [end for end, _ in self._poll.poll(1000 * max(timeout_s, 0.0))]
        if self._woken in ready:
            os.read(self._woken, 1)
            return False
        return bool(ready)

    def wake(self) -> None:
        """End the wait that runs, or else the next one; of no effect once closed."""
        with self._closing:
            if not self.is_closed:
                os.write(self._wake, b"x")

    def close(self) -> None:
        """Let go of the pipe; harmless when repeated."""
        with self._closing:
            if not self.is_closed:
                for end in (self._woken, self._wake):
                    os.close(end)
                self._woken = self._wake = -1
