"""Texture as one JPEG of everything: at the Q the window needs, or progressive and stopped once the window is good.

The file is the smallest of baseline and progressive, with and without chroma at half the resolution.
"""

from __future__ import annotations

import cv2
import numpy as np

from protocol.grid import ImageArray
from tests.bench.cache import Cache
from tests.bench.rivals.jpeg_texture import CHROMA, MCU, Q_MAX, Q_MIN, least
from tests.bench.rivals.offer import Offer, cheapest
from tests.bench.scans import BenchScan
from tests.bench.target import Window, crop

SCANS_TRIED = 4
Q_ABOVE = (0, 6, 12)


def texture_offer(scan: BenchScan, window: Window, cache: Cache) -> Offer:
    """The whole texture."""
    offers = []
    for chroma in CHROMA:
        q = _least_q(scan, window, chroma)
        if q is not None:
            sizes = {p: len(_file(scan, chroma, q, p, cache)) for p in (False, True)}
            kind = min(sizes, key=lambda p: sizes[p])
            offers.append(Offer(sizes[kind], f"JPEG {chroma} Q {q} of everything{', progressive' if kind else ''}"))
    return cheapest(offers)


def progressive_offer(scan: BenchScan, window: Window, cache: Cache) -> Offer:
    """The scans of a progressive file up to the first after which the window is good."""
    offers = []
    for chroma in CHROMA:
        q = _least_q(scan, window, chroma)
        for finer in {min(q + above, Q_MAX) for above in Q_ABOVE} if q is not None else ():
            file = _file(scan, chroma, finer, True, cache)
            size = _enough_scans(file, window)
            if size:
                offers.append(Offer(size, f"progressive JPEG {chroma} Q {finer}, {size / len(file):.0%} of the file"))
    return cheapest(offers)


def _least_q(scan: BenchScan, window: Window, chroma: str) -> int | None:
    """From the coding units round the window alone, which decode as they do in the whole."""
    unit, texture, r = MCU[chroma], scan.grid.texture, window.texture
    top, bottom = r.top // unit * unit, min(-(-(r.top + r.height) // unit) * unit, texture.shape[0])
    left = r.left // unit * unit
    wide = -(-(r.left - left + r.width) // unit) * unit
    around = np.ascontiguousarray(texture[top:bottom].take(np.arange(left, left + wide), axis=1, mode="wrap"))

    def reached(q: int) -> bool:
        made = _decode(_encode(around, chroma, q, False))
        return window.texture_reached(made[r.top - top :, r.left - left :][: r.height, : r.width])

    return least(reached, Q_MIN, Q_MAX)


def _file(scan: BenchScan, chroma: str, q: int, progressive: bool, cache: Cache) -> bytes:
    key = f"{scan.key} {chroma} {q} {progressive}"
    return cache.blob("rivals.jpeg_whole", key, lambda: _encode(scan.grid.texture, chroma, q, progressive))


def _enough_scans(file: bytes, window: Window) -> int:
    """Bytes up to the end of the earliest scan that reaches the target; 0 when none of the last few does."""
    ends = [at for at in _scan_starts(file)[1:]] + [len(file) - 2]
    enough = 0
    for end in reversed(ends[-SCANS_TRIED:]):
        if not window.texture_reached(np.asarray(crop(_decode(file[:end] + b"\xff\xd9"), window.texture))):
            break
        enough = end
    return enough


def _scan_starts(file: bytes) -> list[int]:
    """Where each scan starts, the Huffman tables before it included."""
    starts, at, tables = [], 2, None
    while (marker := file[at : at + 2]) != b"\xff\xd9":
        size = 2 + int.from_bytes(file[at + 2 : at + 4], "big")
        if marker == b"\xff\xc4" and tables is None:
            tables = at
        if marker == b"\xff\xda":
            starts.append(tables if tables is not None else at)
            tables = None
            at = _data_end(file, at + size)
        else:
            at += size
    return starts


def _data_end(file: bytes, at: int) -> int:
    """The first marker at or after `at` that is neither stuffing nor a restart."""
    while True:
        at = file.index(b"\xff", at)
        if file[at + 1] != 0 and not 0xD0 <= file[at + 1] <= 0xD7:
            return at
        at += 2


def _encode(image: ImageArray, chroma: str, q: int, progressive: bool) -> bytes:
    flags = (
        cv2.IMWRITE_JPEG_QUALITY, q,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, CHROMA[chroma],
        cv2.IMWRITE_JPEG_OPTIMIZE, 1,
        cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive),
    )  # fmt: skip
    return bytes(cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), flags)[1].tobytes())


def _decode(file: bytes) -> ImageArray:
    return np.asarray(cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR_RGB), np.uint8)
