"""Range, texture and void mask as payload bytes: the one entrance to the codecs.

A payload holds no header: shape, codec and quality travel in the refinement that carries it, and both ends rebuild the
headers of JPEG and HTJ2K from them. Lengths and checksums are the carrier's. Decoders read hostile bytes: they bound
what they allocate by the shape announced, insist on the payload's end, and raise nothing but CodecError.

One scale of texture quality serves both codecs. For HTJ2K it is the quantiser's step, 2**(-quality/8) of full scale; a
JPEG of equal quality is one of equal PSNR, by the table JPEG_Q. 255 is lossless (HTJ2K only).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np

from protocol import codec_colours, codec_htj2k, codec_jpeg, codec_lift, codec_mask
from protocol.errors import CodecError
from protocol.grid import BoolArray, ImageArray, StepArray, dequantise, quantise

LOSSLESS = codec_htj2k.LOSSLESS
LOSSY_MAX = codec_htj2k.LOSSY_MAX
SIXTEENTHS = codec_colours.SIXTEENTHS  # of a step of quality: as fine is a lossy HTJ2K's
SAMPLES_MAX = 1 << 25
SIDE_MAX = 16384


class TextureCodec(IntEnum):
    """How texture travels; the numbers are the wire's."""

    JPEG = 1
    HTJ2K = 2


class RangeCodec(IntEnum):
    """How range travels; the numbers are the wire's."""

    RAW = 0
    HTJ2K = 2
    LIFT = 3


# Q of the JPEG whose PSNR equals that of HTJ2K, for each quality from JPEG_QUALITY_MIN on: medians over 30 patches of
# three real and two generated textures, by tests/golden/calibrate_jpeg.py. One patch is off by 1.1 dB on average.
JPEG_QUALITY_MIN = 12
JPEG_Q = (
    *(11, 12, 12, 13, 13, 14, 14, 15, 17, 18, 19, 21, 22, 23, 25, 27, 30, 33, 35, 37, 40),
    *(42, 48, 52, 57, 58, 65, 67, 71, 74, 76, 79, 81, 83, 85, 87, 89, 91, 92, 93, 94, 95),
)
JPEG_QUALITY_MAX = JPEG_QUALITY_MIN + len(JPEG_Q) - 1


def encode_texture(image: ImageArray, codec: TextureCodec, quality: float, *, quick: bool = False) -> bytes:
    """Payload of an (h, w, 3) uint8 RGB image.

    quality : 0..LOSSY_MAX in sixteenths or LOSSLESS for HTJ2K, JPEG_QUALITY_MIN..JPEG_QUALITY_MAX for JPEG.
    quick : half the time and 5 to 30% more bytes for JPEG, where the link is fast; nothing else differs.
    Raises CodecError for any other quality and for an array that is no such image.
    """
    _check_array(image, np.uint8, 3)
    if codec == TextureCodec.JPEG:
        return codec_jpeg.encode(image, jpeg_q(quality), quick)
    return codec_htj2k.encode(image, LOSSLESS) if quality == LOSSLESS else codec_colours.encode(image, quality)


def encode_textures(
    images: Sequence[ImageArray], codec: TextureCodec, quality: float, *, quick: bool = False
) -> list[bytes]:
    """A payload of each of several images of one texture, as of encode_texture.

    Lossy HTJ2K's colours are turned as suits the largest one, which takes less time than to look at each.
    """
    if codec == TextureCodec.JPEG or quality == LOSSLESS or len(images) < 2:
        return [encode_texture(image, codec, quality, quick=quick) for image in images]
    for image in images:
        _check_array(image, np.uint8, 3)
    turn = codec_colours.turn_of(max(images, key=lambda image: image.size))
    return [codec_colours.encode(image, quality, turn) for image in images]


def decode_texture(payload: bytes, codec: TextureCodec, quality: int, shape: tuple[int, int]) -> ImageArray:
    """(h, w, 3) uint8 RGB of a payload, shape = (h, w), quality its whole steps. Raises CodecError."""
    _check_payload(payload, shape, 3)
    if codec == TextureCodec.JPEG:
        return codec_jpeg.decode(payload, shape, jpeg_q(quality))
    if quality == LOSSLESS:
        return codec_htj2k.decode(payload, (*shape, 3), LOSSLESS)
    return codec_colours.decode(payload, shape, quality)


def encode_range(
    range_steps: StepArray, codec: RangeCodec, quantum: int = 1, care: BoolArray | None = None, *, quick: bool = False
) -> bytes:
    """Payload of (h, w) uint16 steps without voids, each to within quantum // 2 steps; exact at quantum 1.

    care : (h, w) bool, False where any value will do (LIFT spends nothing there).
    quick : a tenth of the time and 4 to 8% more bytes for LIFT; nothing else differs.
    Raises CodecError for an array that is not that.
    """
    _check_array(range_steps, np.uint16, 1)
    if codec == RangeCodec.LIFT:
        return codec_lift.encode(range_steps, quantum, care, quick=quick)
    values = quantise(range_steps, quantum)
    return values.astype("<u2").tobytes() if codec == RangeCodec.RAW else codec_htj2k.encode(values, LOSSLESS)


def decode_range(payload: bytes, codec: RangeCodec, shape: tuple[int, int], quantum: int = 1) -> StepArray:
    """(h, w) uint16 steps of a payload, 1..65535, shape = (h, w). Raises CodecError."""
    _check_payload(payload, shape, 2)
    if codec == RangeCodec.LIFT:
        return codec_lift.decode(payload, shape, quantum)
    if codec == RangeCodec.HTJ2K:
        return dequantise(codec_htj2k.decode(payload, shape, LOSSLESS), quantum)
    if len(payload) != 2 * shape[0] * shape[1]:
        raise CodecError(f"raw range of {shape} takes {2 * shape[0] * shape[1]} bytes, got {len(payload)}")
    return dequantise(np.frombuffer(payload, "<u2").astype(np.uint16).reshape(shape), quantum)


def decode_ranges(
    payload: bytes, codec: RangeCodec, shapes: Sequence[tuple[int, int]], quantum: int = 1
) -> list[StepArray]:
    """Steps, as of decode_range, of each of several images in one payload, which is LIFT. Raises CodecError."""
    if len(shapes) == 1:
        return [decode_range(payload, codec, shapes[0], quantum)]
    if codec != RangeCodec.LIFT:
        raise CodecError("range of several images travels as LIFT alone")
    for shape in shapes:
        _check_shape(shape)
    _check_length(payload, sum(height * width for height, width in shapes), 2)
    return codec_lift.decode_all(payload, shapes, quantum)


def encode_mask(mask: BoolArray) -> bytes:
    """Payload of an (h, w) bool mask, true where void; empty when nothing is. Raises CodecError for another array."""
    _check_array(mask, np.bool_, 1)
    return codec_mask.encode(mask)


def decode_mask(payload: bytes, shape: tuple[int, int]) -> BoolArray:
    """(h, w) bool of a payload, shape = (h, w). Raises CodecError."""
    _check_payload(payload, shape, 2)
    return codec_mask.decode(payload, shape)


def jpeg_q(quality: float) -> int:
    """Q 10..95 of the JPEG that stands for a quality. Raises CodecError for other than whole ones of its bounds."""
    if not JPEG_QUALITY_MIN <= quality <= JPEG_QUALITY_MAX or quality != int(quality):
        raise CodecError(f"JPEG quality must be {JPEG_QUALITY_MIN}..{JPEG_QUALITY_MAX}, got {quality}")
    return JPEG_Q[int(quality) - JPEG_QUALITY_MIN]


def _check_array(array: np.ndarray, dtype: type[np.generic], channels: int) -> None:
    expected = 2 if channels == 1 else 3
    if array.dtype != dtype or array.ndim != expected or (channels == 3 and array.shape[2] != 3):
        raise CodecError(f"cannot encode {array.shape} {array.dtype}")
    _check_shape(array.shape[:2])


def _check_payload(payload: bytes, shape: tuple[int, int], sample_bytes: int) -> None:
    _check_shape(shape)
    _check_length(payload, shape[0] * shape[1], sample_bytes)


def _check_length(payload: bytes, samples: int, sample_bytes: int) -> None:
    limit = 4096 + 2 * sample_bytes * samples
    if samples > SAMPLES_MAX or len(payload) > limit:
        raise CodecError(f"payload of {len(payload)} bytes for {samples} samples; {limit} at most")


def _check_shape(shape: tuple[int, ...]) -> None:
    height, width = shape
    if not (1 <= height <= SIDE_MAX and 1 <= width <= SIDE_MAX and height * width <= SAMPLES_MAX):
        raise CodecError(f"shape {shape} is outside 1..{SIDE_MAX} a side and {SAMPLES_MAX} samples")
