import math
from dataclasses import replace
from fractions import Fraction
from math import lcm

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from node.coarse import (
    average_range,
    average_texture,
    build_coarse,
    build_pyramid,
    coarse_shape,
    evened,
    fill_voids,
)
from protocol.grid import VOID, BoolArray, Grid, GridSpec, StepArray

SIZES = {"S": (100, 360, 256, 1024), "M": (1024, 1440, 2048, 4096), "L": (2048, 4096, 4096, 8192)}


def _spec(height: int, width: int, texture_height: int, texture_width: int) -> GridSpec:
    return GridSpec(width, height, texture_width, texture_height, step_mm=0.05, pitch_mm=1.0)


def _random_grid(spec: GridSpec, seed: int, void_share: float = 0.3) -> Grid:
    """Samples with voids in patches, since single void samples are not what scanners leave."""
    rng = np.random.default_rng(seed)
    range_steps = rng.integers(1, 65536, (spec.height, spec.width)).astype(np.uint16)
    patches = rng.random((-(-spec.height // 6), -(-spec.width // 6))) < void_share
    range_steps[np.kron(patches, np.ones((6, 6), bool))[: spec.height, : spec.width]] = 0
    texture = rng.integers(0, 256, (spec.texture_height, spec.texture_width, 3)).astype(np.uint8)
    return Grid(spec, range_steps, texture)


def _share(sample: int, size: int, cell: int, cells: int) -> Fraction:
    """How much of a sample lies in a cell."""
    low, high = Fraction(cell * size, cells), Fraction((cell + 1) * size, cells)
    return max(Fraction(0), min(high, Fraction(sample + 1)) - max(low, Fraction(sample)))


def _mean_by_fractions(
    samples: StepArray, measured: BoolArray, cell: tuple[int, int], shape: tuple[int, int]
) -> list[Fraction]:
    """Sum and area of the measured samples in one cell."""
    total = area = Fraction(0)
    for row, column in np.argwhere(measured):
        part = _share(row, samples.shape[0], cell[0], shape[0]) * _share(column, samples.shape[1], cell[1], shape[1])
        total, area = total + part * int(samples[row, column]), area + part
    return [total, area]


def _round_half_up(value: Fraction) -> int:
    return (2 * value.numerator + value.denominator) // (2 * value.denominator)


@given(st.data())
def test_range_cells_are_rounded_area_means_of_what_was_measured(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 7)), data.draw(st.integers(1, 9))
    rows, columns = data.draw(st.integers(1, height)), data.draw(st.integers(1, width))
    samples = data.draw(arrays(np.uint16, (height, width), elements=st.sampled_from([0, 1, 2, 999, 65534, 65535])))
    means = average_range(samples, rows, columns)
    for cell in np.ndindex(rows, columns):
        total, area = _mean_by_fractions(samples, samples > 0, cell, (rows, columns))
        mostly_void = 2 * area < Fraction(height * width, rows * columns)
        assert means[cell] == (0 if mostly_void else _round_half_up(total / area))


@given(st.data())
def test_texture_cells_average_texels_over_measured_cells_where_there_are_any(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 6)), data.draw(st.integers(1, 7))
    rows, columns = data.draw(st.integers(1, height)), data.draw(st.integers(1, width))
    texture = data.draw(arrays(np.uint8, (height, width, 3), elements=st.sampled_from([0, 1, 128, 255])))
    measured = data.draw(arrays(np.bool_, (data.draw(st.integers(1, 4)), data.draw(st.integers(1, 5)))))
    texel_row = [int((r + Fraction(1, 2)) * measured.shape[0] / height) for r in range(height)]
    texel_column = [int((c + Fraction(1, 2)) * measured.shape[1] / width) for c in range(width)]
    texel_measured = measured[np.ix_(texel_row, texel_column)]
    means = average_texture(texture, measured, rows, columns)
    for *cell, channel in np.ndindex(rows, columns, 3):
        plane = texture[..., channel].astype(np.uint16)
        at = (cell[0], cell[1])
        total, area = _mean_by_fractions(plane, texel_measured, at, (rows, columns))
        if area == 0:
            total, area = _mean_by_fractions(plane, np.ones_like(texel_measured), at, (rows, columns))
        assert means[(*at, channel)] == _round_half_up(total / area)


def test_sums_stay_exact_at_the_largest_values() -> None:
    assert (average_range(np.full((16384, 40), 65535, np.uint16), 3, 7) == 65535).all()
    assert (average_texture(np.full((16384, 40, 3), 255, np.uint8), np.ones((5, 5), bool), 3, 7) == 255).all()


@pytest.mark.parametrize(
    ("size", "range_shape", "texture_shape"),
    [("S", (13, 45), (64, 256)), ("M", (64, 90), (128, 256)), ("L", (64, 128), (128, 256))],
)
def test_coarse_shapes_of_the_benchmark_sizes(
    size: str, range_shape: tuple[int, int], texture_shape: tuple[int, int]
) -> None:
    height, width, texture_height, texture_width = SIZES[size]
    assert coarse_shape(height, width, 8, 8192) == range_shape
    assert coarse_shape(texture_height, texture_width, 4, 32768) == texture_shape


@given(st.integers(1, 16384), st.integers(1, 16384), st.sampled_from([4, 8]), st.integers(1, 40000))
def test_coarse_shape_is_the_finest_that_fits(height: int, width: int, spacing_min: int, cells_max: int) -> None:
    rows, columns = coarse_shape(height, width, spacing_min, cells_max)
    assert 1 <= rows <= height and 1 <= columns <= width and rows * columns <= cells_max
    fits = [-(-height // p) * -(-width // p) <= cells_max for p in (spacing_min << k for k in range(16))]
    spacing = spacing_min << fits.index(True)
    assert (rows, columns) == (-(-height // spacing), -(-width // spacing))


def test_a_first_view_without_room_for_one_cell_is_refused() -> None:
    with pytest.raises(ValueError, match="at least one cell"):
        build_coarse(_random_grid(_spec(10, 16, 10, 16), 0), first_view_bytes=3)


@pytest.mark.parametrize("turns", [1, 2, 4])
def test_rolling_the_scan_rolls_its_coarse_grid_and_its_filled_range(turns: int) -> None:
    spec = _spec(*SIZES["S"])
    grid = _random_grid(spec, seed=turns)
    coarse = build_coarse(grid)
    spacing = coarse.range_spacing[0]
    k = turns * lcm(72, spacing.numerator)  # 72 columns are no whole number of texels here, so range only
    rolled = build_coarse(Grid(spec, np.roll(grid.range_steps, k, axis=1), grid.texture))
    assert np.array_equal(rolled.range_steps, np.roll(coarse.range_steps, int(k / spacing), axis=1))
    assert np.array_equal(rolled.filled, np.roll(coarse.filled, int(k / spacing), axis=1))
    filled = fill_voids(grid.range_steps)
    assert np.array_equal(fill_voids(np.roll(grid.range_steps, k, axis=1)), np.roll(filled, k, axis=1))


def test_rolling_by_whole_texels_rolls_the_coarse_texture_too() -> None:
    spec = _spec(*SIZES["S"])
    grid = _random_grid(spec, seed=9)
    coarse, k, texels = build_coarse(grid), 360 // 8, 1024 // 8
    rolled = Grid(spec, np.roll(grid.range_steps, k, axis=1), np.roll(grid.texture, texels, axis=1))
    expected = np.roll(coarse.texture, int(texels / coarse.texture_spacing[0]), axis=1)
    assert np.array_equal(build_coarse(rolled).texture, expected)


@given(st.integers(0, 2), st.integers(0, 2**32 - 1))
def test_rolling_by_whole_coarse_cells_of_fractional_spacing_is_exact(turns: int, seed: int) -> None:
    grid = _random_grid(_spec(11, 264, 4, 16), seed)  # 264/9 = 88/3: three coarse cells are 88 columns
    rolled = average_range(np.roll(grid.range_steps, 88 * turns, axis=1), 2, 9)
    assert np.array_equal(rolled, np.roll(average_range(grid.range_steps, 2, 9), 3 * turns, axis=1))


def test_spacings_are_the_exact_ratios_of_the_shapes() -> None:
    coarse = build_coarse(_random_grid(_spec(*SIZES["S"]), 0))
    assert coarse.range_spacing == (Fraction(8), Fraction(100, 13))
    assert coarse.texture_spacing == (Fraction(4), Fraction(4))
    assert np.array_equal(coarse.measured, coarse.range_steps > 0)


@given(st.data())
def test_voids_take_the_value_of_a_nearest_measured_sample_round_the_seam(data: st.DataObject) -> None:
    height, width = data.draw(st.integers(1, 12)), data.draw(st.integers(1, 14))
    measured = data.draw(arrays(np.bool_, (height, width), fill=st.nothing()))
    names = np.arange(1, height * width + 1, dtype=np.uint16).reshape(height, width)
    filled = fill_voids(np.where(measured, names, 0).astype(np.uint16))
    if not measured.any():
        assert not filled.any()
        return
    assert np.array_equal(filled[measured], names[measured])
    at = np.argwhere(measured)
    for row, column in np.argwhere(~measured):
        sideways = np.abs(at[:, 1] - column)
        distances = np.hypot(at[:, 0] - row, np.minimum(sideways, width - sideways))
        source = np.flatnonzero(names[measured] == filled[row, column])
        assert distances[source[0]] <= 1.05 * distances.min()


@given(st.integers(0, 2**32 - 1), st.integers(0, 47), st.floats(0.05, 0.95))
def test_filling_voids_commutes_with_rolling(seed: int, k: int, void_share: float) -> None:
    range_steps = _random_grid(_spec(30, 48, 1, 1), seed, void_share).range_steps
    assert np.array_equal(fill_voids(np.roll(range_steps, k, axis=1)), np.roll(fill_voids(range_steps), k, axis=1))


@pytest.mark.parametrize("shape", [(8, 16), (5, 7), (1, 1), (1, 9), (9, 1)])
def test_pyramid_entries_average_cells_that_start_at_texel_0(shape: tuple[int, int]) -> None:
    texture = np.random.default_rng(3).integers(0, 256, (*shape, 3)).astype(np.uint8)
    pyramid = build_pyramid(texture, 4)
    assert [level.shape[:2] for level in pyramid] == [(-(-shape[0] // s), -(-shape[1] // s)) for s in (1, 2, 4)]
    for finer, coarser in zip(pyramid, pyramid[1:], strict=False):
        for row, column in np.ndindex(finer.shape[0] // 2, finer.shape[1] // 2):
            mean = finer[2 * row : 2 * row + 2, 2 * column : 2 * column + 2].mean((0, 1))
            assert np.abs(coarser[row, column] - mean).max() <= 0.5


@pytest.mark.parametrize(("spacing_max", "levels"), [(1, 1), (3, 2), (4, 3), (16, 5)])
def test_pyramid_ends_at_the_coarse_spacing(spacing_max: int, levels: int) -> None:
    assert len(build_pyramid(np.zeros((32, 32, 3), np.uint8), spacing_max)) == levels


def test_what_is_derived_is_read_only_and_the_grid_is_left_as_it_was() -> None:
    grid = _random_grid(_spec(*SIZES["S"]), 1)
    before = grid.range_steps.copy(), grid.texture.copy()
    coarse = build_coarse(grid)
    steps = [coarse.range_steps, coarse.filled, fill_voids(grid.range_steps)]
    images = [coarse.texture, *build_pyramid(grid.texture, 4)]
    assert not any(array.flags.writeable for array in steps)
    assert not any(array.flags.writeable for array in images)
    assert grid.range_steps.flags.writeable and grid.texture.flags.writeable
    assert np.array_equal(grid.range_steps, before[0]) and np.array_equal(grid.texture, before[1])


# -- spheres -----------------------------------------------------------------------------------------------------------


def test_cells_of_short_rows_are_averaged_as_far_as_a_row_is_high() -> None:
    random = np.random.default_rng(4)
    cells = random.integers(1, 60000, (32, 64)).astype(np.uint16)
    averaged = evened(cells)
    np.testing.assert_array_equal(averaged[10:22], cells[10:22])  # there a cell is as wide as high
    for row in range(32):
        wide = 1 / math.sin(math.pi * (row + 0.5) / 32)
        half = math.floor((wide - 1) / 2)
        column = random.integers(64)
        around = cells[row, np.arange(column - half, column + half + 1) % 64].astype(int)
        assert averaged[row, column] == int(around.mean() + 0.5)
    assert np.ptp(averaged[0].astype(int)) < np.ptp(cells[0].astype(int)) / 2


def test_what_is_averaged_stays_void_and_takes_nothing_from_voids() -> None:
    cells = np.full((32, 64), 500, np.uint16)
    cells[:3, 10:40] = VOID
    np.testing.assert_array_equal(evened(cells), cells)


def test_a_turned_sphere_has_its_first_view_turned() -> None:
    random = np.random.default_rng(5)
    texture = random.integers(0, 256, (32, 64, 3)).astype(np.uint8)
    np.testing.assert_array_equal(evened(np.roll(texture, 7, axis=1)), np.roll(evened(texture), 7, axis=1))
    assert evened(texture)[0].std() < texture[0].std() / 2


def test_only_a_spheres_first_view_is_averaged() -> None:
    random = np.random.default_rng(6)
    texture = random.integers(0, 256, (128, 256, 3)).astype(np.uint8)
    steps = np.full((64, 128), 3000, np.uint16)
    spec = GridSpec(128, 64, 256, 128, 0.02, 1.0)
    cylinder = build_coarse(Grid(spec, steps, texture)).texture
    sphere = build_coarse(Grid(replace(spec, geometry="sphere"), steps, texture)).texture
    np.testing.assert_array_equal(sphere, evened(cylinder))
    assert not np.array_equal(sphere[0], cylinder[0])
