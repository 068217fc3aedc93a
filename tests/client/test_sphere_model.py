"""A spherical model takes in the golden refinements, and refuses what does not fit."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from client.errors import HoldingsDiffer
from client.model import Model
from protocol.codec import RangeCodec, TextureCodec, encode_range, encode_texture
from protocol.errors import RemoteWireError
from protocol.lattice import Channel
from protocol.messages import ScanInfo
from protocol.refinement import Generator, Refinement
from tests.golden.write_sphere import FOLDER, RANGE, TEXTURE

STEPS: list[dict[str, Any]] = json.loads((FOLDER / "strips.json").read_text())["range"]


@pytest.fixture
def model() -> Model:
    """As the golden vectors begin: every sample 1, nothing held."""
    coarse = RANGE.coarse_width, RANGE.coarse_height, TEXTURE.coarse_width, TEXTURE.coarse_height
    info = ScanInfo("golden", 64, 136, 64, 136, *coarse, 0.01, 1.0, 0.0, 0.0, geometry="sphere")
    model = Model(info)
    steps = encode_range(np.ones((17, 8), np.uint16), RangeCodec.RAW)
    texels = encode_texture(np.zeros((17, 8, 3), np.uint8), TextureCodec.HTJ2K, 255)
    model.apply(Refinement(Generator.COARSE, Channel.RANGE, 1, 0, 0, RangeCodec.RAW, 1, 136, steps))
    model.apply(Refinement(Generator.COARSE, Channel.TEXTURE, 1, 1, 0, TextureCodec.HTJ2K, 255, 136, texels))
    return model


def test_golden_refinements_are_applied_to_the_bit(model: Model) -> None:
    for step in STEPS:
        if step["refinement"] is not None:
            blocks = model.apply(Refinement.from_bytes(bytes.fromhex(step["refinement"]))).blocks
            assert blocks.tolist() == step["adopted"]
        assert model.holdings.channels[Channel.RANGE].to_runs() == step["runs"]
        assert model.digest() == step["digest"]
    assert model.range_steps.astype("<u2").tobytes() == (FOLDER / "range.bin").read_bytes()


def test_what_was_applied_once_is_refused_the_second_time(model: Model) -> None:
    refinement = Refinement.from_bytes(bytes.fromhex(STEPS[0]["refinement"]))
    model.apply(refinement)
    with pytest.raises(HoldingsDiffer):
        model.apply(refinement)


@pytest.mark.parametrize("change", [
    lambda one: replace(one, payload=one.payload[:-1]), lambda one: replace(one, payload=one.payload + b"\0"),
    lambda one: replace(one, mask=one.mask[:-1]), lambda one: replace(one, samples=one.samples + 1),
])  # fmt: skip
def test_what_does_not_fit_its_strips_changes_nothing(model: Model, change: Any) -> None:
    whole = Refinement.from_bytes(bytes.fromhex(STEPS[1]["refinement"]))
    model.apply(Refinement.from_bytes(bytes.fromhex(STEPS[0]["refinement"])))
    before, digest = model.range_steps.copy(), model.digest()
    assert whole.mask
    with pytest.raises((RemoteWireError, HoldingsDiffer)):
        model.apply(change(whole))
    np.testing.assert_array_equal(model.range_steps, before)
    assert model.digest() == digest
    model.apply(whole)
