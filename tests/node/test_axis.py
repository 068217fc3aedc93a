import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from node.axis import LEAN_MAX_RAD, OFFSET_MAX_MM, Axis, seen_to_true, true_height, true_to_seen

offsets = st.floats(-20, 20)
leans = st.floats(-LEAN_MAX_RAD, LEAN_MAX_RAD)
axes = st.builds(Axis, offsets, offsets, leans, leans, st.floats(-200, 200))
ranges = st.lists(st.floats(60, 400), min_size=1, max_size=8).map(np.array)
heights = st.floats(-100, 100)


@given(axes, ranges, heights)
def test_seen_and_true_are_inverse(axis: Axis, range_mm: np.ndarray, height_mm: float) -> None:
    row_mm = np.full_like(range_mm, height_mm)
    radius_mm, ahead_rad, z_mm = seen_to_true(axis, range_mm, row_mm)
    again_mm, ahead_again_rad, row_again_mm = true_to_seen(axis, radius_mm, z_mm)
    assert np.abs(again_mm - range_mm).max() < 1e-9 and np.abs(row_again_mm - row_mm).max() < 1e-9
    assert np.abs(ahead_again_rad - ahead_rad).max() < 1e-9


@given(axes, ranges, heights)
def test_row_and_distance_tell_the_height(axis: Axis, range_mm: np.ndarray, height_mm: float) -> None:
    row_mm = np.full_like(range_mm, height_mm)
    radius_mm, _, z_mm = seen_to_true(axis, range_mm, row_mm)
    assert np.abs(true_height(axis, radius_mm, row_mm) - z_mm).max() < 1e-9


@given(ranges, heights)
def test_an_axis_that_is_where_it_should_be_changes_nothing(range_mm: np.ndarray, height_mm: float) -> None:
    radius_mm, ahead_rad, z_mm = seen_to_true(Axis(0, 0), range_mm, np.full_like(range_mm, height_mm))
    assert np.array_equal(radius_mm, range_mm) and not ahead_rad.any() and (z_mm == height_mm).all()


@given(axes, ranges, heights, st.floats(-math.pi, math.pi))
def test_distances_between_points_are_those_of_the_sensors_frame(
    axis: Axis, range_mm: np.ndarray, height_mm: float, theta: float
) -> None:
    """The model turns and shifts, nothing else: two samples of one column are as far apart as their ranges."""
    far_mm, row_mm = range_mm + 10, np.full_like(range_mm, height_mm)
    places = []
    for mm in (range_mm, far_mm):
        radius_mm, ahead_rad, z_mm = seen_to_true(axis, mm, row_mm)
        angle = theta + ahead_rad
        places.append(np.stack([radius_mm * np.cos(angle), radius_mm * np.sin(angle), z_mm]))
    assert np.allclose(np.linalg.norm(places[1] - places[0], axis=0), 10, atol=1e-9)


def test_offsets_do_what_they_say() -> None:
    radius_mm, ahead_rad, _ = seen_to_true(Axis(3.0, 1.0), np.array([3.0]), np.array([0.0]))
    assert radius_mm[0] == pytest.approx(5.0) and ahead_rad[0] == pytest.approx(math.atan2(3, 4))
    leaning = Axis(1.0, 2.0, 0.01, 0.02, height_mm=10.0)
    for above_mm in (0.0, 50.0):
        radius_mm, ahead_rad, _ = seen_to_true(leaning, np.array([70.0]), np.array([10.0 + above_mm]))
        assert radius_mm[0] * math.cos(ahead_rad[0]) == pytest.approx(72 + 0.01 * above_mm, abs=0.02)
        assert radius_mm[0] * math.sin(ahead_rad[0]) == pytest.approx(1 + 0.02 * above_mm, abs=0.02)


def test_a_point_nearer_to_the_axis_than_the_line_of_sight_is_not_seen() -> None:
    range_mm, _, _ = true_to_seen(Axis(3.0, 0.0), np.array([2.0, 5.0]), np.array([0.0, 0.0]))
    assert np.isnan(range_mm).tolist() == [True, False]


@pytest.mark.parametrize(
    "values", [(math.nan, 0), (0, math.inf), (OFFSET_MAX_MM * 1.1, 0), (0, 0, 2 * LEAN_MAX_RAD), (0, 0, 0, 0, 2e6)]
)
def test_what_no_axis_can_be_is_refused(values: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="must be between"):
        Axis(*values)
