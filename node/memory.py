"""Memory of a process that runs for months: what is let go of goes back soon, and what stays is looked at once.

Python frees cycles (of a stream that ended in an error, say) when as much as a quarter of what stays has gathered. What
a node imports and makes at its start stays for good and is large, so `settle` takes it out of that account, and
`keep_trimmed` does not wait for so many: with what stays set aside, a collection takes milliseconds. And glibc
keeps what is freed for each arena apart, of which it makes up to eight a core: `bound_arenas`. Of that arena it gives
back only the end: `keep_trimmed` gives back the rest, too. With TLS that matters most, since uvloop takes 256 KiB for a
connection and again for each read of one, and what is small and stays comes to lie between (MagicStack/uvloop#726).
To have large blocks mapped one by one instead (M_MMAP_THRESHOLD) would make planning take twice the time.
"""

from __future__ import annotations

import asyncio
import ctypes
import gc

ARENAS_MAX = 1
TRIM_S = 20.0
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


async def keep_trimmed(every_s: float = TRIM_S) -> None:
    """Until cancelled, collect now and then what ended connections left, and give freed memory back to the system,
    which glibc alone has to be told to do."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    while True:
        await asyncio.sleep(every_s)
        gc.collect()
        if trim is not None:
            await asyncio.to_thread(trim, 0)
