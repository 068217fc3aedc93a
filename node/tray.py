"""Memory that two processes share, for the arrays in what one hands the other: a line would copy them thrice."""

from __future__ import annotations

import mmap
import os
import pickle
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

ALIGNED = 64  # bytes


@dataclass(frozen=True, slots=True)
class Laid:
    """Something whose arrays lie in a tray: the rest of it, pickled, and where they begin and how long they are."""

    pickled: bytes
    places: tuple[int, ...]
    sizes: tuple[int, ...]


class Tray:
    """Such memory, no part of any disk.  file : of one that another process made; None: a new one."""

    def __init__(self, file: int | None = None) -> None:
        self.file = os.memfd_create("foveascan", os.MFD_CLOEXEC) if file is None else file
        weakref.finalize(self, os.close, self.file)
        self._mapped: mmap.mmap | None = None

    def lay(self, value: object, begin: int = 0) -> Laid:
        """Put the arrays of something there, from a place on: whatever lay there before is gone. Raises OSError."""
        buffers: list[pickle.PickleBuffer] = []
        pickled = pickle.dumps(value, 5, buffer_callback=buffers.append)
        arrays = [buffer.raw() for buffer in buffers]
        sizes = tuple(array.nbytes for array in arrays)
        *places, end = accumulate((_aligned(size) for size in sizes), initial=_aligned(begin))
        if arrays:
            mapped = self._map(end)
            for place, size, array in zip(places, sizes, arrays, strict=True):
                mapped[place : place + size] = array
        return Laid(pickled, tuple(places), sizes)

    def take(self, laid: Laid, *, copied: bool) -> Any:
        """What was laid. copied : else its arrays go on lying there, and are to be left as they are. Raises OSError."""
        arrays: Sequence[bytearray | memoryview] = ()
        if laid.sizes:
            mapped = memoryview(self._map(laid.places[-1] + laid.sizes[-1]))
            arrays = [mapped[place : place + size] for place, size in zip(laid.places, laid.sizes, strict=True)]
        return pickle.loads(laid.pickled, buffers=[bytearray(array) for array in arrays] if copied else arrays)

    def _map(self, size: int) -> mmap.mmap:
        """At least so much of it, made if it is not there. Raises OSError."""
        if self._mapped is None or len(self._mapped) < size:
            if os.fstat(self.file).st_size < size:
                os.truncate(self.file, size)
            self._mapped = mmap.mmap(self.file, 0)
        return self._mapped


def end_of(laid: Laid) -> int:
    """From where on a tray is free. [bytes]"""
    return laid.places[-1] + laid.sizes[-1] if laid.sizes else 0


def _aligned(size: int) -> int:
    return -(-size // ALIGNED) * ALIGNED
