import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from client.classic_model import ClassicModel
from client.errors import HoldingsDiffer
from client.model import Model
from client.replica import Replica
from protocol import codec_jpeg
from protocol import messages as m
from protocol.classic import ClassicParameters, build_classic, claim, kept_samples, single
from protocol.codec import LOSSLESS, RangeCodec, TextureCodec, encode_texture
from protocol.errors import RemoteWireError
from protocol.lattice import Channel, Parameters
from protocol.refinement import Generator, Refinement

INFO = m.ScanInfo("ab12", 72, 40, 144, 80, 4, 5, 36, 20, 0.01, 0.5, 20.0, 0.0, profile="classic")
FOVEA = ClassicParameters(3, 70, 20, single(0.4), single(0.4), single(2.5), single(2.5))
STEPS = np.arange(5000, 5020, dtype="<u2")
TEXELS = np.random.default_rng(2).integers(0, 256, (20, 36, 3)).astype(np.uint8)


def first_view(steps: np.ndarray = STEPS) -> list[Refinement]:
    colour = encode_texture(TEXELS, TextureCodec.HTJ2K, LOSSLESS)
    return [
        Refinement(Generator.COARSE, Channel.RANGE, 1, 0, 0, RangeCodec.RAW, 1, 20, steps.tobytes()),
        Refinement(Generator.COARSE, Channel.TEXTURE, 1, 1, 0, TextureCodec.HTJ2K, LOSSLESS, 720, colour),
    ]


def opened(steps: np.ndarray = STEPS) -> ClassicModel:
    model = ClassicModel(INFO)
    for refinement in first_view(steps):
        model.apply(refinement)
    return model


def range_fovea(value: int = 6000) -> Refinement:
    lattice = build_classic(INFO.shapes()[Channel.RANGE], FOVEA)
    kept = kept_samples(lattice, claim(lattice, []))
    payload = np.full(kept.sum(), value, "<u2").tobytes()
    count = int(kept.sum())
    return Refinement(
        Generator.CLASSIC, Channel.RANGE, 1, 2, 1, RangeCodec.RAW, 1, count, payload, parameters=FOVEA
    )  # fmt: skip


def texture_fovea() -> Refinement:
    parameters = replace(FOVEA, x=140, y=0)
    lattice = build_classic(INFO.shapes()[Channel.TEXTURE], parameters)
    payload = codec_jpeg.encode(np.full((lattice.y.size, lattice.x.size, 3), 77, np.uint8), 90)
    count = lattice.y.size * lattice.x.size
    return Refinement(
        Generator.CLASSIC, Channel.TEXTURE, 1, 3, 1, TextureCodec.JPEG, 90, count, payload, parameters=parameters
    )  # fmt: skip


def test_an_opening_decides_which_model_it_is() -> None:
    assert isinstance(Replica(m.Opened(1, 1, INFO)).model, ClassicModel)
    default = m.ScanInfo("ab12", 72, 40, 144, 80, 4, 5, 36, 20, 0.01, 0.5, 20.0, 0.0)
    assert not isinstance(Replica(m.Opened(1, 1, default)).model, ClassicModel)


def test_the_first_view_fills_the_dense_grids() -> None:
    model = opened()
    assert model.complete and model.range_mm.shape == (40, 72) and model.texture.shape == (80, 144, 3)
    np.testing.assert_allclose(model.range_mm[0, ::18], STEPS[:4] * 0.01, atol=1e-4)
    np.testing.assert_allclose(model.range_mm[0, 63], (STEPS[3] + STEPS[0]) * 0.005, atol=1e-4)
    np.testing.assert_array_equal(model.range_mm[39, ::18], np.float32(STEPS[16:] * 0.01))
    np.testing.assert_array_equal(model.texture[79, ::4], TEXELS[19])
    np.testing.assert_array_equal(model.coarse_texture, TEXELS)
    assert (model.spacing == 18).all() and (model.owner == 0).all() and model.digest() == "0" * 16


def test_a_hole_in_the_first_view_takes_what_hangs_on_it() -> None:
    steps = STEPS.copy()
    steps[5] = 0
    model = opened(steps)
    void = np.isnan(model.range_mm)
    assert void[10, 18] and void[10, 1] and void[1, 18] and void[18, 35]
    assert not void[10, 0] and not void[10, 36] and not void[0, 18]
    np.testing.assert_array_equal(void, model.range_steps == 0)


def test_a_fovea_overwrites_what_it_owns_and_nothing_else() -> None:
    model = opened()
    before = model.range_mm
    applied = model.apply(range_fovea())
    owned = model.owner == 3
    assert owned[20, 70] and owned[20, 2] and not owned[20, 40]
    assert (model.range_steps[owned] == 6000).all()
    np.testing.assert_array_equal(model.range_mm[owned], np.float32(60.0))
    np.testing.assert_array_equal(model.range_mm[~owned], before[~owned])
    rows, columns = np.nonzero(owned)
    np.testing.assert_array_equal(applied.blocks, np.unique(rows // 8 * 9 + columns // 8))
    assert model.spacing[20, 70] == pytest.approx(1.0) and (model.spacing[~owned] == 18).all()


def test_a_hole_among_the_samples_is_a_hole() -> None:
    model = opened()
    model.apply(range_fovea(0))
    np.testing.assert_array_equal(np.isnan(model.range_mm), model.owner == 3)


def test_texture_is_mapped_back_to_texels() -> None:
    model = opened()
    before = model.texture.copy()
    model.apply(texture_fovea())
    changed = (model.texture != before).any(2)
    assert (np.abs(model.texture[changed].astype(int) - 77) <= 2).all()
    assert changed[0, 140] and changed[0, 0] and not changed[0, 70]
    assert (model.owner == 0).all()  # of range


def test_positions_are_reported() -> None:
    y, x = opened().positions(Channel.RANGE, FOVEA)
    right = np.diff(x[x >= 70])
    np.testing.assert_allclose(right[1:] / right[:-1], math.exp(1 / FOVEA.s_x), rtol=1e-9)
    assert 20.0 in y and 70.0 in x


@pytest.mark.parametrize("samples", [1, 100000])
def test_another_count_is_a_disagreement(samples: int) -> None:
    model = opened()
    with pytest.raises(HoldingsDiffer):
        model.apply(replace(range_fovea(), samples=samples))
    assert (model.owner == 0).all() and model.digest() == "0" * 16


def test_a_fovea_that_owns_nothing_is_a_disagreement() -> None:
    model = opened()
    model.apply(range_fovea())
    with pytest.raises(HoldingsDiffer):
        model.apply(range_fovea())


@pytest.mark.parametrize(
    "wrong",
    [
        replace(range_fovea(), codec=RangeCodec.HTJ2K),
        replace(range_fovea(), quality=2),
        replace(range_fovea(), mask=b"x"),
        replace(range_fovea(), payload=b"123"),
        replace(range_fovea(), parameters=replace(FOVEA, x=72)),
        replace(range_fovea(), parameters=Parameters(2, 0, 0, 1, 1)),
        replace(texture_fovea(), codec=TextureCodec.HTJ2K),
        replace(texture_fovea(), quality=0),
        replace(texture_fovea(), quality=101),
        replace(texture_fovea(), payload=b"\xff\xd9x"),
        replace(texture_fovea(), mask=b"x"),
        replace(first_view()[0], seq=2),
    ],
)
def test_what_makes_no_sense_is_refused_and_changes_nothing(wrong: Refinement) -> None:
    model = opened()
    before = model.range_mm, model.texture.copy()
    with pytest.raises(RemoteWireError):
        model.apply(wrong)
    np.testing.assert_array_equal(model.range_mm, before[0])
    np.testing.assert_array_equal(model.texture, before[1])


@pytest.mark.parametrize("wrong", [{"codec": RangeCodec.LIFT}, {"payload": b""}, {"samples": 21}])
def test_a_first_view_that_makes_no_sense_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(RemoteWireError):
        ClassicModel(INFO).apply(replace(first_view()[0], **wrong))


def test_no_fovea_comes_before_the_first_view() -> None:
    with pytest.raises(RemoteWireError, match="before the first view"):
        ClassicModel(INFO).apply(range_fovea())


def test_a_default_model_takes_no_classic_fovea() -> None:
    model = Model(m.ScanInfo("ab12", 72, 40, 144, 80, 4, 5, 36, 20, 0.01, 0.5, 20.0, 0.0))
    for refinement in first_view():
        model.apply(refinement)
    with pytest.raises(RemoteWireError, match="another profile"):
        model.apply(range_fovea())


def test_what_it_states_is_its_place() -> None:
    assert opened().state() == m.Statement([], [])
