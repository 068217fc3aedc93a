"""libumockdev's preload library: a program's ioctls come here over a Unix socket, and its memory can be reached.

Messages are three u64 (kind, two arguments) and data: 1 ioctl(request, address), 3 done(result, errno),
5 read(address, size), 6 write(address, size). Source: umockdev's ioctl_tree.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator
from pathlib import Path

PRELOAD = "libumockdev-preload.so.0"
_MESSAGE = struct.Struct("<QQQ")
_IOCTL, _DONE, _READ, _WRITE = 1, 3, 5, 6
_MINUS_1 = (1 << 64) - 1
_NOT_MINE = (1 << 64) - 100  # the preload then does the real thing


class PreloadClient:
    """The preload library at the other end of a socket: its ioctls come, its memory is read and written."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection

    def ioctls(self) -> Iterator[tuple[int, int]]:
        """(request, address of the argument) of each ioctl, which wants `done` or `fail`; EOFError at the end."""
        while True:
            kind, request, address = _MESSAGE.unpack(self._receive(_MESSAGE.size))
            if kind == _IOCTL:
                yield request & 0xFFFFFFFF, address
            else:
                self._connection.sendall(_MESSAGE.pack(_DONE, _NOT_MINE, 0))

    def fetch(self, address: int, size: int) -> bytes:
        """Bytes of the program's memory."""
        self._connection.sendall(_MESSAGE.pack(_READ, address, size))
        return self._receive(size)

    def fetch_last(self, address: int, size: int) -> bytes:
        """The same, and the ioctl succeeded, whatever they are: the program goes on as soon as it has sent them."""
        self._connection.sendall(_MESSAGE.pack(_READ, address, size) + _MESSAGE.pack(_DONE, 0, 0))
        return self._receive(size)

    def done(self, writes: list[tuple[int, bytes | memoryview]] | None = None, result: int = 0) -> None:
        """The ioctl succeeded, after these bytes are written to these addresses."""
        parts: list[bytes | memoryview] = []
        for address, data in writes or []:
            parts += (_MESSAGE.pack(_WRITE, address, len(data)), data)
        parts.append(_MESSAGE.pack(_DONE, result, 0))
        sent = self._connection.sendmsg(parts)  # at once: between two calls our thread would wait for the table's
        if sent < sum(map(len, parts)):  # interrupted
            self._connection.sendall(b"".join(parts)[sent:])

    def fail(self, number: int) -> None:
        """The ioctl failed."""
        self._connection.sendall(_MESSAGE.pack(_DONE, _MINUS_1, number))

    def _receive(self, size: int) -> bytes:
        data = self._connection.recv(size, socket.MSG_WAITALL)
        if len(data) < size:
            raise EOFError
        return data


def is_available() -> bool:
    """Whether this machine has the preload library."""
    folders = (Path(folder) for folder in ("/lib", "/usr/lib", "/usr/local/lib", "/usr/lib64"))
    return any(any(folder.glob(f"**/{PRELOAD}")) for folder in folders if folder.is_dir())


def is_under_preload() -> bool:
    """Whether this very process sees a testbed instead of real USB."""
    return "UMOCKDEV_DIR" in os.environ and PRELOAD in os.environ.get("LD_PRELOAD", "")
