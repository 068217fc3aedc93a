"""The dense model from the first view alone, against closed forms in fractions."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LatticeError
from protocol.grid import StepArray
from protocol.lattice import Channel, ChannelShape
from protocol.reconstruct import coarse_to_range, coarse_to_texture
from tests.protocol.lattice_cases import shapes

S_RANGE = ChannelShape(Channel.RANGE, 360, 100, 20, 10)


def coarse_cell(coarse: StepArray, row: int, column: int, height: int, width: int) -> int:
    """One dense cell of the first view, in fractions."""
    h, w = coarse.shape
    y, x = (
        Fraction(2 * row + 1, 2 * height) * h - Fraction(1, 2),
        Fraction(2 * column + 1, 2 * width) * w - Fraction(1, 2),
    )
    y0, x0 = y.numerator // y.denominator, x.numerator // x.denominator
    nearest = y0 + (y - y0 >= Fraction(1, 2)), x0 + (x - x0 >= Fraction(1, 2))

    def value(i: int, j: int) -> int:
        return int(coarse[min(max(i, 0), h - 1), j % w])

    if value(*nearest) == 0:
        return 0
    total = weight = Fraction(0)
    for i, wy in ((y0, 1 - y + y0), (y0 + 1, y - y0)):
        for j, wx in ((x0, 1 - x + x0), (x0 + 1, x - x0)):
            if value(i, j):
                total, weight = total + wy * wx * value(i, j), weight + wy * wx
    mean = total / weight + Fraction(1, 2)
    return mean.numerator // mean.denominator


@given(shapes(Channel.RANGE), st.integers(0, 2**32), st.sampled_from((0.0, 0.3, 0.9)))
def test_the_first_view_equals_the_closed_form(shape: ChannelShape, seed: int, voids: float) -> None:
    rng = np.random.default_rng(seed)
    coarse = rng.integers(1, 65536, (shape.coarse_height, shape.coarse_width), dtype=np.uint16)
    coarse[rng.random(coarse.shape) < voids] = 0
    dense = coarse_to_range(coarse, shape)
    for row in range(shape.height):
        for column in range(shape.width):
            assert dense[row, column] == coarse_cell(coarse, row, column, shape.height, shape.width)


def with_whole_spacing(shape: ChannelShape) -> ChannelShape:
    """The same with as many columns to a coarse one everywhere."""
    return replace(shape, width=shape.width // shape.coarse_width * shape.coarse_width)


@given(shapes(Channel.RANGE).map(with_whole_spacing), st.integers(0, 2**32))
def test_the_first_view_rolls_with_whole_coarse_cells(shape: ChannelShape, seed: int) -> None:
    size = shape.coarse_height, shape.coarse_width
    coarse = np.random.default_rng(seed).integers(1, 65536, size, dtype=np.uint16)
    there = coarse_to_range(np.roll(coarse, 1, axis=1), shape)
    assert np.array_equal(there, np.roll(coarse_to_range(coarse, shape), shape.width // shape.coarse_width, axis=1))


@given(shapes(Channel.TEXTURE), st.integers(0, 2**32))
def test_the_first_texture_is_near_the_closed_form(shape: ChannelShape, seed: int) -> None:
    coarse = np.random.default_rng(seed).integers(0, 256, (shape.coarse_height, shape.coarse_width, 3), dtype=np.uint8)
    dense = coarse_to_texture(coarse, shape)
    steps = coarse_to_range(coarse[..., 0].astype(np.uint16) + 1, shape).astype(int) - 1
    assert dense.shape == (shape.height, shape.width, 3) and dense.dtype == np.uint8
    assert np.abs(dense[..., 0] - steps).max() <= 2


def test_a_first_view_of_another_shape_is_refused() -> None:
    with pytest.raises(LatticeError):
        coarse_to_range(np.zeros((20, 10), np.uint16), S_RANGE)
    with pytest.raises(LatticeError):
        coarse_to_texture(np.zeros((10, 20), np.uint8), ChannelShape(Channel.TEXTURE, 64, 64, 20, 10))
