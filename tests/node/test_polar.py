"""Texture round a pole as one image: what lies on it, what a strip makes of it, and when a look takes it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from client.model import Model
from node import refine_texture
from node.coded import Part
from node.first_view import FirstView, build_first_view, texture_as_seen
from node.library import Scan
from node.polar import FARTHEST_RAD, PolarTexture, polar_samples, reaches
from node.refine_texture import Compared, compared_with
from node.texture_model import TextureModel
from protocol.codec import TextureCodec, decode_texture, encode_texture
from protocol.errors import LatticeError
from protocol.grid import TEXTURE_BLOCK, Grid, GridSpec, ImageArray
from protocol.holdings import ChannelHoldings, texture_rank
from protocol.lattice import STRIDES, Channel, ChannelShape, Parameters, mask_to_runs
from protocol.messages import CodecName, Look
from protocol.refinement import Refinement
from protocol.region import Cap
from protocol.rings import thin_grid, thin_texture
from protocol.sphere import DirectionGrid, cap_region, vectors
from protocol.strips import Strips, build_strips, image_shapes, samples_of, select_strips, texture_patches
from tests.node.planning import plan_look
from tests.node.scans import keep

SHAPE = ChannelShape(Channel.TEXTURE, 512, 256, 64, 32, True)


def stone() -> ImageArray:
    """Colours that vary slowly with direction alone, as a scan has them."""
    grid = DirectionGrid(SHAPE.width, SHAPE.height)
    row, column = np.mgrid[: SHAPE.height, : SHAPE.width]
    towards = vectors(grid.theta_v(row), grid.theta_h(column))
    return thin_texture(np.rint(128 + 60 * np.sin(3 * towards + 1)).astype(np.uint8))


def strips_of(parameters: Parameters) -> Strips:
    return select_strips(build_strips(SHAPE, parameters), ChannelHoldings.coarse(SHAPE), texture_rank(40))


def listed(region: Cap, half_spacing: int = 4) -> Parameters:
    runs = mask_to_runs(region.touched(TEXTURE_BLOCK))
    return Parameters(half_spacing, *region.blocks(TEXTURE_BLOCK), listed=runs, polar=True)


@st.composite
def caps(draw: st.DrawFn) -> Cap:
    """Windows that the maps hold."""
    from_pole, share = draw(st.floats(0, 0.2)), draw(st.floats(0.001, 0.08))
    v = 1 - from_pole - 1e-9 if draw(st.booleans()) else from_pole
    region = cap_region(draw(st.floats(0, 1, exclude_max=True)), v, share, SHAPE.width, SHAPE.height)
    assume(reaches(SHAPE, region))
    return region


def finely_coloured() -> Grid:
    """A ball of waves at which two texels a sample are enough, from pole to pole."""
    grid, random = DirectionGrid(SHAPE.width, SHAPE.height), np.random.default_rng(3)
    row, column = np.mgrid[: SHAPE.height, : SHAPE.width]
    towards = vectors(grid.theta_v(row), grid.theta_h(column))
    waves = np.sin(towards @ random.normal(0, 6, (3, 40)) + random.uniform(0, 6, 40)).sum(axis=-1)
    colours = np.clip(np.rint(128 + 9 * waves[..., None] * [1.0, 0.9, 0.8]), 0, 255).astype(np.uint8)
    steps = np.full((64, 128), 5000, np.uint16)
    return thin_grid(Grid(GridSpec(128, 64, 512, 256, 0.01, 1.0, geometry="sphere"), steps, colours))


TEXTURE = stone()
MAPS = PolarTexture(TEXTURE)


@given(caps(), st.sampled_from([4, 8]))
def test_a_strip_gets_its_texels_back_wherever_the_cap_lies(region: Cap, half_spacing: int) -> None:
    strips = strips_of(listed(region, half_spacing))
    polar = strips[0].polar
    assert polar is not None
    image = MAPS.image(strips, polar)
    assert image.shape[:2] == polar.sample_shape
    for strip, patch in zip(strips, texture_patches(strips, [image]), strict=True):
        selection = strip.selection
        columns = (selection.x.start + np.arange(int(selection.x.size.sum()))) * selection.lattice.shape.stride
        rows = slice(selection.y.start, selection.y.start + selection.y.low.size)
        truth = TEXTURE[rows][:, columns % SHAPE.width]
        off = np.abs(patch[:, : columns.size].astype(int) - truth)[selection.adopted_cells()]
        assert off.max() <= half_spacing


@given(caps())
def test_an_image_is_one_of_odd_sides_whatever_the_strips(region: Cap) -> None:
    strips = strips_of(listed(region))
    polar = strips[0].polar
    assert polar is not None and all(strip.polar is polar for strip in strips)
    assert polar.rows % 2 == polar.columns % 2 == 1
    assert samples_of(strips) == polar.samples
    assert all(image_shapes(strips, codec) == [polar.sample_shape] for codec in TextureCodec)


@given(caps())
def test_a_scan_without_maps_gives_the_same_image(region: Cap) -> None:
    strips = strips_of(listed(region))
    assert (polar := strips[0].polar) is not None
    np.testing.assert_array_equal(polar_samples(TEXTURE, strips, polar), MAPS.image(strips, polar))


@given(caps())
def test_holdings_know_nothing_of_it(region: Cap) -> None:
    parameters = listed(region)
    as_strips = strips_of(replace(parameters, polar=False))
    for one, other in zip(strips_of(parameters), as_strips, strict=True):
        np.testing.assert_array_equal(one.adopted, other.adopted)
        np.testing.assert_array_equal(one.selection.lattice.level, other.selection.lattice.level)


@pytest.mark.parametrize("is_lower", [False, True])
def test_the_pole_itself_is_where_the_map_begins(is_lower: bool) -> None:
    blocks = 13 if is_lower else 0
    strips = strips_of(Parameters(4, 0, blocks, 32, 3, polar=True))
    assert (polar := strips[0].polar) is not None
    assert polar.place.lower == is_lower
    assert -polar.left == polar.columns // 2 or -polar.left == polar.columns // 2 + 1
    radius = polar.place.radius(np.array([0, 255]))
    assert min(radius) == pytest.approx(np.pi / 512 * 256 / np.pi / 2, rel=1e-3)  # half a row, in samples of two


def test_texels_are_found_again_where_they_lie_on_the_map() -> None:
    place = strips_of(Parameters(4, 0, 0, 32, 3, polar=True))[0].polar
    assert place is not None
    row, column = np.arange(48), np.arange(0, 512, 11)
    radius, angle = place.place.radius(row)[:, None], place.place.angle(column)
    down, across = place.place.texel_at(radius * np.cos(angle), radius * np.sin(angle))
    np.testing.assert_allclose(down, np.broadcast_to(row[:, None], down.shape), atol=1e-9)
    np.testing.assert_allclose((across - column + 256) % 512, 256, atol=1e-9)


@pytest.mark.parametrize(
    ("shape", "parameters"),
    [
        (SHAPE, Parameters(2, 0, 0, 32, 3, polar=True)),
        (SHAPE, Parameters(3, 0, 0, 32, 3, polar=True)),
        (SHAPE, Parameters(4, 0, 0, 32, 9, polar=True)),
        (SHAPE, Parameters(4, 0, 7, 32, 9, polar=True)),
        (SHAPE, Parameters(4, 0, 0, 32, 3, 1 << 17, 0, polar=True)),
        (SHAPE, Parameters(4, 0, 0, 32, 3, strides=(1, 2), polar=True)),
        (replace(SHAPE, sphere=False), Parameters(4, 0, 0, 32, 3, polar=True)),
        (replace(SHAPE, channel=Channel.RANGE), Parameters(4, 0, 0, 64, 3, polar=True)),
    ],
)
def test_what_is_no_texture_of_a_hemisphere_is_refused(shape: ChannelShape, parameters: Parameters) -> None:
    with pytest.raises(LatticeError, match="pole|strides"):
        build_strips(shape, parameters)


def test_only_windows_near_enough_to_a_pole_are_on_the_maps() -> None:
    middles = (FARTHEST_RAD - 0.45) / np.pi, FARTHEST_RAD / np.pi
    near, far = (cap_region(0.3, v, 0.01, SHAPE.width, SHAPE.height) for v in middles)
    assert reaches(SHAPE, near) and not reaches(SHAPE, far)
    assert not reaches(replace(SHAPE, sphere=False), near)
    assert build_strips(SHAPE, listed(near))[0].parameters.strides == STRIDES


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scan, FirstView, TextureModel]:
    scan = keep(finely_coloured(), tmp_path_factory.mktemp("ball"))
    view = build_first_view(scan, "htj2k", 1024)
    return scan, view, TextureModel(scan.texture, texture_as_seen(view), sphere=True)


@pytest.mark.parametrize("codec", ["htj2k", "jpeg"])
@pytest.mark.parametrize("v", [0.0, 0.12, 0.93])
def test_a_look_near_a_pole_takes_one_image_and_reaches_its_quality(
    ball: tuple[Scan, FirstView, TextureModel], v: float, codec: CodecName
) -> None:
    scan, view, model = ball
    client = Model(view.info)
    for data in view.refinements(1):
        client.apply(Refinement.from_bytes(data))
    update = plan_look(scan, view.state, Look(1, 0.3, v, window=0.05, texture_db=40), codec, model=model).settled()
    (coded,) = (one for one in update.coded if one.channel is Channel.TEXTURE)
    assert coded.parameters.polar and len(coded.strips) > 1
    for seq, one in enumerate(update.coded, 2):
        client.apply(one.refinement(1, seq, 1))
    assert client.digest() == update.state.holdings.digest()
    cap = cap_region(0.3, v, 0.05, SHAPE.width, SHAPE.height)
    inside = cap.inside(np.arange(SHAPE.height), range(SHAPE.width)) * np.sin(
        DirectionGrid(SHAPE.width, SHAPE.height).theta_v(np.arange(SHAPE.height))
    )[:, None]
    squared = ((client.texture.astype(float) - scan.texture) ** 2).mean(axis=-1)
    db = 10 * np.log10(255**2 / ((squared * inside).sum() / inside.sum()))
    assert update.texture_db == pytest.approx(db, abs=0.07)
    assert db >= 39.99


def test_what_a_pole_takes_and_misses_is_known_beforehand(ball: tuple[Scan, FirstView, TextureModel]) -> None:
    scan, _, model = ball
    region = cap_region(0.3, 0.1, 0.05, SHAPE.width, SHAPE.height)
    strips = strips_of(listed(region))
    assert (polar := strips[0].polar) is not None and model.maps is not None
    image = model.maps.image(strips, polar)
    expected = model.expect(region, TextureCodec.HTJ2K, 2, strides=None)
    for quality in (20, 34):
        payload = encode_texture(image, TextureCodec.HTJ2K, quality)
        seen = texture_patches(strips, [decode_texture(payload, TextureCodec.HTJ2K, quality, polar.sample_shape)])
        compared = (Compared(scan, strip.selection, region) for strip in strips)
        error, values = np.sum([one.error(patch) for one, patch in zip(compared, seen, strict=True)], axis=0)
        assert expected.mse(quality) == pytest.approx(error / values, rel=0.4)
        assert expected.size_bytes(quality) == pytest.approx(len(payload), rel=0.4)


@pytest.mark.parametrize(("sampled_from", "off"), [(1 << 30, 1e-5), (0, 0.05)])
@pytest.mark.parametrize("v", [0.0, 0.12, 0.93])
def test_what_an_image_of_a_pole_leaves_is_told_by_a_quarter_of_many_texels(
    ball: tuple[Scan, FirstView, TextureModel], monkeypatch: pytest.MonkeyPatch, v: float, sampled_from: int, off: float
) -> None:
    scan, _, model = ball
    region = cap_region(0.01, v, 0.08, SHAPE.width, SHAPE.height)
    strips = strips_of(listed(region))
    assert (polar := strips[0].polar) is not None and model.maps is not None
    payload = encode_texture(model.maps.image(strips, polar), TextureCodec.HTJ2K, 20)
    seen = decode_texture(payload, TextureCodec.HTJ2K, 20, polar.sample_shape)
    pairs = zip(strips, texture_patches(strips, [seen]), strict=True)
    whole = np.sum([Compared(scan, strip.selection, region).error(patch) for strip, patch in pairs], axis=0)
    monkeypatch.setattr(refine_texture, "SAMPLED_FROM", sampled_from)
    parts = [compared_with(scan, strip, region).part_error(Part(strip, image=seen)) for strip in strips]
    error, values = np.sum(parts, axis=0)
    assert values == pytest.approx(whole[1], rel=max(off, 1e-9)) and error / values == pytest.approx(
        whole[0] / whole[1], rel=off
    )


def test_what_more_images_of_poles_miss_is_learned(ball: tuple[Scan, FirstView, TextureModel]) -> None:
    scan, view, _ = ball
    model = TextureModel(scan.texture, texture_as_seen(view), sphere=True)
    region = cap_region(0.3, 0.1, 0.05, SHAPE.width, SHAPE.height)
    before = [model.expect(region, TextureCodec.HTJ2K, 2, strides=strides).mse(30) for strides in (None, STRIDES)]
    for _ in range(20):
        model.learn(TextureCodec.HTJ2K, 2, 100, 100, polar=True, worse=1.1)
    after = [model.expect(region, TextureCodec.HTJ2K, 2, strides=strides).mse(30) for strides in (None, STRIDES)]
    assert after[0] > 1.5 * before[0] and after[1] == before[1]
