"""Waiting for what another thread, task or process brings about; never for a time."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from client import Session

PATIENCE_S = 60  # on a machine that does much else


async def until(is_so: Callable[[], object]) -> None:
    """Until something is so. Raises TimeoutError when it does not become so."""
    async with asyncio.timeout(PATIENCE_S):
        while not is_so():
            await asyncio.sleep(0.01)


async def until_ready(session: Session) -> None:
    """Until the node's scanner can sweep."""
    async with asyncio.timeout(PATIENCE_S):
        while (await session.scanner())["phase"] != "ready":
            await asyncio.sleep(0.05)
