"""Memory of a process that runs for months: what is let go of goes back soon, and what stays is looked at once.

Python frees cycles (of a stream that ended in an error, say) when as much as a quarter of what stays has gathered. What
a node imports and makes at its start stays for good and is large, so `settle` takes it out of that account. And glibc
keeps what is freed for each arena apart, of which it makes up to eight a core: `bound_arenas`.
"""

from __future__ import annotations

import ctypes
import gc

ARENAS_MAX = 1
_M_ARENA_MAX = -8  # of malloc.h


def bound_arenas() -> None:
    """Have the threads that are started from now on share the memory that is freed. Other C libraries than glibc have
    no such arenas, and are left alone."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, ARENAS_MAX)


def settle() -> None:
    """All that is here now stays for as long as the process runs."""
    gc.collect()
    gc.freeze()
