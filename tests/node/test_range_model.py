"""What is known of range before any trial."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from node import range_model, refine_range
from node.first_view import build_first_view
from node.library import Scan
from node.quality import Encodes
from node.range_bitmaps import reach_range
from node.range_model import SPACINGS, RangeModel, how_often, percentile_of
from node.range_search import RangeSearch
from node.refine_range import _TrialPart, trial_of
from protocol.grid import Grid, GridSpec
from protocol.messages import Look, RangeParameters
from protocol.region import region_round
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid, click_of, region_on, vectors
from tests.node.scans import keep, make_grid


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return keep(make_grid(), tmp_path_factory.mktemp("library"))


@pytest.mark.parametrize(("u", "v"), [(0.1, 0.5), (0.62, 0.3), (0.99, 0.1), (0.4, 0.9)])
def test_it_says_what_a_trial_would_find(scan: Scan, u: float, v: float) -> None:
    model = RangeModel(scan.spec, scan.range_steps, scan.filled)
    state = build_first_view(scan, "htj2k", 32768).state
    region = region_round(u, v, 0.05, scan.spec.width, scan.spec.height)
    assert model.error(region, 1) == 0
    trials = {p: trial for p in SPACINGS if (trial := trial_of(scan, state, region, p)) is not None}
    assert 2 in trials and 4 in trials  # 8 is as coarse as the first view
    for p, trial in trials.items():
        assert trial.error(1) <= model.error(region, p) + 1 <= 1.06 * trial.error(1) + 2


def test_what_cannot_be_and_what_nobody_measured() -> None:
    grid = make_grid(width=156, voids=False)
    region = region_round(0.5, 0.5, 0.05, grid.spec.width, grid.spec.height)
    known = RangeModel(grid.spec, grid.range_steps, grid.range_steps)
    assert known.error(region, 4) > 0
    assert known.error(region, 8) == np.inf  # 156 columns have no eighth
    unknown = RangeModel(grid.spec, np.zeros_like(grid.range_steps), grid.range_steps)
    assert unknown.error(region, 4) == 0


def test_a_spacing_as_coarse_as_the_first_view_is_never_chosen(scan: Scan) -> None:
    plain = replace(scan, range_steps=np.full_like(scan.range_steps, 3000), filled=np.full_like(scan.filled, 3000))
    state = build_first_view(scan, "htj2k", 32768).state
    region = region_round(0.5, 0.5, 0.05, scan.spec.width, scan.spec.height)
    known = RangeModel(scan.spec, plain.range_steps, plain.filled)
    assert known.error(region, 8) == 0 and trial_of(plain, state, region, 8) is None
    for hurried in (False, True):
        search = RangeSearch(plain, state, Look(1, 0.5, 0.5), region, known, hurried, Encodes(lambda: False))
        assert search.choose(50.0).p == 4


# -- closed objects ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """A lumpy object, as seen by direction."""
    spec = GridSpec(320, 192, 640, 384, 0.005, 1.0, 0.0, geometry="sphere")
    grid = DirectionGrid(spec.width, spec.height)
    row, column = np.mgrid[: spec.height, : spec.width]
    x, y, z = np.moveaxis(vectors(grid.theta_v(row), grid.theta_h(column)), -1, 0)
    steps = np.rint((60 + np.sin(5 * x + 1) * np.cos(4 * y) + 0.6 * np.sin(5 * z - 3 * x)) / spec.step_mm)
    texture = make_grid(voids=False).texture
    kept = thin_grid(Grid(spec, steps.astype(np.uint16), texture))
    return keep(kept, tmp_path_factory.mktemp("closed"))


@pytest.mark.parametrize("theta_v", [0.0, 0.3, 0.8, math.pi / 2, math.pi])
def test_it_says_of_a_sphere_what_a_trial_would_find(sphere: Scan, theta_v: float) -> None:
    spec = sphere.spec
    model = RangeModel(spec, sphere.range_steps, sphere.filled)
    state = build_first_view(sphere, "htj2k", 32768).state
    region = region_on(spec, *click_of(theta_v, 1.0), 0.05, spec.width, spec.height)
    trials = {p: trial for p in SPACINGS if (trial := trial_of(sphere, state, region, p)) is not None}
    assert 2 in trials and 4 in trials
    for p, trial in trials.items():  # samples may begin elsewhere than those of the whole rows
        assert 0.8 * trial.error(1) - 1 <= model.error(region, p) <= 1.25 * trial.error(1) + 2


@pytest.mark.parametrize("theta_v", [0.0, 0.8, math.pi / 2])
def test_of_many_cells_a_ninth_tells_what_interpolating_misses(
    sphere: Scan, monkeypatch: pytest.MonkeyPatch, theta_v: float
) -> None:
    spec = sphere.spec
    model = RangeModel(spec, sphere.range_steps, sphere.filled)
    region = region_on(spec, *click_of(theta_v, 1.0), 0.4, spec.width, spec.height)
    whole = [model.error(region, p) for p in (2, 4)]
    monkeypatch.setattr(range_model, "MANY_CELLS", 0)
    assert [model.error(region, p) for p in (2, 4)] == pytest.approx(whole, rel=0.1) and min(whole) > 1


def test_what_a_trial_surveyed_is_encoded(sphere: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, wanted = sphere.spec, RangeParameters(p=2, quantum=9)
    state = build_first_view(sphere, "htj2k", 32768).state
    near, far = (region_on(spec, *click_of(0.3, angle), 0.05, spec.width, spec.height) for angle in (1.0, 4.0))
    (afresh,) = reach_range(sphere, state, near, wanted, 20.0)
    elsewhere = reach_range(sphere, state, near, wanted, 20.0, trial=trial_of(sphere, state, far, 2))
    trial = trial_of(sphere, state, near, 2)
    monkeypatch.setattr(refine_range, "_surveyed", lambda *_: pytest.fail("surveyed again"))
    (coded,) = reach_range(sphere, state, near, wanted, 20.0, trial=trial)
    for one in (elsewhere[0], coded):
        assert (one.payload, one.mask, one.parameters) == (afresh.payload, afresh.mask, afresh.parameters)


def test_a_closed_object_is_sampled_as_far_apart_as_its_shape_allows(sphere: Scan) -> None:
    state = build_first_view(sphere, "htj2k", 32768).state
    known = RangeModel(sphere.spec, sphere.range_steps, sphere.filled)
    for v in (0.0, 0.1, 0.5):
        region = region_on(sphere.spec, 0.5, v, 0.05, sphere.spec.width, sphere.spec.height)
        chosen = [
            RangeSearch(sphere, state, Look(1, 0.5, v, range_mm=0.1), region, model, hurried, Encodes(lambda: False))
            .choose(20.0)
            .p
            for model, hurried in ((None, False), (known, False), (known, True))
        ]
        assert chosen[0] == chosen[1] > 1 and chosen[2] > 1


@pytest.mark.parametrize("counts", [[98, 1, 1], [990, 0, 10], [991, 0, 9], [0, 1], [3, 0, 2]])
def test_counted_values_have_the_percentile_that_they_have_one_by_one(counts: list[int]) -> None:
    values = np.repeat(np.arange(len(counts)), counts)
    assert percentile_of(np.array(counts)) == np.percentile(values, 99, method="higher")


def test_weighed_values_count_by_their_area() -> None:
    assert percentile_of(np.array([500.0, 400.0, 8.0])) == 1  # as near a pole, where a thousand samples have little
    assert percentile_of(np.zeros(3)) == percentile_of(np.zeros(0)) == 0
    assert percentile_of(np.array([0.0, 0.2])) == 1


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_values_are_counted_where_they_count(dtype: Any) -> None:
    rng = np.random.default_rng(3)
    values = np.asarray(rng.integers(0, 200, (40, 50)), dtype)
    counts = rng.random((40, 50)) < 0.7
    often = how_often(values, counts)
    np.testing.assert_array_equal(often, np.bincount(values[counts]))
    np.testing.assert_array_equal(how_often(values, counts, 255)[: often.size], often)
    assert how_often(values, np.zeros_like(counts)).sum() == 0
    assert how_often(values[:0], counts[:0]).sum() == 0


def test_what_is_known_of_the_range_spares_a_trial(scan: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    view, model = build_first_view(scan, "htj2k", 32768), RangeModel(scan.spec, scan.range_steps, scan.filled)
    region = region_round(0.62, 0.3, 0.05, scan.spec.width, scan.spec.height)
    tried: list[int] = []
    errors = _TrialPart.errors

    def noted(part: _TrialPart, quantum: int) -> Any:
        tried.append(quantum)
        return errors(part, quantum)

    monkeypatch.setattr(_TrialPart, "errors", noted)
    look = Look(1, 0.62, 0.3, range_mm=1.0)
    search = RangeSearch(scan, view.state, look, region, model, False, Encodes(lambda: False))
    found = search.choose(search.target_steps)
    assert tried and 1 not in tried
    trial = trial_of(scan, view.state, region, found.p)
    assert trial is not None and trial.error(found.quantum) <= search.target_steps
