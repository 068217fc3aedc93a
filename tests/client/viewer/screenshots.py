"""Take the pictures of client/viewer/screenshots, from generated specimens only.

    python -m tests.client.viewer.screenshots
"""

from __future__ import annotations

import io
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

import hatch_build
from tests.client.viewer.browser import click, launch, opened, wait_drawn, wait_updates
from tests.system.line import RunningNode, run_line

FOLDER = hatch_build.VIEWER / "screenshots"
WIDE = {"width": 1280, "height": 800}
# So slow that there is time for a picture half way through the sweep.
SPECIMEN = ("--size", "M", "--link-rate", "9000000")


def main() -> None:
    """One picture for each of the main states."""
    FOLDER.mkdir(exist_ok=True)
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        browser = stack.enter_context(_browser())
        node = aside.submit(run_line, stack, folder, "--specimen", "head", *SPECIMEN).result()
        _looks(browser, node)
        _tools(browser, node)
        _narrow(browser, node)
        _sweep(browser, node)


@contextmanager
def _browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        yield launch(playwright)


def _looks(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url, viewport=WIDE) as page:
        page.wait_for_timeout(1000)  # thumbnails
        _take(page, "first_view")
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        _take(page, "click")
        page.locator("#view").focus()
        for key in ("ArrowRight", "ArrowRight", *"+++++"):
            page.keyboard.press(key)
        page.keyboard.press("Enter")
        wait_updates(page, 2)
        page.locator("#received").scroll_into_view_if_needed()
        page.wait_for_selector(".uplot")
        _take(page, "near")


def _tools(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url, viewport=WIDE, color_scheme="dark") as page:
        click(page, 0.5, 0.45)
        wait_updates(page, 1)
        page.get_by_label("measures").check()
        click(page, 0.42, 0.45)
        click(page, 0.58, 0.45)
        page.locator("summary:has-text('Display')").click()
        page.get_by_label("Overlay").select_option("texture")
        page.get_by_label("sets a pin").scroll_into_view_if_needed()
        _take(page, "distance_and_overlay")


def _narrow(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url, viewport={"width": 360, "height": 740}, device_scale_factor=2) as page:
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        page.wait_for_timeout(1000)
        _take(page, "narrow")


def _sweep(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url, viewport=WIDE) as page:
        page.get_by_role("button", name="Start a sweep").click()
        page.wait_for_selector('html[data-live="yes"]', state="attached")
        while page.locator("progress").evaluate("(bar) => bar.value") < 55:
            page.wait_for_timeout(50)
        wait_drawn(page)
        _take(page, "sweep")
        page.wait_for_selector('html[data-live="no"]', state="attached")


def _take(page: Page, name: str) -> None:
    wait_drawn(page)
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.save(FOLDER / f"{name}.jpg", quality=88, subsampling=0, optimize=True)


if __name__ == "__main__":
    main()
