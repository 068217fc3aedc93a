"""A simulated scanner's end of a TCP connection: it listens, and serves one node at a time."""

from __future__ import annotations

import os
import re
import select
import socket
from contextlib import suppress

from protocol.errors import UsageError
from simulators.pace import Pace

_LISTEN = re.compile(r"(?:(?:\[([0-9A-Fa-f:.]+)\]|([^\s:\[\]/]+)):)?([0-9]{1,5})")


def parse_listen(text: str) -> tuple[str, int]:
    """Where to listen: PORT, on this machine alone, or HOST:PORT. Port 0: any free one. Raises UsageError."""
    match = _LISTEN.fullmatch(text)
    if match is None or int(match[3]) > 65535:
        raise UsageError(f"path: expected PORT or HOST:PORT to listen at, got {text!r}")
    return match[1] or match[2] or "127.0.0.1", int(match[3])


class TcpListener:
    """As a carrier's port. While nobody is connected, what is written goes nowhere, as with a plug that is out.

    rate_bytes_s : speed towards the node. Raises OSError where it cannot listen.
    """

    def __init__(self, place: tuple[str, int], rate_bytes_s: float = float("inf")) -> None:
        self._place = place
        self._pace = Pace(rate_bytes_s)
        self._node: socket.socket | None = None
        self._listener: socket.socket | None = None
        self._wake_read, self._wake_write = os.pipe()
        self.plug_in()

    @property
    def name(self) -> str:
        """The address that a node opens."""
        host, port = self._place
        return f"tcp:[{host}]:{port}" if ":" in host else f"tcp:{host}:{port}"

    def plug_in(self) -> None:
        """Listen."""
        family = socket.AF_INET6 if ":" in self._place[0] else socket.AF_INET
        try:
            self._listener = socket.create_server(self._place, family=family, backlog=1)
        except OSError as error:
            why = error.strerror if isinstance(error, socket.gaierror) else os.strerror(error.errno or 0)
            cure = "choose another place to listen at (--path), or port 0 for any free one"
            raise OSError(error.errno, f"{self.name}: {why}; {cure}") from error
        self._place = self._place[0], self._listener.getsockname()[1]

    def hang_up(self) -> None:
        """End the connection and listen no more."""
        self._drop()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read; b"" too when a node comes or goes."""
        waited_for = [end for end in (self._wake_read, self._listener, self._node) if end is not None]
        ready, _, _ = select.select(waited_for, [], [], max(timeout_s, 0.0))
        if self._wake_read in ready:
            os.read(self._wake_read, 1)
        if self._listener is not None and self._listener in ready:
            self._meet(self._listener)
        elif self._node is not None and self._node in ready:
            return self._receive(max_bytes)
        return b""

    def write(self, data: bytes) -> None:
        """Send `data` at the pace of the line; waits while the node does not read, until `cancel`."""
        rest = memoryview(data)
        while rest and self._node is not None:
            woken, _, _ = select.select([self._wake_read], [self._node], [])
            if woken:
                return
            try:
                rest = rest[self._node.send(rest) :]
            except BlockingIOError:
                continue
            except OSError:
                self._drop()
        self._pace.wait(len(data))

    def cancel(self) -> None:
        """As Port.cancel."""
        os.write(self._wake_write, b"x")

    def close(self) -> None:
        """Hang up for good."""
        self.hang_up()
        for descriptor in (self._wake_read, self._wake_write):
            os.close(descriptor)

    def _meet(self, listener: socket.socket) -> None:
        """A node comes; a second one beside the first is sent away."""
        node, _ = listener.accept()
        if self._node is not None and self._is_there():
            node.close()
            return
        self._drop()
        node.setblocking(False)
        node.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._node = node

    def _is_there(self) -> bool:
        """Whether the node has not hung up."""
        assert self._node is not None
        try:
            return self._node.recv(1, socket.MSG_PEEK) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    def _receive(self, max_bytes: int) -> bytes:
        assert self._node is not None
        data = b""
        with suppress(BlockingIOError):
            try:
                data = self._node.recv(max_bytes)
            except ConnectionError:
                pass
            if not data:
                self._drop()
        return data

    def _drop(self) -> None:
        if self._node is not None:
            self._node.close()
            self._node = None
