"""A serial line (UART, USB serial adapter, pty) as a Port, through pyserial.

A device that goes away shows itself in many ways: OSError, SerialException, `termios.error` (which is neither), a read
that is ready and empty for ever, TypeError from a descriptor closed underneath. All of them become PortLost here.
"""

from __future__ import annotations

import termios
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress

import serial

from protocol.errors import PortLost

_WRITE_TIMEOUT_S = 2.0
_GATHER_S = 0.008  # what arrives within this time is read at once: a tenth of the wake-ups, and 3 Mbaud bring 2.4 KB
_GATHER_BELOW_BYTES = 2048  # never let more than this lie in the kernel's 4 KiB buffer on purpose
_GONE = (OSError, termios.error, TypeError, ValueError)  # pyserial's SerialException is an OSError


class SerialPort:
    """An open serial line; nobody else can open it meanwhile.

    Raises PortLost when the path cannot be opened as a serial line at that speed, saying why.
    """

    def __init__(self, path: str, baud: int = 3_000_000) -> None:
        self._name = path
        self._is_lost = False
        try:
            self._serial = serial.Serial(path, baud, timeout=0, write_timeout=_WRITE_TIMEOUT_S, exclusive=True)
        except _GONE as error:
            raise PortLost(f"{path}: cannot open: {error}") from error

    @property
    def name(self) -> str:
        """The path it was opened by."""
        return self._name

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read. Bytes that arrive a few milliseconds apart are gathered."""
        with self._translated("read"):
            self._serial.timeout = timeout_s
            first = self._serial.read(1)
            if not first:
                return b""
            if self._serial.in_waiting < _GATHER_BELOW_BYTES:
                time.sleep(_GATHER_S)
            self._serial.timeout = 0
            return bytes(first + self._serial.read(min(self._serial.in_waiting, max_bytes - 1)))

    def write(self, data: bytes) -> None:
        """As Port.write; a line that takes nothing for two seconds is lost."""
        with self._translated("write"):
            self._serial.write(data)

    def cancel(self) -> None:
        """As Port.cancel."""
        with suppress(*_GONE):
            self._serial.cancel_read()

    def close(self) -> None:
        """As Port.close."""
        self.cancel()
        with suppress(*_GONE):
            self._serial.close()

    @contextmanager
    def _translated(self, doing: str) -> Iterator[None]:
        """Turn every way of being gone into PortLost, for good."""
        if self._is_lost:
            raise PortLost(f"{self._name}: was lost before")
        try:
            yield
        except _GONE as error:
            self._is_lost = True
            raise PortLost(f"{self._name}: {doing} failed: {error}") from error
