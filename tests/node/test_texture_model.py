from __future__ import annotations

import cv2
import numpy as np
import pytest

from node.quality import ceiled
from node.refine_texture import db_of_mse, mse_of_db
from node.texture_model import Expected, TextureModel
from protocol.codec import SIXTEENTHS, TextureCodec, decode_texture, encode_texture
from protocol.region import Region, region_round
from tests.node.scans import make_grid

TEXTURE = make_grid().texture
MODEL = TextureModel(TEXTURE)


def coded(region: Region, quality: float) -> tuple[float, int]:
    """Squared error and bytes of a region's own patch."""
    patch = np.ascontiguousarray(TEXTURE[region.rows][:, region.columns])
    quality = ceiled(quality, 1 / SIXTEENTHS)
    payload = encode_texture(patch, TextureCodec.HTJ2K, quality)
    missed = patch.astype(float) - decode_texture(payload, TextureCodec.HTJ2K, int(quality), patch.shape[:2])
    return float(np.mean(missed**2)), len(payload)


@pytest.mark.parametrize("u", [0.62, 0.75, 0.99])
@pytest.mark.parametrize("target_db", [34, 38, 42])
def test_the_first_guess_is_near(u: float, target_db: float) -> None:
    region = region_round(u, 0.5, 0.1, TEXTURE.shape[1], TEXTURE.shape[0])
    expected = MODEL.expect(region, TextureCodec.HTJ2K)
    mse, size = coded(region, expected.quality_for_mse(mse_of_db(target_db)))
    assert db_of_mse(mse) == pytest.approx(target_db, abs=1.5)
    assert expected.size_bytes(expected.quality_for_mse(mse_of_db(target_db))) == pytest.approx(size, rel=0.25)


@pytest.mark.parametrize("codec", list(TextureCodec))
@pytest.mark.parametrize("p", [1, 2, 4])
@pytest.mark.parametrize("quality", [34, 45])
def test_every_codec_and_spacing_is_known(codec: TextureCodec, p: int, quality: int) -> None:
    region = Region(320, 80, 320, 160, 640)
    patch = TEXTURE[region.rows][:, region.columns]
    samples = np.asarray(cv2.resize(patch, (320 // p, 160 // p), interpolation=cv2.INTER_AREA), np.uint8)
    payload = encode_texture(samples, codec, quality)
    decoded = decode_texture(payload, codec, quality, (160 // p, 320 // p))
    missed = cv2.resize(decoded, (320, 160), interpolation=cv2.INTER_LINEAR).astype(float) - patch
    expected = MODEL.expect(region, codec, p)
    ratio = expected.size_bytes(quality) / len(payload)
    assert 1 / 2.5 < ratio < 2.5  # half of this texture is noise, which comes within a few steps of quality
    assert db_of_mse(expected.mse(quality)) == pytest.approx(db_of_mse(float(np.mean(missed**2))), abs=1.5)


def test_a_part_takes_a_part() -> None:
    region = region_round(0.5, 0.5, 0.2, TEXTURE.shape[1], TEXTURE.shape[0])
    _, _, wide, high = region.blocks(16)
    left = np.zeros((high, wide), np.bool_)
    left[:, : wide // 2] = True
    whole = MODEL.expect(region, TextureCodec.HTJ2K).size_bytes(40)
    parts = [MODEL.expect(region, TextureCodec.HTJ2K, 1, among).size_bytes(40) for among in (left, ~left)]
    assert max(parts) < whole < sum(parts) < 1.3 * whole


def test_what_is_kept_counts_in_the_error() -> None:
    expected = Expected.generic(mse_of_db(40), 5000).beside(0.5, mse_of_db(30))
    alone = Expected.generic(mse_of_db(40), 5000)
    assert expected.mse(34) == pytest.approx((alone.mse(34) + mse_of_db(30)) / 2)


def test_quality_for_bytes_undoes_size_bytes() -> None:
    expected = MODEL.expect(region_round(0.7, 0.5, 0.1, TEXTURE.shape[1], TEXTURE.shape[0]), TextureCodec.HTJ2K)
    for quality in (2, 10, 30, 50, 70, 90):
        assert expected.quality_for_bytes(expected.size_bytes(quality) * 1.001) == pytest.approx(quality, abs=1)


def test_bytes_are_learned_from_what_is_sent() -> None:
    model = TextureModel(TEXTURE[:256, :256])
    region = region_round(0.5, 0.5, 1.0, 256, 256)
    before = model.expect(region, TextureCodec.JPEG).size_bytes(40)
    for _ in range(20):
        model.learn(TextureCodec.JPEG, 1, model.expect(region, TextureCodec.JPEG).size_bytes(40), round(1.3 * before))
    assert model.expect(region, TextureCodec.JPEG).size_bytes(40) == pytest.approx(1.3 * before, rel=0.03)


def test_what_is_missed_is_learned_too() -> None:
    model = TextureModel(TEXTURE[:256, :256])
    region = region_round(0.5, 0.5, 1.0, 256, 256)
    before = model.expect(region, TextureCodec.HTJ2K).mse(40)
    for _ in range(20):
        worse = 1.2 * before / model.expect(region, TextureCodec.HTJ2K).mse(40)
        model.learn(TextureCodec.HTJ2K, 1, 100, 100, worse=worse)
    assert model.expect(region, TextureCodec.HTJ2K).mse(40) == pytest.approx(1.2 * before, rel=0.02)
    assert model.expect(region, TextureCodec.HTJ2K, 2).mse(40) == TextureModel(TEXTURE[:256, :256]).expect(
        region, TextureCodec.HTJ2K, 2
    ).mse(40)


def test_generic_expectation_puts_the_target_in_the_middle() -> None:
    expected = Expected.generic(mse_of_db(40), 5000)
    quality = expected.quality_for_mse(mse_of_db(40))
    assert expected.mse(quality) <= mse_of_db(40) * 1.001
    assert expected.size_bytes(quality) == pytest.approx(5000, rel=0.1)
