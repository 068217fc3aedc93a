"""A serial line (UART, USB serial adapter, pty) as a Port: opened and set up by pyserial, waited for by select.

A device that goes away shows itself in many ways: OSError, SerialException, `termios.error` (which is neither), a line
that is always ready and always empty, a closed or missing descriptor. All of them become PortLost here.
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

from protocol.errors import PortLost

_WRITE_TIMEOUT_S = 2.0
_GATHER_S = 0.008  # bytes that follow within this time are read at once: fewer wake-ups; at 3 Mbaud that is 2.4 KB
_GATHER_BELOW_BYTES = 1024  # the kernel's own buffer holds 4 KiB
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
            self._serial = serial.Serial(path, baud, timeout=0, write_timeout=_WRITE_TIMEOUT_S, exclusive=True)
        except _GONE as error:
            raise PortLost(f"{path}: cannot open: {_why(error)}") from error
        self._wake_read, self._wake_write = os.pipe()

    @property
    def name(self) -> str:
        """The path it was opened by."""
        return self._name

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read. Bytes that arrive a few milliseconds apart are gathered."""
        with self._translated("read"):
            ready, _, _ = select.select([self._serial.fileno(), self._wake_read], [], [], max(timeout_s, 0.0))
            if self._wake_read in ready:
                os.read(self._wake_read, 1)
                return b""
            if not ready:
                return b""
            if self._serial.in_waiting < _GATHER_BELOW_BYTES:
                time.sleep(_GATHER_S)
            # ready and empty is the end of the line: reading one byte makes pyserial say so
            return bytes(self._serial.read(min(max(self._serial.in_waiting, 1), max_bytes)))

    def write(self, data: bytes) -> None:
        """As Port.write; a line that takes nothing for two seconds is lost."""
        with self._translated("write"):
            self._serial.write(data)

    def cancel(self) -> None:
        """As Port.cancel."""
        with suppress(OSError):
            os.write(self._wake_write, b"x")

    def close(self) -> None:
        """As Port.close."""
        if self._wake_read < 0:
            return
        for descriptor in (self._wake_read, self._wake_write):
            os.close(descriptor)
        self._wake_read = self._wake_write = -1
        with suppress(*_GONE):
            self._serial.close()

    @contextmanager
    def _translated(self, doing: str) -> Iterator[None]:
        """Turn every way of being gone into PortLost, for good."""
        if self._is_lost or self._wake_read < 0:
            raise PortLost(f"{self._name}: the port is {'lost' if self._is_lost else 'closed'}")
        try:
            yield
        except _GONE as error:
            self._is_lost = True
            raise PortLost(f"{self._name}: {doing} failed: {error}") from error


def _why(error: Exception) -> str:
    """Why a port does not open, with the cure where one is known."""
    return _CURES.get(getattr(error, "errno", None) or 0, str(error))
