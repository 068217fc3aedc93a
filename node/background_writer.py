"""Bytes to a file's end by a thread of its own, so that a slow disk never holds up the port they come from."""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from pathlib import Path

SYNC_S = 0.25  # what was written is made durable at least that often
WAITING_BYTES_MAX = 8 << 20
GATHER_S = 0.02  # what comes within this time is written at once: fewer wake-ups
GATHER_BYTES = 1 << 20  # but no more than this


class BackgroundWriter:
    """Appends to an existing file. Use it from one thread; errors of the disk surface in the next call.

    Where the disk is slower than the source, `write` waits, so the source is slowed and nothing is dropped.
    A piece that does not fit on the disk is taken away again whole.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND)
        self._changed = threading.Condition()
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._unsafe = False  # something was written and is not durable yet
        self._appending = False
        self._closing = False
        self._failure: OSError | None = None
        self._synced_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="journal", daemon=True)
        self._thread.start()

    def write(self, piece: bytes) -> None:
        """Take a piece. Raises OSError when an earlier one could not be written."""
        with self._changed:
            self._changed.wait_for(lambda: self._failure or self._waiting_bytes < WAITING_BYTES_MAX)
            self._raise_failure()
            self._waiting.append(piece)
            self._waiting_bytes += len(piece)
            if len(self._waiting) == 1 or self._waiting_bytes >= GATHER_BYTES:
                self._changed.notify_all()

    def close(self, patience_s: float | None = None) -> None:
        """Make everything durable and let go of the file. Raises OSError where it could not be written.

        patience_s : after so long, what waits for a disk that takes its time is handed to the system, which a power cut
        alone keeps from writing it; it becomes durable when the disk gets to it.
        """
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(patience_s)
        if self._thread.is_alive():
            self._hand_over()
        self._raise_failure()

    def _hand_over(self) -> None:
        """Write what the thread, which waits for the disk, has not begun."""
        with self._changed:
            self._changed.wait_for(lambda: not self._appending)
            while self._waiting:
                append_whole(self._file, self._waiting.popleft())
                self._unsafe = True

    def _raise_failure(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            while (batch := self._next_batch()) is not None:
                for piece in batch:
                    append_whole(self._file, piece)
                self._done(wrote=bool(batch))
        except OSError as error:
            with self._changed:
                self._failure = error
                self._waiting.clear()
                self._appending = False
                self._changed.notify_all()
        finally:
            with self._changed:
                os.close(self._file)

    def _next_batch(self) -> list[bytes] | None:
        """Everything that waits; [] when it is only time to sync; None at the end."""
        with self._changed:
            due_s = max(0.0, self._synced_s + SYNC_S - time.monotonic()) if self._unsafe else None
            if self._changed.wait_for(lambda: self._waiting or self._closing, due_s):
                self._changed.wait_for(lambda: self._waiting_bytes >= GATHER_BYTES or self._closing, GATHER_S)
            if self._closing and not self._waiting and not self._unsafe:
                return None
            batch = list(self._waiting)
            self._waiting.clear()
            self._waiting_bytes = 0
            self._appending = True
            self._changed.notify_all()
            return batch

    def _done(self, wrote: bool) -> None:
        """A batch is written: make it durable when that is due."""
        with self._changed:
            self._appending = False
            self._changed.notify_all()
            self._unsafe |= wrote
            is_due = self._unsafe and (self._closing or time.monotonic() >= self._synced_s + SYNC_S)
            self._unsafe &= not is_due
        if is_due:
            os.fdatasync(self._file)
            self._synced_s = time.monotonic()


def append_whole(file: int, piece: bytes) -> None:
    """Write a piece whole, or take away what of it was written and raise OSError."""
    begin, rest = os.fstat(file).st_size, memoryview(piece)
    try:
        while rest:
            rest = rest[os.write(file, rest) :]
    except OSError:
        os.ftruncate(file, begin)
        raise
