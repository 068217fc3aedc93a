"""A scanner, or a simulated one, at the far end of a TCP connection, as a Port. The same frames as on USB."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

from drivers.address import parse_tcp
from drivers.self_pipe import SelfPipe
from protocol.errors import PortLost

_CONNECT_S = 2.0
_WRITE_TIMEOUT_S = 2.0


class TcpPort:
    """An open connection. Raises PortLost when the address makes no sense or nobody answers there."""

    def __init__(self, address: str) -> None:
        self._name = address
        self._lost: str | None = None
        try:
            self._socket = socket.create_connection(parse_tcp(address), _CONNECT_S)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.settimeout(_WRITE_TIMEOUT_S)
        except ValueError as error:
            raise PortLost(str(error)) from error
        except OSError as error:
            why = error.strerror or str(error)
            raise PortLost(f"{address}: cannot connect: {why}; is the scanner there, and on?") from error
        self._waiting = SelfPipe(self._socket.fileno())

    @property
    def name(self) -> str:
        """The address it was opened by."""
        return self._name

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read."""
        with self._translated("read"):
            if not self._waiting.wait(timeout_s):
                return b""
            data = self._socket.recv(max_bytes)
            if not data:
                raise ConnectionResetError("the other end hung up")
            return data

    def write(self, data: bytes) -> None:
        """As Port.write; a connection that takes nothing for two seconds is lost."""
        with self._translated("write"):
            self._socket.sendall(data)

    def cancel(self) -> None:
        """As Port.cancel."""
        self._waiting.wake()

    def close(self) -> None:
        """As Port.close."""
        self._waiting.close()
        self._socket.close()

    @contextmanager
    def _translated(self, doing: str) -> Iterator[None]:
        """Turn every way of being gone into PortLost, for good."""
        if self._lost or self._waiting.is_closed:
            raise PortLost(f"{self._name}: {self._lost or 'the port is closed'}")
        try:
            yield
        except (OSError, ValueError) as error:
            self._lost = f"{doing} failed: {error}"
            raise PortLost(f"{self._name}: {self._lost}") from error
