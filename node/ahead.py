"""What an update begins with, handed from the thread that plans it to the event loop while the rest is planned."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Lock

from node.coded import Coded


class Ahead:
    """Of one look. Either it is given up, or something of it is sent ahead and it is planned to its end: never both.

    Made in the event loop; `superseded` and `send` are for planning threads. first : done once something is to be sent.
    """

    def __init__(self, is_given_up: Callable[[], bool]) -> None:
        self._loop = asyncio.get_running_loop()
        self.first: asyncio.Future[Sequence[Coded]] = self._loop.create_future()
        self._is_given_up = is_given_up
        self._lock = Lock()
        self._is_over = self._has_begun = False

    def superseded(self) -> bool:
        """Whether planning shall stop."""
        with self._lock:
            self._is_over = self._is_over or (not self._has_begun and self._is_given_up())
            return self._is_over

    def send(self, coded: Sequence[Coded]) -> None:
        """These are the update's first refinements, whatever follows. Once at most."""
        with self._lock:
            if self._is_over or not coded:
                return
            self._has_begun = True
        with suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(self._deliver, coded)

    def _deliver(self, coded: Sequence[Coded]) -> None:
        if not self.first.done():  # nobody waits any more
            self.first.set_result(coded)
