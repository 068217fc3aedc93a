"""The codecs: what goes in comes out, and golden bytes decode for ever."""

from __future__ import annotations

import json
import runpy
from pathlib import Path
from typing import Any

import cv2
import imagecodecs
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from protocol import codec, codec_colours, codec_htj2k, codec_jpeg, codec_lift
from protocol.codec import RangeCodec, TextureCodec
from protocol.errors import CodecError
from protocol.grid import BoolArray, ImageArray, StepArray
from tests.protocol.images import discs, ranges, shapes, texture

GOLDEN = Path(__file__).parents[1] / "golden"
INDEX = json.loads((GOLDEN / "codec" / "vectors.json").read_text())
SHAPES = [(1, 1), (1, 9), (9, 1), (2, 2), (7, 33), (40, 30), (64, 130), (257, 64)]
QUALITIES = {TextureCodec.JPEG: (12, 40, 53), TextureCodec.HTJ2K: (0, 40, 95)}
LOSSY = [(kind, quality) for kind, qualities in QUALITIES.items() for quality in qualities]
measured = shapes.flatmap(lambda shape: arrays(np.uint16, shape, elements=st.integers(1, 65535)))


# --- round trips


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", RangeCodec)
def test_range_returns_exactly(shape: tuple[int, int], kind: RangeCodec) -> None:
    values = ranges(shape)
    decoded = codec.decode_range(codec.encode_range(values, kind), kind, shape)
    assert decoded.dtype == np.uint16
    np.testing.assert_array_equal(decoded, values)


@settings(max_examples=60, deadline=None)
@given(measured, st.sampled_from(RangeCodec))
def test_any_range_returns_exactly(values: StepArray, kind: RangeCodec) -> None:
    payload = codec.encode_range(values, kind)
    np.testing.assert_array_equal(codec.decode_range(payload, kind, values.shape), values)


@settings(max_examples=100, deadline=None)
@given(measured, st.integers(1, 65534), st.sampled_from(RangeCodec), st.integers(0, 2**32 - 1))
def test_any_range_returns_within_half_a_quantum(values: StepArray, quantum: int, kind: RangeCodec, seed: int) -> None:
    care = np.random.default_rng(seed).random(values.shape) < 0.7
    decoded = codec.decode_range(codec.encode_range(values, kind, quantum, care), kind, values.shape, quantum)
    far = np.abs(decoded.astype(int) - values) > quantum // 2
    assert not (far & care).any() if kind is RangeCodec.LIFT and max(values.shape) > 2 else not far.any()


def test_lift_surveys_what_it_decodes_to() -> None:
    values = ranges((33, 40))
    care = discs((33, 40))
    surveyed = codec_lift.Survey(values, 300, care)
    payload = codec_lift.encode(values, 300, care)
    np.testing.assert_array_equal(surveyed.decoded, codec_lift.decode(payload, (33, 40), 300))
    assert 0.5 < codec_lift.expected_bytes([surveyed]) / len(payload) < 2


def test_lift_carries_several_images_in_fewer_bytes_than_one_each() -> None:
    shapes = [(33, 40), (1, 7), (56, 180)]
    images = [codec_lift.Survey(ranges(shape), 300) for shape in shapes]
    payload = codec_lift.encode_surveyed(images)
    decoded = codec.decode_ranges(payload, RangeCodec.LIFT, shapes, 300)
    for image, steps in zip(images, decoded, strict=True):
        np.testing.assert_array_equal(steps, image.decoded)
    assert len(payload) < sum(len(codec_lift.encode_surveyed([image])) for image in images)
    with pytest.raises(CodecError, match="LIFT alone"):
        codec.decode_ranges(payload, RangeCodec.RAW, shapes, 300)
    with pytest.raises(CodecError):
        codec.decode_ranges(payload, RangeCodec.LIFT, shapes[:2], 300)
    with pytest.raises(CodecError):
        codec.decode_ranges(payload, RangeCodec.LIFT, [*shapes, (4, 4)], 300)
    with pytest.raises(CodecError, match="shape"):
        codec.decode_ranges(payload, RangeCodec.LIFT, [(33, 40), (0, 7)], 300)


@settings(max_examples=60, deadline=None)
@given(shapes.flatmap(lambda shape: arrays(np.uint8, (*shape, 3))))
def test_any_texture_returns_exactly_when_lossless(image: ImageArray) -> None:
    payload = codec.encode_texture(image, TextureCodec.HTJ2K, codec.LOSSLESS)
    decoded = codec.decode_texture(payload, TextureCodec.HTJ2K, codec.LOSSLESS, image.shape[:2])
    np.testing.assert_array_equal(decoded, image)


@pytest.mark.parametrize(
    ("kind", "quality"), [(TextureCodec.HTJ2K, q) for q in range(8, 96, 8)] + [(TextureCodec.JPEG, q) for q in (16, 53)]
)
def test_black_and_white_stay_so_at_every_quality(kind: TextureCodec, quality: int) -> None:
    image = np.full((64, 96, 3), 255, np.uint8)
    cv2.putText(image, "wrap", (2, 45), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (0, 0, 0), 4)
    decoded = codec.decode_texture(codec.encode_texture(image, kind, quality), kind, quality, (64, 96))
    assert cv2.PSNR(image, decoded) > min(10 + quality / 2, 50)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(("kind", "quality"), LOSSY)
def test_lossy_texture_keeps_its_shape_at_every_quality(
    shape: tuple[int, int], kind: TextureCodec, quality: int
) -> None:
    payload = codec.encode_texture(texture(shape), kind, quality)
    assert codec.decode_texture(payload, kind, quality, shape).shape == (*shape, 3)


@pytest.mark.parametrize("kind", TextureCodec)
def test_a_better_quality_is_nearer_the_truth_and_larger(kind: TextureCodec) -> None:
    image = texture((64, 96))
    payloads = {q: codec.encode_texture(image, kind, q) for q in (15, 30, 45, 53)}
    psnr_db = [cv2.PSNR(image, codec.decode_texture(p, kind, q, (64, 96))) for q, p in payloads.items()]
    assert psnr_db == sorted(psnr_db)
    assert list(payloads.values()) == sorted(payloads.values(), key=len)


def test_colours_keep_their_order() -> None:
    red = np.zeros((16, 16, 3), np.uint8)
    red[..., 0] = 255
    for kind in TextureCodec:
        decoded = codec.decode_texture(codec.encode_texture(red, kind, 50), kind, 50, (16, 16))
        assert np.abs(decoded.astype(int) - red).max() <= 6


def test_a_patch_of_a_larger_array_needs_no_copy_by_the_caller() -> None:
    image = texture((64, 64))[8:40:2, 5:37]
    for kind in TextureCodec:
        decoded = codec.decode_texture(codec.encode_texture(image, kind, 53), kind, 53, (16, 32))
        assert cv2.PSNR(np.ascontiguousarray(image), decoded) > 35
    values = ranges((64, 64))[8:40:2, 5:37]
    for range_kind in RangeCodec:
        payload = codec.encode_range(values, range_kind)
        np.testing.assert_array_equal(codec.decode_range(payload, range_kind, (16, 32)), values)


@settings(max_examples=150, deadline=None)
@given(shapes.flatmap(lambda shape: arrays(np.bool_, shape)))
def test_any_mask_returns_exactly(mask: BoolArray) -> None:
    np.testing.assert_array_equal(codec.decode_mask(codec.encode_mask(mask), mask.shape), mask)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.001, 0.03, 0.5, 0.999]), st.booleans())
def test_masks_of_discs_and_noise_return_exactly(seed: int, noise: float, turned: bool) -> None:
    mask = discs((120, 170)) ^ (np.random.default_rng(seed).random((120, 170)) < noise)
    mask = np.ascontiguousarray(mask.T) if turned else mask
    np.testing.assert_array_equal(codec.decode_mask(codec.encode_mask(mask), mask.shape), mask)


def test_a_mask_never_takes_more_than_its_bits() -> None:
    noise = np.random.default_rng(1).random((200, 300)) < 0.5
    assert len(codec.encode_mask(noise)) <= noise.size // 8 + 32
    assert codec.encode_mask(np.zeros((200, 300), np.bool_)) == b""


# --- headers that do not travel


@pytest.mark.parametrize("side", [1, 5, 8, 16, 33, 64, 129, 256, 520])
def test_openjph_writes_the_headers_that_are_rebuilt(side: int) -> None:
    image, values = np.zeros((side, side + 3, 3), np.uint16), np.zeros((side + 3, side), np.uint16)
    for quality in range(0, 16 * codec.LOSSY_MAX + 1, 1 if side <= 16 else 7):
        codec_htj2k.encode(image, quality / 16)
    codec_htj2k.encode(image.astype(np.uint8), codec.LOSSLESS)
    codec_htj2k.encode(values, codec.LOSSLESS)


@pytest.mark.parametrize("shape", [(1, 1), (3, 500), (64, 48)])
def test_libjpeg_writes_the_headers_that_are_rebuilt(shape: tuple[int, int]) -> None:
    for q in range(1, 101):
        codec_jpeg.encode(texture(shape), q)


def test_an_encoder_with_other_headers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    strange_j2k = bytes(imagecodecs.htj2k_encode(texture((32, 32)), resolutions=1))
    strange_jpeg = cv2.imencode(".jpg", texture((32, 32)), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    monkeypatch.setattr(imagecodecs, "htj2k_encode", lambda *_, **__: strange_j2k)
    monkeypatch.setattr(imagecodecs, "jpeg8_encode", lambda *_, **__: strange_jpeg)
    for kind in TextureCodec:
        with pytest.raises(CodecError, match="would not rebuild"):
            codec.encode_texture(texture((32, 32)), kind, 40)


def test_rebuilt_streams_are_ordinary_files() -> None:
    image = texture((40, 56))
    jpeg = codec_jpeg.restore(codec_jpeg.encode(image, 75), (40, 56), 75)
    by_opencv = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert by_opencv is not None and cv2.PSNR(image, by_opencv) > 35
    j2k = codec_htj2k.restore(codec_htj2k.encode(image, codec.LOSSLESS), image.shape, codec.LOSSLESS)
    np.testing.assert_array_equal(imagecodecs.htj2k_decode(j2k), image)
    values = image.astype(np.uint16) * codec_htj2k.LEVEL
    lossy = imagecodecs.htj2k_decode(codec_htj2k.restore(codec_htj2k.encode(values, 60.5), image.shape, 60.5))
    assert cv2.PSNR(image, (lossy / codec_htj2k.LEVEL).round().astype(np.uint8)) > 45


def test_small_jpegs_do_without_fitted_tables_and_large_ones_carry_them() -> None:
    assert not codec_jpeg.encode(texture((8, 8)), 75).startswith(b"\xff\xc4")
    assert codec_jpeg.encode(texture((257, 300)), 75).startswith(b"\xff\xc4")


def test_a_quick_jpeg_is_larger_and_the_same_image() -> None:
    small, quick = (codec.encode_texture(texture((130, 200)), TextureCodec.JPEG, 40, quick=q) for q in (False, True))
    assert len(small) < len(quick) and not quick.startswith(b"\xff\xc4")
    first, second = (codec.decode_texture(payload, TextureCodec.JPEG, 40, (130, 200)) for payload in (small, quick))
    np.testing.assert_array_equal(first, second)


# --- turned colours


def test_colours_of_one_hue_take_less_than_grey_and_two_differences() -> None:
    y, x = np.mgrid[:96, :128]
    waves = (np.sin(x / 3) * np.cos(y / 5))[..., None] * (90, 20, -60)
    image = np.clip(128 + waves, 0, 255).astype(np.uint8)
    turned = codec_colours.encode(image, 40)
    usual = codec_htj2k.encode(image.astype(np.uint16) * codec_htj2k.LEVEL, 40)
    assert cv2.PSNR(image, codec_colours.decode(turned, (96, 128), 40)) > 40
    assert len(turned) < 0.8 * len(usual)


@settings(max_examples=60, deadline=None)
@given(shapes.flatmap(lambda shape: arrays(np.uint8, (*shape, 3))))
def test_any_texture_returns_nearly_at_the_best_quality(image: ImageArray) -> None:
    payload = codec.encode_texture(image, TextureCodec.HTJ2K, 80)
    decoded = codec.decode_texture(payload, TextureCodec.HTJ2K, 80, image.shape[:2])
    assert np.abs(decoded.astype(int) - image).max() <= 1


def test_a_quality_between_two_whole_ones_lies_between_them() -> None:
    image = texture((64, 96))
    image[::5] //= 2
    payloads = [codec.encode_texture(image, TextureCodec.HTJ2K, 40 + part / 4) for part in range(5)]
    db = [
        cv2.PSNR(image, codec.decode_texture(payload, TextureCodec.HTJ2K, 40 + part // 4, (64, 96)))
        for part, payload in enumerate(payloads)
    ]
    assert sorted(db) == db and sorted(payloads, key=len) == payloads


def test_images_of_one_texture_are_turned_as_suits_the_largest() -> None:
    images = [texture((40, 64)), texture((64, 96)), texture((24, 32))]
    payloads = codec.encode_textures(images, TextureCodec.HTJ2K, 45.5)
    assert [payload[:5] for payload in payloads] == [payloads[1][:5]] * 3
    assert payloads[1] == codec.encode_texture(images[1], TextureCodec.HTJ2K, 45.5)
    for image, payload in zip(images, payloads, strict=True):
        decoded = codec.decode_texture(payload, TextureCodec.HTJ2K, 45, (image.shape[0], image.shape[1]))
        assert cv2.PSNR(image, decoded) > 40
    exact = codec.encode_textures(images, TextureCodec.HTJ2K, codec.LOSSLESS)
    assert exact == [codec.encode_texture(image, TextureCodec.HTJ2K, codec.LOSSLESS) for image in images]


@pytest.mark.parametrize("prefix", [b"\x10\x7f\0\0\0", b"\xff\x7f\0\0\0", b"\0\0\0\0\0"])
def test_more_than_sixteenths_and_no_turn_are_refused(prefix: bytes) -> None:
    payload = codec.encode_texture(texture((33, 40)), TextureCodec.HTJ2K, 45)
    with pytest.raises(CodecError, match="sixteenths"):
        codec.decode_texture(prefix + payload[5:], TextureCodec.HTJ2K, 45, (33, 40))


# --- golden vectors


def samples_of(vector: dict[str, Any]) -> NDArray[Any]:
    dtype = {"texture": "u1", "range": "<u2", "mask": "?"}[vector["channel"]]
    shape = (*vector["shape"], 3) if vector["channel"] == "texture" else vector["shape"]
    samples = np.fromfile(GOLDEN / "codec" / f"{vector['name']}.samples", dtype)
    return samples.reshape(shape)


def decoded(vector: dict[str, Any], payload: bytes) -> NDArray[Any]:
    shape = tuple(vector["shape"])
    if vector["channel"] == "mask":
        return codec.decode_mask(payload, shape)
    if vector["channel"] == "range":
        return codec.decode_range(payload, RangeCodec(vector["codec"]), shape, vector.get("quantum", 1))
    return codec.decode_texture(payload, TextureCodec(vector["codec"]), vector["quality"], shape)


@pytest.mark.parametrize("vector", INDEX["vectors"], ids=lambda vector: vector["name"])
def test_golden_payloads_decode_for_ever(vector: dict[str, Any]) -> None:
    payload = (GOLDEN / "codec" / f"{vector['name']}.payload").read_bytes()
    difference = np.abs(decoded(vector, payload).astype(int) - samples_of(vector).astype(int)).max()
    assert difference <= (2 if vector.get("quality", 255) < codec.LOSSLESS else 0)


def test_golden_headers_are_rebuilt_for_ever() -> None:
    assert runpy.run_path(str(GOLDEN / "write_codec.py"))["header_hashes"]() == INDEX["headers"]
