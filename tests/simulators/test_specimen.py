"""Specimens: truth by formula, truth by column, truth from a file."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from exchange.formats import SIZES
from protocol.errors import ConfigError
from protocol.grid import VOID, Grid, GridSpec
from simulators import shapes
from simulators.specimen import GENERATORS, Specimen, make_specimen


@cache
def made(name: str, size: str = "S") -> Grid:
    return make_specimen(name, size).grid


def tiny() -> Specimen:
    spec = GridSpec(8, 3, 16, 4, 0.01, 1.0, 0.0, 0.7)
    steps = np.arange(1, 25, dtype=np.uint16).reshape(3, 8) * 100
    steps[1, 3] = VOID
    texture = np.arange(4 * 16 * 3, dtype=np.uint8).reshape(4, 16, 3)
    return Specimen("tiny", Grid(spec, steps, texture))


@pytest.mark.parametrize("turns", [-1, 0, 3])
def test_nominal_angles_return_the_grid_exactly(turns: int) -> None:
    specimen = tiny()
    grid, spec = specimen.grid, specimen.grid.spec
    for column in range(spec.width):
        angle = float(spec.angle_rad(np.array(column))) + 2 * np.pi * turns
        assert np.array_equal(specimen.range_column(angle), grid.range_steps[:, column])
    for column in range(spec.texture_width):
        angle = spec.theta0_rad + 2 * np.pi * ((column + 0.5) / spec.texture_width + turns)
        assert np.array_equal(specimen.texture_column(angle), grid.texture[:, column])


def test_between_columns_the_range_is_interpolated_across_the_seam() -> None:
    specimen = tiny()
    seam = specimen.range_column(specimen.grid.spec.theta0_rad)
    assert np.array_equal(seam, [450, 1250, 2050])


@pytest.mark.parametrize(("offset", "expected"), [(2.4, 1100), (2.6, VOID), (3.4, VOID), (3.6, 1300)])
def test_beside_a_void_the_nearer_sample_decides(offset: float, expected: int) -> None:
    specimen = tiny()
    angle = float(specimen.grid.spec.angle_rad(np.array(offset)))
    assert specimen.range_column(angle)[1] == expected


@given(st.floats(-50, 50))
@settings(max_examples=50)
def test_any_angle_lies_between_its_neighbours(angle: float) -> None:
    specimen = tiny()
    low, high = specimen.grid.range_steps[0].min(), specimen.grid.range_steps[0].max()
    column = specimen.range_column(angle)
    assert column.dtype == np.uint16 and low <= column[0] <= high
    assert specimen.texture_column(angle).shape == (4, 3)


def test_the_truth_is_read_only() -> None:
    specimen = tiny()
    with pytest.raises(ValueError, match="read-only"):
        specimen.grid.range_steps[0, 0] = 1


@pytest.mark.parametrize("size", ["S", "M"])
def test_the_sphere_is_a_sphere(size: str) -> None:
    grid = made("sphere", size)
    z = grid.spec.height_mm(np.arange(grid.spec.height))
    radius = np.hypot(grid.range_mm, z[:, None])
    assert np.nanmax(np.abs(radius - shapes.SPHERE_RADIUS_MM)) < grid.spec.step_mm
    assert np.array_equal(np.isnan(grid.range_mm[:, 0]), np.abs(z) > shapes.SPHERE_RADIUS_MM)


def test_the_cylinder_is_a_cylinder() -> None:
    grid = made("cylinder")
    assert np.allclose(grid.range_mm, shapes.CYLINDER_RADIUS_MM, atol=grid.spec.step_mm / 2)


@pytest.mark.parametrize("name", GENERATORS)
def test_every_specimen_has_the_named_shape_and_repeats_with_its_seed(name: str) -> None:
    one, two, other = made(name), make_specimen(name, "S").grid, make_specimen(name, "S", seed=2).grid
    spec = one.spec
    assert (spec.width, spec.height, spec.texture_width, spec.texture_height) == SIZES["S"]
    assert np.array_equal(one.range_steps, two.range_steps) and np.array_equal(one.texture, two.texture)
    assert not np.array_equal(one.texture, other.texture)


@pytest.mark.parametrize("name", GENERATORS)
def test_every_specimen_joins_at_the_seam(name: str) -> None:
    grid = made(name)
    for samples in (grid.range_steps.astype(np.int64), grid.texture.astype(np.int64)):
        steps = np.abs(np.diff(np.concatenate([samples, samples[:, :1]], axis=1), axis=1)).mean(axis=0)
        assert steps[-1].max() <= 3 * steps.mean() + 1


@pytest.mark.parametrize("name", GENERATORS)
def test_every_size_shows_the_same_object(name: str) -> None:
    small, large = made(name), made(name, "M")
    inner = large.range_mm[5::10, 2::4][:100]
    near = small.range_mm[: len(inner)]
    assert np.nanmedian(np.abs(inner - near)) < 1.0


@pytest.mark.parametrize(("name", "size", "message"), [("teapot", "S", "teapot"), ("sphere", "XL", "XL")])
def test_unknown_names_and_sizes_are_refused(name: str, size: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_specimen(name, size)
