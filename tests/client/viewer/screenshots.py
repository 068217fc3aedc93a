"""Take the pictures of client/viewer/screenshots, from generated specimens only.

    python -m tests.client.viewer.screenshots
"""

from __future__ import annotations

import asyncio
import io
import json
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

import hatch_build
from client.transfer import send_scan
from exchange.native import write_native
from foveascan import started
from node.access import Access, access_folder
from node.auth import COOKIE
from node.library import About, Library
from simulators.specimen import GENERATORS, make_specimen
from tests.client.viewer.browser import blank, click, launch, opened, wait_drawn, wait_updates
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
        _path(browser, node)
        _narrow(browser, node)
        _sweep(browser, node)
        _compare(browser, node, aside)
        _pole(browser, stack.enter_context(_pebble(aside, folder / "closed")))
        _administration(browser, aside, folder / "logins")


@contextmanager
def _browser() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        yield launch(playwright)


@contextmanager
def _pebble(aside: Executor, folder: Path) -> Iterator[str]:
    """The address of a node with the closed specimen, as it is seen from inside."""
    shape, file = (1440, 1024, 4096, 2048), io.BytesIO()
    write_native(GENERATORS["pebble"](shape, 1), file, "pebble")
    file.seek(0)
    with started("serve", "--library", str(folder), "--listen", "127.0.0.1:0", "--insecure", "--json") as (_, ready):
        sent = send_scan(ready["url"], file, moved=lambda done, total: None)
        aside.submit(asyncio.run, sent).result()
        yield ready["url"]


def _administration(browser: Browser, aside: Executor, folder: Path) -> None:
    """A node with logins, as an admin sees it who has just made a code."""

    def prepare() -> str:
        with closing(Library(folder)) as library:
            library.add(make_specimen("head", "S").grid, About(time.time()))
        access, roles = Access(access_folder(folder)), {"me": "admin", "reception": "view", "room 2": "operate"}
        return [access.grant(role, name, time.time()) for name, role in roles.items()][0]  # type: ignore[arg-type]

    token = aside.submit(prepare).result()
    with ExitStack() as stack:
        node = started("serve", "--library", str(folder), "--listen", "127.0.0.1:0", "--json")
        url = aside.submit(stack.enter_context, node).result()[1]["url"]
        with blank(browser, ignore_https_errors=True, viewport=WIDE) as (page, _):
            page.context.add_cookies([{"name": COOKIE, "value": token, "url": url, "secure": True}])
            page.goto(url)
            page.wait_for_selector("html[data-scan]", state="attached")
            page.get_by_role("button", name="Administration").click()
            page.get_by_label("Name: who or where it is").fill("tablet")
            page.get_by_role("button", name="Make a code").click()
            page.wait_for_selector("#admin .code code")
            _take(page, "administration")
        aside.submit(stack.close).result()


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


def _path(browser: Browser, node: RunningNode) -> None:
    """A path of several points over the cheek, then the offline copy of that view."""
    with opened(browser, node.url, viewport=WIDE) as page:
        page.locator("#view").focus()
        for key in ("ArrowRight", "ArrowRight", "ArrowRight", *"++++", "Enter"):
            page.keyboard.press(key)
        wait_updates(page, 1)
        page.get_by_label("traces a path").check()
        for place in ((0.45, 0.3), (0.55, 0.42), (0.52, 0.6), (0.4, 0.72)):
            click(page, *place)
        _take(page, "path")
        page.locator("summary:has-text('This scan')").click()
        page.get_by_role("button", name="Offline copy of this view").click()
        with page.expect_download() as download:
            page.get_by_role("button", name="Save the file").click()
        with tempfile.NamedTemporaryFile(suffix=".html") as copy:
            download.value.save_as(copy.name)
            at, look = f"file://{copy.name}", {"viewport": WIDE, "color_scheme": "dark"}
            with opened(browser, at, allowed=copy.name, **look) as offline:
                _take(offline, "offline_copy")


def _compare(browser: Browser, node: RunningNode, aside: Executor) -> None:
    """Two visits of one subject, the same place sharp in both."""
    file = io.BytesIO()
    write_native(GENERATORS["head"]((1440, 1024, 4096, 2048), 2), file, "Six weeks later")
    file.seek(0)
    sent = send_scan(node.url, file, moved=lambda done, total: None)
    later = aside.submit(asyncio.run, sent).result().scan
    with opened(browser, node.url, viewport=WIDE) as page:
        scans = page.request.get(f"{node.url}/v1/scans").json()
        first = next(scan["id"] for scan in scans if scan["id"] != later)
        for scan, name in ((first, "First visit"), (later, "Six weeks later")):
            said = json.dumps({"name": name, "subject": "P-17", "body_site": "face"})
            json_headers = {"Content-Type": "application/json"}
            page.request.patch(f"{node.url}/v1/scans/{scan}/sidecar", data=said, headers=json_headers)
    with opened(browser, f"{node.url}/#scan={first}", viewport=WIDE) as page:
        page.locator("summary:has-text('Compare')").click()
        page.get_by_label("Beside the open scan").select_option(later)
        page.wait_for_selector(f'.picture[data-scan="{later}"]')
        page.locator("#view").focus()
        for key in ("ArrowRight", "ArrowRight", *"+++", "Enter"):
            page.keyboard.press(key)
        wait_updates(page, 1)
        page.wait_for_selector('.picture[data-updates="1"][data-looking="no"]')
        page.get_by_label("Sharpen both").scroll_into_view_if_needed()
        _take(page, "compare")


def _pole(browser: Browser, url: str) -> None:
    """From above, the upper pole somewhat over the middle of the picture: before and after a click on it."""
    with opened(browser, url, viewport=WIDE) as page:
        scan = page.evaluate("document.documentElement.dataset.scan")
    with opened(browser, f"{url}/#scan={scan}&camera=0.3,1.3,220,0,47,0", viewport=WIDE) as page:
        page.wait_for_timeout(1000)
        _take(page, "pole_before")
        click(page, 0.5, 0.37)
        wait_updates(page, 1)
        _take(page, "pole_after")


def _take(page: Page, name: str) -> None:
    wait_drawn(page)
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    picture.save(FOLDER / f"{name}.jpg", quality=88, subsampling=0, optimize=True)


if __name__ == "__main__":
    main()
