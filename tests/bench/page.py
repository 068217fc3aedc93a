"""`bench page`: how long the browser's page takes to show a scan, and what a click takes, in chromium on a real node.

Each figure stands beside what the same browser takes for an empty frame: a page of one canvas, as large, that is
cleared. A frame counts as drawn when a fence behind its last command has passed (`page_hook.js`), the picture that
stands there before it when the browser says that it painted it. Both pages take turns
in one tab. Where the time goes is told in steps, and what each process spends of the processor; unlike times, that says
little of what else the machine does.

The page asks for detail when the pointer is pressed, and a click is over when it is let go. So there are two times:
from the press to the update drawn, which is what the work takes, of a pointer that is let go at once; and from the
click to it, which is what a person waits, of one that is pressed as long as people do (`PRESS_MS`).
"""

from __future__ import annotations

import random
from collections.abc import AsyncIterator, Iterable
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from aiohttp import web
from playwright.async_api import Browser, Page, TimeoutError, async_playwright

from protocol.errors import ConfigError
from tests.bench.ours import node_at
from tests.bench.page_memory import memory
from tests.bench.page_processes import Processes, Spent
from tests.bench.scans import SEED, BenchScan
from tests.client.viewer.browser import CALLS_NOBODY, CHROMIUM, GRAPHICS

HERE = Path(__file__).parent
HOOK = HERE / "page_hook.js"
EMPTY = HERE / "empty_page.html"
VIEWPORT = {"width": 1000, "height": 700}
SPOT = 0.24  # clicks fall so far from the middle, at most: onto the object
PRESS_MS = 80  # people take 60 to 120 for a click
CLICK_TRIES = 3  # on a machine so busy that a click takes half a second, it is none
ASKED = {"first_ms": 150, "click_ms": 50, "update_ms": 8}
PROCESSORS = ("SwiftShader", "llvmpipe")  # names of renderers without a card
RENDERER = """() => {
  const gl = document.createElement('canvas').getContext('webgl2');
  return gl?.getParameter(gl.getExtension('WEBGL_debug_renderer_info').UNMASKED_RENDERER_WEBGL) ?? '';
}"""
FORGET = """() => {
  ['frames', 'messages', 'painting', 'tasks'].forEach((list) => (bench[list].length = 0));
  bench.looked = null;
}"""
DRAWN = "() => bench.frames.some((frame) => frame.end !== null)"
ANY, OF_A_SCAN = "frame", "frame of a scan"  # what the hook says when one is drawn
AT_REST = """() => {
  const came = Math.max(0, ...bench.messages.filter(([kind]) => kind === 'patched').map(([, at]) => at));
  return bench.frames.every(({ end }) => end !== null) && (!came || bench.frames.some(({ begin }) => begin >= came));
}"""
# When the parts of a page are there, from the start of the navigation. [ms]
STEPS = """() => {
  const [page] = performance.getEntriesByType('navigation');
  const script = performance.getEntriesByType('resource').find(({ name }) => /assets\\/main-/.test(name));
  const frame = bench.frames.find(({ scan }) => scan);
  return {
    page: page.responseEnd, 'first script run': bench.first.worker, 'graphics context': bench.first.context,
    picture: bench.poster ?? frame.end,
    'main script there': script.responseEnd, 'first shader given': bench.first.program,
    'stream ready': bench.first.stream, 'first view decoded': bench.first.view,
    'frame begun': frame.begin, 'frame drawn': frame.end,
  };
}"""


async def run(scan: BenchScan, clicks: int, repeats: int, seconds: float, graphics: str) -> dict[str, Any]:
    """Measure on one scan. Raises ConfigError where there is no such graphics.

    seconds : of random clicks, to see whether memory grows.  graphics : one of `GRAPHICS`.
    """
    async with async_playwright() as playwright, AsyncExitStack() as stack:
        browser = await playwright.chromium.launch(executable_path=CHROMIUM, args=[*GRAPHICS[graphics], *CALLS_NOBODY])
        renderer = await _renderer(browser, graphics)
        ours, pid, _, _ = await stack.enter_async_context(node_at([scan]))
        empty = await stack.enter_async_context(_empty_page())
        context = await browser.new_context(viewport=VIEWPORT, reduced_motion="reduce")  # type: ignore[arg-type]
        await context.add_init_script(path=HOOK)
        processes = Processes(await browser.new_browser_cdp_session(), pid)
        page = await context.new_page()
        empty += "#" + ",".join(map(str, await _picture_size(page, ours)))
        record = {
            "scan": scan.name, "size": scan.size, "repeats": repeats, "clicks": clicks, "renderer": renderer,
            "first": await _first_views(page, processes, ours, empty, repeats),
            **await _clicks(page, await context.new_page(), processes, ours, empty, clicks),
            "memory": None,
        }  # fmt: skip
        if seconds:
            await _open(page, ours, OF_A_SCAN)
            record["memory"] = await memory(page, processes, _click, _somewhere, seconds)
        await browser.close()
        return record


def told(record: dict[str, Any]) -> str:
    """The figures as text."""
    first, press, click, update, redraw = (record[name] for name in ("first", "press", "click", "update", "redraw"))
    lines = [
        f"{record['scan']} {record['size']}, medians; in brackets, of what an empty frame takes",
        f"drawn by {record['renderer']}",
        f"address to a picture of the first view: {first['picture_ms']:.0f} ms, asked {ASKED['first_ms']} ms",
        f"address to the model of it drawn: {_beside(first)}",
        *_in_parts(first),
        f"  tasks over 50 ms until then: {first['long_tasks']} (empty page {first['empty_long_tasks']}), longest "
        f"{first['longest_ms']:.0f} ms",
        f"press to drawn: {_beside(press)}",
        *_in_parts(press),
        f"click to drawn, let go {PRESS_MS} ms after the press: {click['ms']:.0f} ms, asked {ASKED['click_ms']} ms",
        f"  tasks over 50 ms in {press['count'] + click['count']} clicks: {press['long_tasks'] + click['long_tasks']}",
        f"an update on the page's thread, painting it among that: {update['ms']:.1f} ms, at the 95th percentile "
        f"{update['p95_ms']:.1f} ms, asked {ASKED['update_ms']} ms",
        f"drawing once more: {_beside(redraw)}, {redraw['triangles']} triangles",
        *_in_parts(redraw),
    ]
    if used := record["memory"]:
        lines.append(f"{used['clicks']} random clicks in {used['seconds']:.0f} s; MB after each fifth:")
        lines += [f"  {name}: {', '.join(f'{size:.1f}' for size in sizes)}" for name, sizes in used["mb"].items()]
    return "\n".join(lines)


def _beside(figure: dict[str, Any]) -> str:
    return f"{figure['ms']:.0f} ms ({figure['ms'] / figure['empty_ms']:.1f} x {figure['empty_ms']:.0f} ms)"


def _in_parts(figure: dict[str, Any]) -> list[str]:
    """Lines on the steps of something, and on what they spend of the processor."""
    steps = ", ".join(f"{name} {ms:.0f}" for name, ms in figure.get("steps", {}).items())
    spent, empty = figure["spent_ms"], figure["empty_spent_ms"]
    each = ", ".join(f"{kind} {ms:.0f}" for kind, ms in spent.items())
    total, least = sum(spent.values()), sum(empty.values())
    lines = [f"  processor: {total:.0f} ms ({total / least:.1f} x {least:.0f} ms): {each}"]
    return [f"  ms: {steps}", *lines] if steps else lines


def _medians(rows: Iterable[dict[str, float]]) -> dict[str, float]:
    """Of each named value."""
    rows = list(rows)
    return {name: median(row[name] for row in rows) for name in rows[0]}


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
    try:
        yield f"http://127.0.0.1:{runner.addresses[0][1]}/"
    finally:
        await runner.cleanup()


async def _renderer(browser: Browser, graphics: str) -> str:
    """What draws, by its own name. Raises ConfigError where it is not what was asked for."""
    page = await browser.new_page()
    name: str = await page.evaluate(RENDERER)
    await page.close()
    if not name or (graphics == "card" and any(processor in name for processor in PROCESSORS)):
        cure = "; a card needs its Vulkan driver installed" if graphics == "card" else ""
        raise ConfigError(f"bench: --graphics {graphics}: chromium draws WebGL by {name or 'nothing'}{cure}")
    return name


async def _open(page: Page, address: str, shown: str) -> None:
    """An address in this tab, once a frame is drawn of which the hook says so. Asking the page would take its time."""
    await page.goto("about:blank")
    await page.wait_for_timeout(300)  # the last page ends
    async with page.expect_console_message(lambda said: said.text.startswith(shown)):
        await page.goto(address, wait_until="commit")


async def _picture_size(page: Page, ours: str) -> tuple[int, int]:
    """Of the picture in our page. [px]"""
    await _open(page, ours, OF_A_SCAN)
    width, height = await page.evaluate("() => ['width', 'height'].map((of) => document.querySelector('canvas')[of])")
    return width, height


async def _first_views(page: Page, processes: Processes, ours: str, empty: str, repeats: int) -> dict[str, Any]:
    """From the start of a navigation to a frame drawn; the first time of each, with cold caches, does not count."""
    seen: dict[str, list[dict[str, Any]]] = {ours: [], empty: []}
    for _ in range(repeats + 1):
        for address, shown in ((empty, ANY), (ours, OF_A_SCAN)):
            async with processes.spending() as spent:
                await _open(page, address, shown)
            bench = await page.evaluate("() => bench")
            drawn = next(frame["end"] for frame in bench["frames"] if address == empty or frame["scan"])
            tasks = [ms for begin, ms in bench["tasks"] if begin < drawn]
            steps = await page.evaluate(STEPS) if address == ours else {}
            seen[address].append({"ms": drawn, "spent": spent, "tasks": tasks, "steps": steps})
    mine, nothing = seen[ours][1:], seen[empty][1:]
    return {
        "picture_ms": median(each["steps"]["picture"] for each in mine),
        "ms": median(each["ms"] for each in mine), "empty_ms": median(each["ms"] for each in nothing),
        "all_ms": [each["ms"] for each in seen[ours]], "all_empty_ms": [each["ms"] for each in seen[empty]],
        "steps": _medians(each["steps"] for each in mine),
        "spent_ms": _medians(each["spent"] for each in mine),
        "empty_spent_ms": _medians(each["spent"] for each in nothing),
        "long_tasks": median(len(each["tasks"]) for each in mine),
        "empty_long_tasks": median(len(each["tasks"]) for each in nothing),
        "longest_ms": median(max(each["tasks"], default=0.0) for each in mine),
    }  # fmt: skip


async def _clicks(
    page: Page, nothing: Page, processes: Processes, ours: str, empty: str, count: int
) -> dict[str, Any]:
    """From press and click to their updates drawn, and what that takes on the page's thread; also a frame once more."""
    at_once, held, empty_clicks, redrawn = (list[dict[str, Any]]() for _ in range(4))
    await _open(nothing, empty, ANY)
    for press_ms, seen in ((0, at_once), (PRESS_MS, held)):
        rng = random.Random(SEED)  # the same places, and of a page that holds as little
        await page.bring_to_front()
        await _open(page, ours, OF_A_SCAN)
        await page.wait_for_timeout(1500)
        for _ in range(count + 1):  # the first takes memory for refined colour, and does not count
            await nothing.bring_to_front()
            empty_clicks.append(await _empty_click(nothing, processes))
            await page.bring_to_front()
            await page.wait_for_timeout(300)
            async with processes.spending() as spent:
                bench = await _click(page, *await _somewhere(page, rng), press_ms)
            seen.append(_told_of_click(bench, spent))
            redrawn.append(await _redraw(page, processes))
    await nothing.bring_to_front()
    empty_frames = [await _empty_click(nothing, processes) for _ in range(9)]
    counted, waited = ([each for each in all_[1:] if each] for all_ in (at_once, held))
    return {
        "press": {"ms": median(each["ms"] for each in counted), "count": len(counted),
                  "empty_ms": median(each["ms"] for each in empty_clicks[1:]),
                  "all_ms": [each["ms"] for each in counted], "steps": _medians(each["steps"] for each in counted),
                  "spent_ms": _medians(each["spent"] for each in counted),
                  "empty_spent_ms": _medians(each["spent"] for each in empty_clicks[1:]),
                  "long_tasks": sum(each["long_tasks"] for each in counted)},
        "click": {"ms": median(each["waited_ms"] for each in waited), "press_ms": PRESS_MS, "count": len(waited),
                  "all_ms": [each["waited_ms"] for each in waited],
                  "long_tasks": sum(each["long_tasks"] for each in waited)},
        "update": {"ms": median(each["update_ms"] for each in counted),
                   "p95_ms": float(np.percentile([each["update_ms"] for each in counted], 95))},
        "redraw": {"ms": median(each["ms"] for each in redrawn), "triangles": redrawn[-1]["triangles"],
                   "empty_ms": median(each["frame_ms"] for each in empty_frames),
                   "spent_ms": _medians(each["spent"] for each in redrawn),
                   "empty_spent_ms": _medians(each["spent"] for each in empty_frames)},
    }  # fmt: skip


def _told_of_click(bench: dict[str, Any], spent: Spent) -> dict[str, Any]:
    """What was noted of one click; nothing where it brought nothing."""
    patches = [(at, ms) for kind, at, ms in bench["messages"] if kind in ("patch", "patched")]
    if not patches:  # nor where it was beside the object
        return {}
    pressed, looked, (came, _), answer = bench["pressed"], bench["looked"], patches[-1], bench["answer"]
    frame = next(frame for frame in bench["frames"] if frame["begin"] >= came)
    painted = max((ms for at, ms in bench["painting"] if at >= came), default=0.0)
    node_ms, apply_ms = answer["nodeMs"], answer["applyMs"]
    return {
        "ms": frame["end"] - pressed,
        "waited_ms": frame["end"] - bench["clicked"],
        "steps": {
            "asked": looked - pressed, "node": node_ms, "decoded and applied": apply_ms,
            "wire and waiting": came - looked - node_ms - apply_ms, "frame begun": frame["begin"] - came,
            "frame drawn": frame["end"] - frame["begin"],
        },
        "spent": spent,
        "update_ms": sum(ms for _, ms in patches) + painted,
        "long_tasks": len(bench["tasks"]),
    }  # fmt: skip


async def _somewhere(page: Page, rng: random.Random) -> tuple[float, float]:
    """A place of the picture where the object is."""
    box = await page.locator("#view").bounding_box()
    assert box is not None
    x, y = (0.5 + rng.uniform(-SPOT, SPOT) for _ in range(2))
    return box["x"] + x * box["width"], box["y"] + y * box["height"]


async def _click(page: Page, x: float, y: float, press_ms: float = 0) -> dict[str, Any]:
    """Click there, pressed so long; what was noted until its update was drawn and all is calm again."""
    before = await page.evaluate("() => Number(document.documentElement.dataset.updates ?? 0)")
    await page.evaluate(FORGET)
    for _ in range(CLICK_TRIES):
        await page.mouse.click(x, y, delay=press_ms)
        if not await page.evaluate("() => bench.looked"):
            break  # it was beside the object
        with suppress(TimeoutError):
            answered = f'html[data-updates="{before + 1}"][data-looking="no"]'
            await page.wait_for_selector(answered, state="attached", timeout=10_000)
            break
    await page.wait_for_timeout(400)
    await page.wait_for_function(AT_REST, polling=50)
    bench: dict[str, Any] = await page.evaluate("() => bench")
    return bench


async def _redraw(page: Page, processes: Processes) -> dict[str, Any]:
    """One frame of the same view once more."""
    await page.evaluate("() => { bench.frames.length = 0; }")
    async with processes.spending() as spent:
        await page.locator("#view").press("Home")
        await page.wait_for_function(DRAWN, polling=50)
    frame = await page.evaluate("() => bench.frames[0]")
    return {"ms": frame["end"] - frame["begin"], "triangles": frame["triangles"], "spent": spent}


async def _empty_click(page: Page, processes: Processes) -> dict[str, Any]:
    await page.evaluate("() => { bench.frames.length = 0; }")
    async with processes.spending() as spent:
        await page.mouse.click(VIEWPORT["width"] / 4, VIEWPORT["height"] / 2)
        await page.wait_for_function(DRAWN, polling=50)
    frame, pressed = await page.evaluate("() => [bench.frames[0], bench.pressed]")
    return {"ms": frame["end"] - pressed, "frame_ms": frame["end"] - frame["begin"], "spent": spent}
