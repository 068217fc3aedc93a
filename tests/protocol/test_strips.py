"""Strips of a sphere: what they cover, that what travels in them comes back, and that updates add up."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.codec import TextureCodec
from protocol.codec_lift import Survey, decode_all, encode_surveyed
from protocol.errors import CodecError, LatticeError
from protocol.grid import VOID, BoolArray, StepArray
from protocol.holdings import ChannelHoldings, range_rank, texture_rank
from protocol.lattice import STRIDE_SETS, STRIDES, Channel, ChannelShape, Parameters, build_lattice, mask_to_runs
from protocol.reconstruct import Selection, cut, paste, range_patch, select, texture_patch
from protocol.rings import ring_strides, thin_rings, thin_texture
from protocol.strips import blocks_of, build_strips, image_shape, join_parts, samples_of, select_strips, split_parts
from tests.golden.write_sphere import FOLDER, scan_of, vectors

SHAPE = ChannelShape(Channel.RANGE, 96, 184, 6, 12, True)
TEXTURE = ChannelShape(Channel.TEXTURE, 96, 184, 6, 12, True)
SKIRT = 178145


@st.composite
def windows(draw: st.DrawFn, shape: ChannelShape = SHAPE, skirts: bool = True) -> Parameters:
    rows, columns = shape.blocks
    wide, block_y = draw(st.integers(1, columns)), draw(st.integers(0, rows - 1))
    high = draw(st.integers(1, rows - block_y))
    block_x = 0 if wide == columns else draw(st.integers(0, columns - 1))
    rho = st.sampled_from([0, SKIRT] if skirts else [0])
    listed = None
    if draw(st.booleans()):
        random = np.random.default_rng(draw(st.integers(0, 999)))
        listed = mask_to_runs(random.random((high, wide)) < draw(st.sampled_from([0.1, 0.5, 0.9])))
    half, strides = draw(st.sampled_from([2, 4, 8])), draw(st.sampled_from(STRIDE_SETS))
    return Parameters(half, block_x, block_y, wide, high, draw(rho), draw(rho), listed, strides)


def surface(seed: int = 1, voids: float = 0.0) -> StepArray:
    random = np.random.default_rng(seed)
    steps = random.integers(1, 65535, (SHAPE.height, SHAPE.width)).astype(np.uint16)
    steps[random.random(steps.shape) < voids] = VOID
    return thin_rings(steps)


def samples_at(steps: StepArray, selection: Selection) -> StepArray:
    lattice, shape = selection.lattice, selection.lattice.shape
    columns = lattice.x.border[selection.x.sample] // 2 % shape.own_width * shape.stride
    return np.maximum(steps[np.ix_(lattice.y.border[selection.y.sample] // 2, columns)], 1)


def refine(dense: StepArray, held: ChannelHoldings, scan: StepArray, parameters: Parameters, quantum: int = 1) -> int:
    """Apply one refinement to a dense model and its holdings, as both ends do. Returns the samples it took."""
    strips = select_strips(build_strips(held.shape, parameters), held, range_rank(quantum))
    images = [Survey(samples_at(scan, strip.selection), quantum) for strip in strips]
    shapes = [strip.selection.sample_shape for strip in strips]
    every = decode_all(encode_surveyed(images), shapes, quantum) if images else []
    for strip, image, decoded in zip(strips, images, every, strict=True):
        selection = strip.selection
        np.testing.assert_array_equal(image.decoded, decoded)
        patch = range_patch(selection, decoded)
        patch[(np.asarray(cut(scan, selection)) == VOID) & selection.seen_cells()] = VOID
        paste(dense, patch, selection)
        held.adopt(selection.lattice, strip.adopted, range_rank(quantum))
    return samples_of(strips)


def cells_of(blocks: BoolArray) -> BoolArray:
    return blocks.repeat(8, axis=0)[: SHAPE.height].repeat(8, axis=1)[:, : SHAPE.width]


@given(windows())
def test_no_block_is_covered_twice_and_listed_ones_are(parameters: Parameters) -> None:
    covered = np.zeros(SHAPE.blocks, np.int64)
    may = np.zeros(SHAPE.blocks, np.bool_)
    for lattice in build_strips(SHAPE, parameters):
        covered[np.ix_(lattice.y.block, lattice.x.block)] += 1
        may[np.ix_(lattice.y.block, lattice.x.block)] |= lattice.listed
        strides = ring_strides(96, 184, 8, parameters.half_spacing)[lattice.y.block]
        assert all(max(s for s in parameters.strides if s <= own) == lattice.shape.stride for own in strides)
    assert covered.max(initial=0) <= 1
    assert np.array_equal(wanted(parameters) & (covered > 0), wanted(parameters))
    if parameters.listed is not None:
        assert np.array_equal(may, wanted(parameters))


def wanted(p: Parameters) -> BoolArray:
    """The blocks of a plateau, the listed ones if any are."""
    blocks = np.zeros(SHAPE.blocks, np.bool_)
    size = p.blocks_high * p.blocks_wide
    runs = p.listed if p.listed is not None else (0, size)
    mask = np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(p.blocks_high, p.blocks_wide)
    columns = (p.block_x + np.arange(p.blocks_wide)) % SHAPE.blocks[1]
    blocks[np.ix_(np.arange(p.block_y, p.block_y + p.blocks_high), columns)] = mask
    return blocks


@given(windows(skirts=False))
def test_a_strip_is_no_wider_than_what_is_listed_in_it(parameters: Parameters) -> None:
    for lattice in build_strips(SHAPE, replace(parameters, half_spacing=2)):
        listed = np.flatnonzero(wanted(parameters)[lattice.y.block].any(axis=0))
        shortest = min(int(((listed - first) % 12).max()) + 1 for first in listed)
        assert lattice.x.block.size - shortest in range(2)  # one more where that is but one sample wide


@given(windows(), st.integers(0, 3), st.sampled_from([0.0, 0.1]))
def test_exact_windows_are_the_scans_and_nothing_else_changes(p: Parameters, seed: int, voids: float) -> None:
    exact = Parameters(2, p.block_x, p.block_y, p.blocks_wide, p.blocks_high, 0, 0, p.listed, p.strides)
    scan, dense, held = surface(seed, voids), np.full((184, 96), 7, np.uint16), ChannelHoldings.coarse(SHAPE)
    refine(dense, held, scan, exact)
    np.testing.assert_array_equal(held.level == 0, wanted(exact))
    cells = cells_of(wanted(exact))
    np.testing.assert_array_equal(dense[cells], scan[cells])
    assert (dense[~cells] == 7).all()


@given(windows(), st.sampled_from([3, 8]))
def test_own_samples_of_a_plateau_are_within_half_a_quantum(p: Parameters, quantum: int) -> None:
    scan, dense, held = surface(), np.full((184, 96), 7, np.uint16), ChannelHoldings.coarse(SHAPE)
    refine(dense, held, scan, p, quantum)
    own = np.zeros(scan.shape, np.bool_)
    for lattice in build_strips(SHAPE, p):
        rows = lattice.y.border[lattice.y.border // 2 < 184] // 2
        columns = lattice.x.border // 2 % lattice.shape.own_width * lattice.shape.stride
        block_rows = np.isin(rows // 8, lattice.y.block)
        own[np.ix_(rows[block_rows], columns)] = True
    own &= cells_of(held.rank == range_rank(quantum))
    own &= np.arange(96) % ring_strides(96, 184, 8).repeat(8)[:184, None] == 0  # a limited stride sends more than these
    assert own.any() == (held.rank > 0).any()
    assert np.abs(dense[own].astype(int) - scan[own]).max(initial=0) <= quantum // 2


@given(windows(), windows(), st.integers(0, 3))
def test_twice_is_once_and_either_order_holds_the_same(one: Parameters, other: Parameters, seed: int) -> None:
    scan, results = surface(seed, 0.05), []
    for order in ((one, other), (other, one)):
        dense, held = np.full((184, 96), 7, np.uint16), ChannelHoldings.coarse(SHAPE)
        for parameters in order:
            refine(dense, held, scan, parameters)
            assert refine(dense, held, scan, parameters) == 0
        results.append((dense, held.level))
    np.testing.assert_array_equal(results[0][1], results[1][1])
    exact = cells_of(results[0][1] == 0)
    np.testing.assert_array_equal(results[0][0][exact], results[1][0][exact])


@given(windows(), st.sampled_from([4, 8]))  # a whole number of samples, whatever spacing and stride
def test_a_turned_scan_is_refined_the_same_turned(p: Parameters, blocks: int) -> None:
    scan, results = surface(2, 0.05), []
    turned = Parameters(
        p.half_spacing, p.block_x if p.blocks_wide == 12 else (p.block_x + blocks) % 12, p.block_y,
        p.blocks_wide, p.blocks_high, p.rho_x, p.rho_y, p.listed if p.blocks_wide < 12 else None,
    )  # fmt: skip
    straight = Parameters(
        p.half_spacing, p.block_x, p.block_y, p.blocks_wide, p.blocks_high, p.rho_x, p.rho_y, turned.listed
    )
    for parameters, steps in ((straight, scan), (turned, np.roll(scan, 8 * blocks, axis=1))):
        dense, held = np.full((184, 96), 7, np.uint16), ChannelHoldings.coarse(SHAPE)
        refine(dense, held, np.ascontiguousarray(steps), parameters)
        results.append(dense)
    np.testing.assert_array_equal(np.roll(results[0], 8 * blocks, axis=1), results[1])


@given(windows(TEXTURE), st.integers(0, 3))
def test_lossless_texture_at_spacing_1_is_the_scans(p: Parameters, seed: int) -> None:
    texture = np.random.default_rng(seed).integers(0, 256, (184, 96, 3)).astype(np.uint8)
    texture, dense = thin_texture(texture), np.zeros((184, 96, 3), np.uint8)
    held = ChannelHoldings.coarse(TEXTURE)
    exact = Parameters(2, p.block_x, p.block_y, p.blocks_wide, p.blocks_high, listed=p.listed)
    for strip in select_strips(build_strips(TEXTURE, exact), held, texture_rank(255)):
        selection, shape = strip.selection, strip.selection.lattice.shape
        columns = selection.lattice.x.border[selection.x.sample] // 2 % shape.own_width * shape.stride
        texels = texture[np.ix_(selection.lattice.y.border[selection.y.sample] // 2, columns)]
        paste(dense, texture_patch(selection, texels), selection)
        held.adopt(selection.lattice, strip.adopted, texture_rank(255))
    cells = (held.level == 0).repeat(16, axis=0)[:184].repeat(16, axis=1)
    assert cells.any() == (p.listed is None or len(p.listed) > 1)
    np.testing.assert_array_equal(dense[cells], texture[cells])


def test_a_cylinder_is_one_strip_and_its_lattice() -> None:
    shape = ChannelShape(Channel.RANGE, 96, 56, 12, 7)
    parameters = Parameters(2, 1, 0, 2, 2, SKIRT, SKIRT)
    (lattice,) = build_strips(shape, parameters)
    assert lattice is build_lattice(shape, parameters)
    held = ChannelHoldings.coarse(shape)
    (strip,) = select_strips((lattice,), held, range_rank(1))
    chosen = select(lattice, held, range_rank(1))
    assert chosen is not None
    np.testing.assert_array_equal(strip.adopted, chosen[1])
    assert not strip.selection.x.beyond


# -- parts -------------------------------------------------------------------------------------------------------------

parts = st.lists(st.binary(max_size=9), min_size=1, max_size=5)


@given(parts)
def test_parts_come_back(parts: list[bytes]) -> None:
    assert split_parts(join_parts(parts), len(parts)) == parts


def test_texture_of_a_sphere_travels_in_an_odd_number_of_rows_as_htj2k() -> None:
    parameters = Parameters(2, 0, 0, 3, 2)
    for sphere in (True, False):
        shape = ChannelShape(Channel.TEXTURE, 96, 64, 12, 8, sphere)
        (strip, *_) = select_strips(build_strips(shape, parameters), ChannelHoldings.coarse(shape), texture_rank(40))
        rows, columns = strip.selection.sample_shape
        assert rows % 2 == 0
        assert image_shape(strip.selection, TextureCodec.HTJ2K) == (rows + sphere, columns)
        assert image_shape(strip.selection, TextureCodec.JPEG) == (rows, columns)


def test_one_part_and_nothing_have_no_length() -> None:
    assert join_parts([b"abc"]) == b"abc"
    assert join_parts([b"", b""]) == b""
    assert split_parts(b"", 2) == [b"", b""]


@pytest.mark.parametrize("change", [lambda data: data[:-1], lambda data: data + b"\0", lambda data: data[:3]])
def test_parts_must_be_whole(change: Callable[[bytes], bytes]) -> None:
    with pytest.raises(CodecError):
        split_parts(change(join_parts([b"one", b"", b"three"])), 3)


# -- golden ------------------------------------------------------------------------------------------------------------

GOLDEN = json.loads((FOLDER / "strips.json").read_text())


def test_the_code_still_equals_the_golden_vectors() -> None:
    now = vectors()
    assert {path.name for path in FOLDER.iterdir()} == set(now)
    here = json.loads(now["strips.json"])
    for there, case in zip(GOLDEN["range"], here["range"], strict=True):
        there, case = ({**one, "refinement": None} for one in (there, case))  # deflate may pack in another way
        assert there == case
    assert [GOLDEN[name] for name in ("strides", "texture")] == [here[name] for name in ("strides", "texture")]
    for name in (name for name in now if name.endswith(".bin")):
        golden, made = (np.frombuffer(data, np.uint8).astype(int) for data in ((FOLDER / name).read_bytes(), now[name]))
        assert np.abs(golden - made).max() <= (2 if name.startswith("texture") else 0), name


def test_golden_scans_are_as_their_docstring_says() -> None:
    scan = scan_of(SHAPE)
    assert (scan == VOID).any()
    np.testing.assert_array_equal(thin_rings(scan), scan)


@given(windows())
def test_blocks_of_strips_are_each_named_once(parameters: Parameters) -> None:
    blocks = blocks_of(select_strips(build_strips(SHAPE, parameters), ChannelHoldings.coarse(SHAPE), range_rank(1)))
    assert np.unique(blocks).size == blocks.size


@pytest.mark.parametrize(
    ("allowed", "strides"),
    [
        (STRIDES, [8, 4, 2, 1, 2, 4, 8]),
        ((1, 2), [2, 1, 2]),
        ((1,), [1]),
        ((1, 2, 8), [8, 2, 1, 2, 8]),
        ((1, 4, 16), [4, 1, 4]),
    ],
)
def test_few_strides_join_strips(allowed: tuple[int, ...], strides: list[int]) -> None:
    strips = build_strips(SHAPE, Parameters(2, 0, 0, 12, 23, strides=allowed))
    assert [lattice.shape.stride for lattice in strips] == strides


def test_strides_are_chosen_on_a_sphere_alone_and_of_those_that_travel() -> None:
    whole = Parameters(2, 0, 0, 12, 23)
    for shape, strides in ((SHAPE, (1, 8)), (SHAPE, ()), (replace(SHAPE, sphere=False), (1, 2))):
        with pytest.raises(LatticeError, match="strides of"):
            build_strips(shape, replace(whole, strides=strides))
