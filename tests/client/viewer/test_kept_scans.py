"""What the page does with kept scans of any geometry and size: measures, marks, downloads and compares them."""

from __future__ import annotations

import math
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from playwright.sync_api import Browser, Page, expect

from foveascan import started
from node.library import About, Library
from protocol.grid import FloatArray, Grid, IntArray
from simulators.specimen import GENERATORS
from tests.client.viewer.browser import (
    WAIT_MS,
    Picture,
    barriers,
    blank,
    click,
    crop,
    layout_faults,
    opened,
    psnr,
    wait_drawn,
    wait_updates,
)
from tests.client.viewer.closed_objects import STANDING, grid_of
from tests.client.viewer.tape import shortest_mm

SHAPES = {"cylinder": (360, 100, 1024, 256), "head": (480, 336, 1024, 512)}
TURNED = 40  # columns that a later head stands turned by
FITTING, WIDE = (1024, 64, 8192, 256), (1024, 64, 16384, 256)
# A graphics card that takes no texture of more than 256 a side, and none is given to it.
SMALL_CARD = """{
  const card = WebGL2RenderingContext.prototype;
  const { getParameter, texStorage2D, MAX_TEXTURE_SIZE } = card;
  card.getParameter = function (what) {
    return what === MAX_TEXTURE_SIZE ? 256 : getParameter.call(this, what);
  };
  card.texStorage2D = function (target, levels, format, width, height) {
    if (Math.max(width, height) > 256) console.error(`a texture of ${width} x ${height}`);
    return texStorage2D.call(this, target, levels, format, width, height);
  };
}"""


@dataclass(frozen=True)
class Kept:
    """A node with generated scans, and what they are."""

    url: str
    ids: dict[str, str]
    grids: dict[str, Grid]

    def at(self, name: str, camera: str = "") -> str:
        """The address of a scan, from where a camera stands."""
        return f"{self.url}/#scan={self.ids[name]}{camera and f'&camera={camera}'}"


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Kept]:
    folder = tmp_path_factory.mktemp("kept")
    grids = {name: GENERATORS[name](shape, 1) for name, shape in SHAPES.items()}
    grids |= {name: GENERATORS["cylinder"](shape, 1) for name, shape in (("fitting", FITTING), ("wide", WIDE))}
    grids["lumpy"] = grid_of(STANDING)
    grids["later"] = later(grids["head"])
    grids |= {name: GENERATORS["cylinder"](SHAPES["cylinder"], seed) for name, seed in (("brief", 2), ("passing", 3))}
    with ExitStack() as stack, ThreadPoolExecutor(1) as aside:  # playwright keeps this thread's event loop
        ids = aside.submit(keep, folder, grids).result()
        serve = ["serve", "--library", str(folder), "--listen", "127.0.0.1:0", "--insecure", "--json"]
        _, ready = stack.enter_context(started(*serve))
        yield Kept(ready["url"], ids, grids)


def later(grid: Grid) -> Grid:
    """The same object in another light, turned on the table."""
    texel = TURNED * grid.spec.texture_width // grid.spec.width
    texture = np.roll(grid.texture, texel, axis=1) // 4 * 3
    return Grid(grid.spec, np.roll(grid.range_steps, TURNED, axis=1), texture)


def keep(folder: Path, grids: dict[str, Grid]) -> dict[str, str]:
    """Put scans into a library. Their ids."""
    library = Library(folder)
    ids = {name: library.add(grid, About(1.8e9, name=name)).id for name, grid in grids.items()}
    library.close()
    return ids


def test_a_path_is_as_long_as_it_is_on_the_surface(browser: Browser, kept: Kept) -> None:
    """On a cylinder the shortest way is a helix."""
    with opened(browser, kept.at("cylinder")) as page:
        page.get_by_label("traces a path").check()
        for place in ((0.42, 0.3), (0.55, 0.45), (0.48, 0.7)):
            click(page, *place)
        places = measured_places(page)
        assert length_mm(page, "Along the surface") == pytest.approx(sum(map(helix_mm, places, places[1:])), rel=0.01)
        page.locator("#view").focus()
        page.keyboard.press("Backspace")
        assert length_mm(page, "Along the surface") == pytest.approx(helix_mm(*places[:2]), rel=0.01)
        page.get_by_role("button", name="Start anew").click()
        assert measured_places(page) == []
        page.get_by_role("radio", name="sharpens").check()
        assert not page.get_by_text("Along the surface").is_visible()


def test_points_stay_while_they_are_sharpened(browser: Browser, kept: Kept) -> None:
    with opened(browser, kept.at("head")) as page:
        page.get_by_label("Quality", exact=True).select_option("exact")
        page.get_by_label("Area round the click").select_option("1")
        advice = page.get_by_text("Not all of these points are sharp yet")
        first = page.locator("#notice", has_text="Click the first point.")
        updates = 0
        distance, path = [(0.46, 0.5), (0.55, 0.42)], [(0.45, 0.6), (0.5, 0.55), (0.56, 0.6)]
        for tool, ends in (("measures", distance), ("traces a path", path)):
            page.get_by_label(tool).check()
            first.wait_for()
            for end in ends:
                click(page, *end)
            places, coarse_mm = measured_places(page), length_mm(page, "Along the surface")
            assert len(places) == len(ends)
            page.get_by_role("radio", name="sharpens").check()
            assert measured_places(page) == places
            assert advice.is_visible() == (updates == 0), "one look is as wide as the scan"
            updates += 1
            click(page, 0.5, 0.5)
            wait_updates(page, updates)
            assert measured_places(page) == places and not advice.is_visible()
            assert (length_mm(page, "Along the surface") != coarse_mm) == (updates == 1)
            page.get_by_label(tool).check()
            assert measured_places(page) == places
        page.get_by_role("button", name="Start anew").click()
        first.wait_for()
        page.get_by_label("sets a pin").check()
        assert not first.is_visible(), "a click does not do that now"


def test_choices_stand_in_their_order(browser: Browser, kept: Kept) -> None:
    with opened(browser, kept.at("cylinder")) as page:
        for label, values in (
            ("Area round the click", ["0.02", "0.05", "0.15", "0.4", "1"]),
            ("Time limit", ["0", "0.25", "0.5", "1", "3"]),
            ("Around it, detail falls off", ["auto", "2", "0.5", "0.1"]),
        ):
            assert page.get_by_label(label).evaluate("(one) => [...one.options].map(({ value }) => value)") == values


def test_a_scan_that_is_gone_is_not_replaced_by_another(browser: Browser, kept: Kept) -> None:
    gone = "That scan is not there any more."
    with blank(browser) as (page, problems):
        for scan in ("d" * 32, f"{kept.ids['head']})"):
            page.goto("about:blank")
            page.goto(f"{kept.url}/#scan={scan}")
            page.get_by_text(gone).wait_for()
            page.get_by_role("button", name="head").wait_for()
            assert page.locator("html").get_attribute("data-scan") is None
        page.get_by_role("button", name="brief").click()
        page.wait_for_selector(f'html[data-scan="{kept.ids["brief"]}"]', state="attached")
        assert not page.get_by_text(gone).is_visible()
        page.goto(f"{kept.url}/#scan={'e' * 32}")
        page.get_by_text(gone).wait_for()
        page.wait_for_selector("html:not([data-scan])", state="attached")
        page.get_by_role("button", name="brief").click()
        page.wait_for_selector(f'html[data-scan="{kept.ids["brief"]}"]', state="attached")
        assert page.request.delete(f"{kept.url}/v1/scans/{kept.ids['brief']}").ok
        page.evaluate("() => dispatchEvent(new Event('focus'))")
        page.get_by_text(gone).wait_for()
        page.wait_for_selector("html:not([data-scan])", state="attached")
        page.get_by_role("button", name="brief").wait_for(state="detached")
        assert not page.get_by_text("This scan", exact=True).is_visible()
    assert all("404" in problem for problem in problems), problems  # small pictures of what is gone


def test_a_scan_that_was_deleted_is_shown_for_ten_seconds_at_most(browser: Browser, kept: Kept) -> None:
    with blank(browser) as (page, problems):
        page.clock.install()
        page.goto(kept.at("passing"))
        page.wait_for_selector("html[data-scan]", state="attached")
        page.get_by_role("button", name="passing").wait_for()
        assert page.request.delete(f"{kept.url}/v1/scans/{kept.ids['passing']}").ok
        page.clock.pause_at(page.evaluate("Date.now() / 1000 + 1"))  # from now on time is what we say
        page.clock.run_for(10_000)
        page.get_by_text("That scan is not there any more.").wait_for()
        page.wait_for_selector("html:not([data-scan])", state="attached")
    assert all("404" in problem for problem in problems), problems


def test_the_newest_scan_is_opened_again_by_an_address_that_names_none(browser: Browser, kept: Kept) -> None:
    with opened(browser, kept.url) as page:
        newest = page.locator("html").get_attribute("data-scan")
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        page.evaluate("location.hash = ''")
        page.wait_for_function("() => /scan=/.test(location.hash) && !/fovea/.test(location.hash)")  # open again
        click(page, 0.5, 0.5)
        wait_updates(page, 2)
        assert page.locator("html").get_attribute("data-scan") == newest


@pytest.mark.parametrize("name", ["head", "lumpy"])
def test_lengths_along_a_face_and_a_closed_object_are_true(browser: Browser, kept: Kept, name: str) -> None:
    """Held against the shortest way through the samples of the truth."""
    with opened(browser, kept.at(name)) as page:
        page.get_by_label("Quality", exact=True).select_option("exact")
        page.get_by_label("Area round the click").select_option("1")
        page.get_by_label("measures").check()
        click(page, 0.46, 0.5)
        click(page, 0.55, 0.42)
        advice = page.get_by_text("Not all of these points are sharp yet")
        assert advice.is_visible()
        page.get_by_role("button", name="Sharpen the middle").click()
        wait_updates(page, 1)
        assert not advice.is_visible()
        places = measured_places(page)
        along_mm, straight_mm = (length_mm(page, name) for name in ("Along the surface", "Straight"))
        drawn = page.locator(".marks path:not(.away)").get_attribute("d") or ""
    points = all_points(kept.grids[name])
    (first, last), margin = [cell(kept.grids[name], *place) for place in places], 12
    between_mm = math.dist(points[first], points[last])  # samples, which stand up to half a step beside the places
    turned = points.shape[1] // 2 - first[1]  # away from the seam
    first, last = [(row, (column + turned) % points.shape[1]) for row, column in (first, last)]
    low = [max(0, min(a, b) - margin) for a, b in zip(first, last, strict=True)]
    high = [max(a, b) + margin for a, b in zip(first, last, strict=True)]
    patch = np.roll(points, turned, axis=1)[low[0] : high[0], low[1] : high[1]]
    ends = [(row - low[0], column - low[1]) for row, column in (first, last)]
    assert along_mm / straight_mm == pytest.approx(shortest_mm(patch, *ends) / between_mm, rel=0.01)
    apart_mm = [math.dist(patch[row, column], patch[row + 1, column + 1]) for row, column in ends]
    assert straight_mm == pytest.approx(between_mm, abs=sum(apart_mm) / 2)
    assert along_mm > straight_mm > 15
    assert drawn.count("L") > 10, "the way over the surface is drawn"


def test_two_scans_stand_beside_each_other_and_move_together(browser: Browser, kept: Kept) -> None:
    with opened(browser, kept.at("head")) as page:
        page.locator("summary:has-text('Compare')").click()
        page.get_by_label("Beside the open scan").select_option(kept.ids["later"])
        beside = page.locator(f'.picture[data-scan="{kept.ids["later"]}"]')
        beside.wait_for()
        page.locator("#view").focus()
        page.keyboard.press("ArrowRight")
        one, other = settled(page, lambda one, other: one == other and one != [])
        page.locator("#view-beside").focus()
        page.keyboard.press("+")
        before = one
        one, other = settled(page, lambda now, other: now == other and now[2] < before[2])

        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        page.wait_for_selector('.picture[data-updates="1"][data-looking="no"]')
        both = settled(page, lambda one, other: True, "fovea")
        assert both[0][1] == pytest.approx(both[1][1], abs=0.1), "seen at the same height"

        page.get_by_label("Sharpen both").uncheck()
        click(page, 0.5, 0.5, "#view-beside")
        page.wait_for_selector('.picture[data-updates="2"][data-looking="no"]')
        assert page.evaluate("document.documentElement.dataset.updates") == "1"

        page.get_by_label("Move both together").uncheck()
        page.locator("#view-beside").focus()
        turned = TURNED * 2 * math.pi / kept.grids["head"].spec.width
        for _ in range(round(turned / (math.pi / 24))):
            page.keyboard.press("ArrowRight")
        alone = one
        _, other = settled(page, lambda now, other: now == alone and other[0] > alone[0] + 0.3)
        page.get_by_label("Move both together").check()
        page.locator("#view").focus()
        page.keyboard.press("ArrowUp")
        apart = other[0] - one[0]
        one, other = settled(page, lambda now, other: now[1] > alone[1] and other[1] > alone[1])
        assert other[0] - one[0] == pytest.approx(apart, abs=1e-3), "one stands turned, as it was left"
        address, pictures = page.url, [crop(page, 0.5, 0.5, 200, view) for view in ("#view", "#view-beside")]
    with opened(browser, address) as page:
        page.wait_for_selector('.picture[data-updates="2"][data-looking="no"]')
        wait_updates(page, 1)
        assert page.get_by_label("Move both together").is_visible(), "the panel is unfolded"
        for view, picture in zip(("#view", "#view-beside"), pictures, strict=True):
            assert psnr(crop(page, 0.5, 0.5, 200, view), picture) > 40, "the address has both"
        page.locator("aside details").evaluate_all("(all) => all.forEach((one) => (one.open = true))")
        for width in (1000, 360):
            page.set_viewport_size({"width": width, "height": 740})
            assert barriers(page) == [] == layout_faults(page)
        page.get_by_role("button", name="Close the comparison").click()
        page.locator("#view-beside").wait_for(state="detached")
        page.wait_for_function("() => !location.hash.includes('beside')")


def test_an_offline_copy_shows_the_same_and_asks_nobody(browser: Browser, kept: Kept, tmp_path: Path) -> None:
    with opened(browser, kept.at("head")) as page:
        click(page, 0.5, 0.5)
        wait_updates(page, 1)
        surface = page.get_by_label("Surface")
        surface.evaluate("(one) => (one.closest('details').open = true)")
        surface.select_option("relief")
        page.mouse.move(2, 2)
        wait_drawn(page)
        picture = crop(page, 0.5, 0.5, 300)
        page.locator("summary:has-text('This scan')").click()
        page.get_by_role("button", name="Offline copy of this view").click()
        assert barriers(page) == []
        with page.expect_download() as download:
            page.get_by_role("button", name="Save the file").click()
        file = tmp_path / "copy.html"
        download.value.save_as(file)
        with page.expect_download() as download:
            page.get_by_role("button", name="Offline copy of this view").click()
            page.get_by_label("Say in it whose scan it is").check()
            page.get_by_role("button", name="Save the file").click()
        assert download.value.suggested_filename.startswith("head, copy of ")
        assert '"about":"head"' in Path(download.value.path()).read_text()
        page.get_by_role("button", name="Offline copy of this view").click()
        assert not page.get_by_label("Say in it whose scan it is").is_checked(), "asked anew"
    assert '"about":""' in file.read_text(), "whose scan it is stays unsaid"
    with opened(browser, file.as_uri(), allowed=file.as_uri()) as page:
        assert psnr(crop(page, 0.5, 0.5, 300), picture) > 45
        assert "Offline copy, made" in (page.locator("#link").text_content() or "")
        page.get_by_label("measures").check()
        click(page, 0.46, 0.5)
        click(page, 0.55, 0.42)
        assert length_mm(page, "Along the surface") > length_mm(page, "Straight") > 10
        page.locator("aside details").evaluate_all("(all) => all.forEach((one) => (one.open = true))")
        for width in (1000, 360):
            page.set_viewport_size({"width": width, "height": 740})
            assert barriers(page) == [] == layout_faults(page)
    with blank(browser) as (page, problems):
        page.goto(file.as_uri())
        page.wait_for_selector("html[data-scan]", state="attached")
        asked = f"fetch('{kept.url}/healthz', {{ mode: 'no-cors' }}).then(() => 'answered', () => 'refused')"
        assert page.evaluate(asked) == "refused"
        assert any("Content Security Policy" in problem for problem in problems)
    cut = tmp_path / "cut.html"
    cut.write_bytes(file.read_bytes()[: -file.stat().st_size // 3])
    with blank(browser) as (page, _):
        page.goto(cut.as_uri())
        page.get_by_text("This file is damaged").wait_for()


def settled(
    page: Page, meant: Callable[[list[float], list[float]], bool], name: str = "camera"
) -> tuple[list[float], list[float]]:
    """Both cameras (or another field) as the address has them, once it has both and that is what is meant."""
    until = time.monotonic() + WAIT_MS / 1000
    while time.monotonic() < until:
        one, other = settled_fields(page, name, f"beside-{name}")
        if one and other and meant(one, other):
            return one, other
        page.wait_for_timeout(50)
    raise AssertionError(f"the address stays {page.url}")


def settled_fields(page: Page, *names: str) -> list[list[float]]:
    """Numbers in the address."""
    told = page.evaluate("(names) => names.map((name) => new URLSearchParams(location.hash.slice(1)).get(name))", names)
    return [[float(number) for number in (text or "").split(",") if number] for text in told]


@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # trimesh's, of samples that no triangle of an OBJ has
def test_downloads_are_the_scan_in_every_format(browser: Browser, kept: Kept, tmp_path: Path) -> None:
    """Of a cylinder with voids and of a closed object: each vertex is a sample of the truth, and none is missing."""
    with opened(browser, kept.at("head")) as page:
        for name in ("head", "lumpy"):
            page.get_by_role("button", name=name).click()
            page.wait_for_selector(f'html[data-scan="{kept.ids[name]}"]', state="attached")
            page.locator("details:has(summary:has-text('This scan'))").evaluate("(one) => (one.open = true)")
            points = all_points(kept.grids[name])
            for what, suffix in (("GLB", "glb"), ("PLY", "ply"), ("OBJ", "obj.zip"), ("STL", "stl")):
                with page.expect_download() as download:
                    page.get_by_role("link", name=what, exact=True).click()
                assert download.value.suggested_filename.endswith(suffix)
                file = tmp_path / f"{name}.{suffix}"
                download.value.save_as(file)
                mesh = loaded(file, tmp_path)
                grid = kept.grids[name]
                found = cells_of(grid, mesh.vertices)
                off_mm = np.linalg.norm(points[found] - mesh.vertices, axis=1)
                assert (off_mm > 0.01).sum() <= 2, "only a pole is no sample"
                seen = np.zeros(points.shape[:2], bool)
                seen[found] = True
                missing = (grid.range_steps > 0) & ~seen
                lone = 0 if suffix in ("glb", "ply") else missing.size // 2000
                assert missing.sum() <= lone, "but for samples that no triangle has"
                if suffix in ("glb", "obj.zip"):
                    assert isinstance(mesh.visual, trimesh.visual.TextureVisuals)
                    material: Any = mesh.visual.material
                    drawn = material.baseColorTexture if suffix == "glb" else material.image
                    assert np.array_equal(np.asarray(drawn.convert("RGB")), grid.texture)


def test_pins_of_any_geometry_are_listed_and_stand_where_they_were_set(browser: Browser, kept: Kept) -> None:
    with opened(browser, kept.at("head")) as page:
        for name in ("head", "lumpy"):
            page.get_by_role("button", name=name).first.click()
            page.wait_for_selector(f'html[data-scan="{kept.ids[name]}"]', state="attached")
            page.get_by_label("sets a pin").check()
            click(page, 0.56, 0.45)
            with page.expect_response(lambda answer: answer.request.method == "PATCH") as answered:
                page.get_by_label("Label of the new pin").fill(f"mole of {name}")
                page.keyboard.press("Enter")
            assert answered.value.ok
            assert stands_at(page, f"mole of {name}") == pytest.approx((0.56, 0.45), abs=0.01)
            page.get_by_role("button", name=f"Show pin mole of {name}").click()
            wait_drawn(page)
            assert stands_at(page, f"mole of {name}")[0] == pytest.approx(0.5, abs=0.02), "it is turned to the front"


def test_long_labels_of_pins_stay_in_a_narrow_picture(browser: Browser, kept: Kept) -> None:
    with opened(browser, kept.at("fitting"), viewport={"width": 360, "height": 740}) as page:
        for x, y in ((0.3, 0.3), (0.7, 0.4), (0.5, 0.7)):
            page.get_by_label("sets a pin").check()
            with page.expect_response(lambda answer: answer.request.method == "PATCH"):
                click(page, x, y)
                page.get_by_label("Label of the new pin").fill(f"a mole that was seen at {x}, {y}, to be looked at")
                page.keyboard.press("Enter")
        expect(page.locator(".pin:not([hidden])")).to_have_count(3)
        wait_drawn(page)
        assert layout_faults(page) == []


def stands_at(page: Page, label: str) -> tuple[float, float]:
    """Where a pin is in the picture, as shares of its width and height."""
    box, pin = (page.locator(at).bounding_box() for at in ("#view", f".pin:has-text('{label}')"))
    assert box is not None and pin is not None
    return (pin["x"] - box["x"]) / box["width"], (pin["y"] - box["y"]) / box["height"]


def loaded(file: Path, folder: Path) -> trimesh.Trimesh:
    """The mesh of a file, in mm with z up."""
    if file.suffix == ".zip":
        with zipfile.ZipFile(file) as packed:
            packed.extractall(folder)
        file = folder / "model.obj"
    mesh = trimesh.load_mesh(file, process=False, maintain_order=True)
    if file.suffix == ".glb":
        mesh.apply_transform([[1000, 0, 0, 0], [0, 0, -1000, 0], [0, 1000, 0, 0], [0, 0, 0, 1]])
    return mesh


def cells_of(grid: Grid, points: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the samples nearest to points. points : (n, 3) mm, z up"""
    spec = grid.spec
    level, up = np.hypot(points[:, 0], points[:, 1]), points[:, 2] - spec.z_max_mm
    v = np.arctan2(level, up) / np.pi if spec.geometry == "sphere" else -up / (spec.pitch_mm * spec.height)
    u = (np.arctan2(points[:, 1], points[:, 0]) - spec.theta0_rad) / (2 * np.pi)
    row = np.clip(np.rint(v * spec.height - 0.5), 0, spec.height - 1).astype(int)
    return row, np.rint(u * spec.width - 0.5).astype(int) % spec.width


@pytest.mark.parametrize(("name", "width"), [("head", 1000), ("head", 360), ("lumpy", 1000)])
def test_a_picture_stands_where_the_model_will(browser: Browser, kept: Kept, name: str, width: int) -> None:
    """As long as there is no model, and as if it were that."""
    with blank(browser, viewport={"width": width, "height": 700}) as (page, _):
        page.route("**/assets/worker-*", lambda route: route.abort())
        page.goto(kept.at(name))
        expect(page.locator("#poster")).to_have_js_property("complete", True)
        before = crop(page, 0.5, 0.5, 240, "#poster")
        page.unroute("**/assets/worker-*")
        page.reload()
        page.wait_for_selector("html[data-scan]", state="attached")
        page.wait_for_selector("#app:not(.early) aside details", state="attached")
        page.locator(".marks").evaluate("(pins) => (pins.hidden = true)")
        wait_drawn(page)
        expect(page.locator("#poster")).to_have_count(0)
        assert psnr(before, crop(page, 0.5, 0.5, 240)) >= 24
        page.goto("about:blank")
        page.goto(kept.at(name, "1,0.2,300,0,75,0"))
        page.wait_for_selector("html[data-scan]", state="attached")
        asked = page.evaluate("performance.getEntriesByType('resource').map(({ name }) => name)")
        assert not [path for path in asked if path.endswith("/picture")], "the camera is elsewhere"


def test_colour_that_a_graphics_card_has_no_room_for_is_shown_smaller(browser: Browser, kept: Kept) -> None:
    """SwiftShader takes 8192 a row: one scan has so many texels, another twice."""
    pictures = []
    for name in ("wide", "fitting"):
        with opened(browser, kept.at(name, "0,0,300,0,75,0")) as page:
            assert page.get_by_text("colour is drawn at 1/2 of its resolution").is_visible() == (name == "wide")
            pictures.append(sharpened(page, "flat"))
    (coarse, _), (_, whole) = pictures
    assert psnr(pictures[0][1], whole) >= 30, "it is drawn where it belongs"
    assert psnr(pictures[0][1], whole) >= psnr(coarse, whole) + 3


@pytest.mark.parametrize("name", ["head", "lumpy"])
def test_shape_that_a_graphics_card_has_no_room_for_is_shown_smaller(browser: Browser, kept: Kept, name: str) -> None:
    """On a card that takes less it is drawn as on one that takes all."""
    pictures, lengths_mm = [], []
    for fits in (False, True):
        with blank(browser) as (page, problems):
            if not fits:
                page.add_init_script(SMALL_CARD)
            page.goto(kept.at(name))
            page.wait_for_selector("html[data-scan]", state="attached")
            page.wait_for_selector("#app:not(.early) aside details", state="attached")
            assert page.get_by_text("shape is drawn at 1/2").is_visible() == (not fits)
            pictures.append(sharpened(page, "relief"))
            page.get_by_label("measures").check()
            click(page, 0.5, 0.45)
            click(page, 0.55, 0.5)
            lengths_mm.append(length_mm(page, "Straight, end to end"))
            assert problems == []
    (coarse, thinned), (_, whole) = pictures
    assert psnr(thinned, whole) >= max(25, psnr(coarse, whole) + 2), "it is drawn where it belongs"
    assert lengths_mm[0] == pytest.approx(lengths_mm[1], rel=1e-3), "and measured as it is"


def sharpened(page: Page, surface: str) -> tuple[Picture, Picture]:
    """What the middle looks like before and after a click there that asks for everything."""
    page.get_by_label("Quality", exact=True).select_option("exact")
    page.get_by_label("Surface").evaluate("(one) => (one.closest('details').open = true)")
    page.get_by_label("Surface").select_option(surface)
    wait_drawn(page)
    coarse = crop(page, 0.5, 0.5, 120)
    click(page, 0.5, 0.5)
    wait_updates(page, 1)
    page.mouse.move(2, 2)
    wait_drawn(page)
    return coarse, crop(page, 0.5, 0.5, 120)


def helix_mm(a: tuple[float, float], b: tuple[float, float]) -> float:
    """From place to place over the cylinder, of 50 mm radius and 150 mm high."""
    turn = abs(a[0] - b[0])
    return math.hypot(2 * math.pi * 50 * min(turn, 1 - turn), 150 * (a[1] - b[1]))


def measured_places(page: Page) -> list[tuple[float, float]]:
    """The points of the measurement, as (u, v)."""
    told = page.locator("output.distance").get_attribute("data-places") or ""
    return [(float(u), float(v)) for u, v in (place.split(",") for place in told.split())]


def length_mm(page: Page, what: str) -> float:
    """A figure of the panel."""
    figure = page.locator("dt", has_text=what).locator("+ dd").text_content() or ""
    return float(figure.removesuffix(" mm"))


def cell(grid: Grid, u: float, v: float) -> tuple[int, int]:
    """Row and column of the sample at a place."""
    return int(v * grid.spec.height), int(u * grid.spec.width)


def all_points(grid: Grid) -> FloatArray:
    """Where every sample is, z up; what was not measured is not finite. (H, W, 3) mm"""
    spec = grid.spec
    radius = np.where(grid.range_steps > 0, grid.range_steps * spec.step_mm, np.nan)
    row, column = np.mgrid[: spec.height, : spec.width]
    angle = spec.theta0_rad + 2 * np.pi * (column + 0.5) / spec.width
    polar = np.pi * (row + 0.5) / spec.height
    closed = spec.geometry == "sphere"
    level = radius * np.sin(polar) if closed else radius
    up = spec.z_max_mm + (radius * np.cos(polar) if closed else -(row + 0.5) * spec.pitch_mm)
    return np.stack([level * np.cos(angle), level * np.sin(angle), up], axis=-1)
