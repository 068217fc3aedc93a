"""What is known of range before any trial."""

from pathlib import Path

import numpy as np
import pytest

from node.first_view import build_first_view
from node.library import Scan
from node.quality import Encodes
from node.range_model import SPACINGS, RangeModel
from node.range_search import RangeSearch
from node.refine_range import trial_of
from protocol.grid import Grid, GridSpec
from protocol.messages import Look
from protocol.region import region_round
from protocol.sphere import region_on
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


def test_a_closed_object_is_sampled_as_far_apart_as_its_shape_allows(tmp_path: Path) -> None:
    """Of a sphere nothing is known beforehand, so every spacing is tried."""
    grid = make_grid(voids=False)
    spec = GridSpec(160, 96, 640, 384, 0.02, 2.0, 0.0, geometry="sphere")
    row = np.linspace(-1, 1, 96)[:, None]
    steps = np.rint((60 + 5 * np.cos(row) + np.zeros(160)) / spec.step_mm).astype(np.uint16)
    sphere = keep(Grid(spec, steps, grid.texture), tmp_path)
    state = build_first_view(sphere, "htj2k", 32768).state
    region = region_on(spec, 0.5, 0.5, 0.05, spec.width, spec.height)
    look = Look(1, 0.5, 0.5, range_mm=0.1)
    known = RangeModel(spec, sphere.range_steps, sphere.filled)
    for hurried in (False, True):
        search = RangeSearch(sphere, state, look, region, known, hurried, Encodes(lambda: False))
        assert search.choose(search.target_steps).p > 1
