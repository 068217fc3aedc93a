"""Whether the page's memory grows under random clicks."""

from __future__ import annotations

import random
from collections.abc import Awaitable, Callable
from typing import Any

from playwright.async_api import Page

from tests.bench.page_processes import Processes
from tests.bench.scans import SEED

ROUNDS = 5  # of memory: at the start, then so often

Somewhere = Callable[[Page, random.Random], Awaitable[tuple[float, float]]]


async def memory(
    page: Page, processes: Processes, click: Callable[[Page, float, float], Awaitable[Any]], somewhere: Somewhere,
    seconds: float,
) -> dict[str, Any]:
    """Random clicks without a pause: what the page's processes and scripts hold, at the start and after each fifth."""
    rng = random.Random(SEED)
    clicks = 0
    sizes: dict[str, list[float]] = {}
    await click(page, *await somewhere(page, rng))
    for part in range(ROUNDS + 1):
        held = {"scripts' heap": await _heap_bytes(page), **await processes.held_bytes()}
        for name, size in held.items():
            sizes.setdefault(name, []).append(size / 1e6)
        if part < ROUNDS:
            clicks += await _clicked_for(page, rng, somewhere, seconds / ROUNDS)
    return {"seconds": seconds, "clicks": clicks, "mb": sizes}


async def _clicked_for(page: Page, rng: random.Random, somewhere: Somewhere, seconds: float) -> int:
    end, clicks = await page.evaluate("() => performance.now()") + 1000 * seconds, 0
    while await page.evaluate("() => performance.now()") < end:
        await page.mouse.click(*await somewhere(page, rng))
        await page.wait_for_selector('html[data-looking="no"]', state="attached")
        clicks += 1
        await page.evaluate("() => Object.values(bench).forEach((list) => Array.isArray(list) && (list.length = 0))")
    return clicks


async def _heap_bytes(page: Page) -> int:
    """Of the page's scripts, once garbage is collected."""
    devtools = await page.context.new_cdp_session(page)
    await devtools.send("HeapProfiler.collectGarbage")
    heap: int = (await devtools.send("Runtime.getHeapUsage"))["usedSize"]
    await devtools.detach()
    return heap
