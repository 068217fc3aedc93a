"""Texture as JPEG tiles of a pyramid: level, kernels, tile size, chroma and Q chosen jointly for each click.

All tiles of a click stand in one column, a restart interval each, so that one encoder run gives every tile as it would
be coded alone, with Huffman tables fitted to just these tiles: better than any table that a whole session could share.
The tables cost the rival nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from protocol.grid import ImageArray
from tests.bench.rivals.offer import Offer, cheapest
from tests.bench.rivals.pyramid import TILES, Level, Rect, enlarged, promising, texture_level, tiles_over
from tests.bench.scans import BenchScan
from tests.bench.target import Window

CHROMA = {"444": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444, "420": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420}
MCU = {"444": 8, "420": 16}
Q_MIN, Q_MAX = 5, 100
SEARCH_TILE = 64
ROWS_MAX = 65500


def texture_offer(scan: BenchScan, window: Window) -> Offer:
    """The cheapest tiles that show the window at the target's PSNR."""
    offers: list[Offer] = []
    for level in promising(scan, window, window.target.texture_db):
        for chroma in CHROMA:
            q = _least_q(scan, window, level, chroma, Q_MIN, Q_MAX, SEARCH_TILE)
            if q is not None:
                offers += [_offer(scan, window, level, chroma, q, tile) for tile in TILES]
    return cheapest([offer for offer in offers if offer.size_bytes])


def _offer(scan: BenchScan, window: Window, level: Level, chroma: str, near: int, tile: int) -> Offer:
    """The lowest Q near the one found, at another tile size. 0 bytes: none."""
    q = _least_q(scan, window, level, chroma, max(near - 2, Q_MIN), min(near + 3, Q_MAX), tile)
    if q is None:
        return Offer(0, "")
    image, rect = _tiles(scan, window, level, tile)
    size = data_bytes(encode_tiles(rect.of(image), tile, chroma, q))
    return Offer(size, f"JPEG {chroma} Q {q}, tiles of {tile}, {level.name}")


def _least_q(scan: BenchScan, window: Window, level: Level, chroma: str, low: int, high: int, tile: int) -> int | None:
    image, rect = _tiles(scan, window, level, tile)
    source = rect.of(image)
    shapes = scan.grid.texture.shape, image.shape

    def reached(q: int) -> bool:
        received = decode_tiles(encode_tiles(source, tile, chroma, q), source.shape, tile)
        return window.texture_reached(enlarged(received, rect, window.texture, shapes, level.enlarge))

    return least(reached, low, high)


def least(reached: Callable[[int], bool], low: int, high: int) -> int | None:
    """The lowest setting that reaches the target, taking quality to rise with it; None when the highest does not."""
    if not reached(high):
        return None
    while low < high:
        middle = (low + high) // 2
        if reached(middle):
            high = middle
        else:
            low = middle + 1
    return low


def _tiles(scan: BenchScan, window: Window, level: Level, tile: int) -> tuple[ImageArray, Rect]:
    image = texture_level(scan, level.spacing, level.shrink)
    return image, tiles_over(window.texture, scan.grid.texture.shape, image.shape, tile)


def encode_tiles(image: np.ndarray, tile: int, chroma: str, q: int) -> list[bytes]:
    """JPEG files with the tiles of an image (edge tiles are padded)."""
    height, width = (-(-side // tile) for side in image.shape[:2])
    padding = ((0, height * tile - image.shape[0]), (0, width * tile - image.shape[1]), (0, 0))
    padded = np.pad(image, padding, "edge") if padding != ((0, 0),) * 3 else image
    return encode_stack(
        padded.reshape(height, tile, width, tile, 3).swapaxes(1, 2).reshape(-1, tile, tile, 3), chroma, q
    )


def decode_tiles(files: list[bytes], shape: tuple[int, ...], tile: int) -> ImageArray:
    """The image again, without the padding."""
    height, width = (-(-side // tile) for side in shape[:2])
    stack = decode_stack(files, tile).reshape(height, width, tile, tile, 3)
    return stack.swapaxes(1, 2).reshape(height * tile, width * tile, 3)[: shape[0], : shape[1]]


def encode_stack(stack: np.ndarray, chroma: str, q: int) -> list[bytes]:
    """JPEG files, each with tiles (n, tile, tile, 3) in one column, a restart interval a tile."""
    tile = stack.shape[1]
    column = stack.reshape(-1, tile, 3)
    flags = (
        cv2.IMWRITE_JPEG_QUALITY, q,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, CHROMA[chroma],
        cv2.IMWRITE_JPEG_RST_INTERVAL, (tile // MCU[chroma]) ** 2,
        cv2.IMWRITE_JPEG_OPTIMIZE, 1,
    )  # fmt: skip
    rows = ROWS_MAX // tile * tile
    return [
        cv2.imencode(".jpg", np.ascontiguousarray(column[top : top + rows, :, ::-1]), flags)[1].tobytes()
        for top in range(0, len(column), rows)
    ]


def decode_stack(files: list[bytes], tile: int) -> ImageArray:
    """The tiles again. (n, tile, tile, 3) uint8"""
    columns = [cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR_RGB) for file in files]
    return np.concatenate([np.asarray(part, np.uint8) for part in columns]).reshape(-1, tile, tile, 3)


def data_bytes(files: list[bytes]) -> int:
    """Entropy-coded data alone; the two bytes of each restart marker stand for a tile's length."""
    return sum(len(file) - _data_start(file) for file in files)


def _data_start(file: bytes) -> int:
    at = file.index(b"\xff\xda")
    return at + 2 + int.from_bytes(file[at + 2 : at + 4], "big")
