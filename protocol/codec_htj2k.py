"""High-throughput JPEG 2000 whose headers do not travel.

A code stream is a main header, one tile header and packets. Both headers follow from (shape, quality), so the wire
carries only the packets and the end marker, and whoever decodes writes the headers anew. That saves 120 to 190 bytes an
image, and a sender cannot lie about a size in headers that it does not write. The writer of these streams is OpenJPH;
`encode` refuses to go on when it writes other headers than this file expects.

A main header is SOC SIZ CAP COD QCD (ISO/IEC 15444-1 A.5, A.6 and 15444-15 A.3), all integers big-endian.
"""

from __future__ import annotations

import math
import struct
from functools import lru_cache
from typing import Any

import imagecodecs
import numpy as np
from numpy.typing import NDArray

from protocol.errors import CodecError

LOSSY_MAX = 95
LOSSLESS = 255
LEVELS_MAX = 7

_SOC, _SIZ, _CAP, _COD, _QCD, _COM = 0xFF4F, 0xFF51, 0xFF50, 0xFF52, 0xFF5C, 0xFF64
_SOT, _SOD = 0xFF90, 0xFF93
_EOC = b"\xff\xd9"
_TILE_HEADER_BYTES = 14
_GUARD_BITS = 1
LEVEL = 32  # of a lossy image's values: one of the 256 that a quality's step is counted in

# L2 norms of the 9/7 synthesis low-pass and high-pass filters after 0, 1, 2 ... levels, as OpenJPH rounds them; float32
# as there, since some steps lie so near a tie that float64 would round them to another mantissa.
_NORM_LOW = np.array([1.0, 1.4021, 2.0304, 2.9012, 4.1153, 5.8245, 8.2388, 11.652], np.float32)
_NORM_HIGH = np.array([1.4425, 1.9669, 2.8839, 4.1475, 5.8946, 8.3472, 11.809], np.float32)
# Bits that the reversible 5/3 adds to the samples in HL, LH, HH of levels 1, 2 ...; LL adds one.
_GROWTH = (1, 1, 1), *((2, 2, 2),) * 4, *((2, 2, 3),) * 2

Samples = NDArray[Any]  # uint16; uint8 where three components are lossless


def encode(samples: Samples, quality: float) -> bytes:
    """Packets and end marker of an image.

    samples : (h, w) uint16 or (h, w, 3) uint8 for LOSSLESS, else (h, w, 3) uint16, LEVEL a grey level.
    quality : 0..LOSSY_MAX, not only whole: the step is 2**(-quality/8) of 256 levels. Or LOSSLESS.
    Raises CodecError for a quality outside these, and when OpenJPH writes headers that `decode` would not rebuild.
    """
    head = main_header(samples.shape, quality)
    levels = decomposition_levels(samples.shape)
    samples = np.ascontiguousarray(samples)
    if quality == LOSSLESS:
        stream = imagecodecs.htj2k_encode(samples, reversible=True, resolutions=levels)
    else:
        stream = imagecodecs.htj2k_encode(samples, reversible=False, level=_step(quality), resolutions=levels)
    return _strip(bytes(stream), head)


def decode(payload: bytes, shape: tuple[int, ...], quality: float) -> Samples:
    """The image that `encode` was given, exactly when lossless.

    shape : (h, w) for range, (h, w, 3) for colours; the caller bounds it.
    Raises CodecError for a payload without its end, for one that does not decode, and for a bad quality.
    """
    stream = restore(payload, shape, quality)
    samples = _decode(stream, resilient=False)
    # imagecodecs drops an error half way through and leaves the rows below it zero: look twice at a last row of zeros.
    if not samples[-1].any() and not np.array_equal(samples, _decode(stream, resilient=True)):
        raise CodecError("HTJ2K does not decode: damaged packets")
    dtype = np.uint8 if _sample_bits(shape, quality) == 8 else np.uint16
    if samples.shape != shape or samples.dtype != dtype:
        raise CodecError(f"HTJ2K decoded to {samples.shape} {samples.dtype}, not {shape} {dtype.__name__}")
    return samples


def restore(payload: bytes, shape: tuple[int, ...], quality: float) -> bytes:
    """The whole code stream of a payload, headers rebuilt from shape and quality."""
    if payload[-2:] != _EOC:
        raise CodecError("HTJ2K payload is cut short: no end marker")
    return main_header(shape, quality) + _tile_header(len(payload) - len(_EOC)) + payload


def decomposition_levels(shape: tuple[int, ...]) -> int:
    """Wavelet levels: halve, upward, until the shorter side is 2 samples, at least once, at most LEVELS_MAX times.

    What is left of an image when it is halved no more costs most: one level less takes up to 17% more, one more 6%.
    """
    return min(max((min(shape[:2]) - 1).bit_length() - 1, 1), LEVELS_MAX)


@lru_cache(maxsize=256)
def main_header(shape: tuple[int, ...], quality: float) -> bytes:
    """SOC SIZ CAP COD QCD, byte for byte as OpenJPH writes them."""
    if not (0 <= quality <= LOSSY_MAX or quality == LOSSLESS):
        raise CodecError(f"HTJ2K quality must be 0..{LOSSY_MAX} or {LOSSLESS}, got {quality}")
    levels, colour = decomposition_levels(shape), len(shape) == 3
    quantisation, bits = _reversible(levels, colour) if quality == LOSSLESS else _irreversible(levels, quality)
    return b"".join((
        struct.pack(">H", _SOC),
        _segment(_SIZ, _size(shape, quality)),
        _segment(_CAP, struct.pack(">IH", 0x00020000, _magnitude_bound(bits) | (0 if quality == LOSSLESS else 0x20))),
        _segment(_COD, struct.pack(">BBHBBBBBB", 0, 2, 1, colour, levels, 4, 4, 0x40, quality == LOSSLESS)),
        _segment(_QCD, quantisation),
    ))


def _decode(stream: bytes, resilient: bool) -> Samples:
    try:
        return imagecodecs.htj2k_decode(stream, resilient=resilient)
    except imagecodecs.Htj2kError as error:
        raise CodecError(f"HTJ2K does not decode: {error}") from error


def _strip(stream: bytes, head: bytes) -> bytes:
    at = len(head)
    if stream[at : at + 2] == struct.pack(">H", _COM):
        at += 2 + int.from_bytes(stream[at + 2 : at + 4], "big")
    payload = stream[at + _TILE_HEADER_BYTES :]
    if stream[: len(head)] != head or stream[at:] != _tile_header(len(payload) - len(_EOC)) + payload:
        raise CodecError("OpenJPH wrote headers that the other end would not rebuild")
    return payload


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">HH", marker, 2 + len(body)) + body


def _size(shape: tuple[int, ...], quality: float) -> bytes:
    height, width = shape[:2]
    components = bytes((_sample_bits(shape, quality) - 1, 1, 1)) * (3 if len(shape) == 3 else 1)
    return struct.pack(">H8IH", 0x4000, width, height, 0, 0, width, height, 0, 0, len(components) // 3) + components


def _sample_bits(shape: tuple[int, ...], quality: float) -> int:
    return 8 if len(shape) == 3 and quality == LOSSLESS else 16


def _tile_header(packet_bytes: int) -> bytes:
    return struct.pack(">HHHIBBH", _SOT, 10, 0, packet_bytes + _TILE_HEADER_BYTES, 0, 1, _SOD)


def _step(quality: float) -> float:
    """Of the full scale of 16 bits."""
    return float(2.0 ** (-quality / 8)) * LEVEL * 256 / 65536


def _reversible(levels: int, colour: bool) -> tuple[bytes, int]:
    """QCD body without quantisation, and the most magnitude bits of any subband."""
    depth = 8 + 1 if colour else 16
    bits = [depth + 1] + [depth + grown for level in range(levels, 0, -1) for grown in _GROWTH[level - 1]]
    return bytes((_GUARD_BITS << 5, *(b << 3 for b in bits))), max(bits)


def _irreversible(levels: int, quality: float) -> tuple[bytes, int]:
    """QCD body with one step a subband, and the most magnitude bits of any, those that its level adds left out."""
    norms = [_NORM_LOW[levels] * _NORM_LOW[levels]]
    for level in range(levels, 0, -1):
        low, high = _NORM_LOW[level], _NORM_HIGH[level - 1]
        norms += [low * high, low * high, high * high]
    steps = [_exponent_and_mantissa(np.float32(_step(quality)) / norm) for norm in norms]
    packed = [exponent << 11 | mantissa for exponent, mantissa in steps]
    levels_of = [levels, *(level for level in range(levels, 0, -1) for _ in range(3))]
    bits = max(exponent + _GUARD_BITS - level for (exponent, _), level in zip(steps, levels_of, strict=True))
    return struct.pack(f">B{len(packed)}H", _GUARD_BITS << 5 | 2, *packed), bits


def _exponent_and_mantissa(step: np.float32) -> tuple[int, int]:
    """(e, m) with step = 2**-e (1 + m / 2048), E-3 of 15444-1 for a range of one."""
    fraction, exponent = math.frexp(step)
    return 1 - exponent, min(math.floor((2 * fraction - 1) * 2048 + 0.5), 2047)


def _magnitude_bound(bits: int) -> int:
    """The five bits of Ccap15 that bound a coefficient's magnitude, 15444-15 A.3."""
    return 0 if bits <= 8 else bits - 8 if bits < 28 else 13 + (bits >> 2)
