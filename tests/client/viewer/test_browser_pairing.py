"""A browser that was never here before: led to the pairing page, let in by a code, put out again."""

from __future__ import annotations

import json
import subprocess
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from playwright.sync_api import sync_playwright

from foveascan import PROGRAM, started
from node.library import About, Library
from node.sidecar import Changes, Pin
from tests.client.viewer.browser import blank, launch, wait_drawn
from tests.node.scans import make_grid


def run(*arguments: str) -> dict[str, str]:
    ran = subprocess.run([*PROGRAM, *arguments, "--json"], capture_output=True, check=True, timeout=60)
    said: dict[str, str] = json.loads(ran.stdout)
    return said


def keep_a_scan(folder: Path) -> None:
    library = Library(folder)
    scan = library.add(make_grid(160, 96), About(0.0))
    library.annotate(scan.id, Changes(pins=(Pin(0.5, 0.5, "mole"),)), by="test")
    library.close()


def test_a_browser_is_let_in_by_a_code_and_put_out_again(tmp_path: Path) -> None:
    with ThreadPoolExecutor(1) as aside:  # playwright keeps this thread's event loop
        aside.submit(keep_a_scan, tmp_path).result()
    serve = ["serve", "--library", str(tmp_path), "--listen", "127.0.0.1:0", "--json"]
    with started(*serve) as (_, ready), sync_playwright() as playwright:
        offered = run("pair", "--name", "tablet", "--library", str(tmp_path))
        running = launch(playwright)
        with blank(running, ignore_https_errors=True) as (page, _):
            page.goto(ready["url"])
            assert page.url == f"{ready['url']}/pair"
            shown = page.locator("ol code").text_content() or ""
            assert shown.replace(":", "").lower() == offered["fingerprint"]
            page.fill("input", offered["code"])
            page.click("button")
            page.wait_for_selector("html[data-scan]", state="attached")
            wait_drawn(page)
            assert page.url.startswith(f"{ready['url']}/")
            assert "foveascan" not in page.evaluate("document.cookie")
            page.locator("aside details").evaluate_all("(all) => all.forEach((one) => (one.open = true))")
            for what in ("Administration", "Start a sweep", "Save", "Delete the scan", "sets a pin"):
                found = page.locator("button, label").get_by_text(what).all()
                assert found and not any(one.is_visible() for one in found), f"who may only look is offered: {what}"
            assert page.locator(".pin").get_by_text("mole").is_visible()
            assert page.get_by_role("button", name="Show pin mole").is_visible()
            assert page.get_by_role("button", name="Remove pin mole").count() == 0
            assert page.get_by_text("To sweep, to set pins, to name or delete scans").first.is_visible()
            run("access", "revoke", "tablet", "--library", str(tmp_path))
            page.wait_for_url("**/pair")
            page.goto(f"{ready['url']}/")
            assert page.url == f"{ready['url']}/pair"
        running.close()
