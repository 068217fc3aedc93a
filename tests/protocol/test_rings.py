"""Thinned rings: how dense they are, and that thinning twice is thinning once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.grid import VOID, Grid, GridSpec, StepArray
from protocol.rings import ring_strides, thin_grid, thin_rings, thin_texture, widened


def rough(height: int, width: int, seed: int, voids: float = 0.0) -> StepArray:
    random = np.random.default_rng(seed)
    steps = random.integers(1, 65535, (height, width)).astype(np.uint16)
    steps[random.random(steps.shape) < voids] = VOID
    return steps


@given(
    st.integers(1, 60).map(lambda n: 8 * n), st.integers(1, 300), st.sampled_from([8, 16]),
    st.sampled_from([2, 4, 8, 16]),
)  # fmt: skip
def test_rings_are_about_as_dense_as_the_equator(width: int, height: int, side: int, half_spacing: int) -> None:
    stride = ring_strides(width, height, side, half_spacing)
    sine = np.sin(np.pi * (np.arange(height) + 0.5) / height)
    widest = np.maximum.reduceat(sine, np.arange(0, height, side))
    assert (stride * widest <= np.sqrt(2) + 1e-6)[stride > 1].all()
    assert (width % stride == 0).all() and (2 * width // stride[stride > 1] % half_spacing == 0).all()
    could_double = (stride < side) & (width % (2 * stride) == 0) & (width // stride % half_spacing == 0)
    assert (2 * stride * widest > np.sqrt(2) - 1e-6)[could_double].all()


def test_a_width_that_nothing_divides_is_not_thinned() -> None:
    assert (ring_strides(99, 40) == 1).all()


@given(st.integers(0, 99), st.sampled_from([0.0, 0.2]))
def test_thinning_twice_is_thinning_once(seed: int, voids: float) -> None:
    steps = thin_rings(rough(56, 96, seed, voids))
    np.testing.assert_array_equal(thin_rings(steps), steps)
    assert steps.any()


@given(st.integers(0, 99))
def test_thinning_keeps_own_samples_and_every_row_of_the_middle(seed: int) -> None:
    steps = rough(120, 96, seed)
    thinned, stride = thin_rings(steps), np.repeat(ring_strides(96, 120), 8)
    for row in range(120):
        np.testing.assert_array_equal(thinned[row, :: stride[row]], steps[row, :: stride[row]])
    assert set(stride.tolist()) == {1, 2, 4}


def test_a_ring_interpolates_round_the_seam_and_voids_spread() -> None:
    steps = np.full((184, 96), 1000, np.uint16)
    steps[0, 88], steps[0, 0] = 100, 201
    thinned = thin_rings(steps)
    assert ring_strides(96, 184)[0] == 8
    assert thinned[0, 88:].tolist() == [100, 113, 125, 138, 151, 163, 176, 188]
    steps[0, 88] = VOID
    assert not thin_rings(steps)[0, 81:96].any()
    assert thin_rings(steps)[0, 80] == 1000 and thin_rings(steps)[0, 0] == 201


@given(st.integers(1, 65535), st.integers(1, 65535), st.sampled_from([2, 4, 8, 16]), st.integers(0, 15))
def test_a_cell_between_two_is_their_mean_by_place(a: int, b: int, stride: int, k: int) -> None:
    k %= stride
    cells = widened(np.array([[a, b]], np.uint16), stride)
    assert cells.shape == (1, stride)
    assert cells[0, k] == (2 * (a * (stride - k) + b * k) + stride) // (2 * stride)


def test_both_grids_of_a_sphere_are_thinned_a_cylinder_of_one_row_is_not() -> None:
    spec = GridSpec(96, 184, 96, 184, 0.01, 1.0, geometry="sphere")
    texture = np.random.default_rng(1).integers(0, 256, (184, 96, 3)).astype(np.uint8)
    grid = thin_grid(Grid(spec, rough(184, 96, 1), texture))
    again = thin_grid(grid)
    np.testing.assert_array_equal(again.range_steps, grid.range_steps)
    np.testing.assert_array_equal(again.texture, grid.texture)
    np.testing.assert_array_equal(grid.texture, thin_texture(texture))
    assert not np.array_equal(grid.texture, texture)


@pytest.mark.parametrize("stride", [1, 4])
def test_widening_texture_stays_between_its_ends(stride: int) -> None:
    texels = np.random.default_rng(2).integers(0, 256, (3, 6, 3)).astype(np.uint8)
    wide = widened(texels, stride)
    if stride == 1:
        assert wide is texels
        return
    assert wide.shape == (3, 20, 3)
    low, high = np.minimum(texels[:, :-1], texels[:, 1:]), np.maximum(texels[:, :-1], texels[:, 1:])
    assert (wide >= low.repeat(4, axis=1)).all() and (wide <= high.repeat(4, axis=1)).all()
