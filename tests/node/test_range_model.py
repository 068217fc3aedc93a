"""What is known of range before any trial."""

import numpy as np
import pytest

from node.first_view import build_first_view
from node.library import Scan
from node.range_model import SPACINGS, RangeModel
from node.refine_range import trial_of
from protocol.region import region_round
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
