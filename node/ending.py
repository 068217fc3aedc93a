"""The end of a node: all its steps share one time, whatever the disk and the clients do meanwhile.

Columns are in the system's hands and every client is told well before that time is over. What still waits for the disk
then (a scan on its way into the library, models in the making) is cut off, as a power cut would, and made good at the
next start.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time

log = logging.getLogger(__name__)

CAPTURE_BY_S, GOODBYES_BY_S, AUDIT_BY_S, ALL_BY_S = 2.5, 3.3, 4.0, 4.4  # from the beginning of the end


class Ending:
    """The time that is left. of_process : the whole process ends with it, and is cut off when the time is over."""

    def __init__(self, *, of_process: bool = False) -> None:
        self._of_process = of_process
        self._began_s = math.inf

    def begin(self) -> None:
        """The time runs from now on; harmless when repeated."""
        if self._began_s < math.inf:
            return
        self._began_s = time.monotonic()
        if self._of_process:
            guard = threading.Timer(ALL_BY_S, _cut_off)
            guard.daemon = True
            guard.start()

    def left_s(self, by_s: float) -> float:
        """How long a step may take that is to be over by_s after the beginning, which this is at the latest."""
        self.begin()
        return max(self._began_s + by_s - time.monotonic(), 0.0)


def _cut_off() -> None:
    waiting = sorted(thread.name for thread in threading.enumerate() if thread is not threading.current_thread())
    log.warning("stopped after %g s; the disk kept these waiting: %s", ALL_BY_S, ", ".join(waiting))
    logging.shutdown()
    os._exit(0)
