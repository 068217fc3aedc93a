from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from protocol.errors import LatticeError
from protocol.grid import BoolArray, ImageArray, StepArray, dequantise, quantise
from protocol.holdings import ChannelHoldings, hash_blocks, range_rank, texture_rank
from protocol.lattice import RHO_ONE, Channel, ChannelShape, Parameters, build_lattice
from protocol.reconstruct import (
    Selection,
    coarse_to_range,
    content_hashes,
    cut,
    paste,
    range_patch,
    select,
    texture_patch,
)
from tests.protocol.foveation_oracle import OracleClient, bilinear
from tests.protocol.lattice_cases import parameters_in, shapes

S_RANGE = ChannelShape(Channel.RANGE, 360, 100, 20, 10)
QUANTA = st.sampled_from((1, 2, 3, 7, 100, 65534))


def scan_of(shape: ChannelShape, seed: int) -> StepArray:
    return np.random.default_rng(seed).integers(1, 65536, (shape.height, shape.width), dtype=np.uint16)


def range_samples(scan: StepArray, selection: Selection) -> StepArray:
    """Point samples of a scan at the transmitted positions."""
    lattice = selection.lattice
    rows = lattice.y.border[selection.y.sample] // 2
    columns = lattice.x.border[selection.x.sample] // 2 % scan.shape[1]
    samples: StepArray = scan[np.ix_(rows, columns)]
    return samples


def refine(
    dense: StepArray, held: ChannelHoldings, scan: StepArray, parameters: Parameters, quantum: int = 1
) -> BoolArray:
    """Apply one refinement of a scan; which cells were adopted."""
    where = np.zeros(dense.shape, np.bool_)
    chosen = select(build_lattice(held.shape, parameters), held, range_rank(quantum))
    if chosen is None:
        return where
    selection, adopted = chosen
    values = quantise(range_samples(scan, selection), quantum)
    paste(dense, range_patch(selection, dequantise(values, quantum)), selection)
    held.adopt(selection.lattice, adopted, range_rank(quantum))
    paste(where.view(np.uint8), np.ones(selection.adopted_cells().shape, np.uint8), selection)
    return where


@st.composite
def range_clicks(draw: st.DrawFn, count: int = 3) -> tuple[ChannelShape, int, list[tuple[Parameters, int]]]:
    shape = draw(shapes(Channel.RANGE))
    series = [(draw(parameters_in(shape)), draw(QUANTA)) for _ in range(draw(st.integers(1, count)))]
    return shape, draw(st.integers(0, 2**32)), series


@given(range_clicks())
def test_range_equals_the_brute_force_cell_by_cell(
    case: tuple[ChannelShape, int, list[tuple[Parameters, int]]],
) -> None:
    shape, seed, series = case
    scan, held, oracle = scan_of(shape, seed), ChannelHoldings.coarse(shape), OracleClient.coarse(shape)
    dense = np.full(scan.shape, 7, np.uint16)
    expected = {(row, column): 7 for row in range(shape.height) for column in range(shape.width)}
    for parameters, quantum in series:
        lattice = build_lattice(shape, parameters)
        where = refine(dense, held, scan, parameters, quantum)
        _, cells = oracle.apply(parameters, range_rank(quantum))
        assert {(int(r), int(c)) for r, c in np.argwhere(where)} == set(cells)
        rows, columns = lattice.y.border // 2, lattice.x.border // 2 % shape.width
        for cell, (y, x) in cells.items():
            corner = {
                (i, j): max(1, min(65535, (int(scan[rows[i], columns[j]]) + quantum // 2) // quantum * quantum))
                for i in y[:2]
                for j in x[:2]
            }
            expected[cell] = bilinear(corner, y, x)
    assert {cell: int(dense[cell]) for cell in expected} == expected


@given(range_clicks(4))
def test_cells_of_blocks_not_adopted_are_untouched(
    case: tuple[ChannelShape, int, list[tuple[Parameters, int]]],
) -> None:
    shape, seed, series = case
    scan, held, dense = scan_of(shape, seed), ChannelHoldings.coarse(shape), scan_of(shape, seed + 1)
    for parameters, quantum in series:
        before, level = dense.copy(), held.level.copy()
        where = refine(dense, held, scan, parameters, quantum)
        assert np.array_equal(dense[~where], before[~where])
        side = shape.block
        finer = np.repeat(np.repeat(held.level < level, side, 0), side, 1)[: shape.height, : shape.width]
        assert np.all(where[finer])


@given(range_clicks(5))
def test_level_nought_holds_the_scan(case: tuple[ChannelShape, int, list[tuple[Parameters, int]]]) -> None:
    shape, seed, series = case
    scan, held = scan_of(shape, seed), ChannelHoldings.coarse(shape)
    dense = np.zeros_like(scan)
    for parameters, quantum in series:
        refine(dense, held, scan, parameters, quantum)
    side = shape.block
    level, rank = (
        np.repeat(np.repeat(a, side, 0), side, 1)[: shape.height, : shape.width] for a in (held.level, held.rank)
    )
    held_quantum = 65535 - rank.astype(np.int64)
    full = (level == 0) & (rank > 0)
    assert np.all(np.abs(dense.astype(np.int64) - scan)[full] <= held_quantum[full] // 2)
    exact = full & (held_quantum == 1)
    assert np.array_equal(dense[exact], scan[exact])


@given(shapes(Channel.RANGE), st.integers(0, 2**32), st.integers(0, 7), st.data())
def test_everything_at_the_scans_own_step_is_the_scan(
    shape: ChannelShape, seed: int, start: int, data: st.DataObject
) -> None:
    assume(shape.coarse_level > 0)
    scan, held = scan_of(shape, seed), ChannelHoldings.coarse(shape)
    dense = np.zeros_like(scan)
    rows, columns = shape.blocks
    if data.draw(st.booleans()):
        refine(dense, held, scan, Parameters(2, 0, 0, columns, rows))
    for row in range(rows):
        for column in range(columns):
            refine(
                dense,
                held,
                scan,
                Parameters(2, (column + start) % columns if columns > 1 else 0, row, 1, 1, RHO_ONE, RHO_ONE),
            )
    assert np.all(held.level == 0)
    assert np.array_equal(dense, scan)


@given(range_clicks(4), st.randoms())
def test_order_does_not_matter_at_level_nought(
    case: tuple[ChannelShape, int, list[tuple[Parameters, int]]], order: object
) -> None:
    shape, seed, series = case
    scan, quantum = scan_of(shape, seed), series[0][1]
    shuffled = list(series)
    order.shuffle(shuffled)  # type: ignore[attr-defined]
    results = []
    for clicks in (series, shuffled):
        held, dense = ChannelHoldings.coarse(shape), np.zeros_like(scan)
        for parameters, _ in clicks:
            refine(dense, held, scan, parameters, quantum)
        results.append(
            (
                held.level,
                np.where(np.kron(held.level == 0, np.ones((8, 8), np.bool_))[: shape.height, : shape.width], dense, 0),
            )
        )
    assert np.array_equal(results[0][0], results[1][0])
    assert np.array_equal(results[0][1], results[1][1])


@given(range_clicks(1))
def test_transmitted_positions_hold_what_was_transmitted(
    case: tuple[ChannelShape, int, list[tuple[Parameters, int]]],
) -> None:
    shape, seed, [(parameters, quantum)] = case
    scan, held, dense = (
        scan_of(shape, seed),
        ChannelHoldings.coarse(shape),
        np.zeros((shape.height, shape.width), np.uint16),
    )
    lattice = build_lattice(shape, parameters)
    where = refine(dense, held, scan, parameters, quantum)
    rows, columns = lattice.y.border // 2, lattice.x.border // 2 % shape.width
    grid = np.ix_(rows, columns)
    sent = dequantise(quantise(scan, quantum), quantum)
    assert np.array_equal(dense[grid][where[grid]], sent[grid][where[grid]])


def test_fifty_clicks_on_the_small_scan_keep_every_invariant() -> None:
    rng = np.random.default_rng(7)
    scan, held = scan_of(S_RANGE, 1), ChannelHoldings.coarse(S_RANGE)
    dense = coarse_to_range(np.full((10, 20), 3000, np.uint16), S_RANGE)
    for _ in range(50):
        half, quantum = int(rng.choice((2, 4, 8, 16))), int(rng.choice((1, 1, 2, 5)))
        rho = round(RHO_ONE * np.exp(1 / rng.choice((0.5, 1, 3))))
        at = int(rng.integers(45)), int(rng.integers(11))
        before, level, rank = dense.copy(), held.level.copy(), held.rank.copy()
        where = refine(dense, held, scan, Parameters(half, *at, int(rng.integers(1, 8)), 2, rho, rho), quantum)
        assert np.all(held.level <= level) and np.all(held.rank >= rank)
        assert np.array_equal(dense[~where], before[~where])
        assert (
            not refine(dense, held, scan, Parameters(half, *at, 1, 1, rho, rho), max(quantum, 2)).any() or quantum > 1
        )
    exact = np.kron((held.level == 0) & (held.rank == 65534), np.ones((8, 8), np.bool_))[:100]
    assert exact.any() and np.array_equal(dense[exact], scan[exact])


@given(st.integers(1, 65535), st.integers(1, 65534))
def test_quantising_loses_at_most_half_a_quantum(value: int, quantum: int) -> None:
    k = quantise(np.array([value], np.uint16), quantum)
    back = int(dequantise(k, quantum)[0])
    assert int(k[0]) == (value + quantum // 2) // quantum
    assert back == min(max(int(k[0]) * quantum, 1), 65535)
    assert abs(back - value) <= quantum // 2
    assert quantum > 1 or back == value


def widest_selection(half: int) -> Selection:
    shape = ChannelShape(Channel.RANGE, 16384, 16384, 1, 1)
    lattice = build_lattice(shape, Parameters(half, 1000, 1000, 1, 1, 16 * RHO_ONE, 16 * RHO_ONE))
    level = np.full(shape.blocks, 29, np.uint8)
    chosen = select(lattice, ChannelHoldings(shape, level, np.zeros(shape.blocks, np.uint16)), range_rank(1))
    assert chosen is not None
    return chosen[0]


def test_integer_rounding_survives_the_longest_intervals() -> None:
    rng = np.random.default_rng(3)
    selection = widest_selection(16)
    assert int(selection.x.whole.max()) >= 4 * 2048
    for _ in range(3):
        samples = rng.choice(np.array([1, 2, 3, 65533, 65534, 65535], np.uint16), selection.sample_shape)
        y, x = selection.y, selection.x
        rows = np.unique(rng.integers(0, y.low.size, 40))
        columns = np.unique(rng.integers(0, x.low.size, 40))
        patch = range_patch(cropped(selection, rows, columns), samples)
        for i, row in enumerate(rows):
            for j, column in enumerate(columns):
                py, wy, px, wx = (int(v) for v in (y.part[row], y.whole[row], x.part[column], x.whole[column]))
                corner = [
                    [int(samples[a, b]) for b in (x.low[column], x.high[column])] for a in (y.low[row], y.high[row])
                ]
                n = (corner[0][0] * (wx - px) + corner[0][1] * px) * (wy - py) + (
                    corner[1][0] * (wx - px) + corner[1][1] * px
                ) * py
                assert patch[i, j] == (2 * n + wy * wx) // (2 * wy * wx)


def cropped(selection: Selection, rows: np.ndarray, columns: np.ndarray) -> Selection:
    """The same selection with a few of its dense rows and columns."""
    y, x = (
        replace(w, low=w.low[at], high=w.high[at], part=w.part[at], whole=w.whole[at])
        for w, at in ((selection.y, rows), (selection.x, columns))
    )
    return replace(selection, y=y, x=x)


@given(shapes(Channel.TEXTURE), st.integers(0, 2**32), st.data())
def test_texture_equals_the_brute_force_within_a_level(shape: ChannelShape, seed: int, data: st.DataObject) -> None:
    parameters = data.draw(parameters_in(shape))
    held, oracle = ChannelHoldings.coarse(shape), OracleClient.coarse(shape)
    chosen = select(build_lattice(shape, parameters), held, texture_rank(60))
    _, cells = oracle.apply(parameters, texture_rank(60))
    if chosen is None:
        assert not cells
        return
    selection = chosen[0]
    texels = np.random.default_rng(seed).integers(0, 256, (*selection.sample_shape, 3), dtype=np.uint8)
    dense = np.zeros((shape.height, shape.width, 3), np.uint8)
    paste(dense, texture_patch(selection, texels), selection)
    y_of = {int(sample): i for i, sample in enumerate(selection.y.sample)}
    x_of = {int(sample): i for i, sample in enumerate(selection.x.sample)}
    needed_y, needed_x = set(), set()
    for (row, column), (y, x) in cells.items():
        needed_y |= {s for s, weight in ((y[0], 1 - y[2]), (y[1], y[2])) if weight}
        needed_x |= {s for s, weight in ((x[0], 1 - x[2]), (x[1], x[2])) if weight}
        corner = {(i, j): int(texels[y_of[i], x_of[j], 1]) for i in y[:2] for j in x[:2]}
        assert abs(int(dense[row, column, 1]) - bilinear(corner, y, x)) <= 1
    assert needed_y <= set(y_of) and needed_x <= set(x_of)


@pytest.mark.parametrize("half_spacing", [3, 4, 6, 8, 12, 16])
def test_a_linear_texture_comes_back_linear_at_every_spacing(half_spacing: int) -> None:
    """No half-texel shift between spacings: means over cells of a ramp interpolate to the same ramp."""
    shape = ChannelShape(Channel.TEXTURE, 512, 96, 8, 4)
    lattice = build_lattice(shape, Parameters(half_spacing, 6, 2, 3, 2))
    chosen = select(lattice, ChannelHoldings.coarse(shape), texture_rank(255))
    assert chosen is not None
    selection = chosen[0]
    ramp = lattice.x.at[lattice.x.sample.argsort()] / 4  # a cell's mean of the ramp is the ramp at its centre
    texels = np.broadcast_to(np.rint(ramp[selection.x.sample])[None, :, None], (*selection.sample_shape, 3))
    dense = np.zeros((shape.height, shape.width, 3), np.uint8)
    paste(dense, texture_patch(selection, texels.astype(np.uint8)), selection)
    plateau = dense[32:64, 96:144, 0].astype(int)
    assert np.abs(plateau - np.arange(96, 144)[None, :]).max() <= 1


def test_a_seam_window_is_one_rectangle() -> None:
    scan, held = scan_of(S_RANGE, 2), ChannelHoldings.coarse(S_RANGE)
    chosen = select(build_lattice(S_RANGE, Parameters(2, 44, 11, 2, 2)), held, range_rank(1))
    assert chosen is not None
    selection, adopted = chosen
    assert adopted.sum() == 4 and selection.x.block.tolist() == [44, 0] and selection.y.block.tolist() == [11, 12]
    assert [(s.start, s.stop) for _, s, _ in selection.spans()] == [(352, 360), (0, 8)]
    assert np.array_equal(cut(scan, selection), np.roll(scan, 8, axis=1)[88:100, :16])
    assert selection.adopted_blocks().tolist() == [11 * 45 + 44, 11 * 45, 12 * 45 + 44, 12 * 45]


def test_spans_cover_a_rectangle_that_begins_left_of_the_seam_by_more_than_itself() -> None:
    held = ChannelHoldings.coarse(S_RANGE)
    chosen = select(build_lattice(S_RANGE, Parameters(2, 0, 4, 1, 1, RHO_ONE, RHO_ONE)), held, range_rank(1))
    assert chosen is not None
    columns = np.concatenate([np.arange(s.start, s.stop) for _, s, _ in chosen[0].spans()])
    assert np.array_equal(columns, (chosen[0].x.start + np.arange(columns.size)) % 360)
    assert np.unique(columns).size == columns.size


@given(shapes(Channel.RANGE), st.integers(0, 2**32), st.data())
def test_content_hashes_are_those_of_padded_blocks(shape: ChannelShape, seed: int, data: st.DataObject) -> None:
    parameters = data.draw(parameters_in(shape))
    chosen = select(build_lattice(shape, parameters), ChannelHoldings.coarse(shape), range_rank(1))
    assume(chosen is not None)
    assert chosen is not None
    selection = chosen[0]
    patch = scan_of(ChannelShape(Channel.RANGE, selection.x.low.size, selection.y.low.size, 1, 1), seed)
    dense = np.zeros((shape.height, shape.width), np.uint16)
    paste(dense, patch, selection)
    padded = np.zeros((shape.blocks[0] * 8, shape.blocks[1] * 8), np.uint16)
    padded[: shape.height, : shape.width] = dense
    for block, found in zip(selection.adopted_blocks(), content_hashes(patch, selection), strict=True):
        row, column = divmod(int(block), shape.blocks[1])
        cells = padded[row * 8 : row * 8 + 8, column * 8 : column * 8 + 8]
        assert found == hash_blocks(cells[None])[0]


def test_payloads_of_another_shape_are_refused() -> None:
    selection = widest_selection(2)
    with pytest.raises(LatticeError):
        range_patch(selection, np.ones((3, 3), np.uint16))
    with pytest.raises(LatticeError):
        texture_patch(selection, np.ones((3, 3, 3), np.uint8))


def test_nothing_to_adopt_selects_nothing() -> None:
    held = ChannelHoldings.coarse(S_RANGE)
    lattice = build_lattice(S_RANGE, Parameters(2, 3, 3, 2, 2, listed=(4,)))
    assert select(lattice, held, range_rank(1)) is None


def test_texture_means_at_an_edge_serve_up_to_the_edge() -> None:
    shape = ChannelShape(Channel.TEXTURE, 512, 64, 8, 2)
    chosen = select(build_lattice(shape, Parameters(16, 3, 0, 2, 4)), ChannelHoldings.coarse(shape), texture_rank(1))
    assert chosen is not None
    texels: ImageArray = np.zeros((*chosen[0].sample_shape, 3), np.uint8)
    texels[0], texels[-1] = 200, 100
    patch = texture_patch(chosen[0], texels)
    assert np.all(patch[:4] == 200) and np.all(patch[-4:] == 100)
    assert cv2.mean(patch[8:-8])[0] < 60
