"""Range as tiles of a pyramid: level, sampling, tile size, quantum and codec chosen jointly for each click.

Point samples at every L-th column and row, or averages over cells; shown by linear or cubic interpolation. Voids are
filled as ours are; the mask travels apart.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import cv2
import imagecodecs
import numpy as np
from numpy.typing import NDArray

from node.coarse import fill_voids
from protocol import codec_htj2k
from protocol.grid import StepArray
from tests.bench.rivals.offer import PIECE_BYTES, Offer, cheapest, void_mask
from tests.bench.rivals.pyramid import ENLARGE, LEVELS, TILES, Rect, tiles_over
from tests.bench.scans import BenchScan
from tests.bench.target import Window

KERNELS = ("linear", "cubic")


def range_offer(scan: BenchScan, window: Window) -> Offer:
    """The cheapest tiles that show the window within the target's error, with its void mask."""
    offers = [
        offer for level in LEVELS for sampling in ("point", "mean") for offer in _offers(scan, window, level, sampling)
    ]
    return cheapest(offers) + void_mask(window)


def _offers(scan: BenchScan, window: Window, level: float, sampling: str) -> list[Offer]:
    if sampling == "point" and level % 1 or sampling == "mean" and level == 1:
        return []
    image = range_level(scan, level, sampling)
    found = [(_largest_quantum(window, image, level, sampling, kernel), kernel) for kernel in KERNELS]
    quantum, kernel = max(found)
    if not quantum:
        return []
    return [
        Offer(size, f"{codec} of {sampling}s 1/{level:g} {kernel}, quantum {quantum}, tiles of {tile}")
        for tile in TILES
        for codec, size in coded_sizes(_rect(window, image, tile).of(_quantised(image, quantum)), tile).items()
    ]


@lru_cache(maxsize=32)
def range_level(scan: BenchScan, level: float, sampling: str) -> NDArray[np.float32]:
    """A scan's range at a level's size, voids filled. [steps]"""
    filled = filled_range(scan)
    if sampling == "point":
        return np.ascontiguousarray(filled[:: int(level), :: int(level)])
    size = int(-(-filled.shape[1] // level)), int(-(-filled.shape[0] // level))
    return np.asarray(cv2.resize(filled, size, interpolation=cv2.INTER_AREA), np.float32)


@lru_cache(maxsize=8)
def filled_range(scan: BenchScan) -> NDArray[np.float32]:
    """A scan's range without voids. [steps]"""
    return np.asarray(fill_voids(scan.grid.range_steps), np.float32)


def shown(
    received: NDArray[np.float32], rect: Rect, window: Window, level: float, sampling: str, kernel: str
) -> StepArray:
    """The window's range from the samples that were received. uint16 [steps]"""
    region, full = window.range, window.grid.range_steps.shape
    x, y = np.arange(region.left, region.left + region.width), np.arange(region.top, region.top + region.height)
    if sampling == "point":
        at_x, at_y = x / level - rect.left, y / level - rect.top
    else:
        shape = (-(-full[0] // level), -(-full[1] // level))
        at_x = (x + 0.5) * shape[1] / full[1] - 0.5 - rect.left
        at_y = (y + 0.5) * shape[0] / full[0] - 0.5 - rect.top
    grids = np.meshgrid(at_x.astype(np.float32), at_y.astype(np.float32))
    made = cv2.remap(received, *grids, ENLARGE[kernel], borderMode=cv2.BORDER_REPLICATE)
    return np.clip(np.rint(made), 1, 65535).astype(np.uint16)


def coded_sizes(values: StepArray, tile: int) -> dict[str, int]:
    """Bytes of all tiles together, by codec; each tile is decoded and compared."""
    pieces = [
        np.ascontiguousarray(values[top : top + tile, left : left + tile])
        for top in range(0, values.shape[0], tile)
        for left in range(0, values.shape[1], tile)
    ]
    sizes = {}
    for name, size_of in CODECS.items():
        if name != "JPEG XL" or tile >= 64:  # its own header outweighs a small tile
            sizes[name] = sum(size_of(piece) + PIECE_BYTES for piece in pieces)
    return sizes


def _htj2k(piece: StepArray) -> int:
    payload = codec_htj2k.encode(piece, codec_htj2k.LOSSLESS)
    assert np.array_equal(codec_htj2k.decode(payload, piece.shape, codec_htj2k.LOSSLESS), piece)
    return len(payload)


def _jpeg_ls(piece: StepArray) -> int:
    # Its encoder refuses what does not shrink unless it is given room.
    stream = imagecodecs.jpegls_encode(piece, out=4 * piece.nbytes + 1024)
    assert np.array_equal(imagecodecs.jpegls_decode(stream), piece)
    start = bytes(stream).index(b"\xff\xda")
    return len(stream) - start - 2 - int.from_bytes(stream[start + 2 : start + 4], "big") - 2


def _jpeg_xl(piece: StepArray) -> int:
    stream = imagecodecs.jpegxl_encode(piece, lossless=True, effort=7)
    assert np.array_equal(imagecodecs.jpegxl_decode(stream), piece)
    return len(stream)


CODECS: dict[str, Callable[[StepArray], int]] = {"HTJ2K": _htj2k, "JPEG-LS": _jpeg_ls, "JPEG XL": _jpeg_xl}


def _largest_quantum(window: Window, image: NDArray[np.float32], level: float, sampling: str, kernel: str) -> int:
    """The largest quantum that keeps the window within the target, to a fortieth; 0 when none does."""
    rect = _rect(window, image, TILES[0])
    source = rect.of(image)

    def reached(quantum: int) -> bool:
        received = (_quantised(source, quantum) * np.float32(quantum)).astype(np.float32)
        steps = shown(received, rect, window, level, sampling, kernel)
        return window.range_reached(steps)

    target = window.target.range_mm / window.grid.spec.step_mm
    low, high = 0, max(int(3 * target), 1)
    while high - low > low // 40:
        middle = (low + high + 1) // 2
        if reached(middle):
            low = middle
        else:
            high = middle - 1
    return low


def _quantised(image: np.ndarray, quantum: int) -> StepArray:
    return np.floor(image / quantum + 0.5).astype(np.uint16)


def _rect(window: Window, image: NDArray[np.float32], tile: int) -> Rect:
    return tiles_over(window.range, window.grid.range_steps.shape, image.shape, tile)
