from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from protocol.errors import LatticeError
from protocol.grid import GridSpec
from protocol.lattice import (
    NO_SKIRT,
    QUARTERS,
    RHO_MAX,
    RHO_ONE,
    Axis,
    Channel,
    ChannelShape,
    Parameters,
    build_lattice,
    channel_shapes,
    level_of_gap,
    mask_to_runs,
    runs_to_mask,
    skirt_steps,
)
from tests.protocol import foveation_oracle as oracle
from tests.protocol.lattice_cases import lattices, windows

S_RANGE = ChannelShape(Channel.RANGE, 360, 100, 20, 10)
S_TEXTURE = ChannelShape(Channel.TEXTURE, 1024, 256, 256, 64)


def assert_axis(axis: Axis, expected: oracle.OracleAxis, size: int, block: int, cyclic: bool) -> None:
    assert [Fraction(int(at), QUARTERS) for at in axis.at] == expected.position
    assert axis.sample.tolist() == expected.sample
    assert axis.count == max(expected.sample) + 1
    blocks = oracle.covered(expected, size, block, cyclic)
    found = {
        int(index): (range(int(start), int(stop)), Fraction(int(gap), QUARTERS))
        for index, start, stop, gap in zip(axis.block, axis.start, axis.stop, axis.gap, strict=True)
    }
    assert found == blocks
    assert len(found) == axis.block.size, "a block is covered twice"


@given(lattices())
def test_positions_coverage_and_gaps_equal_the_brute_force(case: tuple[ChannelShape, Parameters]) -> None:
    shape, parameters = case
    lattice = build_lattice(shape, parameters)
    assert_axis(lattice.y, oracle.axis_y(shape, parameters), shape.height, shape.block, cyclic=False)
    assert_axis(lattice.x, oracle.axis_x(shape, parameters), shape.width, shape.block, cyclic=True)


@given(lattices())
def test_levels_equal_the_brute_force(case: tuple[ChannelShape, Parameters]) -> None:
    shape, parameters = case
    lattice = build_lattice(shape, parameters)
    for i, y_gap in enumerate(lattice.y.gap):
        for j, x_gap in enumerate(lattice.x.gap):
            assert lattice.level[i, j] == oracle.level_of(Fraction(int(max(y_gap, x_gap)), QUARTERS))
    assert shape.coarse_level == oracle.coarse_level(shape)


@given(lattices())
def test_no_column_is_sampled_twice_outside_a_ring(case: tuple[ChannelShape, Parameters]) -> None:
    shape, parameters = case
    assume(parameters.blocks_wide < shape.blocks[1])
    lattice = build_lattice(shape, parameters)
    if shape.channel is Channel.RANGE:
        columns = lattice.x.at // QUARTERS % shape.width
        assert np.unique(columns).size == columns.size
    assert np.unique(lattice.x.block).size == lattice.x.block.size
    assert np.all(np.diff(lattice.x.at) > 0) and np.all(np.diff(lattice.y.at) > 0)


@given(lattices())
def test_borders_give_the_positions(case: tuple[ChannelShape, Parameters]) -> None:
    shape, parameters = case
    lattice = build_lattice(shape, parameters)
    for axis, ring in ((lattice.x, parameters.blocks_wide == shape.blocks[1]), (lattice.y, False)):
        texture = shape.channel is Channel.TEXTURE
        assert axis.border.size == axis.count + texture
        centre = axis.border[:-1] + axis.border[1:] - 2 if texture else 2 * axis.border
        index = np.flatnonzero(np.isin(axis.at, centre) & (centre[axis.sample] == axis.at))
        assert axis.sample[index].tolist() == list(range(axis.count))
        repeated = np.delete(np.arange(axis.at.size), index).tolist()
        assert set(repeated) <= {0, axis.at.size - 1} and len(repeated) == (2 if ring else len(repeated))


@given(windows(), st.integers(0, 50))
def test_range_moves_with_whole_turns_of_the_grid(case: tuple[ChannelShape, Parameters], turn: int) -> None:
    shape, p = case
    columns = shape.blocks[1]
    moved = replace(p, block_x=(p.block_x + turn) % columns)
    a, b = build_lattice(shape, p), build_lattice(shape, moved)
    assert np.array_equal(np.diff(a.x.at), np.diff(b.x.at))
    assert np.array_equal((a.x.block + turn) % columns, b.x.block)
    assert np.array_equal(a.level, b.level) and np.array_equal(a.listed, b.listed)


@given(lattices(listed=True))
def test_only_listed_plateau_blocks_may_be_adopted(case: tuple[ChannelShape, Parameters]) -> None:
    shape, parameters = case
    lattice = build_lattice(shape, parameters)
    chosen = oracle.listed_blocks(shape, parameters)
    for i, row in enumerate(lattice.y.block):
        for j, column in enumerate(lattice.x.block):
            assert lattice.listed[i, j] == (chosen is None or (row, column) in chosen)


@pytest.mark.parametrize("shape", [S_RANGE, S_TEXTURE])
def test_a_plateau_covers_all_its_blocks(shape: ChannelShape) -> None:
    for half in shape.half_spacings:
        lattice = build_lattice(shape, Parameters(half, shape.blocks[1] - 2, 1, 5, 3))
        plateau = [(shape.blocks[1] - 2 + i) % shape.blocks[1] for i in range(5)]
        assert set(plateau) <= set(lattice.x.block.tolist())
        assert {1, 2, 3} <= set(lattice.y.block.tolist())


def test_spacing_one_reaches_level_nought_in_the_plateau_only() -> None:
    for shape in (S_RANGE, S_TEXTURE):
        rho = round(RHO_ONE * np.exp(1))
        lattice = build_lattice(shape, Parameters(2, 3, 2, 2, 3, rho, rho))
        rows, columns = np.nonzero(lattice.level == 0)
        assert set(lattice.y.block[rows]) == {2, 3, 4} and set(lattice.x.block[columns]) == {3, 4}


@pytest.mark.parametrize("half_spacing", S_TEXTURE.half_spacings)
def test_texture_cells_are_counted_from_the_plateau(half_spacing: int) -> None:
    lattice = build_lattice(S_TEXTURE, Parameters(half_spacing, 5, 3, 2, 2))
    for axis, start in ((lattice.x, 5 * 16), (lattice.y, 3 * 16)):
        assert 2 * start in axis.border
        assert np.all((axis.border - 2 * start) % half_spacing == 0)


@given(
    st.sampled_from((2, 3, 4, 6, 8, 12, 16)), st.integers(RHO_ONE, RHO_MAX), st.integers(1, 600), st.integers(1, 2000)
)
def test_steps_never_decrease_nor_leave_their_bounds(half: int, rho: int, coarse: int, reach: int) -> None:
    steps = skirt_steps(half, rho, coarse, reach)
    assert steps == sorted(steps)
    assert all(2 * step >= half and step <= coarse for step in steps)
    assert sum(steps[:-1]) < reach
    assert steps == oracle.growing_steps(Fraction(half, 2), rho, coarse)[: len(steps)]


def test_no_skirt_is_none_even_where_the_first_view_is_coarse() -> None:
    assert skirt_steps(2, NO_SKIRT, 10**6, 10**6) == []
    wide = ChannelShape(Channel.RANGE, 4096, 2048, 16, 8)
    lattice = build_lattice(wide, Parameters(2, 7, 9, 2, 2))
    assert lattice.x.at.tolist() == [QUARTERS * column for column in range(56, 73)]
    assert lattice.y.at.tolist() == [QUARTERS * row for row in range(72, 89)]


@given(st.integers(0, 1 << 16))
def test_level_is_the_smallest_that_holds_the_gap(gap: int) -> None:
    level = int(level_of_gap(np.array([gap]))[0])
    assert gap**2 <= 16 * 2**level
    assert level == 0 or gap**2 > 16 * 2 ** (level - 1)


def test_rows_at_an_image_edge_count_their_whole_cell() -> None:
    shape = ChannelShape(Channel.TEXTURE, 512, 48, 4, 1)
    lattice = build_lattice(shape, Parameters(2, 4, 2, 1, 1, NO_SKIRT, 6 * RHO_ONE))
    top = lattice.y.block.tolist().index(0)
    cell = int(lattice.y.border[1] - lattice.y.border[0]) // 2
    assert cell > 16 and lattice.y.first[top] == 0
    assert lattice.y.gap[top] >= QUARTERS * cell


@given(st.lists(st.booleans(), min_size=1, max_size=200))
def test_runs_and_masks_are_inverse(flags: list[bool]) -> None:
    mask = np.array(flags)
    assert np.array_equal(runs_to_mask(mask_to_runs(mask), mask.size), mask)


@pytest.mark.parametrize("runs", [(), (5,), (-1, 7), (3, 2, 2), (2**70,), (2**63 - 1, 2**63 - 1, 8)])
def test_runs_that_do_not_add_up_are_refused(runs: tuple[int, ...]) -> None:
    with pytest.raises(LatticeError):
        runs_to_mask(runs, 6)


BAD = [
    Parameters(3, 0, 0, 1, 1),
    Parameters(0, 0, 0, 1, 1),
    Parameters(2, 45, 0, 1, 1),
    Parameters(2, -1, 0, 1, 1),
    Parameters(2, 0, 13, 1, 1),
    Parameters(2, 0, -1, 1, 1),
    Parameters(2, 0, 12, 1, 2),
    Parameters(2, 0, 0, 0, 1),
    Parameters(2, 0, 0, 1, 0),
    Parameters(2, 0, 0, 46, 1),
    Parameters(2, 1, 0, 45, 1),
    Parameters(2, 0, 0, 1, 1, RHO_ONE - 1, RHO_ONE),
    Parameters(2, 0, 0, 1, 1, RHO_ONE, RHO_MAX + 1),
    Parameters(2, 0, 0, 1, 1, 1, 1),
    Parameters(2, 0, 0, 1, 1, listed=()),
    Parameters(2, 0, 0, 2, 2, listed=(1, 2)),
    Parameters(2, 0, 0, 1, 1, listed=(2**34,) * 100),
]


@pytest.mark.parametrize("parameters", BAD)
def test_parameters_that_describe_no_lattice_are_refused(parameters: Parameters) -> None:
    with pytest.raises(LatticeError):
        build_lattice(S_RANGE, parameters)


def test_a_range_spacing_must_divide_the_width() -> None:
    shape = ChannelShape(Channel.RANGE, 100, 50, 10, 5)
    build_lattice(shape, Parameters(8, 1, 1, 1, 1))
    with pytest.raises(LatticeError):
        build_lattice(shape, Parameters(16, 1, 1, 1, 1))


def test_a_ring_of_texture_needs_a_spacing_that_divides_the_width() -> None:
    build_lattice(S_TEXTURE, Parameters(16, 0, 0, 64, 1))
    with pytest.raises(LatticeError):
        build_lattice(S_TEXTURE, Parameters(12, 0, 0, 64, 1))


@pytest.mark.parametrize("coarse", [(0, 1), (361, 1), (20, 101), (20, 0)])
def test_a_coarse_shape_outside_the_dense_one_is_refused(coarse: tuple[int, int]) -> None:
    with pytest.raises(LatticeError):
        ChannelShape(Channel.RANGE, 360, 100, *coarse)


def test_channel_shapes_take_rows_first() -> None:
    shapes = channel_shapes(GridSpec(360, 100, 1024, 256, 0.01, 1.0), (10, 20), (64, 256))
    assert shapes == {Channel.RANGE: S_RANGE, Channel.TEXTURE: S_TEXTURE}
    assert (S_RANGE.coarse_level, S_TEXTURE.coarse_level) == (9, 4)


def test_the_largest_grid_at_the_slowest_growth_stays_small() -> None:
    shape = ChannelShape(Channel.RANGE, 16384, 16384, 1, 1)
    lattice = build_lattice(shape, Parameters(2, 3, 3, 1, 1, RHO_ONE, RHO_ONE))
    assert lattice.x.count <= 16384 and lattice.y.count <= 16384
