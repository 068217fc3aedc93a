"""The page in a real browser, before the real daemon and the simulated scanner."""

from __future__ import annotations

import json
import math
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, WebSocket

from foveascan import started
from node.journal import Journals
from protocol.grid import GridSpec
from protocol.scanner_messages import DeviceInfo, RangeColumn, SweepHeader
from tests.client.viewer.browser import (
    WAIT_MS,
    barriers,
    blank,
    click,
    crop,
    layout_faults,
    opened,
    point_at,
    psnr,
    show,
    wait_drawn,
    wait_updates,
)
from tests.system.line import RunningNode, run_line

FAST = ("--link-rate", "20000000")
# On a busy machine a sweep may be over before anybody has looked.
NOTE_SHOWN = """(bar) => new MutationObserver(() => {
  if (!bar.hidden) document.documentElement.dataset.shown = 'yes';
}).observe(bar, { attributes: true })"""


CAMERA = "() => new URLSearchParams(location.hash.slice(1)).get('camera')"
# On a busy machine all takes longer than half a second: here a press may last, and is a click or a drag as it ends.
PATIENT = """() => {
  const wait = setTimeout;
  window.setTimeout = (work, ms, ...more) => wait(work, ms === 500 ? 1e9 : ms, ...more);
}"""
# In which order the page asks, and hears that the pointer was let go.
NOTE_PRESSES = """() => {
  const [noted, post] = [(window.noted = []), Worker.prototype.postMessage];
  addEventListener('pointerup', () => noted.push('let go'), true);
  Worker.prototype.postMessage = function (message, ...more) {
    if (message.kind === 'look') noted.push('look');
    return post.call(this, message, ...more);
  };
}"""


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    """A node with the generated head at M."""
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:  # playwright keeps this thread's event loop
        yield aside.submit(run_line, stack, tmp_path_factory.mktemp("page"), "--size", "M", *FAST).result()


def test_a_click_sharpens_what_it_is_at(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        click_at = (0.5, 0.42)
        coarse = crop(page, *click_at, 90)
        click(page, *click_at)
        wait_updates(page, 1)
        sharp = crop(page, *click_at, 90)
        exactly(page)
        click(page, *click_at)
        wait_updates(page, 2)
        full = crop(page, *click_at, 90)
    assert psnr(sharp, full) >= 32
    assert psnr(sharp, full) >= psnr(coarse, full) + 6


def test_a_press_asks_for_what_its_click_shows(browser: Browser, node: RunningNode) -> None:
    with blank(browser) as (page, problems):
        said = conversation(page)
        show(page, node.url)
        page.evaluate(PATIENT)
        page.evaluate(NOTE_PRESSES)
        click(page, 0.5, 0.42)
        wait_updates(page, 1)
        page.wait_for_url("**fovea=**")
        assert page.evaluate("window.noted") == ["look", "let go"]
        assert [kind for kind in said if kind in ("look", "cancel")] == ["look"] and problems == []


def test_a_hand_that_shakes_moves_no_camera(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        page.wait_for_url("**camera=**")
        camera = page.evaluate(CAMERA)
        point_at(page, 0.5, 0.42)
        page.mouse.down()
        point_at(page, 0.505, 0.42)
        page.mouse.up()
        wait_updates(page, 1)
        page.wait_for_url("**fovea=**")
        assert page.evaluate(CAMERA) == camera
        page.mouse.down()
        point_at(page, 0.53, 0.42)
        page.mouse.up()
        page.wait_for_function(f"(camera) => camera !== ({CAMERA})()", arg=camera)


def test_a_press_that_becomes_a_drag_is_no_look(browser: Browser, node: RunningNode) -> None:
    """What it has brought is held and seen; what it has not is called off."""
    with blank(browser) as (page, problems):
        said = conversation(page)
        show(page, node.url)
        page.evaluate(PATIENT)
        before = crop(page, 0.5, 0.42, 90)
        point_at(page, 0.5, 0.42)
        page.mouse.down()
        until(page, lambda: said.count("ack") == 2)
        wait_drawn(page)
        assert psnr(crop(page, 0.5, 0.42, 90), before) < 30, "it is not seen"
        point_at(page, 0.6, 0.42)
        page.mouse.up()
        os.kill(node.process.pid, signal.SIGSTOP)
        try:
            point_at(page, 0.5, 0.6)
            page.mouse.down()
            point_at(page, 0.45, 0.6)
            page.mouse.up()
            until(page, lambda: said.count("cancel") == 1)
        finally:
            os.kill(node.process.pid, signal.SIGCONT)
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        page.wait_for_url("**fovea=**")
        assert page.url.count("fovea=") == 1
        assert said.count("look") == 3 and not {"state", "resync"} & {*said}, "both ends disagree"
        assert problems == []


def test_a_look_draws_its_part_of_the_picture_as_if_all_were_drawn(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        surface = page.get_by_label("Surface")
        surface.evaluate("(one) => (one.closest('details').open = true)")
        surface.select_option("relief")
        surface.select_option("lit")
        page.wait_for_selector('#view[data-ready="true"]')
        wait_drawn(page)
        whole = page.locator("#view").get_attribute("data-triangles")
        for number, place in enumerate(((0.5, 0.4), (0.44, 0.55)), 1):
            click(page, *place)
            wait_updates(page, number)
        assert int(page.locator("#view").get_attribute("data-triangles") or 0) < int(whole or 0)
        parts = crop(page, 0.5, 0.5, 500)
        surface.select_option("relief")
        surface.select_option("lit")
        wait_drawn(page)
        assert np.abs(parts - crop(page, 0.5, 0.5, 500)).max() <= 2


def test_the_spacing_held_is_laid_over_the_surface_and_taken_off(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        overlay = page.get_by_label("Overlay")
        overlay.evaluate("(one) => (one.closest('details').open = true)")
        wait_drawn(page)
        plain = crop(page, 0.5, 0.5, 200)
        overlay.select_option("texture")
        until(page, lambda: psnr(crop(page, 0.5, 0.5, 200), plain) < 25)
        overlay.select_option("none")
        until(page, lambda: psnr(crop(page, 0.5, 0.5, 200), plain) > 45)


def test_nothing_is_seen_through_a_surface_come_near(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        page.locator("#view").focus()
        for key in (*"+++++", "Enter", "-", "-", "ArrowUp", "+", "+", "+"):
            page.keyboard.press(key)
            wait_drawn(page)
        page.get_by_label("Surface").evaluate("(one) => (one.closest('details').open = true)")
        page.get_by_label("Surface").select_option("relief")
        wait_updates(page, 1)
        assert crop(page, 0.5, 0.5, 260).min(axis=2).min() > 25, "the dark inside of the object shows"


def test_distances_are_true_within_one_percent(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        page.get_by_label("measures").check()
        click(page, 0.46, 0.5)
        click(page, 0.55, 0.45)
        output = page.locator("output.distance")
        shown_mm = float((output.locator("strong").text_content() or "").removesuffix(" mm"))
        places = [tuple(map(float, place.split(","))) for place in (output.get_attribute("data-places") or "").split()]
    assert shown_mm == pytest.approx(math.dist(*(point(node, *place) for place in places)), rel=0.01)
    assert shown_mm > 20


def test_the_address_reproduces_the_view(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        page.locator("#view").focus()
        for key in ("ArrowRight", "ArrowRight", "ArrowUp", "+", "+"):
            page.keyboard.press(key)
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        page.wait_for_url("**fovea=**")
        wait_drawn(page)
        address, before = page.url, crop(page, 0.5, 0.5, 300)
    with opened(browser, address) as page:
        wait_updates(page, 1)
        assert psnr(crop(page, 0.5, 0.5, 300), before) > 45


def test_a_lost_graphics_context_comes_back_as_it_was(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url, allowed="Context") as page:
        click(page, 0.5, 0.45)
        wait_updates(page, 1)
        page.mouse.move(2, 2)
        before = crop(page, 0.5, 0.45, 200)
        page.evaluate("() => (window.lose = document.querySelector('#view').getContext('webgl2')"
                      ".getExtension('WEBGL_lose_context')).loseContext()")  # fmt: skip
        wait_drawn(page)
        page.evaluate("() => window.lose.restoreContext()")
        page.wait_for_selector("html[data-restored]", state="attached")
        wait_drawn(page)
        assert psnr(crop(page, 0.5, 0.45, 200), before) > 40


def test_pins_stay_with_the_scan(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        page.get_by_label("sets a pin").check()
        click(page, 0.5, 0.5)
        with page.expect_response(lambda answer: answer.request.method == "PATCH") as answered:
            page.get_by_label("Label of the new pin").fill("mole <b>3</b>")
            page.keyboard.press("Enter")
        assert answered.value.ok
    with opened(browser, node.url) as page:
        pin = page.get_by_role("button", name="Show pin mole <b>3</b>")
        page.locator("summary:has-text('Pins')").click()
        assert pin.is_visible()
        with page.expect_response(lambda answer: answer.request.method == "PATCH"):
            page.get_by_role("button", name="Remove pin mole <b>3</b>").click()
        pin.wait_for(state="detached")


def test_a_scan_is_renamed_and_deleted_after_being_asked(browser: Browser, tmp_path: Path) -> None:
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:
        line = aside.submit(run_line, stack, tmp_path, "--specimen", "cylinder", *FAST).result()
        with opened(browser, line.url) as page:
            page.locator("summary:has-text('This scan')").click()
            page.get_by_role("textbox", name="Name").fill("back, left")
            page.get_by_role("textbox", name="Subject code").fill("P-17")
            page.get_by_label("sets a pin").check()
            click(page, 0.5, 0.5)
            with page.expect_response(lambda answer: answer.request.method == "PATCH"):
                page.get_by_label("Label of the new pin").fill("mole")
                page.keyboard.press("Enter")
            page.get_by_role("button", name="Show pin mole").wait_for(state="attached")
            assert page.get_by_role("textbox", name="Subject code").input_value() == "P-17", "typed, not yet saved"
            page.get_by_role("button", name="Save").click()
            page.get_by_role("button", name="back, left P-17").wait_for()
            assert page.request.get(f"{line.url}/v1/scans").json()[0]["subject"] == "P-17", "what a list shows"
            page.get_by_role("button", name="Delete the scan").click()
            page.get_by_role("button", name="Keep it").click()
            assert page.get_by_role("button", name="back, left").is_visible()
            page.get_by_role("button", name="Delete the scan").click()
            page.get_by_text("Delete the scan “back, left · ").wait_for()
            here = page.evaluate("location.hash")
            page.evaluate("location.hash = `scan=${'0'.repeat(32)}`")
            page.get_by_text("not there any more").wait_for()
            assert not page.locator("dialog[open]").count(), "who goes elsewhere is asked nothing about the scan there"
            page.evaluate("(hash) => { location.hash = hash; }", here)
            page.get_by_role("button", name="Delete the scan").click()
            page.get_by_role("button", name="Delete it").click()
            page.get_by_text("None yet.").wait_for()
            page.get_by_text("No scan yet.").wait_for()


def test_detail_follows_the_pointer(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        page.get_by_label("Follow my pointer").check()
        box = page.locator("#view").bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + 0.48 * box["width"], box["y"] + 0.5 * box["height"])
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
        page.wait_for_selector('html[data-updates][data-looking="no"]', state="attached")  # of one look or of both


def test_what_is_long_in_coming_is_shown_where_it_will_be(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        os.kill(node.process.pid, signal.SIGSTOP)
        try:
            click(page, 0.5, 0.5)
            page.wait_for_selector(".busy:not([hidden])", state="attached")
        finally:
            os.kill(node.process.pid, signal.SIGCONT)
        wait_updates(page, 1)
        assert page.locator(".busy").get_attribute("hidden") is not None


def test_what_is_coming_can_be_stopped(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        before = received(page)
        exactly(page)
        page.get_by_label("Area round the click").select_option("1")
        page.locator("#view").focus()
        page.keyboard.press("Enter")
        page.keyboard.press("Escape")
        page.wait_for_selector('html[data-looking="no"]', state="attached")
        assert page.evaluate("document.documentElement.dataset.updates") is None
        page.get_by_label("Quality", exact=True).select_option("preview")
        page.get_by_label("Area round the click").select_option("0.02")
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        assert received(page) - before < 500_000, "all of it came"


def test_downloads_are_whole_files(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        page.locator("summary:has-text('This scan')").click()
        with page.expect_download() as download:
            page.get_by_role("link", name="GLB").click()
        assert Path(download.value.path()).read_bytes()[:4] == b"glTF"


def test_a_sweep_appears_as_it_runs_and_a_cut_line_is_taken_up_again(browser: Browser, tmp_path: Path) -> None:
    with ExitStack() as stack:
        scanner = ["simulate", "--path", str(tmp_path / "scanner"), "--json"]
        _, ready = stack.enter_context(started(*scanner))
        serve = ["serve", "--scanner", ready["path"], "--library", str(tmp_path / "library"), "--insecure", "--json"]
        listen = f"127.0.0.1:{free_port()}"
        first = ExitStack()
        process, at = first.enter_context(started(*serve, "--listen", listen))
        page, problems = stack.enter_context(blank(browser))
        with first:
            page.goto(at["url"])
            watch_a_sweep(page)
            click(page, 0.5, 0.5)
            wait_updates(page, 1)
            picture = crop(page, 0.5, 0.45, 200)
            assert problems == []
            process.kill()
            page.wait_for_selector('html[data-link="lost"]', state="attached")
            assert "No connection" in (page.locator("#link").text_content() or "")
        spent = received(page)
        stack.enter_context(started(*serve, "--listen", listen))
        page.wait_for_selector('html[data-link="ready"]', state="attached")
        page.mouse.move(2, 2)
        assert psnr(crop(page, 0.5, 0.45, 200), picture) > 40
        assert received(page) - spent < 1500, "something was sent twice"
        click(page, 0.5, 0.5)
        wait_updates(page, 2)


def test_a_sweep_of_somebody_else_is_offered_and_takes_no_picture_away(browser: Browser, tmp_path: Path) -> None:
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:
        line = aside.submit(run_line, stack, tmp_path).result()
        with opened(browser, line.url) as page:
            before = crop(page, 0.5, 0.45, 200)
            assert page.request.post(f"{line.url}/v1/sweeps").ok
            page.get_by_role("button", name="Watch the sweep").wait_for()
            assert psnr(crop(page, 0.5, 0.45, 200), before) > 40
            page.get_by_role("button", name="Watch the sweep").click()
            page.wait_for_selector('html[data-live="yes"]', state="attached")
            page.wait_for_selector('html[data-live="no"]', state="attached")


def keep_cut_sweeps(folder: Path) -> None:
    """Two sweeps of a scanner that is not there, a sixth of the one and a third of the other."""
    header = SweepHeader(7, GridSpec(8, 6, 16, 6, step_mm=0.05, pitch_mm=1.0), 3200, range_rows=6, texture_rows=6)
    journals = Journals(folder / "sweeps")
    for count in (4, 8):
        journal = journals.begin(DeviceInfo("ELSEWHERE", 1, 3200, 10), header, 1e9 + count)
        for column in range(count):
            journal.add(RangeColumn(7, 0, column, 0, 400 * column, 1, bytes(12)))
        journals.keep(journal, "somebody fell over the plug")


def test_a_cut_sweep_is_told_with_what_can_become_of_it(browser: Browser, tmp_path: Path) -> None:
    keep_cut_sweeps(tmp_path / "library")
    with ExitStack() as stack:
        _, ready = stack.enter_context(started("simulate", "--path", str(tmp_path / "scanner"), "--json"))
        serve = ["serve", "--scanner", ready["path"], "--library", str(tmp_path / "library"), "--insecure", "--json"]
        _, at = stack.enter_context(started(*serve, "--listen", "127.0.0.1:0"))
        page, problems = stack.enter_context(blank(browser))
        page.goto(at["url"])
        cut = page.get_by_role("list", name="Sweeps that were cut").get_by_role("listitem")
        cut.nth(1).wait_for()
        third, sixth = (cut.nth(number).text_content() or "" for number in (0, 1))
        assert third.startswith("33 % kept, ") and sixth.startswith("16 % kept, ")
        assert "somebody fell over the plug" in third
        for width in (1000, 360):
            page.set_viewport_size({"width": width, "height": 700})
            assert barriers(page) == [] and layout_faults(page) == []
        page.set_viewport_size({"width": 1000, "height": 700})
        page.get_by_role("button", name="Go on with the sweep: 33 % kept").click(timeout=20_000)
        why = "it was begun by scanner ELSEWHERE, this is SIM-0001"
        page.locator("#notice").get_by_text(f"There is no scan of it: sweep interrupted: {why}").wait_for()
        page.get_by_text(f"Ready. Last trouble: sweep interrupted: {why}").wait_for()
        page.get_by_role("button", name="Delete the sweep: 16 % kept").click()
        page.get_by_role("button", name="Keep it").click()
        assert cut.count() == 2
        page.get_by_role("button", name="Delete the sweep: 16 % kept").click()
        page.get_by_role("button", name="Delete it").click()
        page.locator("#notice").get_by_text("The sweep is deleted.").wait_for()
        cut.nth(1).wait_for(state="detached")
        assert (cut.text_content() or "").startswith("33 % kept") and problems == []


def watch_a_sweep(page: Page) -> None:
    """Start one by its button; see it appear, and become a scan."""
    page.get_by_label("Progress of the sweep").evaluate(NOTE_SHOWN)
    page.get_by_role("button", name="Start a sweep").click(timeout=20_000)
    page.wait_for_selector('html[data-live="yes"]', state="attached")
    empty = crop(page, 0.5, 0.45, 200)
    page.wait_for_selector("html[data-shown]", state="attached")
    page.wait_for_selector('html[data-live="no"][data-scan]', state="attached")
    wait_drawn(page)
    assert psnr(crop(page, 0.5, 0.45, 200), empty) < 25


def conversation(page: Page) -> list[str]:
    """The types of all messages that a page and its node will exchange as text, as they do."""
    said = list[str]()

    def note(frame: str | bytes) -> None:
        if isinstance(frame, str):
            said.append(json.loads(frame)["type"])

    def hear(socket: WebSocket) -> None:
        socket.on("framesent", note)
        socket.on("framereceived", note)

    page.on("websocket", hear)
    return said


def until(page: Page, is_so: Callable[[], bool]) -> None:
    """Wait for what the page does."""
    end_s = time.monotonic() + WAIT_MS / 1000
    while not is_so():
        assert time.monotonic() < end_s
        page.wait_for_timeout(20)


def exactly(page: Page) -> None:
    """Ask the next click for all that the scan has, in an area larger than any crop here."""
    page.get_by_label("Quality", exact=True).select_option("exact")
    page.get_by_label("Area round the click").select_option("0.15")


def received(page: Page) -> int:
    """Bytes that the page says it has received."""
    amount, unit = (page.locator("#received").text_content() or "").split()
    return int(float(amount) * {"B": 1, "KB": 1e3, "MB": 1e6}[unit])


def point(node: RunningNode, u: float, v: float) -> tuple[float, float, float]:
    """Where the truth says that a place is. [mm]"""
    with np.load(node.folder / "truth.npz") as truth:
        steps, step_mm, bottom_mm, top_mm = (truth[key] for key in ("depth_u16", "scale_mm", "z_min_mm", "z_max_mm"))
    height, width = steps.shape
    radius_mm, angle = float(steps[int(v * height), int(u * width)] * step_mm), 2 * math.pi * u
    return radius_mm * math.cos(angle), radius_mm * math.sin(angle), float(v * (bottom_mm - top_mm))


def free_port() -> int:
    """A port nobody listens at just now."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port
