"""A serial line (UART, USB serial adapter, pty) as a Port: opened and set up by pyserial, read and written by us.

A device that goes away shows itself in many ways: OSError, SerialException, `termios.error` (which is neither), a line
that is always ready and always empty, a closed or missing descriptor. All of them become PortLost here. pyserial's own
reading and writing waits by select, which takes no descriptor above 1023.
"""

from __future__ import annotations

import errno
import os
import select
import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import serial

from drivers.self_pipe import SelfPipe
from protocol.errors import PortLost

_WRITE_TIMEOUT_S = 2.0
_GATHER_S = 0.015  # bytes that follow within this time are read at once: a wake-up costs more than what it brings
_GATHER_BYTES = 4500  # but no more than these; a kernel's buffers, with those of a USB adapter, hold 12 KB at least
_GATHER_BELOW_BYTES = 4000  # a read brings 4 KiB at most: more is waiting, perhaps
_BITS_PER_BYTE = 10  # start, eight data, stop
_GONE = (OSError, termios.error, TypeError, ValueError)  # pyserial's SerialException is an OSError
_CURES = {
    errno.EACCES: "permission denied; join the group that owns it (foveascan doctor names it)",
    errno.EAGAIN: "another program has it open; end that (fuser -v names it)",
    errno.ENOENT: "no such file; plug the scanner in, or correct the path",
}


class SerialPort:
    """An open serial line; nobody else can open it meanwhile.

    Raises PortLost when the path cannot be opened as a serial line of that speed, saying why.
    """

    def __init__(self, path: str, baud: int = 3_000_000) -> None:
        self._name = path
        self._is_lost = False
        try:
            self._serial = serial.Serial(path, baud, timeout=0, exclusive=True)
        except _GONE as error:
            raise PortLost(f"{path}: cannot open: {_why(error)}") from error
        self._gather_s = min(_GATHER_S, _GATHER_BYTES * _BITS_PER_BYTE / baud)
        self._waiting = SelfPipe(self._serial.fileno())
        self._room = select.poll()
        self._room.register(self._serial.fileno(), select.POLLOUT)

    @property
    def name(self) -> str:
        """The path it was opened by."""
        return self._name

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read. Bytes that arrive a few milliseconds apart are gathered."""
        with self._translated("read"):
            if not self._waiting.wait(timeout_s):
                return b""
            if self._serial.in_waiting < _GATHER_BELOW_BYTES:
                time.sleep(self._gather_s)
            data = os.read(self._serial.fileno(), max_bytes)
            if not data:
                raise ConnectionResetError("the line is ready and empty: it has ended")
            return data

    def write(self, data: bytes) -> None:
        """As Port.write; a line that takes nothing for two seconds is lost."""
        with self._translated("write"):
            rest = memoryview(data)
            while rest:
                if not self._room.poll(1000 * _WRITE_TIMEOUT_S):
                    raise TimeoutError(f"nothing was taken for {_WRITE_TIMEOUT_S:g} s")
                with suppress(BlockingIOError):
                    rest = rest[os.write(self._serial.fileno(), rest) :]

    def cancel(self) -> None:
        """As Port.cancel."""
        self._waiting.wake()

    def close(self) -> None:
        """As Port.close."""
        self._waiting.close()
        with suppress(*_GONE):
            self._serial.close()

    @contextmanager
    def _translated(self, doing: str) -> Iterator[None]:
        """Turn every way of being gone into PortLost, for good."""
        if self._is_lost or self._waiting.is_closed:
            raise PortLost(f"{self._name}: the port is {'lost' if self._is_lost else 'closed'}")
        try:
            yield
        except _GONE as error:
            self._is_lost = True
            raise PortLost(f"{self._name}: {doing} failed: {error}") from error


def _why(error: Exception) -> str:
    """Why a port does not open, with the cure where one is known."""
    return _CURES.get(getattr(error, "errno", None) or 0, str(error))
