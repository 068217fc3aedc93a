"""Baseline JPEG 4:4:4 whose headers do not travel.

The 623 bytes in front of the entropy-coded data follow from (shape, Q): the quantisation tables of Annex K scaled by the
Independent JPEG Group's rule, the Huffman tables of Annex K, one scan, no restarts. The wire carries the entropy-coded
data and the end marker; whoever decodes writes the headers anew, so a sender cannot lie about a size in them.
"""

from __future__ import annotations

import struct

import cv2
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from protocol.errors import CodecError

ImageArray = NDArray[np.uint8]

_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"
_APP0, _DQT, _SOF0, _DHT, _SOS = 0xFFE0, 0xFFDB, 0xFFC0, 0xFFC4, 0xFFDA


def encode(image: ImageArray, jpeg_q: int) -> bytes:
    """Entropy-coded data and end marker of an (h, w, 3) uint8 RGB image, jpeg_q 1..100.

    Raises CodecError when the encoder writes headers that `decode` would not rebuild.
    """
    settings = [
        cv2.IMWRITE_JPEG_QUALITY, jpeg_q,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]  # fmt: skip
    done, buffer = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    stream, head = buffer.tobytes(), header(image.shape[:2], jpeg_q)
    if not done or not stream.startswith(head):
        raise CodecError("the JPEG encoder wrote headers that the other end would not rebuild")
    return stream[len(head) :]


def decode(payload: bytes, shape: tuple[int, int], jpeg_q: int) -> ImageArray:
    """(h, w, 3) uint8 RGB of a payload that `encode` wrote.

    Raises CodecError for a payload without its end, with foreign markers in it, or that does not decode.
    """
    try:
        image = imagecodecs.jpeg8_decode(restore(payload, shape, jpeg_q))
    except imagecodecs.Jpeg8Error as error:
        raise CodecError(f"JPEG does not decode: {error}") from error
    if image.shape != (*shape, 3) or image.dtype != np.uint8:
        raise CodecError(f"JPEG decoded to {image.shape} {image.dtype}, not {(*shape, 3)} uint8")
    return image  # type: ignore[no-any-return]


def restore(payload: bytes, shape: tuple[int, int], jpeg_q: int) -> bytes:
    """The whole JPEG file of a payload, headers rebuilt from shape and Q."""
    if payload[-2:] != _EOI:
        raise CodecError("JPEG payload is cut short: no end marker")
    if payload.count(b"\xff") != payload.count(b"\xff\x00") + 1:
        raise CodecError("JPEG payload holds markers other than its end")
    return header(shape, jpeg_q) + payload


def header(shape: tuple[int, int], jpeg_q: int) -> bytes:
    """SOI APP0 DQT DQT SOF0 DHT DHT DHT DHT SOS, byte for byte as libjpeg writes them."""
    height, width = shape
    return b"".join((
        _SOI,
        _segment(_APP0, b"JFIF\0\1\1\0\0\1\0\1\0\0"),
        _segment(_DQT, b"\0" + quantisation(_LUMA, jpeg_q)),
        _segment(_DQT, b"\1" + quantisation(_CHROMA, jpeg_q)),
        _segment(_SOF0, struct.pack(">BHHB", 8, height, width, 3) + b"\1\x11\0" + b"\2\x11\1" + b"\3\x11\1"),
        *(_segment(_DHT, table) for table in _HUFFMAN),
        _segment(_SOS, b"\3" + b"\1\0" + b"\2\x11" + b"\3\x11" + b"\0\x3f\0"),
    ))


def quantisation(base: bytes, jpeg_q: int) -> bytes:
    """A table of Annex K (64 bytes, zigzag) scaled to Q 1..100 by the Independent JPEG Group's rule."""
    scale = 5000 // jpeg_q if jpeg_q < 50 else 200 - 2 * jpeg_q
    return bytes(min(max((step * scale + 50) // 100, 1), 255) for step in base)


def _segment(marker: int, body: bytes) -> bytes:
    return struct.pack(">HH", marker, 2 + len(body)) + body


# Annex K, tables K.1 and K.2 in zigzag order.
_LUMA = bytes.fromhex(
    "100b0c0e0c0a100e0d0e1211101318281a181616183123251d283a333d3c3933383740485c4e404457453738506d5157"
    "5f626768673e4d71797064785c656763"
)
_CHROMA = bytes.fromhex(
    "1112121815182f1a1a2f6342384263636363636363636363636363636363636363636363636363636363636363636363"
    "63636363636363636363636363636363"
)
# Annex K, tables K.3 to K.6: class and number, codes of each length 1..16, symbols.
_HUFFMAN = (
    bytes.fromhex(
        "0000010501010101010100000000000000000102030405060708090a0b"
    ),
    bytes.fromhex(
        "100002010303020403050504040000017d01020300041105122131410613516107227114328191a1082342b1c11552d1"
        "f02433627282090a161718191a25262728292a3435363738393a434445464748494a535455565758595a636465666768"
        "696a737475767778797a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4"
        "c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa"
    ),
    bytes.fromhex(
        "0100030101010101010101010000000000000102030405060708090a0b"
    ),
    bytes.fromhex(
        "1100020102040403040705040400010277000102031104052131061241510761711322328108144291a1b1c109233352"
        "f0156272d10a162434e125f11718191a262728292a35363738393a434445464748494a535455565758595a6364656667"
        "68696a737475767778797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2"
        "c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
    ),
)
