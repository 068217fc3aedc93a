"""A sweep on a fast line goes first: what threads compute for clients waits while columns come.

All threads share one interpreter. Columns at the full speed of USB need it a hundred times between two moments at which
a thread that computes would let go of it, so while they come, that is done one at a time, with pauses in which the
capture thread makes good what it was kept from. On a serial line nothing ever waits, nor what a process plans.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from drivers.scanner import SweepEvent, SweepFinished, SweepInterrupted, SweepStarted
from protocol.scanner_messages import RangeColumn, TextureColumn

_COLUMNS = (RangeColumn, TextureColumn)

FAST_BYTES_S = 4e6
PORTION_BYTES = 1 << 18
TELLING_BYTES = 1 << 20  # fewer do not tell how fast a sweep is: a thread that was kept waiting finds as many at once
STILL_S = 0.25  # a fast sweep that brings nothing for longer takes the way no more
WAIT_S = 0.25
REST = 3.0  # a pause is at least that many times as long as what was computed before it
WAIT_MAX_S = 1.0  # nobody waits longer for the columns: clients go on seeing something
LOOK_S = 0.01


class RightOfWay:
    """Who goes first. `watch` is for the capture thread, `given` for all that compute.  clock : in seconds."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began_s = 0.0
        self._bytes = self._measured_bytes = 0
        self._is_fast = False
        self._taken_until_s = 0.0
        self._rest_until_s = 0.0
        self._one = threading.Lock()

    def watch(self, event: SweepEvent) -> None:
        """Take in what happens in a sweep; for the capture thread."""
        if isinstance(event, _COLUMNS):
            if not self._bytes:
                self._began_s = self._clock()
            self._bytes += len(event.data)
            if self._bytes >= self._measured_bytes + PORTION_BYTES:
                self._measure(self._clock())
        elif isinstance(event, SweepStarted | SweepFinished | SweepInterrupted):
            self._bytes = self._measured_bytes = 0
            self._is_fast, self._taken_until_s = False, 0.0

    def _measure(self, now_s: float) -> None:
        """Another portion has come. All of a sweep tells how fast it is: a part that was kept waiting comes at once.

        A sweep that was fast once counts as fast to its end: it may be we who slow it.
        """
        self._measured_bytes = self._bytes
        self._is_fast |= self._bytes >= TELLING_BYTES and (now_s - self._began_s) * FAST_BYTES_S < self._bytes
        if self._is_fast:
            self._taken_until_s = now_s + STILL_S

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
            began_s = self._clock()
            until_s = min(max(began_s + WAIT_S, self._rest_until_s), began_s + WAIT_MAX_S)
            while self.is_taken and self._clock() < until_s:
                time.sleep(LOOK_S)
            began_s = self._clock()
            yield
            now_s = self._clock()
            self._rest_until_s = now_s + REST * (now_s - began_s)
