"""Planned updates, applied as a client would: what they reach, what they cost, what they leave alone."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from client.model import Model
from node import refine_range
from node.coded import Coded
from node.first_view import FirstView, build_first_view, texture_as_seen
from node.foveate import REPLY_BYTES, Update, plan_update
from node.library import Scan
from node.range_model import RangeModel
from node.state import ClientState
from node.texture_model import TextureModel
from node.wanted import Wanted
from protocol import messages as m
from protocol.grid import VOID, Grid
from protocol.lattice import Channel
from protocol.messages import Look, LookParameters, RangeParameters, TextureParameters
from protocol.refinement import Refinement
from protocol.region import region_round
from simulators.specimen import make_specimen
from tests.node.planning import plan_look
from tests.node.scans import keep, make_grid

CLICKS = [(0.1, 0.5), (0.62, 0.3), (0.99, 0.02), (0.4, 0.98)]
places = st.floats(0, 0.999)
TURN = (0.1, 0.3, 0.5, 0.7, 0.9)
EXACT = LookParameters(RangeParameters(1, 1), TextureParameters(1, 255))


@pytest.fixture(scope="module")
def view(scan: Scan) -> FirstView:
    return build_first_view(scan, "htj2k", 32768)


@pytest.fixture(scope="module")
def model_of_texture(scan: Scan, view: FirstView) -> TextureModel:
    return TextureModel(scan.texture, texture_as_seen(view))


@pytest.fixture(scope="module")
def head(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scan, TextureModel]:
    """A head at S, whose texture is like a face's, and what is known of it."""
    scan = keep(make_specimen("head", "S").grid, tmp_path_factory.mktemp("head"))
    return scan, TextureModel(scan.texture, texture_as_seen(build_first_view(scan, "htj2k", 32768)))


class Viewer:
    """A client's model fed with planned updates, beside what the node believes of it."""

    def __init__(self, scan: Scan, view: FirstView) -> None:
        self.scan = scan
        self.model = Model(view.info)
        self.state: ClientState = view.state.copy()
        for data in view.refinements(1):
            self.model.apply(Refinement.from_bytes(data))
        self.seq = 2

    def take(self, update: Update) -> int:
        """Apply an update as it travels; its bytes on the wire."""
        update = update.settled()
        size = 0
        for coded in update.coded:
            data = coded.refinement(1, self.seq, 1).to_bytes()
            self.model.apply(Refinement.from_bytes(data))
            self.seq += 1
            size += len(data)
        self.state = update.state
        assert self.model.holdings.digest() == self.state.holdings.digest()
        return size

    def range_error_mm(self, look: Look) -> float:
        s = self.scan.spec
        region = region_round(look.u, look.v, look.window, s.width, s.height)
        grids = self.model.range_steps, self.scan.range_steps
        held, true = (steps[region.rows][:, region.columns].astype(int) for steps in grids)
        np.testing.assert_array_equal(held == VOID, true == VOID)
        error = np.abs(held - true)[true != VOID]
        return float(np.percentile(error, 99, method="higher")) * s.step_mm if error.size else 0.0

    def texture_db(self, look: Look) -> float:
        s = self.scan.spec
        region = region_round(look.u, look.v, look.window, s.texture_width, s.texture_height)
        held, true = (a[region.rows][:, region.columns].astype(float) for a in (self.model.texture, self.scan.texture))
        return float(10 * np.log10(255**2 / max(np.mean((held - true) ** 2), 1e-9)))


@pytest.mark.parametrize("pace", ["unknown", "known", "hurried"])
@pytest.mark.parametrize("codec", ["htj2k", "jpeg"])
@pytest.mark.parametrize(("u", "v"), CLICKS)
def test_reaches_the_quality_asked_for(
    scan: Scan, view: FirstView, codec: m.CodecName, u: float, v: float, pace: str
) -> None:
    viewer = Viewer(scan, view)
    look = Look(1, u, v, texture_db=34, range_mm=0.05)
    model = None if pace == "unknown" else RangeModel(scan.spec, scan.range_steps, scan.filled)
    update = plan_look(scan, viewer.state, look, codec, range_model=model, hurried=pace == "hurried")
    viewer.take(update)
    assert update.reason == "complete"
    assert viewer.range_error_mm(look) <= look.range_mm
    assert viewer.texture_db(look) >= look.texture_db
    assert update.texture_db == pytest.approx(viewer.texture_db(look), abs=0.01)


@pytest.mark.parametrize("hurried", [False, True])
@pytest.mark.parametrize("range_mm", [0.02, 0.05])
def test_a_model_that_promises_too_much_costs_tries_not_quality(
    scan: Scan, view: FirstView, monkeypatch: pytest.MonkeyPatch, range_mm: float, hurried: bool
) -> None:
    look, told = Look(1, 0.3, 0.6, range_mm=range_mm), RangeModel(scan.spec, scan.range_steps, scan.filled)
    known = plan_look(scan, view.state, look, range_model=told, hurried=hurried)
    monkeypatch.setattr(RangeModel, "error", lambda self, region, p: 0.0 if p == 1 else 1.0)
    viewer = Viewer(scan, view)
    update = plan_look(scan, viewer.state, look, range_model=told, hurried=hurried)
    viewer.take(update)
    assert viewer.range_error_mm(look) <= range_mm
    if not hurried:
        assert update.wire_bytes <= 1.1 * known.wire_bytes


def test_what_is_held_exactly_and_too_thinly_is_mended_by_what_is_dense(scan: Scan, view: FirstView) -> None:
    viewer = Viewer(scan, view)
    thin = LookParameters(range=RangeParameters(p=4, quantum=1))
    viewer.take(plan_look(scan, viewer.state, Look(1, 0.3, 0.6, parameters=thin)))
    look = Look(2, 0.3, 0.6, range_mm=0.05)
    viewer.take(plan_look(scan, viewer.state, look))
    assert viewer.range_error_mm(look) <= look.range_mm


@pytest.mark.parametrize("known", [False, True])
def test_everything_there_is_can_be_asked_for(
    scan: Scan, view: FirstView, model_of_texture: TextureModel, known: bool
) -> None:
    viewer = Viewer(scan, view)
    look = Look(1, 0.7, 0.5, texture_db=100, range_mm=0)
    update = plan_look(scan, viewer.state, look, model=model_of_texture if known else None)
    viewer.take(update)
    assert update.texture_db is not None and update.texture_db >= 55  # the codec's best, on noise
    assert viewer.range_error_mm(look) == 0


@pytest.mark.parametrize(("u", "window"), [(0.99, 0.5959915993072378), (0, 0.5419719531578474)])
def test_a_window_may_touch_every_block_without_being_all_round(tmp_path: Path, u: float, window: float) -> None:
    scan = keep(make_grid(48, 32), tmp_path)  # of three blocks round, so that a run of 37 touches all
    viewer = Viewer(scan, build_first_view(scan, "htj2k", 32768))
    look = Look(1, u, 0.5, window)
    viewer.take(plan_look(scan, viewer.state, look))
    assert viewer.range_error_mm(look) <= look.range_mm


@pytest.mark.parametrize("explicit", [False, True])
def test_a_second_thread_changes_nothing(scan: Scan, view: FirstView, explicit: bool) -> None:
    look = Look(1, 0.62, 0.3, parameters=EXACT if explicit else None)
    with ThreadPoolExecutor(1) as pool:
        alone, beside = (plan_update(scan, view.state, Wanted(look, ("htj2k",)), pool=each) for each in (None, pool))
    assert [coded.payload for coded in beside.coded] == [coded.payload for coded in alone.coded]
    assert (beside.reason, beside.encodes, beside.texture_db) == (alone.reason, alone.encodes, alone.texture_db)
    assert beside.settled().state.holdings.digest() == alone.settled().state.holdings.digest()


def test_range_is_told_before_the_update_that_begins_with_it(scan: Scan, view: FirstView) -> None:
    told: list[Sequence[Coded]] = []
    with ThreadPoolExecutor(1) as pool:
        update = plan_update(scan, view.state, Wanted(Look(1, 0.62, 0.3), ("htj2k",)), pool=pool, ready=told.append)
    ((*first,),) = told
    assert first and all(coded.channel is Channel.RANGE for coded in first)
    assert update.coded[: len(first)] == tuple(first)


def test_says_the_largest_error_left_in_the_window(scan: Scan, view: FirstView) -> None:
    viewer = Viewer(scan, view)
    look = Look(1, 0.62, 0.3)
    update = plan_look(scan, viewer.state, look).settled()
    viewer.take(update)
    s = scan.spec
    region = region_round(look.u, look.v, look.window, s.width, s.height)
    held, true = (a[region.rows][:, region.columns].astype(int) for a in (viewer.model.range_steps, scan.range_steps))
    assert update.error_max_mm is not None
    assert update.error_max_mm >= np.abs(held - true).max() * s.step_mm - 1e-9


@settings(max_examples=40, deadline=None)
@given(places, places, st.integers(0, 9000), st.sampled_from(["htj2k", "jpeg"]), st.booleans())
def test_never_a_byte_over_the_budget(
    scan: Scan, view: FirstView, model_of_texture: TextureModel, u: float, v: float, budget: int, codec: m.CodecName,
    known: bool,
) -> None:  # fmt: skip
    viewer = Viewer(scan, view)
    model = model_of_texture if known else None
    update = plan_look(scan, viewer.state, Look(1, u, v), codec, budget, model=model)
    if update.coded:
        assert viewer.take(update) + REPLY_BYTES <= budget
    else:
        assert update.reason == "byte limit"


def test_more_bytes_never_make_it_worse(scan: Scan, view: FirstView, model_of_texture: TextureModel) -> None:
    look = Look(1, 0.62, 0.3, texture_db=45, range_mm=0.01)
    reached = []
    for budget in (1200, 2500, 5000, 10000, 20000):
        viewer = Viewer(scan, view)
        viewer.take(plan_look(scan, viewer.state, look, "htj2k", budget, model=model_of_texture))
        reached.append((viewer.texture_db(look), -viewer.range_error_mm(look)))
    for worse, better in zip(reached, reached[1:], strict=False):
        assert better[0] >= worse[0] - 0.5
        assert better[1] >= worse[1] - 0.06  # texture may take a fifth of the bytes meant for range


@pytest.mark.parametrize("codec", ["htj2k", "jpeg"])
@pytest.mark.parametrize("share", [0.3, 0.5, 0.7, 0.9])
def test_a_limit_is_filled_in_few_encodes(
    head: tuple[Scan, TextureModel], codec: m.CodecName, share: float
) -> None:
    scan, model = head
    view = build_first_view(scan, codec, 32768)
    encodes = []
    for u, v in ((0.25, 0.5), (0.5, 0.4), (0.75, 0.6)):
        free = plan_look(scan, view.state, Look(1, u, v), codec, model=model)
        budget = round(share * free.wire_bytes)
        update = plan_look(scan, view.state, Look(1, u, v), codec, budget, model=model)
        assert update.reason == "byte limit"
        assert 0.85 * budget <= update.wire_bytes <= budget
        encodes.append(update.encodes)
    assert np.mean(encodes) <= 3


def test_texture_is_never_made_worse(head: tuple[Scan, TextureModel]) -> None:
    scan, model = head
    view = build_first_view(scan, "htj2k", 32768)
    for u in (0.1, 0.3, 0.5, 0.7):
        look = Look(1, u, 0.5)
        before = Viewer(scan, view).texture_db(look)
        for budget in (500, 700, 1000, 1400, 2000):
            viewer = Viewer(scan, view)
            viewer.take(plan_look(scan, viewer.state, look, "htj2k", budget, model=model))
            assert viewer.texture_db(look) >= before


def test_what_is_known_of_range_spares_trials_and_a_hurry_spares_more(
    head: tuple[Scan, TextureModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    scan, model = head
    state = build_first_view(scan, "htj2k", 32768).state
    known = RangeModel(scan.spec, scan.range_steps, scan.filled)
    trials: list[refine_range.Trial] = []

    class Counted(refine_range.Trial):
        def __init__(self, *of: Any) -> None:
            super().__init__(*of)
            trials.append(self)

    monkeypatch.setattr(refine_range, "Trial", Counted)
    counted, size_bytes = [], []
    paces: tuple[dict[str, Any], ...] = {}, {"range_model": known}, {"range_model": known, "hurried": True}
    for pace in paces:
        trials.clear()
        updates = [plan_look(scan, state, Look(1, u, 0.5), model=model, **pace) for u in TURN]
        counted.append(len(trials))
        size_bytes.append(sum(update.wire_bytes for update in updates))
    free, spared, hurried = counted
    assert 0 == hurried < spared < free
    assert size_bytes[1] <= 1.01 * size_bytes[0]
    assert size_bytes[2] <= 1.15 * size_bytes[0]


def test_the_same_look_twice_sends_nothing(scan: Scan, view: FirstView) -> None:
    viewer = Viewer(scan, view)
    look = Look(1, 0.3, 0.4, parameters=EXACT)
    viewer.take(plan_look(scan, viewer.state, look))
    again = plan_look(scan, viewer.state, look)
    assert again.coded == ()
    assert again.reason == "complete"


def test_looks_all_over_end_with_the_exact_scan(scan: Scan, view: FirstView) -> None:
    viewer = Viewer(scan, view)
    for u in np.arange(0.05, 1, 0.1):
        for v in np.arange(0.05, 1, 0.1):
            viewer.take(plan_look(scan, viewer.state, Look(1, float(u), float(v))))
            viewer.take(plan_look(scan, viewer.state, Look(1, float(u), float(v), parameters=EXACT)))
    np.testing.assert_array_equal(viewer.model.range_steps, scan.range_steps)
    np.testing.assert_array_equal(viewer.model.texture, scan.texture)
    assert not viewer.state.error.any()


def test_a_superseded_plan_is_dropped(scan: Scan, view: FirstView) -> None:
    update = plan_update(scan, view.state, Wanted(Look(1, 0.5, 0.5), ("htj2k",)), superseded=lambda: True)
    assert (update.reason, update.coded) == ("superseded", ())
    assert update.state is view.state


def test_planning_leaves_the_state_it_was_given(scan: Scan, view: FirstView) -> None:
    before = view.state.copy()
    plan_look(scan, view.state, Look(1, 0.5, 0.5))
    assert view.state.holdings.digest() == before.holdings.digest()
    np.testing.assert_array_equal(view.state.error, before.error)


def test_few_encodes_once_the_texture_is_known(scan: Scan, view: FirstView, model_of_texture: TextureModel) -> None:
    encodes = [
        plan_look(scan, view.state, Look(1, u, v), model=model_of_texture).encodes for u, v in CLICKS
    ]
    assert np.mean(encodes) <= 3
    assert max(encodes) <= 4


@pytest.mark.parametrize("shape", [(8, 8), (16, 1), (9, 7), (64, 3)])
def test_odd_scans_are_served(tmp_path: Path, shape: tuple[int, int]) -> None:
    width, height = shape
    grid = make_grid(width, height, texels=2, voids=False)
    scan = keep(grid, tmp_path)
    viewer = Viewer(scan, build_first_view(scan, "htj2k", 32768))
    viewer.take(plan_look(scan, viewer.state, Look(1, 0.5, 0.5)))


def test_a_scan_that_is_all_void_is_served(tmp_path: Path) -> None:
    grid = make_grid(64, 32, voids=False)
    void = type(grid)(grid.spec, np.zeros_like(grid.range_steps), grid.texture)
    scan = keep(void, tmp_path)
    viewer = Viewer(scan, build_first_view(scan, "htj2k", 32768))
    viewer.take(plan_look(scan, viewer.state, Look(1, 0.5, 0.5)))
    assert not viewer.model.range_steps.any()


@pytest.mark.parametrize("budget", [None, 600, 2500])
def test_a_click_on_a_void_is_served(scan: Scan, view: FirstView, budget: int | None) -> None:
    row, column = np.argwhere(scan.range_steps == VOID)[0]
    viewer = Viewer(scan, view)
    look = Look(1, (column + 0.5) / scan.spec.width, (row + 0.5) / scan.spec.height)
    viewer.take(plan_look(scan, viewer.state, look, "htj2k", budget))
    assert budget or viewer.range_error_mm(look) <= look.range_mm


def test_parameters_that_do_not_fit_a_limit_are_not_sent(scan: Scan, view: FirstView) -> None:
    update = plan_look(scan, view.state, Look(1, 0.5, 0.5, parameters=EXACT), "htj2k", 800)
    assert (update.reason, update.wire_bytes <= 800) == ("byte limit", True)
    assert Channel.TEXTURE not in {coded.channel for coded in update.coded}


def test_first_view_fits_and_is_the_same_for_the_node(scan: Scan) -> None:
    codecs: tuple[m.CodecName, ...] = "htj2k", "jpeg"
    for codec in codecs:
        view = build_first_view(scan, codec, 32768)
        assert sum(len(part) for part in view.refinements(0)) <= 32768
        state = Viewer(scan, view).state
        assert state.holdings.channels[Channel.RANGE].level.min() == state.shapes[Channel.RANGE].coarse_level


def test_alpha_widens_the_skirt_and_scale_the_window(scan: Scan, view: FirstView) -> None:
    narrow = plan_look(scan, view.state, Look(1, 0.5, 0.5))
    soft = plan_look(scan, view.state, Look(1, 0.5, 0.5, alpha=0.05))
    wide = plan_look(scan, view.state, Look(1, 0.5, 0.5, scale=0.5))
    assert soft.coded[0].parameters.rho_x < narrow.coded[0].parameters.rho_x
    assert sum(p.strip.adopted.sum() for c in soft.coded for p in c.parts) > sum(
        p.strip.adopted.sum() for c in narrow.coded for p in c.parts
    )
    assert wide.coded[0].parameters.blocks_wide > 1.5 * narrow.coded[0].parameters.blocks_wide


def test_fill_spends_the_rest_on_the_periphery(scan: Scan, view: FirstView, model_of_texture: TextureModel) -> None:
    budget = 60_000
    plain = plan_look(scan, view.state, Look(1, 0.7, 0.5), "htj2k", budget, model=model_of_texture)
    filled = plan_look(scan, view.state, Look(1, 0.7, 0.5, fill=True), "htj2k", budget, model=model_of_texture)
    assert plain.wire_bytes < filled.wire_bytes <= budget
    levels = [update.state.holdings.channels[Channel.TEXTURE].level for update in (plain, filled)]
    assert (levels[1] <= levels[0]).all()
    assert (levels[1] < levels[0]).sum() > 20


def test_a_click_beside_a_held_window_costs_what_is_new(scan: Scan, view: FirstView) -> None:
    viewer = Viewer(scan, view)
    whole = plan_look(scan, viewer.state, Look(1, 0.75, 0.5)).wire_bytes
    viewer.take(plan_look(scan, viewer.state, Look(1, 0.65, 0.5)))
    rest = plan_look(scan, viewer.state, Look(1, 0.75, 0.5))
    viewer.take(rest)
    assert rest.wire_bytes < 0.75 * whole


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(places, places, st.sampled_from([0.02, 0.05, 0.1, 0.3])), min_size=2, max_size=5))
@example([(0.0, 0.0, 0.02), (0.8125, 0.0, 0.02), (0.90625, 0.0, 0.02)])  # held blocks are cut by the window's edge
def test_overlapping_windows_reach_their_quality_too(
    scan: Scan, view: FirstView, model_of_texture: TextureModel, looks: list[tuple[float, float, float]]
) -> None:
    viewer = Viewer(scan, view)
    for u, v, range_mm in looks:
        look = Look(1, u, v, texture_db=36, range_mm=range_mm)
        viewer.take(plan_look(scan, viewer.state, look, model=model_of_texture))
        assert viewer.range_error_mm(look) <= range_mm
        assert viewer.texture_db(look) >= look.texture_db - 0.01


def test_cells_kept_and_cells_mended_share_one_allowance(tmp_path: Path) -> None:
    """What is kept of a held window uses up most of the 1% that may be off, so what is mended must leave little."""
    grid, random = make_specimen("head", "S").grid, np.random.default_rng(1)
    (height, width), block = grid.range_steps.shape, 8
    rough = 40 * (0.2 + random.random((height // block + 1, width // block)) ** 3)
    noise = random.normal(size=(height, width)) * rough.repeat(block, 0).repeat(block, 1)[:height]
    noisy = np.clip(grid.range_steps + np.round(noise), 1, 65535)
    scan = keep(replace(grid, range_steps=np.where(grid.range_steps == VOID, VOID, noisy).astype(np.uint16)), tmp_path)
    viewer = Viewer(scan, build_first_view(scan, "htj2k", 32768))
    for u, v in ((0.796, 0.912), (0.873, 0.985)):
        look = Look(1, u, v, texture_db=5, range_mm=0.3)
        viewer.take(plan_look(scan, viewer.state, look))
        assert viewer.range_error_mm(look) <= look.range_mm


@pytest.mark.parametrize("codec", ["htj2k", "jpeg"])
@pytest.mark.parametrize("shape", [(160, 96), (8, 8), (1, 100), (360, 1)])
def test_a_texture_of_one_colour_is_served(tmp_path: Path, codec: m.CodecName, shape: tuple[int, int]) -> None:
    grid = make_grid(*shape)
    scan = keep(Grid(grid.spec, grid.range_steps, np.full_like(grid.texture, 128)), tmp_path)
    viewer = Viewer(scan, build_first_view(scan, codec, 32768))
    for model in (None, TextureModel(scan.texture)):
        look = Look(1, 0.5, 0.5)
        viewer.take(plan_look(scan, viewer.state, look, codec, model=model))
        assert viewer.texture_db(look) >= 40


@pytest.mark.parametrize("target_db", [40, 50, 60])
def test_noise_reaches_the_quality_asked_for(tmp_path: Path, target_db: float) -> None:
    grid = make_grid()
    noise = np.random.default_rng(1).integers(0, 256, grid.texture.shape, np.uint8)
    scan = keep(Grid(grid.spec, grid.range_steps, noise), tmp_path)
    viewer = Viewer(scan, build_first_view(scan, "htj2k", 32768))
    look = Look(1, 0.5, 0.5, texture_db=target_db)
    viewer.take(plan_look(scan, viewer.state, look, model=TextureModel(scan.texture)))
    assert viewer.texture_db(look) >= target_db - 0.01


def test_texture_that_the_first_view_shows_well_enough_is_not_sent(
    scan: Scan, view: FirstView, model_of_texture: TextureModel
) -> None:
    viewer = Viewer(scan, view)
    look = Look(1, 0.2, 0.5, texture_db=30)
    update = plan_look(scan, viewer.state, look, model=model_of_texture)
    assert [coded.channel for coded in update.coded] == [Channel.RANGE]
    assert update.texture_db == pytest.approx(viewer.texture_db(look), abs=0.3)
    assert viewer.texture_db(look) >= look.texture_db
    assert plan_look(scan, viewer.state, look).coded[-1].channel is Channel.TEXTURE  # not known yet: sent


def test_a_window_a_little_further_on_costs_what_is_new_in_it(
    scan: Scan, view: FirstView, model_of_texture: TextureModel
) -> None:
    viewer = Viewer(scan, view)
    first = plan_look(scan, viewer.state, Look(1, 0.7, 0.5), model=model_of_texture)
    viewer.take(first)
    look = Look(1, 0.7 + 16 / 640, 0.5)
    second = plan_look(scan, viewer.state, look, model=model_of_texture)
    viewer.take(second)
    assert second.wire_bytes < 0.5 * first.wire_bytes
    assert viewer.range_error_mm(look) <= look.range_mm
    assert viewer.texture_db(look) >= look.texture_db - 0.01
