from collections.abc import Iterable
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from node.assemble import Assembler, Assembly, IncompleteTurn
from node.resampling import Encoder
from protocol.errors import RemoteWireError
from protocol.grid import FloatArray, Grid, GridSpec, ImageArray, StepArray

SPEC = GridSpec(width=24, height=10, texture_width=48, texture_height=12, step_mm=0.05, pitch_mm=1.0)
COUNTS = 4000


def _random_grid(spec: GridSpec, seed: int, low: int = 0) -> Grid:
    rng = np.random.default_rng(seed)
    range_steps = rng.integers(low, 65536, (spec.height, spec.width)).astype(np.uint16)
    texture = rng.integers(0, 256, (spec.texture_height, spec.texture_width, 3)).astype(np.uint8)
    return Grid(spec, range_steps, texture)


def _count_at(column: float, width: int, encoder: Encoder) -> int:
    turns = (column + 0.5) / width
    return encoder.zero_count + encoder.direction * round(turns * encoder.counts_per_turn)


def _add_range(assembler: Assembler, grid: Grid, encoder: Encoder, columns: Iterable[int]) -> None:
    for column in columns:
        assembler.add_range_column(_count_at(column, grid.spec.width, encoder), 0, grid.range_steps[:, column])


def _add_texture(assembler: Assembler, grid: Grid, encoder: Encoder, columns: Iterable[int]) -> None:
    for column in columns:
        assembler.add_texture_column(_count_at(column, grid.spec.texture_width, encoder), 0, grid.texture[:, column])


def _assembled(grid: Grid, encoder: Encoder, without: Iterable[int] = ()) -> Assembler:
    """An assembler that has all texture columns and all range columns but some."""
    assembler = Assembler(grid.spec, encoder)
    _add_range(assembler, grid, encoder, sorted(set(range(grid.spec.width)) - set(without)))
    _add_texture(assembler, grid, encoder, range(grid.spec.texture_width))
    return assembler


def _same(a: Grid, b: Grid) -> bool:
    return a.spec == b.spec and np.array_equal(a.range_steps, b.range_steps) and np.array_equal(a.texture, b.texture)


@given(
    seed=st.integers(0, 2**32 - 1),
    counts=st.integers(96, 1 << 31),
    zero=st.integers(-(2**31), 2**31),
    direction=st.sampled_from([1, -1]),
    random=st.randoms(use_true_random=False),
)
def test_columns_in_any_order_without_jitter_give_the_grid_bit_for_bit(
    seed: int, counts: int, zero: int, direction: int, random: Random
) -> None:
    grid, encoder = _random_grid(SPEC, seed), Encoder(counts, zero, direction)
    assembler = Assembler(SPEC, encoder)
    range_columns, texture_columns = list(range(SPEC.width)), list(range(SPEC.texture_width))
    random.shuffle(range_columns)
    random.shuffle(texture_columns)
    _add_texture(assembler, grid, encoder, texture_columns)
    _add_range(assembler, grid, encoder, range_columns)
    assert _same(assembler.finish(), grid)


def test_pieces_of_columns_and_duplicates_give_the_same_grid() -> None:
    grid, encoder = _random_grid(SPEC, 1), Encoder(COUNTS)
    assembler = _assembled(grid, encoder, without=[5])
    at = _count_at(5, SPEC.width, encoder)
    assembler.add_range_column(at, 6, grid.range_steps[6:, 5])
    assembler.add_range_column(at, 0, grid.range_steps[:4, 5])
    assert assembler.missing_range().tolist() == [5]
    assembler.add_range_column(at, 2, grid.range_steps[2:8, 5])
    _add_texture(assembler, grid, encoder, [3, 3, 4])
    assert _same(assembler.finish(), grid)


@pytest.mark.parametrize("lost", [[0], [23], [7], [0, 23], [3, 4, 5], [1, 9, 20], list(range(24))])
def test_an_incomplete_turn_is_refused_and_names_what_is_missing(lost: list[int]) -> None:
    grid, encoder = _random_grid(SPEC, 2), Encoder(COUNTS, 17, -1)
    assembler = _assembled(grid, encoder, without=lost)
    with pytest.raises(IncompleteTurn, match=f"{len(lost)} range and 0 texture") as refusal:
        assembler.finish()
    assert refusal.value.range_columns.tolist() == lost
    assert refusal.value.texture_columns.tolist() == []
    _add_range(assembler, grid, encoder, lost)
    assert _same(assembler.finish(), grid)


def test_missing_texture_columns_are_named_too() -> None:
    grid, encoder = _random_grid(SPEC, 3), Encoder(COUNTS)
    assembler = Assembler(SPEC, encoder)
    _add_range(assembler, grid, encoder, range(SPEC.width))
    _add_texture(assembler, grid, encoder, range(1, SPEC.texture_width))
    assert assembler.missing_texture().tolist() == [0]
    assert assembler.missing_range().tolist() == []


@given(seed=st.integers(0, 2**32 - 1), zero=st.integers(-5000, 5000), direction=st.sampled_from([1, -1]))
def test_jittered_columns_are_interpolated_between_the_two_round_each_angle(
    seed: int, zero: int, direction: int
) -> None:
    rng = np.random.default_rng(seed)
    encoder = Encoder(COUNTS, zero, direction)
    grid = _random_grid(SPEC, seed, low=1)
    assembler = Assembler(SPEC, encoder)
    range_at = np.arange(SPEC.width) + rng.uniform(-0.4, 0.4, SPEC.width)
    texture_at = np.arange(SPEC.texture_width) + rng.uniform(-0.4, 0.4, SPEC.texture_width)
    for column, position in enumerate(range_at):
        assembler.add_range_column(_count_at(position, SPEC.width, encoder), 0, grid.range_steps[:, column])
    for column, position in enumerate(texture_at):
        assembler.add_texture_column(_count_at(position, SPEC.texture_width, encoder), 0, grid.texture[:, column])
    assembled = assembler.finish()
    expected = _interpolated(grid.texture, texture_at)
    count = SPEC.texture_width / COUNTS / _least_gap(texture_at)
    assert np.abs(assembled.texture - expected).max() <= 0.51 + 255 * count
    expected = _interpolated(grid.range_steps, range_at)
    count = SPEC.width / COUNTS / _least_gap(range_at)
    assert np.abs(assembled.range_steps - expected).max() <= 0.51 + 65535 * (count + 2**-15)


def _least_gap(position: FloatArray) -> float:
    """Between two neighbours, in columns: in so much a count is lost to rounding."""
    return min(1.0, float(np.diff(position, append=position[0] + len(position)).min()))


def _interpolated(samples: StepArray | ImageArray, position: FloatArray) -> FloatArray:
    """numpy's own linear interpolation along a row, a turn repeated on either side."""
    width = samples.shape[1]
    wide_at = np.concatenate([position - width, position, position + width])
    flat = np.moveaxis(samples.astype(np.float64), 1, -1).reshape(-1, width)
    lines = [np.interp(np.arange(width), wide_at, np.tile(line, 3)) for line in flat]
    shape = (*np.moveaxis(samples, 1, -1).shape[:-1], width)
    return np.moveaxis(np.array(lines).reshape(shape), -1, 1)


@pytest.mark.parametrize(
    ("left", "right", "weight_of_right", "expected"),
    [
        (100, 200, 0.25, 125),
        (100, 0, 0.25, 100),
        (100, 0, 0.75, 0),
        (0, 100, 0.25, 0),
        (0, 100, 0.75, 100),
        (0, 0, 0.5, 0),
    ],
)
def test_beside_a_void_the_nearer_column_decides(left: int, right: int, weight_of_right: float, expected: int) -> None:
    spec = GridSpec(width=8, height=1, texture_width=8, texture_height=1, step_mm=0.05, pitch_mm=1.0)
    encoder = Encoder(8000)
    assembler = Assembler(spec, encoder)
    for column in range(8):
        value = np.array([left if column < 4 else right], np.uint16)
        assembler.add_range_column(_count_at(column - weight_of_right, 8, encoder), 0, value)
        assembler.add_texture_column(_count_at(column, 8, encoder), 0, np.zeros((1, 3), np.uint8))
    assert assembler.finish().range_steps[0, 3] == expected


def test_a_second_turn_at_other_angles_narrows_the_gaps() -> None:
    grid, encoder = _random_grid(SPEC, 4), Encoder(COUNTS)
    assembler = _assembled(grid, encoder, without=[6])
    assembler.add_range_column(_count_at(5.5, SPEC.width, encoder), 0, grid.range_steps[:, 5])
    assembler.add_range_column(_count_at(6.5, SPEC.width, encoder), 0, grid.range_steps[:, 5])
    assert assembler.missing_range().size == 0
    assert np.array_equal(assembler.finish().range_steps[:, 6], grid.range_steps[:, 5])


def test_the_sweep_may_go_on_after_a_grid_was_made() -> None:
    grid, encoder = _random_grid(SPEC, 5), Encoder(COUNTS)
    assembler = _assembled(grid, encoder)
    first = assembler.finish()
    assembler.add_range_column(_count_at(0, SPEC.width, encoder), 0, np.zeros(SPEC.height, np.uint16))
    assert np.array_equal(first.range_steps, grid.range_steps)


@pytest.mark.parametrize(("row0", "rows"), [(-1, 2), (0, 11), (9, 2), (10, 1)])
def test_rows_that_do_not_fit_a_column_are_refused(row0: int, rows: int) -> None:
    assembler = Assembler(SPEC, Encoder(COUNTS))
    with pytest.raises(RemoteWireError, match="do not fit a column of 10"):
        assembler.add_range_column(0, row0, np.ones(rows, np.uint16))


def test_more_columns_than_any_sweep_has_are_refused() -> None:
    assembler = Assembler(SPEC, Encoder(COUNTS))
    with pytest.raises(RemoteWireError, match="range columns in one sweep"):
        for count in range(200 * SPEC.width):
            assembler.add_range_column(count, 0, np.ones(SPEC.height, np.uint16))


def test_samples_of_another_type_are_refused_and_not_converted() -> None:
    assembler = Assembler(SPEC, Encoder(COUNTS))
    with pytest.raises(ValueError, match=r"range samples must be \(n,\) uint16"):
        assembler.add_range_column(0, 0, np.ones(SPEC.height, np.int64))
    with pytest.raises(ValueError, match=r"texture samples must be \(n, 3\) uint8"):
        assembler.add_texture_column(0, 0, np.ones((SPEC.texture_height, 4), np.uint8))


@pytest.mark.parametrize(("counts", "direction"), [(0, 1), ((1 << 31) + 1, 1), (COUNTS, 0), (COUNTS, 2)])
def test_an_encoder_out_of_bounds_is_refused(counts: int, direction: int) -> None:
    with pytest.raises(ValueError, match="must be"):
        Encoder(counts, 0, direction)


def test_an_encoder_too_coarse_for_the_grid_is_refused() -> None:
    with pytest.raises(ValueError, match="need 96"):
        Assembler(SPEC, Encoder(95))


def _turns(grids: list[Grid], encoder: Encoder, overlap: float = 0.0) -> Assembler:
    """A sweep of several turns, each of which saw another grid, and part of one more, which saw the last."""
    assembler = Assembler(grids[0].spec, encoder)
    for turn, grid in enumerate([*grids, grids[-1]]):
        spec, share = grid.spec, 1.0 if turn < len(grids) else overlap
        later = Encoder(
            encoder.counts_per_turn, encoder.zero_count + encoder.direction * turn * encoder.counts_per_turn,
            encoder.direction,
        )  # fmt: skip
        _add_range(assembler, grid, later, range(int(share * spec.width)))
        _add_texture(assembler, grid, later, range(int(share * spec.texture_width)))
    return assembler


SMOOTH = GridSpec(width=120, height=40, texture_width=240, texture_height=60, step_mm=0.01, pitch_mm=1.0)


def _smooth_grid(turned: float = 0.0, noise_steps: float = 0.0, seed: int = 0) -> Grid:
    """A bumpy object, turned by a share of a turn, seen with noise."""
    rng = np.random.default_rng(seed)
    u = np.arange(SMOOTH.width) / SMOOTH.width + turned
    v = np.arange(SMOOTH.height)[:, None] / SMOOTH.height
    shape = 5000 + 800 * np.sin(2 * np.pi * (3 * u + v)) + 300 * np.cos(2 * np.pi * 7 * u)
    steps = np.rint(shape + rng.normal(0, noise_steps, shape.shape)).astype(np.uint16)
    ut = np.arange(SMOOTH.texture_width) / SMOOTH.texture_width + turned
    grey = 120 + 60 * np.sin(2 * np.pi * (5 * ut + 2 * np.arange(SMOOTH.texture_height)[:, None] / 60))
    return Grid(SMOOTH, steps, np.repeat(np.rint(grey).astype(np.uint8)[:, :, None], 3, axis=2))


def _assembly(grids: list[Grid], overlap: float = 0.0) -> Assembly:
    return _turns(grids, Encoder(2400 * 7), overlap).assembly()


@pytest.mark.parametrize("passes", [1, 2, 5])
@pytest.mark.parametrize("direction", [1, -1])
def test_passes_that_saw_the_same_give_it_bit_for_bit(passes: int, direction: int) -> None:
    grid = _random_grid(SPEC, 3)
    assembler = _turns([grid] * passes, Encoder(COUNTS, 77, direction), overlap=0.25)
    assert _same(assembler.finish(), grid)


def test_noise_falls_with_the_root_of_the_passes() -> None:
    truth = _smooth_grid()
    left = {}
    for passes in (1, 4, 16):
        grids = [_smooth_grid(noise_steps=20.0, seed=seed) for seed in range(passes)]
        left[passes] = float(np.std(_turns(grids, Encoder(16800)).finish().range_steps.astype(int) - truth.range_steps))
    assert left[1] / left[4] == pytest.approx(2.0, rel=0.15)
    assert left[1] / left[16] == pytest.approx(4.0, rel=0.15)


def test_the_report_tells_the_noise_of_a_single_sample() -> None:
    quality = _assembly([_smooth_grid(noise_steps=20.0, seed=seed) for seed in range(2)]).quality
    assert quality.noise_mm == pytest.approx(20.0 * SMOOTH.step_mm, rel=0.15)
    assert quality.passes == 2 and not quality.has_slipped


def test_what_one_pass_alone_saw_otherwise_is_left_out() -> None:
    grids = [_smooth_grid() for _ in range(3)]
    grids[1].range_steps[7, 20:30] = 60000
    grids[1].texture[:, 100] = 255
    assembly = _assembly(grids)
    assert _same(assembly.grid, grids[0])
    assert assembly.quality.rejected >= 10


def test_an_overlap_without_a_slip_reports_none() -> None:
    quality = _assembly([_smooth_grid(noise_steps=5.0)], overlap=0.2).quality
    assert quality.slip_deg == pytest.approx(0.0, abs=0.3) and not quality.has_slipped and quality.complaints == ()


@pytest.mark.parametrize("slip_deg", [-6.0, -2.25, 3.0, 7.5])
def test_an_overlap_tells_how_far_the_object_slipped_and_is_left_out(slip_deg: float) -> None:
    first, later = _smooth_grid(), _smooth_grid(turned=slip_deg / 360)
    assembler = _turns([first], Encoder(16800))
    again = Encoder(16800, 16800)
    _add_range(assembler, later, again, range(SMOOTH.width // 5))
    _add_texture(assembler, later, again, range(SMOOTH.texture_width // 5))
    assembly = assembler.assembly()
    assert assembly.quality.slip_deg == pytest.approx(slip_deg, abs=0.4)
    assert assembly.quality.has_slipped and "moved" in assembly.quality.complaints[0]
    assert _same(assembly.grid, first)


def test_a_fast_first_turn_and_the_columns_between_make_the_grid() -> None:
    grid, encoder = _random_grid(SPEC, 9), Encoder(COUNTS)
    assembler = Assembler(SPEC, encoder)
    _add_range(assembler, grid, encoder, range(0, SPEC.width, 4))
    _add_texture(assembler, grid, encoder, range(0, SPEC.texture_width, 4))
    later = Encoder(COUNTS, COUNTS)
    _add_range(assembler, grid, later, [c for c in range(SPEC.width) if c % 4])
    _add_texture(assembler, grid, later, [c for c in range(SPEC.texture_width) if c % 4])
    assert _same(assembler.finish(), grid)
