"""Thinned rings: how dense they are, that thinning twice is once, and that what travels of them is exact."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.codec import RangeCodec
from protocol.errors import CodecError
from protocol.grid import VOID, StepArray
from protocol.holdings import ChannelHoldings, range_rank
from protocol.lattice import Channel, ChannelShape, Parameters, build_lattice
from protocol.range_payload import decode_selection, encode_selection, survey_selection
from protocol.reconstruct import Selection, range_patch, select, thinned_rings
from protocol.rings import ring_strides, thin_rings

SHAPE = ChannelShape(Channel.RANGE, 96, 56, 12, 7, True)
SKIRT = 178145


def surface(shape: ChannelShape, seed: int = 1, voids: float = 0.0) -> StepArray:
    random = np.random.default_rng(seed)
    steps = random.integers(1, 65535, (shape.height, shape.width)).astype(np.uint16)
    steps[random.random(steps.shape) < voids] = VOID
    return thin_rings(steps)


def selected(shape: ChannelShape, parameters: Parameters) -> Selection:
    found = select(build_lattice(shape, parameters), ChannelHoldings.coarse(shape), range_rank(1))
    assert found is not None
    return found[0]


@given(st.integers(1, 60).map(lambda n: 8 * n), st.integers(1, 300), st.sampled_from([2, 4, 8, 16]))
def test_rings_are_about_as_dense_as_the_equator(width: int, height: int, half_spacing: int) -> None:
    stride, p = ring_strides(width, height, half_spacing), half_spacing // 2
    along = stride * np.sin(np.pi * (np.arange(height) + 0.5) / height) / p
    assert (stride % p == 0).all() and (stride <= 8 * p).all()
    assert (along <= np.sqrt(2) + 1e-6).all()
    free = (stride < 8 * p) & (width % (2 * stride) == 0)
    assert (along[free] >= np.sqrt(0.5) - 1e-6).all()
    np.testing.assert_array_equal(stride, stride[::-1])


def test_a_width_that_nothing_divides_is_not_thinned() -> None:
    assert (ring_strides(99, 40) == 1).all()


@given(st.integers(0, 99), st.sampled_from([0.0, 0.2]))
def test_thinning_twice_is_thinning_once(seed: int, voids: float) -> None:
    steps = surface(SHAPE, seed, voids)
    np.testing.assert_array_equal(thin_rings(steps), steps)
    assert steps[SHAPE.height // 2].any()


def test_a_ring_keeps_its_own_samples_and_interpolates_round_the_seam() -> None:
    steps = np.full((56, 96), 1000, np.uint16)
    steps[0, 88], steps[0, 0] = 100, 201
    thinned = thin_rings(steps)
    assert ring_strides(96, 56)[0] == 8
    assert thinned[0, 88:].tolist() == [100, 113, 125, 138, 151, 163, 176, 188]
    steps[0, 88] = VOID
    assert not thin_rings(steps)[0, 81:96].any()


windows = st.builds(
    Parameters,
    half_spacing=st.sampled_from([2, 4, 8]),
    block_x=st.integers(0, 11),
    block_y=st.integers(0, 5),
    blocks_wide=st.integers(1, 11),
    blocks_high=st.integers(1, 1),
    rho_x=st.sampled_from([0, SKIRT]),
    rho_y=st.sampled_from([0, SKIRT]),
)
rings = st.builds(
    Parameters,
    half_spacing=st.sampled_from([2, 4, 8]),
    block_x=st.just(0),
    block_y=st.integers(0, 3),
    blocks_wide=st.just(12),
    blocks_high=st.integers(1, 4),
    rho_x=st.just(0),
    rho_y=st.sampled_from([0, SKIRT]),
)


@given(windows | rings, st.sampled_from([1, 7]))
def test_what_travels_comes_back_within_half_a_quantum(parameters: Parameters, quantum: int) -> None:
    selection = selected(SHAPE, parameters)
    steps = surface(SHAPE)
    rows = selection.lattice.y.border[selection.y.sample] // 2
    columns = selection.lattice.x.border[selection.x.sample] // 2 % SHAPE.width
    samples = steps[np.ix_(rows, columns)]
    care = np.ones(samples.shape, np.bool_)
    payload, expected = encode_selection(selection, samples, quantum, care)
    decoded = decode_selection(selection, payload, RangeCodec.LIFT, quantum)
    np.testing.assert_array_equal(decoded, expected)
    np.testing.assert_array_equal(survey_selection(selection, samples, quantum, care)[0], expected)
    own = np.ones(samples.shape, np.bool_)
    for ring in thinned_rings(selection):
        own[np.ix_(ring.row, ring.part > 0)] = False
    assert np.abs(decoded[own].astype(int) - samples[own]).max() <= quantum // 2


@given(windows | rings)
def test_every_cell_of_an_exact_window_is_the_scans(parameters: Parameters) -> None:
    parameters = Parameters(2, *[getattr(parameters, n) for n in ("block_x", "block_y", "blocks_wide", "blocks_high")])
    selection = selected(SHAPE, parameters)
    steps = surface(SHAPE)
    rows = selection.lattice.y.border[selection.y.sample] // 2
    columns = selection.lattice.x.border[selection.x.sample] // 2 % SHAPE.width
    samples = steps[np.ix_(rows, columns)]
    payload, _ = encode_selection(selection, samples, 1, np.ones(samples.shape, np.bool_))
    patch = range_patch(selection, decode_selection(selection, payload, RangeCodec.LIFT, 1))
    for dense_rows, dense_columns, source in selection.spans():
        np.testing.assert_array_equal(patch[:, source], steps[dense_rows, dense_columns])


@given(st.integers(0, 200), st.integers(0, 255))
def test_damaged_ring_payloads_are_refused_or_decoded_to_the_same_shape(at: int, value: int) -> None:
    selection = selected(SHAPE, Parameters(2, 0, 0, 12, 3))
    samples = np.full(selection.sample_shape, 500, np.uint16)
    payload = bytearray(encode_selection(selection, samples, 1, np.ones(samples.shape, np.bool_))[0])
    payload[at % len(payload)] = value
    try:
        assert decode_selection(selection, bytes(payload), RangeCodec.LIFT, 1).shape == selection.sample_shape
    except CodecError:
        pass


@pytest.mark.parametrize("change", [lambda data: data[:-1], lambda data: data + b"\0", lambda data: data[:3]])
def test_ring_payloads_must_be_whole(change: object) -> None:
    selection = selected(SHAPE, Parameters(2, 0, 0, 12, 3))
    samples = np.full(selection.sample_shape, 500, np.uint16)
    payload, _ = encode_selection(selection, samples, 1, np.ones(samples.shape, np.bool_))
    with pytest.raises(CodecError):
        decode_selection(selection, change(payload), RangeCodec.LIFT, 1)  # type: ignore[operator]


def test_a_cylinder_knows_no_rings() -> None:
    shape = ChannelShape(Channel.RANGE, 96, 56, 12, 7)
    assert thinned_rings(selected(shape, Parameters(2, 0, 0, 12, 3))) == []
    assert selected(shape, Parameters(2, 1, 0, 2, 2)).sample_shape == (16, 16)
    assert selected(SHAPE, Parameters(2, 1, 0, 2, 2)).sample_shape == (16, 17)
