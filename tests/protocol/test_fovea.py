import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from protocol.errors import LatticeError
from protocol.fovea import (
    RINGS_MAX,
    cartesian_to_view,
    clip_ring,
    cyclic_offset,
    cyclic_positions,
    cylinder_to_view,
    finest_scale,
    fovea_table,
    open_positions,
    radius_to_view,
    scale_from_extent,
    scale_from_sigma,
    spacing_at,
    view_to_cartesian,
    view_to_radius,
)

ALPHA = st.floats(0.005, 4)
S = st.floats(0.05, 200)
RADIUS = st.floats(0, 20000)


@given(RADIUS, ALPHA, S)
def test_view_and_radius_are_inverse(radius: float, alpha: float, s: float) -> None:
    back = view_to_radius(radius_to_view(np.array([radius]), alpha, s), alpha, s)[0]
    assert math.isclose(back, radius, rel_tol=1e-9, abs_tol=1e-12)
    assert math.isclose(view_to_radius(np.array([radius]), 0, s)[0] * s, radius, rel_tol=1e-12, abs_tol=1e-300)


@given(st.floats(1, 20000), st.floats(1, 20000), ALPHA)
def test_the_scale_maps_one_extent_onto_the_other(view_max: float, radius_max: float, alpha: float) -> None:
    s = scale_from_extent(view_max, radius_max, alpha)
    assert math.isclose(radius_to_view(np.array([radius_max]), alpha, s)[0], view_max, rel_tol=1e-12)
    assert radius_to_view(np.array([0.0]), alpha, s)[0] == 0


@given(ALPHA, S)
def test_the_transform_is_increasing_and_concave(alpha: float, s: float) -> None:
    view = radius_to_view(np.arange(0, 200, dtype=np.float64), alpha, s)
    assert np.all(np.diff(view) > 0) and np.all(np.diff(view, 2) < 1e-9)


@given(ALPHA, st.floats(0.5, 20))
def test_neighbouring_spacings_grow_by_one_ratio(alpha: float, s: float) -> None:
    spacing = np.diff(view_to_radius(np.arange(10, dtype=np.float64), alpha, s))
    assert np.allclose(spacing[1:] / spacing[:-1], math.exp(1 / s), rtol=1e-9)


@given(RADIUS, ALPHA, S)
def test_the_local_spacing_is_the_slope_of_the_inverse(radius: float, alpha: float, s: float) -> None:
    view = radius_to_view(np.array([radius]), alpha, s)
    slope = (view_to_radius(view + 1e-5, alpha, s) - view_to_radius(np.maximum(view - 1e-5, 0), alpha, s))[0]
    step = 1e-5 + min(view[0], 1e-5)
    assert math.isclose(slope / step, spacing_at(np.array([radius]), alpha, s)[0], rel_tol=1e-2)


def test_a_vanishing_alpha_is_uniform_sampling() -> None:
    radius = np.linspace(0, 100, 11)
    assert np.allclose(radius_to_view(radius, 1e-9, 3 / 1e-9), radius_to_view(radius, 0, 3), rtol=1e-6)
    assert np.allclose(spacing_at(radius, 0, 3), 1 / 3)


@given(st.lists(st.floats(-1000, 1000), min_size=1, max_size=20), st.floats(-500, 500), ALPHA, st.floats(0.5, 50))
def test_an_open_axis_is_odd_round_its_fovea_and_returns(x: list[float], fovea: float, alpha: float, s: float) -> None:
    position = np.array(sorted(x))
    view = cartesian_to_view(position, fovea, alpha, s)
    assert np.all(np.diff(view) >= 0)
    assert np.allclose(view_to_cartesian(view, fovea, alpha, s), position, atol=1e-6)
    assert np.allclose(cartesian_to_view(2 * fovea - position, fovea, alpha, s), 2 * fovea - view, atol=1e-6)
    assert cartesian_to_view(np.array([fovea]), fovea, alpha, s)[0] == fovea


@example(0.0, 180.00000000000003, 360)
@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), st.integers(1, 16384))
def test_offsets_stay_within_half_a_turn(x: float, fovea: float, width: int) -> None:
    offset = cyclic_offset(np.array([x]), fovea, width)[0]
    assert -width / 2 <= offset < width / 2
    assert math.isclose(math.remainder(x - fovea - offset, width), 0, abs_tol=1e-6)


@given(st.integers(2, 400), st.integers(0, 400), ALPHA, st.floats(0.02, 1))
def test_the_cylinder_is_the_same_wherever_the_fovea_is(width: int, fovea: int, alpha: float, sigma: float) -> None:
    x = np.arange(width, dtype=np.float64)
    at_nought, there = (cylinder_to_view(x, f, width, alpha, sigma) for f in (0, fovea))
    difference = np.roll(at_nought, fovea % width) + fovea - there
    assert np.allclose(np.remainder(difference + width / 2, width), width / 2, atol=1e-6)
    assert np.all((there >= 0) & (there < width))


@given(st.integers(1, 200), ALPHA, st.floats(0.02, 1))
def test_the_antipode_reaches_the_kept_share(half: int, alpha: float, sigma: float) -> None:
    view = cylinder_to_view(np.array([half], np.float64), 0.0, 2 * half, alpha, sigma)[0]
    assert math.isclose(min(view, 2 * half - view), sigma * half, rel_tol=1e-9)


def test_the_papers_setting_gives_one_sample_a_column() -> None:
    s = scale_from_sigma(0.05, 180, 0.5)
    assert round(s, 3) == 1.995 and round(s * 0.5, 3) == 0.998
    assert [round(finest_scale(alpha), 3) for alpha in (0.5, 0.1, 0.05)] == [2.466, 10.492, 20.496]


@given(ALPHA)
def test_the_finest_scale_starts_with_a_whole_sample(alpha: float) -> None:
    first = view_to_radius(np.array([1.0]), alpha, finest_scale(alpha))[0]
    assert math.isclose(first, 1, rel_tol=1e-9)


@given(ALPHA, st.floats(0.3, 200), st.floats(0.5, 64))
def test_the_clip_equals_the_brute_force(alpha: float, s: float, coarse: float) -> None:
    last = clip_ring(alpha, s, coarse)
    assume(last < 20000)

    def ring(k: int) -> float:
        return math.expm1(k / s) / alpha

    if last:
        assert ring(last) - ring(last - 1) <= coarse * (1 + 1e-9)
    assert ring(last + 1) - ring(last) > coarse * (1 - 1e-9)


@pytest.mark.parametrize(("alpha", "s", "samples"), [(0.5, 1.995, 143), (0.5, finest_scale(0.5), 221)])
def test_the_papers_patch_has_so_many_samples(alpha: float, s: float, samples: int) -> None:
    count = [2 * clip_ring(alpha, s, coarse) + 1 for coarse in (18, 10)]
    assert count[0] * count[1] == samples


@given(ALPHA, st.floats(0.3, 60), st.integers(1, 40), st.integers(4, 720))
def test_tables_equal_direct_evaluation(alpha: float, s: float, coarse: int, width: int) -> None:
    assume(clip_ring(alpha, s, coarse) <= RINGS_MAX)
    table = fovea_table(alpha, s, float(coarse), width / 2)
    k = np.arange(table.offset.size)
    direct = np.minimum(np.expm1(k / s) / alpha, width / 2)
    assert np.allclose(table.offset, direct, rtol=1e-9)
    assert np.array_equal(table.snapped, np.rint(table.offset))
    assert np.allclose(table.spacing, (1 + alpha * direct) / (s * alpha))
    assert not table.offset.flags.writeable
    assert table.offset.nbytes + table.snapped.nbytes + table.spacing.nbytes <= 65536


@given(ALPHA, st.floats(0.3, 60), st.integers(1, 40), st.integers(4, 720), st.integers(0, 719))
def test_no_column_comes_twice_and_no_row_leaves(alpha: float, s: float, coarse: int, width: int, fovea: int) -> None:
    table = fovea_table(alpha, s, float(coarse), width / 2)
    x = cyclic_positions(table, fovea, width)
    assert np.all(np.diff(x) > 0) and x[-1] - x[0] < width and fovea in x
    y = open_positions(table, fovea % 100, 100)
    assert np.all((y >= 0) & (y <= 99)) and np.all(np.diff(y) > 0) and fovea % 100 in y


def test_a_table_without_end_is_refused() -> None:
    with pytest.raises(LatticeError):
        fovea_table(1e-6, 1e12, 18.0, 1e9)


BAD: list[Callable[[], object]] = [
    lambda: radius_to_view(np.array([-1.0]), 1, 1),
    lambda: radius_to_view(np.array([math.nan]), 1, 1),
    lambda: radius_to_view(np.array([1.0]), -1, 1),
    lambda: radius_to_view(np.array([1.0]), math.nan, 1),
    lambda: radius_to_view(np.array([1.0]), 1, 0),
    lambda: view_to_radius(np.array([1e6]), 1, 1),
    lambda: view_to_radius(np.array([1.0]), 1, math.inf),
    lambda: scale_from_extent(0, 1, 1),
    lambda: scale_from_extent(1, 1, math.nan),
    lambda: scale_from_sigma(0, 180, 0.5),
    lambda: scale_from_sigma(1.1, 180, 0.5),
    lambda: finest_scale(0),
    lambda: finest_scale(math.nan),
    lambda: clip_ring(0, 1, 18),
]


@pytest.mark.parametrize("call", BAD, ids=range(len(BAD)))
def test_what_describes_no_transform_is_refused(call: Callable[[], object]) -> None:
    with pytest.raises(LatticeError):
        call()
