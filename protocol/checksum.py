"""CRC-32 of what comes over a line, without letting other threads in between.

zlib lets go of the interpreter for more than 5 KiB and waits to get it back; beside threads that compute, the wait is a
hundred times what the sum takes, and a scanner sends thousands of columns a second.
"""

from __future__ import annotations

import zlib

_AT_ONCE_BYTES = 5120


def crc32(data: bytes | memoryview, start: int = 0) -> int:
    """As zlib.crc32."""
    if len(data) <= _AT_ONCE_BYTES:
        return zlib.crc32(data, start)
    view = memoryview(data)
    for at in range(0, len(view), _AT_ONCE_BYTES):
        start = zlib.crc32(view[at : at + _AT_ONCE_BYTES], start)
    return start
