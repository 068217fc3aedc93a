import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LatticeError
from protocol.holdings import (
    COARSE_RANK,
    RANK_MAX,
    ChannelHoldings,
    Holdings,
    hash_blocks,
    mix32,
    range_rank,
    texture_rank,
)
from protocol.lattice import NO_SKIRT, RHO_ONE, Channel, ChannelShape, Parameters, build_lattice
from tests.protocol.foveation_oracle import OracleClient
from tests.protocol.lattice_cases import parameters_in, shapes

SHAPES = {
    Channel.RANGE: ChannelShape(Channel.RANGE, 360, 100, 20, 10),
    Channel.TEXTURE: ChannelShape(Channel.TEXTURE, 1024, 256, 256, 64),
}
RANKS = {Channel.RANGE: (65534, 65533, 65530, 65000), Channel.TEXTURE: (256, 255, 100, 98, 97, 61)}


@st.composite
def clicks(draw: st.DrawFn, count: int = 4) -> tuple[ChannelShape, list[tuple[Parameters, int]]]:
    shape = draw(shapes())
    rank = st.sampled_from(RANKS[shape.channel])
    return shape, [(draw(parameters_in(shape)), draw(rank)) for _ in range(draw(st.integers(1, count)))]


def apply(held: ChannelHoldings, parameters: Parameters, rank: int) -> int:
    """Adopt what is adoptable; how many blocks that were."""
    lattice = build_lattice(held.shape, parameters)
    adopted = held.adoptable(lattice, rank)
    held.adopt(lattice, adopted, rank)
    return int(adopted.sum())


@given(clicks())
def test_adoption_equals_the_brute_force(case: tuple[ChannelShape, list[tuple[Parameters, int]]]) -> None:
    shape, series = case
    held, expected = ChannelHoldings.coarse(shape), OracleClient.coarse(shape)
    for parameters, rank in series:
        adopted, _ = expected.apply(parameters, rank)
        assert apply(held, parameters, rank) == len(adopted)
        assert {block: int(held.level[block]) for block in expected.level} == expected.level
        assert {block: int(held.rank[block]) for block in expected.rank} == expected.rank


@given(clicks(6))
def test_no_level_rises_and_no_quality_falls(case: tuple[ChannelShape, list[tuple[Parameters, int]]]) -> None:
    shape, series = case
    held = ChannelHoldings.coarse(shape)
    for parameters, rank in series:
        before = held.copy()
        apply(held, parameters, rank)
        assert np.all(held.level <= before.level) and np.all(held.rank >= before.rank)
        changed = (held.level != before.level) | (held.rank != before.rank)
        assert np.all(held.level[changed] < shape.coarse_level)


@given(clicks(6))
def test_applying_again_adopts_nothing(case: tuple[ChannelShape, list[tuple[Parameters, int]]]) -> None:
    shape, series = case
    held = ChannelHoldings.coarse(shape)
    for parameters, rank in series:
        apply(held, parameters, rank)
        assert apply(held, parameters, rank) == 0


@given(clicks(5), st.randoms())
def test_order_does_not_matter_to_levels_at_one_rank(
    case: tuple[ChannelShape, list[tuple[Parameters, int]]], order: object
) -> None:
    shape, series = case
    there, back = ChannelHoldings.coarse(shape), ChannelHoldings.coarse(shape)
    rank = series[0][1]
    shuffled = list(series)
    order.shuffle(shuffled)  # type: ignore[attr-defined]
    for parameters, _ in series:
        apply(there, parameters, rank)
    for parameters, _ in shuffled:
        apply(back, parameters, rank)
    assert np.array_equal(there.level, back.level) and np.array_equal(there.rank, back.rank)


def test_a_finer_refinement_of_worse_quality_is_not_adopted() -> None:
    held = ChannelHoldings.coarse(SHAPES[Channel.RANGE])
    assert apply(held, Parameters(4, 4, 4, 2, 2), range_rank(3)) == 4
    assert apply(held, Parameters(2, 4, 4, 2, 2), range_rank(4)) == 0
    assert apply(held, Parameters(2, 4, 4, 2, 2), range_rank(3)) == 4
    assert apply(held, Parameters(4, 4, 4, 2, 2), range_rank(1)) == 0


def test_texture_quality_must_rise_by_three() -> None:
    held = ChannelHoldings.coarse(SHAPES[Channel.TEXTURE])
    plateau = Parameters(2, 4, 4, 2, 2)
    assert apply(held, plateau, texture_rank(60)) == 4
    assert apply(held, plateau, texture_rank(62)) == 0
    assert apply(held, plateau, texture_rank(63)) == 4


def test_nothing_at_or_above_the_coarse_level_is_adopted() -> None:
    shape = ChannelShape(Channel.TEXTURE, 1024, 256, 256, 64)  # spacing 4 all over
    held = ChannelHoldings.coarse(shape)
    assert apply(held, Parameters(8, 4, 4, 2, 2, RHO_ONE, RHO_ONE), texture_rank(255)) == 0
    assert apply(held, Parameters(4, 4, 4, 2, 2, NO_SKIRT, NO_SKIRT), texture_rank(0)) == 4


@given(clicks(4))
def test_runs_are_inverse(case: tuple[ChannelShape, list[tuple[Parameters, int]]]) -> None:
    shape, series = case
    held = ChannelHoldings.coarse(shape)
    assert held.to_runs() == [[held.level.size, shape.coarse_level, COARSE_RANK]]
    for parameters, rank in series:
        apply(held, parameters, rank)
    runs = held.to_runs()
    back = ChannelHoldings.from_runs(shape, runs)
    assert np.array_equal(back.level, held.level) and back.level.dtype == np.uint8
    assert np.array_equal(back.rank, held.rank) and back.rank.dtype == np.uint16
    assert all(a[1:] != b[1:] for a, b in zip(runs, runs[1:], strict=False)), "neighbouring runs are alike"


@pytest.mark.parametrize(
    "runs",
    [
        [],
        [[584, 9, 0]],
        [[586, 9, 0]],
        [[585, 10, 0]],
        [[585, -1, 0]],
        [[585, 9, -1]],
        [[585, 9, 65535]],
        [[0, 9, 0], [585, 9, 0]],
        [[-1, 9, 0], [586, 9, 0]],
        [[585, 9]],
        [[585, 9, 0], [1]],
        [[2**63, 9, 0]],
        [[2**70, 9, 0]],
        [[2**62, 9, 0]] * 4 + [[585, 9, 0]],
    ],
)
def test_runs_out_of_bounds_are_refused(runs: list[list[int]]) -> None:
    with pytest.raises(LatticeError):
        ChannelHoldings.from_runs(SHAPES[Channel.RANGE], runs)


def test_the_best_ranks_may_be_stated() -> None:
    for channel, shape in SHAPES.items():
        size = shape.blocks[0] * shape.blocks[1]
        held = ChannelHoldings.from_runs(shape, [[size, 0, RANK_MAX[channel]]])
        assert np.all(held.rank == RANK_MAX[channel])
        with pytest.raises(LatticeError):
            ChannelHoldings.from_runs(shape, [[size, 0, RANK_MAX[channel] + 1]])


def test_ranks() -> None:
    assert (range_rank(1), range_rank(65534), texture_rank(0), texture_rank(255)) == (65534, 1, 1, 256)
    for rank_of, bad in ((range_rank, (0, 65535, -1)), (texture_rank, (-1, 256))):
        for value in bad:
            with pytest.raises(LatticeError):
                rank_of(value)


def mixed(value: int) -> int:
    value ^= value >> 16
    value = value * 0x85EBCA6B % 2**32
    value ^= value >> 13
    value = value * 0xC2B2AE35 % 2**32
    return value ^ value >> 16


@given(st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=20))
def test_mixing_is_murmurs_finaliser(values: list[int]) -> None:
    assert mix32(np.array(values, np.uint32)).tolist() == [mixed(value) for value in values]


@given(st.lists(st.integers(0, 65535), min_size=64, max_size=64), st.integers(0, 10**6))
def test_content_is_the_sum_of_spread_block_hashes(cells: list[int], block: int) -> None:
    hashed = sum(value * (mixed(i + 1) | 1) for i, value in enumerate(cells)) % 2**32
    array = np.array(cells, np.uint16).reshape(1, 8, 8)
    assert hash_blocks(array).tolist() == [hashed]
    holdings = Holdings.coarse(SHAPES)
    holdings.add_content(np.array([block]), hash_blocks(array))
    assert holdings.content == mixed((hashed + 0x9E3779B1 * (block + 1)) % 2**32)
    holdings.add_content(np.array([block, block]), np.repeat(hash_blocks(array), 2))
    assert holdings.content == 3 * mixed((hashed + 0x9E3779B1 * (block + 1)) % 2**32) % 2**32


def test_the_digest_is_a_checksum_of_both_channels_then_content() -> None:
    holdings = Holdings.coarse(SHAPES)
    apply(holdings.channels[Channel.RANGE], Parameters(2, 4, 4, 2, 2), range_rank(1))
    data = b""
    for channel in (Channel.RANGE, Channel.TEXTURE):
        held = holdings.channels[channel]
        data += bytes(held.level.ravel().tolist())
        data += b"".join(int(rank).to_bytes(2, "little") for rank in held.rank.ravel())
    holdings.content = 0xABC
    assert holdings.digest() == f"{zlib.crc32(data):08x}00000abc"


def test_the_digest_tells_apart_any_one_change() -> None:
    holdings = Holdings.coarse(SHAPES)
    seen = {holdings.digest()}
    for channel in Channel:
        for name in ("level", "rank"):
            changed = holdings.copy()
            getattr(changed.channels[channel], name)[3, 4] ^= 1
            seen.add(changed.digest())
    cells = np.arange(64, dtype=np.uint16).reshape(1, 8, 8)
    for block in range(3):
        for value in (0, 1, 9):
            cells[0, 5, 5] = value
            changed = holdings.copy()
            changed.add_content(np.array([block]), hash_blocks(cells))
            seen.add(changed.digest())
    assert len(seen) == 1 + 4 + 9


def test_copies_are_independent() -> None:
    holdings = Holdings.coarse(SHAPES)
    copy = holdings.copy()
    apply(copy.channels[Channel.RANGE], Parameters(2, 4, 4, 2, 2), range_rank(1))
    copy.content = 5
    assert holdings.digest() == Holdings.coarse(SHAPES).digest() != copy.digest()
