"""Levels of a tile pyramid: an image made smaller by a kernel, cut into tiles, made larger again by another kernel."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from protocol.grid import ImageArray
from protocol.region import Region
from tests.bench.scans import BenchScan
from tests.bench.target import Window

LEVELS = (1, 1.5, 2, 3, 4, 6, 8)
TILES = (16, 32, 64, 128, 256)
SHRINK = {"box": Image.Resampling.BOX, "cubic": Image.Resampling.BICUBIC, "lanczos": Image.Resampling.LANCZOS}
ENLARGE = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC, "lanczos": cv2.INTER_LANCZOS4}

Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Rect:
    """A rectangle of a level image."""

    left: int
    top: int
    right: int
    bottom: int

    def of(self, image: NDArray[Scalar]) -> NDArray[Scalar]:
        """Its samples."""
        return image[self.top : self.bottom, self.left : self.right]


@dataclass(frozen=True)
class Level:
    """One level: x and y spacing (which need not be whole), and how it was made and is shown."""

    spacing: float
    shrink: str
    enlarge: str

    @property
    def name(self) -> str:
        return f"1/{self.spacing:g} {self.shrink}/{self.enlarge}" if self.spacing != 1 else "1/1"


def levels() -> list[Level]:
    """Every level with every pair of kernels."""
    pairs = [(shrink, enlarge) for shrink in SHRINK for enlarge in ENLARGE]
    return [Level(1, "box", "linear")] + [Level(spacing, *pair) for spacing in LEVELS[1:] for pair in pairs]


@lru_cache(maxsize=48)
def texture_level(scan: BenchScan, spacing: float, shrink: str) -> ImageArray:
    """A scan's texture at a level's size."""
    texture = scan.grid.texture
    if spacing == 1:
        return texture
    size = tuple(-(-side // spacing) for side in texture.shape[1::-1])
    image = Image.fromarray(np.ascontiguousarray(texture)).resize((int(size[0]), int(size[1])), SHRINK[shrink])
    return np.asarray(image)


def tiles_over(region: Region, full: tuple[int, ...], level: tuple[int, ...], tile: int) -> Rect:
    """The whole tiles of a level image (rows, columns) that hold the samples beneath a region of the full one."""
    left, right = (_onto(x, full[1], level[1]) for x in (region.left, region.left + region.width - 1))
    top, bottom = (_onto(y, full[0], level[0]) for y in (region.top, region.top + region.height - 1))
    return Rect(
        left // tile * tile,
        top // tile * tile,
        min((right // tile + 1) * tile, level[1]),
        min((bottom // tile + 1) * tile, level[0]),
    )


def enlarged(
    received: ImageArray, rect: Rect, region: Region, shapes: tuple[tuple[int, ...], tuple[int, ...]], kernel: str
) -> ImageArray:
    """What a client shows in a region from the tiles it has; shapes : of the full image and of the level's.

    Beyond the tiles their outermost samples go on.
    """
    full, level = shapes
    if full[:2] == level[:2]:
        top, left = region.top - rect.top, region.left - rect.left
        return received[top : top + region.height, left : left + region.width]
    x = (np.arange(region.left, region.left + region.width) + 0.5) * level[1] / full[1] - 0.5 - rect.left
    y = (np.arange(region.top, region.top + region.height) + 0.5) * level[0] / full[0] - 0.5 - rect.top
    at_x, at_y = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    made = cv2.remap(received, at_x, at_y, ENLARGE[kernel], borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(made, np.uint8)


def promising(scan: BenchScan, window: Window, target_db: float) -> list[Level]:
    """Of each spacing the pair of kernels that keeps most, where that reaches the target before any coding."""
    best: dict[float, tuple[float, Level]] = {}
    for level in levels():
        image = texture_level(scan, level.spacing, level.shrink)
        rect = tiles_over(window.texture, scan.grid.texture.shape, image.shape, 32)
        shapes = scan.grid.texture.shape, image.shape
        db = window.texture_db(enlarged(rect.of(image), rect, window.texture, shapes, level.enlarge))
        if db > max(target_db, best.get(level.spacing, (0.0, level))[0]):
            best[level.spacing] = db, level
    return [level for _, level in best.values()]


def _onto(sample: int, full: int, level: int) -> int:
    """The sample of an axis of `level` beneath one of `full`."""
    return (2 * sample + 1) * level // (2 * full)
