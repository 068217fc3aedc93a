"""The closed specimen: the same stone at every size, rough and drawn on over its poles as elsewhere."""

from pathlib import Path

import numpy as np
import pytest

from exchange.closing import closes
from exchange.native import write_native
from protocol.sphere import DirectionGrid, vectors
from simulators.pebble import Pebble, pebble
from simulators.specimen import make_specimen


def test_a_sweep_sees_the_sides_of_what_is_known_whole() -> None:
    specimen = make_specimen("pebble", "S")
    assert specimen.closed is not None
    assert (specimen.grid.spec.geometry, specimen.closed.spec.geometry) == ("cylinder", "sphere")
    assert specimen.grid.range_steps.shape == specimen.closed.range_steps.shape == (100, 360)
    assert (specimen.closed.range_steps > 0).all() and not (specimen.grid.range_steps[[0, -1]] > 0).any()
    with pytest.raises(ValueError, match="read-only"):
        specimen.closed.range_steps[0, 0] = 1


def test_it_is_the_same_stone_at_every_size() -> None:
    coarse, fine = pebble((48, 24, 64, 32), 3), pebble((144, 72, 64, 32), 3)
    rows = slice(6, 18)  # where no ring is thinned
    np.testing.assert_array_equal(fine.range_steps[1::3, 1::3][rows], coarse.range_steps[rows])
    assert not np.array_equal(pebble((48, 24, 64, 32), 4).range_steps, coarse.range_steps)


def test_it_is_drawn_on_over_its_poles_as_elsewhere() -> None:
    grid, stone = DirectionGrid(90, 90), Pebble(0)
    near = vectors(grid.theta_v(np.linspace(0, 9, 40))[:, None], grid.theta_h(np.arange(90)))  # 20 degrees of a pole
    caps = [near, near * (1, 1, -1), near[..., [2, 0, 1]], -near[..., [1, 2, 0]]]
    drawing = [float(stone.colour(cap).std()) for cap in caps]
    relief = [float(np.diff(stone.radius_mm(cap), axis=0).std()) for cap in caps]
    assert min(drawing) > max(drawing) / 4 and min(drawing) > 8
    assert min(relief) > max(relief) / 3


def test_a_sweep_of_it_that_is_fine_enough_closes() -> None:
    assert closes(make_specimen("sphere", "S").grid)
    assert not closes(make_specimen("head", "S").grid)


def test_a_spherical_grid_from_a_file_is_seen_by_the_turntable_as_a_cylinder(tmp_path: Path) -> None:
    with open(tmp_path / "stone.npz", "wb") as file:
        write_native(pebble((48, 24, 64, 32), 0), file, "stone")
    specimen = make_specimen(tmp_path / "stone.npz")
    assert specimen.closed is not None and specimen.closed.spec.geometry == "sphere"
    assert (specimen.name, specimen.grid.spec.geometry) == ("stone", "cylinder")
    assert specimen.range_column(0.3).max() * specimen.grid.spec.step_mm == pytest.approx(60, abs=12)
