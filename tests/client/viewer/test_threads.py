"""What the page's own thread is kept with: no task as long as a person would notice."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser

from tests.client.viewer.browser import blank, click, wait_drawn, wait_updates
from tests.system.line import run_line

TASK_MAX_MS = 50
TASK = "ThreadControllerImpl::RunTask"


def test_no_task_of_the_page_takes_50_ms_of_its_thread(browser: Browser, tmp_path: Path) -> None:
    """Time is the processor's, as the browser's own trace has it: what else the machine does is not counted."""
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:  # playwright keeps this thread's event loop
        line = aside.submit(run_line, stack, tmp_path, "--size", "M", "--link-rate", "20000000").result()
        tasks = tasks_ms(browser, line.url)
    assert len(tasks) > 100
    assert max(tasks) < TASK_MAX_MS, sorted(tasks)[-5:]


def tasks_ms(browser: Browser, address: str) -> list[float]:
    """Open the page, click, zoom, open every panel: what each task of the page's thread took."""
    with blank(browser) as (page, _):
        browser.start_tracing(page=page, categories=["toplevel", "devtools.timeline"])
        page.goto(address)
        page.wait_for_selector("html[data-scan]", state="attached")
        wait_drawn(page)
        for number, place in enumerate(((0.5, 0.5), (0.45, 0.4), (0.55, 0.4)), 1):
            click(page, *place)
            wait_updates(page, number)
        page.keyboard.press("+")
        page.locator("aside details").evaluate_all("(all) => all.forEach((one) => (one.open = true))")
        page.locator("#received").scroll_into_view_if_needed()
        page.wait_for_selector("canvas:not(#view)", state="attached")
        page.wait_for_timeout(1500)  # charts are drawn once a second
        events: list[dict[str, Any]] = json.loads(browser.stop_tracing())["traceEvents"]
    asked = (one for one in events if one["name"] == "ResourceSendRequest")
    ours = next(one["pid"] for one in asked if f"{address}/" in str(one["args"]))
    main = next(one["tid"] for one in events if one["pid"] == ours and one["args"].get("name") == "CrRendererMain")
    tasks = [one for one in events if one["name"] == TASK and (one["pid"], one["tid"]) == (ours, main)]
    return [one["tdur"] / 1000 for one in tasks if "tdur" in one]  # what tracing itself cut short has none
