"""Payloads that nobody encoded: the codecs raise CodecError and nothing else, or decode to the shape asked for."""

from __future__ import annotations

import zlib
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import codec, codec_jpeg
from protocol.codec import RangeCodec, TextureCodec
from protocol.errors import CodecError
from tests.protocol.images import discs, ranges, shapes, texture

Decoder = Callable[[bytes, tuple[int, int]], object]
DECODERS: dict[str, tuple[bytes, Decoder]] = {
    "jpeg": (
        codec.encode_texture(texture((33, 40)), TextureCodec.JPEG, 45),
        lambda payload, shape: codec.decode_texture(payload, TextureCodec.JPEG, 45, shape),
    ),
    "htj2k": (
        codec.encode_texture(texture((33, 40)), TextureCodec.HTJ2K, 45),
        lambda payload, shape: codec.decode_texture(payload, TextureCodec.HTJ2K, 45, shape),
    ),
    "lossless": (
        codec.encode_texture(texture((33, 40)), TextureCodec.HTJ2K, codec.LOSSLESS),
        lambda payload, shape: codec.decode_texture(payload, TextureCodec.HTJ2K, codec.LOSSLESS, shape),
    ),
    "range": (
        codec.encode_range(ranges((33, 40)), RangeCodec.HTJ2K),
        lambda payload, shape: codec.decode_range(payload, RangeCodec.HTJ2K, shape),
    ),
    "lift": (
        codec.encode_range(ranges((33, 40)), RangeCodec.LIFT, 7),
        lambda payload, shape: codec.decode_range(payload, RangeCodec.LIFT, shape, 7),
    ),
    "raw": (
        codec.encode_range(ranges((33, 40)), RangeCodec.RAW),
        lambda payload, shape: codec.decode_range(payload, RangeCodec.RAW, shape),
    ),
    "mask": (codec.encode_mask(discs((33, 40))), codec.decode_mask),
}
# imagecodecs reports what it swallows to sys.unraisablehook; the decoder notices by itself.
swallowed = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")


def decodes_or_refuses(decode: Decoder, payload: bytes, shape: tuple[int, int]) -> None:
    try:
        result = decode(payload, shape)
    except CodecError:
        return
    assert isinstance(result, np.ndarray) and result.shape[:2] == shape


@pytest.mark.parametrize("name", DECODERS)
def test_a_payload_cut_anywhere_is_refused(name: str) -> None:
    payload, decode = DECODERS[name]
    for length in range(1 if name == "mask" else 0, len(payload)):  # no byte at all is a mask without voids
        with pytest.raises(CodecError):
            decode(payload[:length], (33, 40))


@pytest.mark.parametrize("name", DECODERS)
def test_an_overlong_payload_is_refused_before_decoding(name: str) -> None:
    payload, decode = DECODERS[name]
    with pytest.raises(CodecError):
        decode(payload + b"\0" * 20_000 + b"\xff\xd9", (33, 40))


@swallowed
@pytest.mark.parametrize("name", DECODERS)
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_mutated_payloads_decode_or_are_refused(name: str, data: st.DataObject) -> None:
    payload, decode = DECODERS[name]
    changes = data.draw(st.lists(st.tuples(st.integers(0, len(payload) - 1), st.integers(0, 255)), max_size=8))
    mutated = bytearray(payload)
    for place, value in changes:
        mutated[place] = value
    decodes_or_refuses(decode, bytes(mutated), data.draw(st.sampled_from([(33, 40), (1, 1), (64, 70)])))


@swallowed
@pytest.mark.parametrize("name", DECODERS)
@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=200), st.booleans(), shapes)
def test_random_bytes_decode_or_are_refused(name: str, data: bytes, ended: bool, shape: tuple[int, int]) -> None:
    decodes_or_refuses(DECODERS[name][1], data + b"\xff\xd9" * ended, shape)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(0, 40) | st.integers(0, 2**21 - 1), max_size=30), shapes)
def test_masks_of_any_numbers_decode_or_are_refused(numbers: list[int], shape: tuple[int, int]) -> None:
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    data = b"".join(bytes((n & 127 | 128, n >> 7 & 127 | 128, n >> 14)) if n > 127 else bytes((n,)) for n in numbers)
    decodes_or_refuses(codec.decode_mask, deflate.compress(data) + deflate.flush(), shape)


def test_a_mask_that_inflates_beyond_its_bits_is_refused() -> None:
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    bomb = deflate.compress(b"\1" * 10_000_000) + deflate.flush()
    with pytest.raises(CodecError, match="too long"):
        codec.decode_mask(bomb, (1000, 1000))


def test_a_jpeg_with_markers_in_its_data_is_refused() -> None:
    payload = codec_jpeg.encode(texture((33, 40)), 75)
    for marker in (b"\xff\xd0", b"\xff\xc0\x00\x04\x08\x00", b"\xff\xff", b"\xff\xd9"):
        with pytest.raises(CodecError, match="markers"):
            codec_jpeg.decode(payload[:-20] + marker + payload[-20:], (33, 40), 75)


@swallowed
def test_an_error_that_imagecodecs_swallows_is_not_taken_for_zeros() -> None:
    values = np.random.default_rng(3).integers(1, 9000, (300, 70)).astype(np.uint16)
    payload = codec.encode_range(values, RangeCodec.HTJ2K)
    reasons = set()
    for place in range(0, len(payload) - 2, len(payload) // 60):
        damaged = bytes((*payload[:place], payload[place] ^ 0x55, *payload[place + 1 :]))
        try:
            assert codec.decode_range(damaged, RangeCodec.HTJ2K, (300, 70))[-1].any()
        except CodecError as error:
            reasons.add(str(error))
    assert "HTJ2K does not decode: damaged packets" in reasons


def test_images_that_end_in_zeros_are_not_taken_for_damaged() -> None:
    dark = texture((40, 30))
    dark[20:] = 0
    payload = codec.encode_texture(dark, TextureCodec.HTJ2K, codec.LOSSLESS)
    np.testing.assert_array_equal(codec.decode_texture(payload, TextureCodec.HTJ2K, codec.LOSSLESS, (40, 30)), dark)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (-1, 5), (1, codec.SIDE_MAX + 1), (codec.SIDE_MAX, codec.SIDE_MAX)])
def test_shapes_out_of_bounds_are_refused_before_allocating(shape: tuple[int, int]) -> None:
    for payload, decode in DECODERS.values():
        with pytest.raises(CodecError, match="shape"):
            decode(payload, shape)


@pytest.mark.parametrize("quality", [-1, 96, 254, 256])
def test_qualities_that_no_codec_has_are_refused(quality: int) -> None:
    for kind in TextureCodec:
        with pytest.raises(CodecError, match="quality"):
            codec.encode_texture(texture((8, 8)), kind, quality)
        with pytest.raises(CodecError, match="quality"):
            codec.decode_texture(b"\0\x7f\0\0\0\xff\xd9", kind, quality, (8, 8))


def test_jpeg_has_a_q_for_its_qualities_only() -> None:
    qs = [codec.jpeg_q(quality) for quality in range(codec.JPEG_QUALITY_MIN, codec.JPEG_QUALITY_MAX + 1)]
    assert qs == sorted(qs) and 10 <= qs[0] and qs[-1] == 95
    for quality in (codec.JPEG_QUALITY_MIN - 1, codec.JPEG_QUALITY_MAX + 1, codec.LOSSLESS):
        with pytest.raises(CodecError, match="quality"):
            codec.jpeg_q(quality)


def test_arrays_of_another_kind_are_refused() -> None:
    with pytest.raises(CodecError, match="cannot encode"):
        codec.encode_texture(texture((8, 8))[..., 0], TextureCodec.JPEG, 40)
    with pytest.raises(CodecError, match="cannot encode"):
        codec.encode_range(texture((8, 8))[..., 0], RangeCodec.HTJ2K)  # type: ignore[arg-type]
    with pytest.raises(CodecError, match="cannot encode"):
        codec.encode_mask(ranges((8, 8)))  # type: ignore[arg-type]
