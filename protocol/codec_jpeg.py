"""Baseline JPEG 4:4:4 whose constant headers do not travel.

What stands in front of the entropy-coded data follows from (shape, Q), but for the Huffman tables: the quantisation
tables of Annex K scaled by the Independent JPEG Group's rule, one scan, no restarts. Huffman tables fitted to the image
save 5 to 30% of the data, take about 150 bytes and double the time of encoding; Annex K's never travel. A payload is

    one DHT segment with the four tables, unless they are Annex K's | entropy-coded data | EOI

and whoever decodes writes SOI APP0 DQT DQT SOF0 in front of it and SOS behind the tables, as libjpeg does.
A sender cannot lie about a size in headers that it does not write.
"""

from __future__ import annotations

import struct
from functools import lru_cache

import imagecodecs
import numpy as np

from protocol.errors import CodecError
from protocol.grid import ImageArray

_SOI, _EOI = b"\xff\xd8", b"\xff\xd9"
_APP0, _DQT, _SOF0, _DHT, _SOS = b"\xff\xe0", b"\xff\xdb", b"\xff\xc0", b"\xff\xc4", b"\xff\xda"
# Below this, Annex K's tables are worth a second encoding.
_SMALL_BYTES = 1024


def encode(image: ImageArray, jpeg_q: int, quick: bool = False) -> bytes:
    """Payload of an (h, w, 3) uint8 RGB image, jpeg_q 1..100; quick: with Annex K's tables.

    Raises CodecError when the encoder writes headers that `decode` would not rebuild.
    """
    if quick:
        return _encode(image, jpeg_q, fit_tables=False)
    payload = _encode(image, jpeg_q, fit_tables=True)
    if len(payload) >= _SMALL_BYTES:
        return payload
    return min(payload, _encode(image, jpeg_q, fit_tables=False), key=len)


def decode(payload: bytes, shape: tuple[int, int], jpeg_q: int) -> ImageArray:
    """(h, w, 3) uint8 RGB of a payload that `encode` wrote, shape = (h, w).

    Raises CodecError for a payload without its end, with foreign markers in it, or that does not decode.
    """
    try:
        image = imagecodecs.jpeg8_decode(restore(payload, shape, jpeg_q))
    except imagecodecs.Jpeg8Error as error:
        raise CodecError(f"JPEG does not decode: {error}") from error
    if image.shape != (*shape, 3) or image.dtype != np.uint8:
        raise CodecError(f"JPEG decoded to {image.shape} {image.dtype}, not {(*shape, 3)} uint8")
    return image


def restore(payload: bytes, shape: tuple[int, int], jpeg_q: int) -> bytes:
    """The whole JPEG file of a payload. Raises CodecError where it is cut short or holds foreign markers."""
    tables_end = 2 + int.from_bytes(payload[2:4], "big") if payload.startswith(_DHT) else 0
    tables, data = payload[:tables_end] or _segment(_DHT, _ANNEX_K_HUFFMAN), payload[tables_end:]
    if not data.endswith(_EOI):
        raise CodecError("JPEG payload is cut short: no end marker")
    if data.count(b"\xff") != data.count(b"\xff\x00") + 1:
        raise CodecError("JPEG payload holds markers other than its end")
    return frame_header(shape, jpeg_q) + tables + _SCAN_HEADER + data


def frame_header(shape: tuple[int, int], jpeg_q: int) -> bytes:
    """SOI APP0 DQT DQT SOF0, byte for byte as libjpeg writes them for (h, w) and Q."""
    height, width = shape
    return b"".join((
        _SOI,
        _segment(_APP0, b"JFIF\0\1\1\0\0\1\0\1\0\0"),
        _segment(_DQT, b"\0" + quantisation(_LUMA, jpeg_q)),
        _segment(_DQT, b"\1" + quantisation(_CHROMA, jpeg_q)),
        _segment(_SOF0, struct.pack(">BHHB", 8, height, width, 3) + b"\1\x11\0" b"\2\x11\1" b"\3\x11\1"),
    ))


@lru_cache(maxsize=256)
def quantisation(base: bytes, jpeg_q: int) -> bytes:
    """A table of Annex K (64 bytes, zigzag) scaled to Q 1..100 by the Independent JPEG Group's rule."""
    scale = 5000 // jpeg_q if jpeg_q < 50 else 200 - 2 * jpeg_q
    return bytes(min(max((step * scale + 50) // 100, 1), 255) for step in base)


def _encode(image: ImageArray, jpeg_q: int, fit_tables: bool) -> bytes:
    stream = imagecodecs.jpeg8_encode(np.ascontiguousarray(image), jpeg_q, subsampling="444", optimize=fit_tables)
    return _strip(bytes(stream), frame_header(image.shape[:2], jpeg_q))


def _strip(stream: bytes, head: bytes) -> bytes:
    tables, at = b"", len(head)
    while stream.startswith(_DHT, at):
        length = int.from_bytes(stream[at + 2 : at + 4], "big")
        tables += stream[at + 4 : at + 2 + length]
        at += 2 + length
    if not stream.startswith(head) or not stream.startswith(_SCAN_HEADER, at):
        raise CodecError("the JPEG encoder wrote headers that the other end would not rebuild")
    travelling = b"" if tables == _ANNEX_K_HUFFMAN else _segment(_DHT, tables)
    return travelling + stream[at + len(_SCAN_HEADER) :]


def _segment(marker: bytes, body: bytes) -> bytes:
    return marker + struct.pack(">H", 2 + len(body)) + body


_SCAN_HEADER = _segment(_SOS, b"\3" b"\1\0" b"\2\x11" b"\3\x11" b"\0\x3f\0")

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
_ANNEX_K_HUFFMAN = bytes.fromhex(
    "0000010501010101010100000000000000000102030405060708090a0b100002010303020403050504040000017d010203000411"
    "05122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a25262728292a3435363738393a43"
    "4445464748494a535455565758595a636465666768696a737475767778797a838485868788898a92939495969798999aa2a3a4a5"
    "a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa"
    "0100030101010101010101010000000000000102030405060708090a0b1100020102040403040705040400010277000102031104"
    "052131061241510761711322328108144291a1b1c109233352f0156272d10a162434e125f11718191a262728292a35363738393a"
    "434445464748494a535455565758595a636465666768696a737475767778797a82838485868788898a92939495969798999aa2a3"
    "a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)
