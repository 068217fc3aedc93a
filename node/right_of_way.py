"""A sweep on a fast line goes first: what is computed for clients waits while columns come.

All threads share one interpreter. Columns at the full speed of USB need it a hundred times between two moments at which
a thread that plans an update would let go of it, so while they come, updates are made one at a time, with pauses. On a
serial line nothing ever waits.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.scanner import SweepEvent
from protocol.scanner_messages import RangeColumn, TextureColumn

FAST_BYTES_S = 4e6
PORTION_BYTES = 1 << 18
WAIT_S = 0.25  # nobody waits longer for the columns: clients go on seeing something
LOOK_S = 0.01


class RightOfWay:
    """Who goes first. `watch` is for the capture thread, `given` for all that compute.  clock : in seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._since_s = 0.0
        self._bytes = 0
        self._taken_until_s = 0.0
        self._one = threading.Lock()

    def watch(self, event: SweepEvent) -> None:
        """Take in what happens in a sweep; for the capture thread."""
        if not isinstance(event, RangeColumn | TextureColumn):
            return
        self._bytes += len(event.data)
        if self._bytes < PORTION_BYTES:
            return
        now_s = self._clock()
        took_s = now_s - self._since_s
        if took_s * FAST_BYTES_S < self._bytes:
            self._taken_until_s = now_s + PORTION_BYTES / FAST_BYTES_S
        self._since_s, self._bytes = now_s, 0

    @property
    def is_taken(self) -> bool:
        """Whether columns come fast."""
        return self._clock() < self._taken_until_s

    @contextmanager
    def given(self) -> Iterator[None]:
        """Compute inside: at once while no columns come fast, else after a pause, and nobody else beside."""
        if not self.is_taken:
            yield
            return
        with self._one:
            until_s = self._clock() + WAIT_S
            while self.is_taken and self._clock() < until_s:
                time.sleep(LOOK_S)
            yield
