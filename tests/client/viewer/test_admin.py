"""What who looks after a node does in its page: lets in and puts out, reads who did what, sees how it is."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import pytest
from playwright.sync_api import Browser, Page, expect

from foveascan import started
from node.access import Access, access_folder
from node.auth import COOKIE
from node.library import About, Library
from protocol import pairing
from tests.client.viewer.browser import barriers, blank, layout_faults
from tests.node.scans import make_grid

PATIENCE_MS = 60_000
expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("admin")
    kept = Library(folder)
    kept.add(make_grid(160, 96), About(1e9))
    kept.close()
    return folder


@pytest.fixture(scope="module")
def url(library: Path) -> Iterator[str]:
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:  # playwright keeps this thread's event loop
        serve = started("serve", "--library", str(library), "--listen", "127.0.0.1:0", "--json")
        yield aside.submit(stack.enter_context, serve).result()[1]["url"]


def test_a_node_without_logins_says_so(browser: Browser, tmp_path: Path) -> None:
    serve = started("serve", "--insecure", "--library", str(tmp_path), "--listen", "127.0.0.1:0", "--json")
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside, blank(browser) as (page, _):
        page.set_default_timeout(PATIENCE_MS)
        page.goto(aside.submit(stack.enter_context, serve).result()[1]["url"])
        page.get_by_role("button", name="Administration").click()
        admin = page.locator("#admin")
        expect(admin).to_contain_text("was started with --insecure and knows no logins")
        expect(admin).to_contain_text("none: this node knows no logins")
        expect(admin.get_by_role("button", name="Make a code")).to_be_hidden()
        assert barriers(page) == []


@pytest.fixture(scope="module")
def page(browser: Browser, url: str, library: Path) -> Iterator[Page]:
    """The page of an admin, with everything for admins open."""
    token = Access(access_folder(library)).grant("admin", "me", time.time())
    with blank(browser, ignore_https_errors=True) as (page, problems):
        page.set_default_timeout(PATIENCE_MS)
        page.context.add_cookies([{"name": COOKIE, "value": token, "url": url, "secure": True}])
        page.goto(url)
        page.wait_for_selector("html[data-scan]", state="attached")
        page.get_by_role("button", name="Administration").click()
        expect(page.locator("#admin .log li").first).to_be_visible()
        yield page
        own = f"asked {url}/", f"asked {url.replace('https', 'wss')}/"
        assert [problem for problem in problems if not problem.startswith(own)] == []


def test_it_says_how_the_node_is(page: Page) -> None:
    admin = page.locator("#admin")
    expect(admin.locator("dl")).to_contain_text("SHA-256")
    for said in ("All is well.", "1 scan", "No scanner at this node", "the node’s own, which it renews", "GB free of"):
        expect(admin).to_contain_text(said)


def test_somebody_is_let_in_and_put_out(page: Page, library: Path) -> None:
    admin = page.locator("#admin")
    admin.get_by_label("Name: who or where it is").fill("room <2>")
    admin.get_by_label("What they may do").select_option("operate")
    admin.get_by_role("button", name="Make a code").click()
    code = admin.locator(".code code").first
    expect(code).to_have_text(re.compile(r"^(\w{4}-){3}\w{4}$"))
    expect(admin.locator(".code")).to_contain_text(re.compile(r"[0-9] min [0-9]+ s left"))
    assert admin.locator(".code .fingerprint").text_content() == admin.locator("dl code").text_content()
    row = admin.locator(".logins li", has_text="room <2>")
    expect(row).to_contain_text("operate · a code waits until")
    key = pairing.key_of(pairing.parse_code(code.text_content() or ""))
    assert Access(access_folder(library)).redeem(lambda other: other == key, time.time())
    page.keyboard.press("Escape")
    expect(admin).to_be_hidden()
    page.get_by_role("button", name="Administration").click()
    expect(row).to_contain_text("last use not known")
    expect(admin.locator(".logins li", has_text="me")).to_contain_text("last used")
    row.get_by_role("button").click()
    page.get_by_role("button", name="Leave it").click()
    expect(row).to_have_count(1)
    row.get_by_role("button").click()
    page.get_by_role("button", name="Revoke", exact=True).click()
    expect(row).to_have_count(0)
    assert [token.name for token in Access(access_folder(library)).tokens()] == ["me"]


def test_who_did_what_is_read_and_narrowed(page: Page) -> None:
    admin = page.locator("#admin")
    show = admin.get_by_role("button", name="Show", exact=True)
    opened, started = (admin.locator(".log li", has_text=word) for word in ("opened", "started"))
    show.click()
    expect(opened).to_have_count(1)
    times = admin.locator(".log time").evaluate_all("(all) => all.map((one) => one.dateTime)")
    assert len(times) > 1 and times == sorted(times, reverse=True)
    opened.get_by_role("button").click()
    expect(started).to_have_count(0)
    expect(opened).to_have_count(1)
    admin.get_by_label("Scan (beginning of its id)").fill("")
    admin.get_by_label("By whom").fill("the node")
    show.click()
    expect(opened).to_have_count(0)
    expect(started).to_have_count(1)
    admin.get_by_label("By whom").fill("somebody else")
    show.click()
    expect(admin).to_contain_text("Nothing of that kind.")


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1000])
def test_it_is_for_everybody(page: Page, scheme: Literal["light", "dark"], width: int) -> None:
    page.emulate_media(color_scheme=scheme, reduced_motion="reduce")
    page.set_viewport_size({"width": width, "height": 800})
    page.get_by_label("Name: who or where it is").fill("x" * 60)  # the code that waited for that is void then
    page.get_by_role("button", name="Make a code").click()
    expect(page.locator("#admin .logins li", has_text="x" * 60)).to_have_count(1)
    expect(page.locator("#admin .code")).to_contain_text("x" * 60)
    assert barriers(page) == [] == layout_faults(page)
    article = "document.querySelector('#admin article')"
    assert page.evaluate(f"{article}.scrollWidth <= {article}.clientWidth")


def test_who_puts_himself_out_is_warned_and_then_at_the_door(browser: Browser, url: str, library: Path) -> None:
    token = Access(access_folder(library)).grant("admin", "my tablet", time.time())
    with blank(browser, ignore_https_errors=True) as (page, _):
        page.set_default_timeout(PATIENCE_MS)
        page.context.add_cookies([{"name": COOKIE, "value": token, "url": url, "secure": True}])
        page.goto(url)
        page.get_by_role("button", name="Administration").click()
        row = page.locator("#admin .logins li", has_text="my tablet")
        expect(row).to_contain_text("this browser’s own")
        expect(page.locator("#admin .logins li", has_text=re.compile("^me"))).not_to_contain_text("own")
        row.get_by_role("button").click()
        expect(page.get_by_role("dialog", name="my tablet is this browser’s own login")).to_be_visible()
        page.get_by_role("button", name="Revoke", exact=True).click()
        page.wait_for_url("**/pair")
        expect(page.locator("body")).to_contain_text("makes one, in its page under")
    assert "my tablet" not in [token.name for token in Access(access_folder(library)).tokens()]
