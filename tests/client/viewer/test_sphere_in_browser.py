"""Closed objects in the page: clicked like any other, and no pole or seam to be seen."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest
import trimesh
from playwright.sync_api import Browser, Page, WebSocket

from client.model import Model
from foveascan import started
from protocol.messages import Ack, Opened, decode_message
from protocol.refinement import Refinement
from tests.client.viewer.browser import blank, click, crop, opened, psnr, wait_drawn, wait_updates
from tests.client.viewer.closed_objects import CENTRE_MM, SIZE, STANDING, STEP_MM, TIPPED, bring, grid_of

ABOVE = math.pi / 2 - 1e-4
# An address is typed, and just then the page puts the view into it that it shows still.
WRITTEN_OVER = "typed => { const was = location.href; location.assign(typed); history.replaceState(null, '', was); }"


@dataclass(frozen=True)
class Objects:
    """A node with the object standing and tipped over."""

    url: str
    standing: str
    tipped: str

    def seen(self, scan: str, elevation: float, distance: float = 200.0) -> str:
        """The address of a view from where theta_h is 0, and from so far up."""
        return f"{self.url}/#scan={scan}&camera=0,{elevation},{distance},0,{CENTRE_MM},0"


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Objects]:
    folder = str(tmp_path_factory.mktemp("closed"))
    serve = ["serve", "--library", folder, "--listen", "127.0.0.1:0", "--insecure", "--json"]
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:  # playwright keeps this thread's event loop
        _, ready = stack.enter_context(started(*serve))
        scans = [aside.submit(bring, ready["url"], turn).result() for turn in (STANDING, TIPPED)]
        yield Objects(ready["url"], *scans)


def test_clicks_all_over_leave_page_client_and_node_agreed(browser: Browser, objects: Objects) -> None:
    spoken: list[str | bytes] = []
    with blank(browser) as (page, problems):
        page.on("websocket", lambda socket: overhear(socket, spoken))
        page.goto(f"{objects.url}/#scan={objects.standing}")
        page.wait_for_selector("html[data-scan]", state="attached")
        page.locator("#view").focus()
        for number, keys in enumerate((["ArrowUp"] * 12, ["ArrowDown"] * 3, ["ArrowDown"] * 21, ["ArrowUp"] * 10), 1):
            for key in (*keys, "ArrowRight", "Enter"):
                page.keyboard.press(key)
            wait_updates(page, number)
    assert problems == []
    asked = [json.loads(said) for said in spoken if isinstance(said, str)]
    heights = [message["v"] for message in asked if message["type"] == "look"]
    assert [min(v, 1 - v) < 0.05 for v in heights] == [True, False, True, False]
    assert not [message for message in asked if message["type"] in ("resync", "state")], "the node held otherwise"
    held_in_python(spoken)


def overhear(socket: WebSocket, spoken: list[str | bytes]) -> None:
    """Note what both sides say."""
    for event in ("framesent", "framereceived"):
        socket.on(event, lambda said: spoken.append(said))


def held_in_python(spoken: list[str | bytes]) -> None:
    """Give the Python client's model what the page was given; at each acknowledgement both must hold the same."""
    model, applied, acknowledged = None, 0, 0
    for said in spoken:
        if isinstance(said, bytes):
            assert model is not None
            model.apply(Refinement.from_bytes(said))
            applied += 1
            continue
        message = decode_message(said)
        if isinstance(message, Opened):
            model = Model(message.scan)
        elif isinstance(message, Ack):
            assert model is not None and message.next_seq == applied
            assert message.digest == model.digest()
            acknowledged += 1
    assert acknowledged == 5, "of the first view and of each look"


@pytest.mark.parametrize("surface", ["flat", "relief"])
def test_a_pole_looks_as_the_same_place_does_elsewhere(browser: Browser, objects: Objects, surface: str) -> None:
    pictures = []
    for scan, elevation in ((objects.standing, 0.0), (objects.tipped, ABOVE)):
        with opened(browser, objects.seen(scan, elevation)) as page:
            shade(page, surface)
            before = crop(page, 0.5, 0.5, 300)
            click(page, 0.5, 0.5)
            wait_updates(page, 1)
            page.mouse.move(2, 2)
            wait_drawn(page)
            pictures.append([picture - picture.mean() for picture in (before, crop(page, 0.5, 0.5, 150))])
    (coarse, fine), (coarse_pole, fine_pole) = pictures  # less their mean, as the light from the sky differs
    assert psnr(coarse, coarse_pole) >= 30
    assert psnr(fine, fine_pole) >= 34


def test_distances_over_a_pole_are_true(browser: Browser, objects: Objects) -> None:
    with opened(browser, objects.seen(objects.standing, ABOVE)) as page:
        exactly(page)
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        page.get_by_label("measures").check()
        click(page, 0.45, 0.52)
        click(page, 0.55, 0.47)
        output = page.locator("output.distance")
        shown_mm = float((output.locator("strong").text_content() or "").removesuffix(" mm"))
        places = [tuple(map(float, place.split(","))) for place in (output.get_attribute("data-places") or "").split()]
    assert all(v < 0.1 for _, v in places) and abs(places[0][0] - places[1][0]) > 0.25
    assert shown_mm == pytest.approx(math.dist(*(point(*place) for place in places)), rel=0.01)
    assert shown_mm > 8


def test_a_pin_on_the_crown_is_shown_from_above(browser: Browser, objects: Objects) -> None:
    with opened(browser, objects.seen(objects.tipped, ABOVE)) as page:
        page.get_by_label("sets a pin").check()
        click(page, 0.5, 0.5)
        with page.expect_response(lambda answer: answer.request.method == "PATCH") as answered:
            page.get_by_label("Label of the new pin").fill("crown")
            page.keyboard.press("Enter")
        assert answered.value.ok
        page.locator("#view").focus()
        page.keyboard.press("Home")
        page.get_by_role("button", name="Show pin crown").click()
        page.wait_for_url("**%2C1.5000%2C**")


def test_an_exported_sphere_is_closed(browser: Browser, objects: Objects) -> None:
    with opened(browser, objects.seen(objects.standing, 0.0)) as page:
        page.locator("summary:has-text('This scan')").click()
        with page.expect_download() as download:
            page.get_by_role("link", name="STL").click()
        mesh = trimesh.load_mesh(Path(download.value.path()), file_type="stl")
    assert mesh.is_watertight and mesh.volume > 0


def test_an_address_typed_anew_shows_the_same_scan_from_there(browser: Browser, objects: Objects) -> None:
    with opened(browser, objects.seen(objects.standing, 0.0)) as page:
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        front = crop(page, 0.5, 0.5, 300)
        page.goto(objects.seen(objects.standing, ABOVE))
        page.wait_for_function("document.documentElement.dataset.looking === 'no'")
        page.wait_for_url("**%2C1.5707%2C**")
        wait_drawn(page)
        assert psnr(crop(page, 0.5, 0.5, 300), front) < 25
        click(page, 0.5, 0.5)
        wait_updates(page, 2)
        page.evaluate(WRITTEN_OVER, objects.seen(objects.standing, 0.5))
        page.wait_for_url("**%2C0.5000%2C**")


def exactly(page: Page) -> None:
    """Ask the next click for every sample."""
    page.get_by_label("Quality", exact=True).select_option("exact")


def shade(page: Page, surface: str) -> None:
    """Choose how the surface is drawn."""
    page.get_by_label("Surface").evaluate("(one) => (one.closest('details').open = true)")
    page.get_by_label("Surface").select_option(surface)
    wait_drawn(page)


def point(u: float, v: float) -> tuple[float, float, float]:
    """Where the truth says that a place is. [mm]"""
    steps = grid_of(STANDING).range_steps
    radius_mm = float(steps[int(v * SIZE[1]), int(u * SIZE[0])]) * STEP_MM
    polar, angle = math.pi * v, 2 * math.pi * u
    level_mm = radius_mm * math.sin(polar)
    return level_mm * math.cos(angle), level_mm * math.sin(angle), CENTRE_MM + radius_mm * math.cos(polar)
