import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from protocol.bilinear import (
    BAND_ROWS,
    among_samples,
    between,
    blend,
    blend_colour,
    steps_with_holes,
    whole_steps,
    wrapped,
)

POSITIONS = st.lists(st.floats(0, 6), min_size=1, max_size=8).map(np.array)
SAMPLES = st.integers(0, 2**32 - 1).map(lambda seed: np.random.default_rng(seed).uniform(1, 65535, (7, 7)))


@given(SAMPLES, POSITIONS, POSITIONS)
def test_values_lie_between_their_corners(samples: np.ndarray, y: np.ndarray, x: np.ndarray) -> None:
    found = blend(samples, among_samples(y), among_samples(x))
    for row, at_y in enumerate(y):
        for column, at_x in enumerate(x):
            corners = samples[int(at_y) : int(np.ceil(at_y)) + 1, int(at_x) : int(np.ceil(at_x)) + 1]
            assert corners.min() - 1e-6 <= found[row, column] <= corners.max() + 1e-6


@given(SAMPLES)
def test_whole_positions_are_exact(samples: np.ndarray) -> None:
    every = among_samples(np.arange(7.0))
    np.testing.assert_array_equal(blend(samples, every, every), samples)


@given(POSITIONS, POSITIONS, st.floats(-9, 9), st.floats(-9, 9))
def test_planes_stay_planes(y: np.ndarray, x: np.ndarray, down: float, across: float) -> None:
    plane = np.add.outer(down * np.arange(7), across * np.arange(7))
    found = blend(plane, among_samples(y), among_samples(x))
    np.testing.assert_allclose(found, np.add.outer(down * y, across * x), atol=1e-9)


@given(st.lists(st.floats(0, 50), min_size=2, max_size=9, unique=True).map(sorted), st.lists(st.floats(-5, 60)))
def test_uneven_samples_interpolate_like_numpy(at: list[float], position: list[float]) -> None:
    values = np.linspace(3, 90, len(at))
    place = between(np.array(at), np.array(position))
    found = values[place.low] * (1 - place.part) + values[place.high] * place.part
    np.testing.assert_allclose(found, np.interp(position, at, values), atol=1e-6)
    assert (place.high[place.part == 0] == place.low[place.part == 0]).all()


def test_the_seam_lies_between_the_last_and_the_first_column() -> None:
    row = np.array([[10.0, 20, 30, 50]])
    x = wrapped(among_samples(np.array([3.25, -0.5, 7.0])), 4)
    np.testing.assert_array_equal(blend(row, among_samples(np.zeros(1)), x), [[40.0, 30.0, 50.0]])


def test_a_hole_counts_only_where_it_has_weight() -> None:
    steps = np.array([[100, 0, 300], [100, 200, 300]], np.uint16)
    y, x = among_samples(np.array([0, 0.5, 1])), among_samples(np.array([0, 0.5, 1, 1.5, 2]))
    void = whole_steps(blend(steps_with_holes(steps), y, x)) == 0
    np.testing.assert_array_equal(void, [[0, 1, 1, 1, 0], [0, 1, 1, 1, 0], [0, 0, 0, 0, 0]])


def test_bands_do_not_show() -> None:
    texels = np.random.default_rng(1).integers(0, 256, (20, 3, 3)).astype(np.uint8)
    y = among_samples(np.linspace(0, 19, 2 * BAND_ROWS + 7))
    x = among_samples(np.array([0.3, 1.9]))
    whole = np.rint(blend(texels, y, x, np.float32)).astype(np.uint8)
    np.testing.assert_array_equal(blend_colour(texels, y, x), whole)
