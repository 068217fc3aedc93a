"""Debian's chromium with the page in it, and pictures of what it draws."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, Playwright

import hatch_build

CHROMIUM = "/usr/bin/chromium"
# What draws: the processor, so that every machine draws alike; or this machine's graphics card, without a display.
GRAPHICS = {
    "software": ("--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    "card": ("--use-angle=vulkan", "--ignore-gpu-blocklist"),  # not --enable-features=Vulkan: it loses its contexts
}
CALLS_NOBODY = (
    "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
ARGUMENTS = (*GRAPHICS["software"], *CALLS_NOBODY)
PRESS_S = 0.08
WAIT_MS = 60_000  # at most; a machine under load takes its time
AXE = hatch_build.VIEWER / "node_modules" / "axe-core" / "axe.min.js"
FAULTS = Path(__file__).with_name("layout_faults.js").read_text().split("\n", 2)[2]
Picture = NDArray[np.float64]
SEEN = """async () => {
  const frames = () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)));
  await frames();
  for (const gl of [...document.querySelectorAll('.picture > canvas')].map((canvas) => canvas.getContext('webgl2'))) {
    const fence = gl?.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl?.flush();
    const isDone = () => !fence || gl.isContextLost() || gl.getSyncParameter(fence, gl.SYNC_STATUS) === gl.SIGNALED;
    while (!isDone()) await new Promise((look) => setTimeout(look, 5));
  }
  await frames();
}"""


def launch(playwright: Playwright) -> Browser:
    """A browser of this machine; none is downloaded."""
    return playwright.chromium.launch(executable_path=CHROMIUM, args=list(ARGUMENTS))


@contextmanager
def opened(browser: Browser, address: str, allowed: str = "\0", **options: Any) -> Iterator[Page]:
    """The page at an address once a scan is drawn and all stands round it.

    Fails afterwards if it complained or asked anybody else. allowed : what it may complain of.
    """
    with blank(browser, **options) as (page, problems):
        show(page, address)
        yield page
    unexpected = [problem for problem in problems if allowed not in problem]
    assert not unexpected, unexpected


def show(page: Page, address: str) -> None:
    """Have a page show an address, until a scan is drawn and all stands round it."""
    page.goto(address)
    page.wait_for_selector("html[data-scan]", state="attached")
    page.wait_for_selector("#app:not(.early) aside details", state="attached")  # panels come after the picture
    wait_drawn(page)


@contextmanager
def blank(browser: Browser, **options: Any) -> Iterator[tuple[Page, list[str]]]:
    """An empty page, and the list of what it will complain of."""
    context = browser.new_context(**{"viewport": {"width": 1000, "height": 700}, "reduced_motion": "reduce", **options})
    context.set_default_timeout(WAIT_MS)
    page, problems = context.new_page(), list[str]()
    page.on("console", lambda said: problems.append(said.text) if said.type in ("error", "warning") else None)
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.on("request", lambda request: None if _is_local(request.url) else problems.append(f"asked {request.url}"))
    try:
        yield page, problems
    finally:
        context.close()


def _is_local(url: str) -> bool:
    return url.startswith(("http://127.0.0.1", "ws://127.0.0.1", "blob:", "data:"))


def wait_drawn(page: Page) -> None:
    """Until what is known is on the screen: two frames after now, and two after the card has drawn them."""
    page.evaluate(SEEN)


def wait_updates(page: Page, count: int) -> None:
    """Until so many looks are answered and drawn."""
    page.wait_for_selector(f'html[data-updates="{count}"][data-looking="no"]', state="attached")
    wait_drawn(page)


def point_at(page: Page, x: float, y: float, view: str = "#view") -> tuple[float, float]:
    """Move the pointer to shares of the picture's width and height. Returns where that is on the page. [px]"""
    box = page.locator(view).bounding_box()
    assert box is not None
    place = box["x"] + x * box["width"], box["y"] + y * box["height"]
    page.mouse.move(*place)
    return place


def click(page: Page, x: float, y: float, view: str = "#view") -> None:
    """Click the picture at shares of its width and height: as short as people do, however slow the machine is."""
    left, top = point_at(page, x, y, view)
    at = {"x": left, "y": top, "button": "left", "clickCount": 1}
    devtools, now = page.context.new_cdp_session(page), time.time()
    devtools.send("Input.dispatchMouseEvent", {"type": "mousePressed", **at, "buttons": 1, "timestamp": now})
    devtools.send("Input.dispatchMouseEvent", {"type": "mouseReleased", **at, "timestamp": now + PRESS_S})
    devtools.detach()


def crop(page: Page, x: float, y: float, side: int, view: str = "#view") -> Picture:
    """What is drawn round a place of the picture: (side, side, 3) 0..255."""
    box = page.locator(view).bounding_box()
    assert box is not None
    left, top = box["x"] + x * box["width"] - side / 2, box["y"] + y * box["height"] - side / 2
    png = page.screenshot(clip={"x": left, "y": top, "width": side, "height": side})
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), np.float64)


def barriers(page: Page) -> list[tuple[str, list[str]]]:
    """What axe-core finds on a page as it stands: rules that are broken, and the elements that do."""
    page.evaluate(AXE.read_text())
    found = page.evaluate("() => axe.run()")
    return [(problem["id"], [one["html"] for one in problem["nodes"]]) for problem in found["violations"]]


def layout_faults(page: Page) -> list[str]:
    """Texts that are cut, and controls that lie on each other, on a page as it stands."""
    found: list[str] = page.evaluate(FAULTS)
    return found


def psnr(one: Picture, other: Picture) -> float:
    """How alike two pictures are. [dB]"""
    return float(10 * np.log10(255**2 / max(float(np.mean((one - other) ** 2)), 1e-3)))
