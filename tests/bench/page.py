"""`bench page`: how long the browser's page takes to show a scan, and what a click takes, in chromium on a real node.

Each figure stands beside what the same browser takes for an empty frame: a page of one canvas that is cleared. A frame
counts as drawn when a fence behind its last command has passed (`page_hook.js`). Both pages take turns.
"""

from __future__ import annotations

import random
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from aiohttp import web
from playwright.async_api import Browser, BrowserContext, Page, TimeoutError, async_playwright

from tests.bench.ours import node_at
from tests.bench.scans import SEED, BenchScan
from tests.client.viewer.browser import ARGUMENTS, CHROMIUM

HERE = Path(__file__).parent
HOOK = HERE / "page_hook.js"
EMPTY = HERE / "empty_page.html"
VIEWPORT = {"width": 1000, "height": 700}
SPOT = 0.24  # clicks fall so far from the middle, at most: onto the object
CLICK_TRIES = 3  # on a machine so busy that a click takes half a second, it is none
ROUNDS = 5  # of memory: at the start, then so often
ASKED = {"first_ms": 150, "click_ms": 50, "update_ms": 8}
FORGET = "() => ['frames', 'messages', 'painting', 'tasks'].forEach((list) => (bench[list].length = 0))"
DRAWN = "() => bench.frames.some((frame) => frame.end !== null && {})"


async def run(scan: BenchScan, clicks: int, repeats: int, seconds: float) -> dict[str, Any]:
    """Measure on one scan. seconds : of random clicks, to see whether memory grows."""
    async with node_at([scan]) as (ours, _, _), _empty_page() as empty, async_playwright() as playwright:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))
        context = await browser.new_context(viewport=VIEWPORT, reduced_motion="reduce")  # type: ignore[arg-type]
        await context.add_init_script(path=HOOK)
        record = {
            "scan": scan.name, "size": scan.size, "repeats": repeats, "clicks": clicks,
            "first": await _first_views(context, ours, empty, repeats),
            **await _clicks(context, ours, empty, clicks),
            "memory": await _memory(browser, context, ours, seconds) if seconds else None,
        }  # fmt: skip
        await browser.close()
        return record


def told(record: dict[str, Any]) -> str:
    """The figures as text."""
    first, click, update, redraw = (record[name] for name in ("first", "click", "update", "redraw"))
    lines = [
        f"{record['scan']} {record['size']}, medians; in brackets, of what an empty frame takes",
        f"address to first view drawn: {_beside(first)}, asked {ASKED['first_ms']} ms",
        f"  tasks over 50 ms until then: {first['long_tasks']} (empty page {first['empty_long_tasks']}), longest "
        f"{first['longest_ms']:.0f} ms",
        f"click to drawn: {_beside(click)}, asked {ASKED['click_ms']} ms",
        f"  tasks over 50 ms in {click['count']} clicks: {click['long_tasks']}",
        f"an update on the page's thread: {update['ms']:.1f} ms, painting it {update['paint_ms']:.1f} ms, both at"
        f" the 95th percentile {update['p95_ms']:.1f} ms, asked {ASKED['update_ms']} ms",
        f"drawing once more: {_beside(redraw)}, {redraw['triangles']} triangles",
    ]
    if memory := record["memory"]:
        lines.append(f"{memory['clicks']} random clicks in {memory['seconds']:.0f} s; MB after each fifth:")
        lines += [f"  {name}: {', '.join(f'{size:.1f}' for size in sizes)}" for name, sizes in memory["mb"].items()]
    return "\n".join(lines)


def _beside(figure: dict[str, Any]) -> str:
    return f"{figure['ms']:.0f} ms ({figure['ms'] / figure['empty_ms']:.1f} x {figure['empty_ms']:.0f} ms)"


@asynccontextmanager
async def _empty_page() -> AsyncIterator[str]:
    """Address of the page that draws nothing."""
    application = web.Application()

    async def respond(_: web.Request) -> web.FileResponse:
        return web.FileResponse(EMPTY)

    application.router.add_get("/", respond)
    runner = web.AppRunner(application)
    await runner.setup()
    site = web.TCPSite(runner, "127.0.0.1", 0)
    await site.start()
    yield f"http://127.0.0.1:{runner.addresses[0][1]}/"
    await runner.cleanup()


@asynccontextmanager
async def _opened(context: BrowserContext, address: str, shown: str) -> AsyncIterator[Page]:
    """A new tab at an address, once a frame for which `shown` holds is drawn."""
    page = await context.new_page()
    await page.goto(address, wait_until="commit")
    await page.wait_for_function(DRAWN.format(shown), polling=100)
    yield page
    await page.close()


async def _first_views(context: BrowserContext, ours: str, empty: str, repeats: int) -> dict[str, Any]:
    """From the start of a navigation to a frame drawn; the first time of each, with cold caches, does not count."""
    times: dict[str, list[float]] = {ours: [], empty: []}
    tasks: dict[str, list[list[float]]] = {ours: [], empty: []}
    for _ in range(repeats + 1):
        for address, shown in ((empty, "true"), (ours, "frame.scan")):
            async with _opened(context, address, shown) as page:
                await page.wait_for_timeout(500)
                bench = await page.evaluate("() => bench")
                drawn = next(frame["end"] for frame in bench["frames"] if address == empty or frame["scan"])
                times[address].append(drawn)
                tasks[address].append([ms for begin, ms in bench["tasks"] if begin < drawn])
    return {
        "ms": median(times[ours][1:]), "empty_ms": median(times[empty][1:]),
        "all_ms": times[ours], "all_empty_ms": times[empty],
        "long_tasks": median(map(len, tasks[ours][1:])), "empty_long_tasks": median(map(len, tasks[empty][1:])),
        "longest_ms": median(max(each, default=0.0) for each in tasks[ours][1:]),
    }  # fmt: skip


async def _clicks(context: BrowserContext, ours: str, empty: str, count: int) -> dict[str, Any]:
    """From a click to its update drawn, and what that takes on the page's own thread; also a frame drawn once more."""
    rng = random.Random(SEED)
    seen, empty_ms, redrawn = list[dict[str, Any]](), list[float](), list[dict[str, Any]]()
    async with _opened(context, empty, "true") as nothing, _opened(context, ours, "frame.scan") as page:
        await page.wait_for_timeout(1500)
        for _ in range(count + 1):  # the first takes memory for refined colour, and does not count
            await nothing.bring_to_front()
            empty_ms.append(await _empty_click(nothing))
            await page.bring_to_front()
            await page.wait_for_timeout(300)
            seen.append(_told_of_click(await _click(page, rng)))
            redrawn.append(await _redraw(page))
    counted = [each for each in seen[1:] if each]
    both = [each["update_ms"] + each["paint_ms"] for each in counted]
    return {
        "click": {"ms": median(each["ms"] for each in counted), "empty_ms": median(empty_ms[1:]),
                  "count": len(counted), "all_ms": [each["ms"] for each in counted],
                  "long_tasks": sum(each["long_tasks"] for each in counted)},
        "update": {"ms": median(each["update_ms"] for each in counted), "p95_ms": float(np.percentile(both, 95)),
                   "paint_ms": median(each["paint_ms"] for each in counted)},
        "redraw": {"ms": median(frame["end"] - frame["begin"] for frame in redrawn),
                   "triangles": redrawn[-1]["triangles"], "empty_ms": await _empty_frame_ms(context, empty)},
    }  # fmt: skip


def _told_of_click(bench: dict[str, Any]) -> dict[str, float]:
    """What was noted of one click; nothing where it brought nothing."""
    patches = [(at, ms) for kind, at, ms in bench["messages"] if kind == "patch"]
    if not patches:
        return {}
    drawn = next(frame["end"] for frame in bench["frames"] if frame["begin"] >= patches[-1][0])
    return {
        "ms": drawn - bench["clicked"],
        "update_ms": sum(ms for _, ms in patches),
        "paint_ms": max(ms for at, ms in bench["painting"] if at >= patches[0][0]),
        "long_tasks": len(bench["tasks"]),
    }


async def _click(page: Page, rng: random.Random) -> dict[str, Any]:
    """Click somewhere on the object; what was noted until its update was drawn and all is calm again."""
    before = await page.evaluate("() => Number(document.documentElement.dataset.updates ?? 0)")
    await page.evaluate(FORGET)
    box = await page.locator("#view").bounding_box()
    assert box is not None
    x, y = (0.5 + rng.uniform(-SPOT, SPOT) for _ in range(2))
    for _ in range(CLICK_TRIES):
        await page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        with suppress(TimeoutError):
            answered = f'html[data-updates="{before + 1}"][data-looking="no"]'
            await page.wait_for_selector(answered, state="attached", timeout=10_000)
            break
    await page.wait_for_timeout(400)
    await page.wait_for_function("() => bench.frames.every((frame) => frame.end !== null)")
    bench: dict[str, Any] = await page.evaluate("() => bench")
    return bench


async def _redraw(page: Page) -> dict[str, Any]:
    """One frame of the same view once more."""
    await page.evaluate("() => { bench.frames.length = 0; }")
    await page.locator("#view").press("Home")
    await page.wait_for_function(DRAWN.format("true"))
    frame: dict[str, Any] = await page.evaluate("() => bench.frames[0]")
    return frame


async def _empty_click(page: Page) -> float:
    await page.evaluate("() => { bench.frames.length = 0; }")
    await page.mouse.click(VIEWPORT["width"] / 2, VIEWPORT["height"] / 2)
    await page.wait_for_function(DRAWN.format("true"))
    taken: float = await page.evaluate("() => bench.frames[0].end - bench.clicked")
    return taken


async def _empty_frame_ms(context: BrowserContext, empty: str) -> float:
    async with _opened(context, empty, "true") as page:
        taken = []
        for _ in range(9):
            await _empty_click(page)
            taken.append(await page.evaluate("() => bench.frames[0].end - bench.frames[0].begin"))
    return float(median(taken))


async def _memory(browser: Browser, context: BrowserContext, ours: str, seconds: float) -> dict[str, Any]:
    """Random clicks without a pause: what the page's processes and scripts hold, at the start and after each fifth."""
    rng = random.Random(SEED)
    clicks = 0
    sizes: dict[str, list[float]] = {}
    async with _opened(context, ours, "frame.scan") as page:
        await _click(page, rng)
        for part in range(ROUNDS + 1):
            for name, size in (await _held(browser, context, page)).items():
                sizes.setdefault(name, []).append(size / 1e6)
            if part < ROUNDS:
                clicks += await _clicked_for(page, rng, seconds / ROUNDS)
    return {"seconds": seconds, "clicks": clicks, "mb": sizes}


async def _clicked_for(page: Page, rng: random.Random, seconds: float) -> int:
    end, clicks = await page.evaluate("() => performance.now()") + 1000 * seconds, 0
    box = await page.locator("#view").bounding_box()
    assert box is not None
    while await page.evaluate("() => performance.now()") < end:
        x, y = (0.5 + rng.uniform(-SPOT, SPOT) for _ in range(2))
        await page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
        await page.wait_for_selector('html[data-looking="no"]', state="attached")
        clicks += 1
        await page.evaluate(FORGET)
    return clicks


async def _held(browser: Browser, context: BrowserContext, page: Page) -> dict[str, float]:
    """Bytes: of the page's scripts once garbage is collected, and of what its processes have to themselves."""
    devtools = await context.new_cdp_session(page)
    await devtools.send("HeapProfiler.collectGarbage")
    heap = (await devtools.send("Runtime.getHeapUsage"))["usedSize"]
    await devtools.detach()
    whole = await browser.new_browser_cdp_session()
    processes = (await whole.send("SystemInfo.getProcessInfo"))["processInfo"]
    await whole.detach()
    largest = {kind: max((_private_bytes(one["id"]) for one in processes if one["type"] == kind), default=0)
               for kind in ("renderer", "GPU")}  # fmt: skip
    return {"scripts' heap": heap, "renderer process": largest["renderer"], "graphics process": largest["GPU"]}


def _private_bytes(process: int) -> int:
    """Anonymous memory of a process."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssAnon"))
