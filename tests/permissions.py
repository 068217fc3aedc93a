"""Tests as anybody but root, whoever runs them."""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Iterator
from contextlib import contextmanager

CAPABILITIES_3, DAC_OVERRIDE_AND_SEARCH = 0x20080522, 0b110  # of linux/capability.h


@contextmanager
def bound_by_permissions() -> Iterator[None]:
    """As anybody but root: without the capabilities by which this thread may open everything."""
    libc, who, had = ctypes.CDLL(None), struct.pack("<Ii", CAPABILITIES_3, 0), ctypes.create_string_buffer(24)
    assert libc.capget(who, had) == 0
    effective, *rest = struct.unpack("<6I", had.raw)
    assert libc.capset(who, struct.pack("<6I", effective & ~DAC_OVERRIDE_AND_SEARCH, *rest)) == 0
    try:
        yield
    finally:
        assert libc.capset(who, had) == 0
