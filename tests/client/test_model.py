from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from client.errors import HoldingsDiffer
from client.model import Model
from protocol.codec import TextureCodec, encode_mask, encode_texture
from protocol.errors import RemoteWireError
from protocol.grid import VOID, dequantise, quantise
from protocol.lattice import Channel, Parameters
from protocol.reconstruct import coarse_to_range, coarse_to_texture
from protocol.refinement import Refinement
from tests.client.scripted_node import QUANTUM, SPEC, WINDOW, Planner, synthetic_grid

GRID = synthetic_grid()
SEAM = Parameters(2, 11, 1, 2, 3)
SMOOTH = Parameters(4, 3, 2, 3, 2)
LISTED = Parameters(2, 3, 2, 3, 2, listed=(1, 2, 2, 1))


def first_view() -> tuple[Planner, Model]:
    planner = Planner(GRID)
    model = Model(planner.info)
    for refinement in planner.first_view():
        model.apply(refinement)
    return planner, model


def cells_of(model: Model, blocks: np.ndarray, channel: Channel = Channel.RANGE) -> np.ndarray:
    """Which dense cells the blocks cover."""
    shape = model.shapes[channel]
    chosen = np.zeros(shape.blocks, bool)
    chosen.ravel()[blocks] = True
    return np.kron(chosen, np.ones((shape.block, shape.block), bool))[: shape.height, : shape.width]


def test_the_first_view_fills_the_dense_model() -> None:
    planner, model = first_view()
    coarse, void = planner.coarse_range()
    expected = dequantise(quantise(coarse, QUANTUM), QUANTUM)
    expected[void] = VOID
    assert np.array_equal(model.range_steps, coarse_to_range(expected, model.shapes[Channel.RANGE]))
    assert np.array_equal(model.texture, coarse_to_texture(planner.coarse_texture(), model.shapes[Channel.TEXTURE]))
    assert (model.spacing == 8).all()
    assert model.holdings.digest() == planner.holdings.digest()


def test_a_model_is_complete_only_with_both_channels() -> None:
    planner = Planner(GRID)
    model = Model(planner.info)
    seen = [model.complete]
    for refinement in planner.first_view():
        model.apply(refinement)
        seen.append(model.complete)
    assert seen == [False, False, True]


@pytest.mark.parametrize("parameters", [WINDOW, SEAM, LISTED], ids=["window", "seam", "listed"])
def test_blocks_at_level_0_equal_the_scan_voids_included(parameters: Parameters) -> None:
    planner, model = first_view()
    blocks = model.apply(planner.range_fovea(parameters)).blocks
    exact = blocks[model.holdings.channels[Channel.RANGE].level.ravel()[blocks] == 0]
    cells = cells_of(model, exact)
    assert exact.size and np.array_equal(model.range_steps[cells], GRID.range_steps[cells])
    assert (model.spacing[cells] == 1).all()


def test_cells_of_blocks_not_adopted_stay_as_they_are() -> None:
    planner, model = first_view()
    before = model.range_steps.copy(), model.texture.copy()
    ranges, textures = model.apply(planner.range_fovea()).blocks, model.apply(planner.texture_fovea()).blocks
    outside = ~cells_of(model, ranges)
    assert np.array_equal(model.range_steps[outside], before[0][outside])
    outside = ~cells_of(model, textures, Channel.TEXTURE)
    assert np.array_equal(model.texture[outside], before[1][outside])


def test_a_quantised_fovea_lies_within_half_a_step_on_its_samples() -> None:
    planner, model = first_view()
    model.apply(planner.range_fovea(SMOOTH, quantum=10))
    at = np.ix_(range(16, 32, 2), range(24, 48, 2))
    measured = GRID.range_steps[at] != VOID
    error = model.range_steps[at].astype(int) - GRID.range_steps[at]
    assert np.abs(error[measured]).max() <= 5
    assert (model.range_steps[at][~measured] == VOID).all()


def test_lossless_texture_at_full_spacing_equals_the_scan() -> None:
    planner, model = first_view()
    model.apply(planner.texture_fovea())
    assert np.array_equal(model.texture[32:64, 48:96], GRID.texture[32:64, 48:96])


def test_a_repeated_fovea_is_a_disagreement_and_changes_nothing() -> None:
    planner, model = first_view()
    fovea = planner.range_fovea()
    model.apply(fovea)
    before = model.range_steps.copy(), model.holdings.digest()
    with pytest.raises(HoldingsDiffer):
        model.apply(replace(fovea, seq=3))
    assert np.array_equal(model.range_steps, before[0]) and model.holdings.digest() == before[1]


def test_another_number_of_samples_is_a_disagreement() -> None:
    planner, model = first_view()
    fovea = planner.range_fovea()
    with pytest.raises(HoldingsDiffer, match=f"{fovea.samples + 1} samples, {fovea.samples} expected"):
        model.apply(replace(fovea, samples=fovea.samples + 1))


def test_a_self_contained_fovea_changes_only_what_it_makes_finer() -> None:
    planner, model = first_view()
    model.apply(planner.range_fovea(WINDOW))
    exact = model.holdings.channels[Channel.RANGE].level == 0
    before = model.range_steps.copy()
    wide = Parameters(4, 1, 1, 7, 5, WINDOW.rho_x, WINDOW.rho_y)
    blocks = model.apply(planner.range_fovea(wide, self_contained=True)).blocks
    assert blocks.size and not exact.ravel()[blocks].any()
    cells = cells_of(model, np.flatnonzero(exact))
    assert np.array_equal(model.range_steps[cells], before[cells])
    assert model.holdings.digest() == planner.holdings.digest()


def test_a_self_contained_fovea_that_is_nowhere_finer_changes_nothing() -> None:
    planner, model = first_view()
    model.apply(planner.range_fovea(WINDOW))
    before = model.range_steps.copy()
    applied = model.apply(planner.range_fovea(Parameters(4, 3, 2, 3, 2), self_contained=True))
    assert applied.blocks.size == 0 and np.array_equal(model.range_steps, before)
    assert model.holdings.digest() == planner.holdings.digest()


BROKEN: dict[str, tuple[str, dict[str, Any]]] = {
    "no such codec": ("range", {"codec": 9}),
    "no such texture codec": ("texture", {"codec": 9}),
    "payload of something else": ("range", {"payload": b"nonsense"}),
    "payload cut short": ("texture", {"payload": b""}),
    "quantum 0": ("range", {"quality": 0}),
    "quantum too large": ("range", {"quality": 65535}),
    "quality off the scale": ("texture", {"quality": 256}),
    "spacing that is none": ("range", {"parameters": replace(WINDOW, half_spacing=3)}),
    "plateau off the grid": ("range", {"parameters": replace(WINDOW, block_y=8)}),
    "bitmap of another size": ("range", {"parameters": replace(WINDOW, listed=(1, 2))}),
    "mask of something else": ("range", {"mask": b"nonsense"}),
    "mask of another shape": ("range", {"mask": encode_mask(np.ones((3, 3), np.bool_))}),
    "texture with a mask": ("texture", {"mask": encode_mask(np.ones((3, 3), np.bool_))}),
}


@pytest.mark.parametrize(("kind", "change"), BROKEN.values(), ids=BROKEN)
def test_a_broken_refinement_is_the_nodes_fault_and_changes_nothing(kind: str, change: dict[str, Any]) -> None:
    planner, model = first_view()
    fovea = planner.range_fovea() if kind == "range" else planner.texture_fovea()
    before = model.range_steps.copy(), model.texture.copy(), model.holdings.digest()
    with pytest.raises(RemoteWireError, match="refinement 2"):
        model.apply(replace(fovea, **change))
    assert np.array_equal(model.range_steps, before[0]) and np.array_equal(model.texture, before[1])
    assert model.holdings.digest() == before[2]


def test_a_fovea_before_the_first_view_is_refused() -> None:
    planner = Planner(GRID)
    model = Model(planner.info)
    model.apply(planner.first_view()[0])
    with pytest.raises(RemoteWireError, match="before the first view"):
        model.apply(planner.range_fovea())


def test_a_second_first_view_is_refused() -> None:
    planner, model = first_view()
    with pytest.raises(RemoteWireError, match="second first view"):
        model.apply(planner.first_view()[0])


def test_a_first_view_of_another_shape_is_refused() -> None:
    planner = Planner(GRID)
    coarse = planner.first_view()[1]
    with pytest.raises(RemoteWireError, match="samples for"):
        Model(planner.info).apply(replace(coarse, samples=coarse.samples - 1))


@pytest.mark.parametrize(("index", "quality"), [(0, 0), (1, 256)], ids=["range", "texture"])
def test_a_first_view_off_the_scale_of_quality_is_refused(index: int, quality: int) -> None:
    planner = Planner(GRID)
    with pytest.raises(RemoteWireError, match="must be"):
        Model(planner.info).apply(replace(planner.first_view()[index], quality=quality))


def test_a_jpeg_first_view_is_taken_like_any_other() -> None:
    planner = Planner(GRID)
    model = Model(planner.info)
    payload = encode_texture(planner.coarse_texture(), TextureCodec.JPEG, 40)
    for refinement in planner.first_view():
        if refinement.channel is Channel.TEXTURE:
            refinement = replace(refinement, codec=TextureCodec.JPEG, quality=40, payload=payload)
        model.apply(refinement)
    exact = coarse_to_texture(planner.coarse_texture(), model.shapes[Channel.TEXTURE])
    assert np.abs(model.texture.astype(int) - exact).mean() < 8


def test_range_in_millimetres_has_nan_for_voids_and_follows_the_steps() -> None:
    planner, model = first_view()
    before = model.range_mm
    assert model.range_mm is before
    model.apply(planner.range_fovea())
    after = model.range_mm
    assert after is not before and after.dtype == np.float32
    assert np.array_equal(np.isnan(after), model.range_steps == VOID)
    measured = model.range_steps != VOID
    assert np.allclose(after[measured], model.range_steps[measured] * SPEC.step_mm)


@pytest.mark.parametrize("name", ["range_steps", "range_mm", "texture", "spacing"])
def test_published_arrays_are_read_only(name: str) -> None:
    _, model = first_view()
    with pytest.raises(ValueError, match="read-only"):
        getattr(model, name)[0, 0] = 1


def test_a_view_taken_earlier_follows_later_refinements() -> None:
    planner, model = first_view()
    view = model.range_steps
    model.apply(planner.range_fovea())
    assert np.array_equal(view, model.range_steps)


def foveae() -> st.SearchStrategy[list[tuple[str, Parameters, int]]]:
    rho = st.sampled_from([0, 80000, 178145])
    window = st.builds(
        Parameters,
        half_spacing=st.sampled_from([2, 4, 8]),
        block_x=st.integers(0, 11),
        block_y=st.integers(0, 5),
        blocks_wide=st.integers(1, 5),
        blocks_high=st.integers(1, 2),
        rho_x=rho,
        rho_y=rho,
    )
    return st.lists(st.tuples(st.sampled_from(["range", "texture"]), window, st.sampled_from([1, 4])), max_size=6)


@given(foveae())
@settings(max_examples=25)
def test_any_series_of_foveae_keeps_both_ends_agreed_and_never_makes_a_block_coarser(
    series: list[tuple[str, Parameters, int]],
) -> None:
    planner, model = first_view()
    held = model.holdings.channels[Channel.RANGE]
    for kind, parameters, quantum in series:
        level = held.level.copy()
        try:
            fovea: Refinement = (
                planner.range_fovea(parameters, quantum) if kind == "range" else planner.texture_fovea(parameters)
            )
        except AssertionError:
            continue  # nothing left to send
        model.apply(fovea)
        assert (held.level <= level).all()
        assert model.holdings.digest() == planner.holdings.digest()
    exact = np.flatnonzero((held.level == 0) & (held.rank == 65534))
    cells = cells_of(model, exact)
    assert np.array_equal(model.range_steps[cells], GRID.range_steps[cells])
