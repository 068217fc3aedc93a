"""Whoever looks at the page, with whatever: fingers, keys alone, large letters, a narrow screen."""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest
from playwright.sync_api import Browser, Page, Route, expect

from tests.client.viewer.browser import barriers, crop, layout_faults, opened, psnr, wait_drawn, wait_updates
from tests.system.line import RunningNode, run_line

# What has the focus, and whether it looks otherwise than without; null at the end of the page.
FOCUSED = """() => {
  const one = document.activeElement;
  if (one === document.body) return null;
  const looks = () => {
    const style = getComputedStyle(one);
    return [style.outlineStyle === 'none' ? '' : style.outline, style.boxShadow, style.borderColor].join();
  };
  const focused = looks();
  one.blur();
  const shows = looks() !== focused;
  one.focus();
  return { name: `${one.tagName} ${one.innerText || one.ariaLabel || one.id}`.trim(), shows };
}"""


@pytest.fixture(scope="module")
def node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    """A node with a small head: what is tested here does not depend on its size."""
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:  # playwright keeps this thread's event loop
        yield aside.submit(run_line, stack, tmp_path_factory.mktemp("reach")).result()


def test_a_tap_sharpens_and_two_fingers_zoom_and_move(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url, has_touch=True, viewport={"width": 400, "height": 800}) as page:
        box = page.locator("#view").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        page.touchscreen.tap(x, y)
        wait_updates(page, 1)
        touch = page.context.new_cdp_session(page)

        def fingers(kind: str, *places: tuple[float, float]) -> None:
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": [{"x": a, "y": b} for a, b in places]})

        def gesture(*steps: list[tuple[float, float]]) -> list[float]:
            """The camera afterwards: azimuth, elevation, distance, target."""
            fingers("touchStart", *steps[0])
            for step in steps[1:]:
                fingers("touchMove", *step)
                wait_drawn(page)
            fingers("touchEnd")
            return settled_camera(page)

        start = settled_camera(page)
        turned = gesture([(x, y)], [(x + 30, y)], [(x + 60, y)])
        assert abs(turned[0] - start[0]) > 0.1
        nearer = gesture([(x - 20, y), (x + 20, y)], [(x - 40, y), (x + 40, y)], [(x - 60, y), (x + 60, y)])
        assert nearer[2] < 0.7 * turned[2]
        moved = gesture(*([(x - 20, y + down), (x + 20, y + down)] for down in (0, 30, 60)))
        assert abs(moved[4] - nearer[4]) > 5
        assert page.evaluate("document.documentElement.dataset.updates") == "1", "a gesture is no tap"


def test_everything_can_be_done_by_keyboard(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        before = crop(page, 0.5, 0.5, 300)
        tab_to(page, "#view")
        page.keyboard.press("ArrowLeft")
        page.keyboard.press("Enter")
        wait_updates(page, 1)
        assert psnr(crop(page, 0.5, 0.5, 300), before) < 35
        page.keyboard.press("Home")
        tab_to(page, "button:has-text('Sharpen the middle')")
        page.keyboard.press("Enter")
        wait_updates(page, 2)
        tab_to(page, "summary:has-text('Display')")
        page.keyboard.press("Enter")
        assert page.get_by_label("Overlay").is_visible()
        page.get_by_role("radio", name="sharpens").focus()
        for _ in ("measures", "traces a path", "sets a pin"):
            page.keyboard.press("ArrowRight")
        page.locator("#view").focus()
        page.keyboard.press("Enter")
        expect(page.get_by_label("Label of the new pin")).to_be_focused()
        page.keyboard.type("mole")
        page.keyboard.press("Enter")
        page.get_by_role("button", name="Show pin mole").wait_for()
        expect(page.locator("#view")).to_be_focused()


def test_what_has_the_focus_shows_it(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        unfold(page)
        met, unseen = 0, list[str]()
        for _ in range(80):
            page.keyboard.press("Tab")
            looks = page.evaluate(FOCUSED)
            if looks is None:
                break
            met, unseen = met + 1, unseen + [looks["name"]] * (not looks["shows"])
        assert met > 30 and unseen == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [1000, 360])
def test_axe_finds_nothing(browser: Browser, node: RunningNode, scheme: str, width: int) -> None:
    with opened(browser, node.url, color_scheme=scheme, viewport={"width": width, "height": 800}) as page:
        unfold(page)
        assert barriers(page) == []


@pytest.mark.parametrize(
    ("width", "height", "letters"),
    [(1280, 800, "100%"), (640, 400, "100%"), (1280, 800, "200%"), (360, 740, "100%"), (360, 740, "200%")],
    ids=["desk", "desk at 200%", "letters at 200%", "phone", "phone, letters at 200%"],
)
def test_nothing_is_cut_and_nothing_lies_on_anything(
    browser: Browser, node: RunningNode, width: int, height: int, letters: str
) -> None:
    with opened(browser, node.url, viewport={"width": width, "height": height}) as page:
        page.evaluate("(size) => { document.documentElement.style.fontSize = size; }", letters)
        unfold(page)
        wait_drawn(page)
        assert layout_faults(page) == []
        for name in ("Sharpen the middle", "Copy a link"):
            button = page.get_by_role("button", name=name)
            button.scroll_into_view_if_needed()
            button.click(trial=True)


def test_what_moves_by_itself_stands_still_where_that_is_asked_for(browser: Browser, node: RunningNode) -> None:
    for motion, turns in (("reduce", "none"), ("no-preference", "turn")):
        with opened(browser, node.url, reduced_motion=motion) as page:
            busy = page.locator(".busy")
            assert busy.evaluate("(mark) => getComputedStyle(mark, '::before').animationName") == turns
            before = dragged(page)
            if motion == "reduce":
                settled_camera(page)
                assert drawn(page) - before <= 1, "the picture glides on"
            else:
                page.wait_for_function(f"() => Number(document.querySelector('#view').dataset.drawn) > {before + 1}")


def test_what_a_sweep_is_worth_is_said(browser: Browser, node: RunningNode) -> None:
    with opened(browser, node.url) as page:
        panel = page.locator("details", has=page.locator("summary", has_text="What it is worth"))
        panel.locator("summary").click()
        measured = panel.locator("dt", has_text="Measured").locator("+ dd").text_content() or ""
        truth = page.request.get(f"{node.url}/v1/scans/latest").json()["quality"]
        assert measured == f"{100 * truth['coverage']:.1f} % of all points"
        assert panel.get_by_text("Nothing speaks against this scan.").is_visible() == (not truth.get("complaints"))
        assert panel.locator("dt", has_text="Noise").locator("+ dd").text_content() == "unknown: nothing was seen twice"
        axis = panel.locator("dt", has_text="axis").locator("+ dd")
        assert axis.text_content() == "taken as the scanner has it"

        def corrected(route: Route) -> None:
            said = route.fetch().json()
            said["quality"]["axis"] = {"lateralMm": 0.8, "radialMm": -0.5}
            route.fulfill(json=said)

        page.route(re.compile("/v1/scans/[0-9a-f]{32}$"), corrected)
        page.reload()
        expect(axis).to_have_text("corrected by 0.80 mm sideways, -0.50 mm in range")
        page.unroute_all(behavior="wait")  # the list's small picture asks, too


def dragged(page: Page) -> int:
    """Turn the picture a little and let go. Returns how many were drawn by then; one at rest may follow."""
    box = page.locator("#view").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 200, box["y"] + 200)
    page.mouse.down()
    page.mouse.move(box["x"] + 260, box["y"] + 200, steps=4)
    wait_drawn(page)
    before = drawn(page)
    page.mouse.up()
    return before


def drawn(page: Page) -> int:
    count: int = page.evaluate("() => Number(document.querySelector('#view').dataset.drawn)")
    return count


def unfold(page: Page) -> None:
    """Open all panels, and lay what can be laid over the picture."""
    page.locator("aside details").evaluate_all("(all) => all.forEach((one) => (one.open = true))")
    page.get_by_label("Overlay").select_option("range")


def settled_camera(page: Page) -> list[float]:
    """The camera as the address has it once it has come to rest: azimuth, elevation, distance, target."""
    # The page waits twice itself, for rest and before it writes; timers that begin after its own end after them.
    told = page.evaluate("""async () => {
      for (const ms of [300, 300]) await new Promise((over) => setTimeout(over, ms));
      return new URLSearchParams(location.hash.slice(1)).get('camera');
    }""")
    return [float(number) for number in told.split(",")]


def tab_to(page: Page, selector: str) -> None:
    """Press Tab until something has the focus."""
    for _ in range(60):
        if page.locator(selector).evaluate("(element) => element === document.activeElement"):
            return
        page.keyboard.press("Tab")
    raise AssertionError(f"{selector} cannot be reached by Tab")
