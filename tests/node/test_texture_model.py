from __future__ import annotations

import numpy as np
import pytest

from node.refine_texture import db_of_mse, mse_of_db
from node.texture_model import Expected, TextureModel
from protocol.codec import TextureCodec, decode_texture, encode_texture
from protocol.region import Region, region_round
from tests.node.scans import make_grid

TEXTURE = make_grid().texture
MODEL = TextureModel(TEXTURE)


def coded(region: Region, quality: int) -> tuple[float, int]:
    """Squared error and bytes of a region's own patch."""
    patch = np.ascontiguousarray(TEXTURE[region.rows][:, region.columns])
    payload = encode_texture(patch, TextureCodec.HTJ2K, quality)
    missed = patch.astype(float) - decode_texture(payload, TextureCodec.HTJ2K, quality, patch.shape[:2])
    return float(np.mean(missed**2)), len(payload)


@pytest.mark.parametrize("u", [0.62, 0.75, 0.99])
@pytest.mark.parametrize("target_db", [34, 38, 42])
def test_the_first_guess_is_near(u: float, target_db: float) -> None:
    region = region_round(u, 0.5, 0.1, TEXTURE.shape[1], TEXTURE.shape[0])
    expected = MODEL.expect(region, TextureCodec.HTJ2K)
    mse, size = coded(region, expected.quality_for_mse(mse_of_db(target_db)))
    assert db_of_mse(mse) == pytest.approx(target_db, abs=1.5)
    assert expected.size_bytes(expected.quality_for_mse(mse_of_db(target_db))) == pytest.approx(size, rel=0.4)


def test_quality_for_bytes_undoes_size_bytes() -> None:
    expected = MODEL.expect(region_round(0.7, 0.5, 0.1, TEXTURE.shape[1], TEXTURE.shape[0]), TextureCodec.HTJ2K)
    for quality in (10, 30, 50, 70, 90):
        assert expected.quality_for_bytes(expected.size_bytes(quality) * 1.001) == pytest.approx(quality, abs=1)


def test_bytes_are_learned_from_what_is_sent() -> None:
    model = TextureModel(TEXTURE[:256, :256])
    region = region_round(0.5, 0.5, 1.0, 256, 256)
    before = model.expect(region, TextureCodec.JPEG).size_bytes(40)
    for _ in range(20):
        model.learn(TextureCodec.JPEG, model.expect(region, TextureCodec.JPEG).size_bytes(40), round(1.3 * before))
    assert model.expect(region, TextureCodec.JPEG).size_bytes(40) == pytest.approx(1.3 * before, rel=0.03)


def test_generic_expectation_puts_the_target_in_the_middle() -> None:
    expected = Expected.generic(mse_of_db(40), 5000)
    quality = expected.quality_for_mse(mse_of_db(40))
    assert expected.mse(quality) <= mse_of_db(40) * 1.001
    assert expected.size_bytes(quality) == pytest.approx(5000, rel=0.1)
