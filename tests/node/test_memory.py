"""How the node keeps its memory flat."""

from __future__ import annotations

import asyncio
import ctypes
import gc
import weakref
from collections.abc import Iterator
from pathlib import Path

import pytest

from node.memory import keep_trimmed, settle

LIBC = ctypes.CDLL(None)
LIBC.malloc.restype = ctypes.c_void_p
LIBC.free.argtypes = [ctypes.c_void_p]
BLOCKS, BLOCK_BYTES, STAYS = 10_000, 6000, 50  # 60 MB, of which each fiftieth block stays: the last one, too


def test_what_was_there_at_the_start_is_looked_at_no_more() -> None:
    there = [object()]
    try:
        settle()
        assert gc.get_freeze_count() > 0
        assert not any(one is there for one in gc.get_objects())
    finally:
        gc.unfreeze()


class Left:
    """What holds itself, as what a stream leaves that ended in an error."""

    def __init__(self) -> None:
        self.itself = self


async def test_what_ended_streams_left_is_collected_without_waiting_for_more() -> None:
    gc.disable()  # so that only who is asked collects
    try:
        left = weakref.ref(Left())
        trimming = asyncio.create_task(keep_trimmed(0.01))
        async with asyncio.timeout(60):
            while left() is not None:
                await asyncio.sleep(0.01)
        trimming.cancel()
    finally:
        gc.enable()


@pytest.fixture
def holes() -> Iterator[float]:
    """Freed memory that lies between blocks that stay, and what was resident before it was there. [MB]"""
    LIBC.malloc_trim(0)  # else it would be made of what others freed
    before_mb = resident_mb()
    blocks = [LIBC.malloc(BLOCK_BYTES) for _ in range(BLOCKS)]
    for block in blocks:
        ctypes.memset(block, 1, BLOCK_BYTES)
    stay = set(blocks[STAYS - 1 :: STAYS])
    for block in blocks:
        if block not in stay:
            LIBC.free(block)
    yield before_mb
    for block in stay:
        LIBC.free(block)


@pytest.mark.skipif(not hasattr(LIBC, "malloc_trim"), reason="only glibc keeps what is freed")
async def test_what_is_freed_between_what_stays_goes_back_to_the_system(holes: float) -> None:
    assert resident_mb() > holes + 40
    trimming = asyncio.create_task(keep_trimmed(0.01))
    async with asyncio.timeout(60):
        while resident_mb() > holes + 20:
            await asyncio.sleep(0.01)
    trimming.cancel()


def resident_mb() -> float:
    """Of this process."""
    [line] = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS:")]
    return int(line.split()[1]) / 1000
