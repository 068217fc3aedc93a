"""Texture as HTJ2K tiles of a pyramid: level, kernels, tile size and step chosen jointly for each click.

Each tile is a code stream of its own, without its headers, as ours travel.
"""

from __future__ import annotations

import numpy as np

from protocol import codec_htj2k
from protocol.grid import ImageArray
from tests.bench.rivals.jpeg_texture import least
from tests.bench.rivals.offer import PIECE_BYTES, Offer, cheapest
from tests.bench.rivals.pyramid import TILES, Level, enlarged, promising, texture_level, tiles_over
from tests.bench.scans import BenchScan
from tests.bench.target import Window

QUALITY_MIN, QUALITY_MAX = 16, 72
SEARCH_TILE = 128
MIDDLE = 1 << 15


def texture_offer(scan: BenchScan, window: Window) -> Offer:
    """The cheapest tiles that show the window at the target's PSNR."""
    offers: list[Offer] = []
    for level in promising(scan, window, window.target.texture_db):
        found = _offer(scan, window, level, SEARCH_TILE, QUALITY_MIN, QUALITY_MAX)
        if found is None:
            continue
        quality, offer = found
        offers.append(offer)
        for tile in TILES:
            near = None if tile == SEARCH_TILE else _offer(scan, window, level, tile, quality - 2, quality + 4)
            if near is not None:
                offers.append(near[1])
    return cheapest(offers)


def _offer(scan: BenchScan, window: Window, level: Level, tile: int, low: int, high: int) -> tuple[int, Offer] | None:
    """The lowest quality in low..high that reaches the target, and what it takes."""
    image = texture_level(scan, level.spacing, level.shrink)
    shapes = scan.grid.texture.shape, image.shape
    rect = tiles_over(window.texture, *shapes, tile)
    source = rect.of(image)
    sizes: dict[int, int] = {}

    def reached(quality: int) -> bool:
        received, sizes[quality] = _coded(source, tile, quality)
        return window.texture_reached(enlarged(received, rect, window.texture, shapes, level.enlarge))

    quality = least(reached, low, high)
    return (
        None if quality is None else (quality, Offer(sizes[quality], f"HTJ2K {quality}, tiles of {tile}, {level.name}"))
    )


def _coded(image: np.ndarray, tile: int, quality: int) -> tuple[ImageArray, int]:
    """The image as its tiles decode, and their bytes."""
    made = np.empty(image.shape, np.uint8)
    size = 0
    for top in range(0, image.shape[0], tile):
        for left in range(0, image.shape[1], tile):
            piece = np.ascontiguousarray(image[top : top + tile, left : left + tile])
            made[top : top + tile, left : left + tile], taken = code(piece, quality)
            size += taken
    return made, size


def code(tile: ImageArray, quality: int) -> tuple[ImageArray, int]:
    """A tile as it decodes, and its bytes. Coded in fractions of a level, with room below black and above white."""
    level = codec_htj2k.LEVEL
    values = tile.astype(np.uint16) * level + (MIDDLE - 128 * level)
    payload = codec_htj2k.encode(values, quality)
    decoded = codec_htj2k.decode(payload, tile.shape, quality).astype(np.int32) - MIDDLE + 128 * level
    return np.clip((decoded + level // 2) // level, 0, 255).astype(np.uint8), len(payload) + PIECE_BYTES
