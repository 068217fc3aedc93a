"""The texture of a sphere as maps of its hemispheres (protocol.polar): what a node cuts a polar image out of.

Near a pole rows are resampled, between four texels each; a map's sample is the mean of what lies in it. The maps of a
scan are made with its texture's model, once; without them the same samples are made for one image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from node.sample import smoothed
from protocol.grid import TEXTURE_BLOCK, ImageArray, IntArray
from protocol.lattice import ChannelShape
from protocol.polar import PolarImage, PolarMap
from protocol.reconstruct import Selection
from protocol.region import Region
from protocol.strips import Strips, blocks_of

SPACINGS = (2, 4)
FARTHEST_RAD = 1.3  # from a pole: there a sample is 0.8 of its spacing high and 1.25 wide
BAND_ROWS = 256
NARROW = 4.0  # samples
FILL_CELL = 2  # samples: of what is hidden here, whose edge is long, 4 take 4% more bytes
MARGIN = 4  # samples that images reach further than their blocks, at most
BlockArray = NDArray[np.int32]


class PolarTexture:
    """Both hemispheres of one texture, as maps at each spacing, as far as they reach."""

    def __init__(self, texture: ImageArray) -> None:
        self._maps = dict(_maps_of(texture))

    def image(self, strips: Strips, image: PolarImage) -> ImageArray:
        """The samples of an image in which strips travel. sample_shape + (3,) uint8; continued where nobody looks."""
        return self._maps[image.place].image(strips, image)

    def halves(self, p: int) -> Iterator[tuple[PolarImage, ImageArray, slice]]:
        """Both maps at a spacing as images, and which rows of blocks lie on each."""
        for place, part in self._maps.items():
            if place.spacing == p:
                rows, columns = part.texels.shape[:2]
                reach, high = int(_reach(place.height)) // TEXTURE_BLOCK, -(-place.height // TEXTURE_BLOCK)
                on_it = slice(high - reach, high) if place.lower else slice(0, reach)
                yield PolarImage(place, part.left, part.top, columns, rows), part.texels, on_it


def reaches(shape: ChannelShape, region: Region) -> bool:
    """Whether the maps hold all blocks of a region."""
    _, top, _, high = region.blocks(TEXTURE_BLOCK)
    first, last = top * TEXTURE_BLOCK, min((top + high) * TEXTURE_BLOCK, shape.height)
    return shape.sphere and min(last, shape.height - first) <= _reach(shape.height)


def polar_samples(texture: ImageArray, strips: Strips, image: PolarImage) -> ImageArray:
    """The same as PolarTexture.image, of a texture whose maps nobody has made."""
    left, top = image.left, image.top
    return _MapPart.of(texture, image.place, left, top, image.columns, image.rows).image(strips, image)


@dataclass(frozen=True, eq=False)
class _MapPart:
    """A rectangle of a map, from its column `left` and row `top` on.

    texels : (h, w, 3) uint8.   block : (h, w) int32, flat index of the block of the texture in which each lies.
    """

    left: int
    top: int
    texels: ImageArray
    block: BlockArray

    @classmethod
    def of(cls, texture: ImageArray, place: PolarMap, left: int, top: int, columns: int, rows: int) -> _MapPart:
        """Cut out of a texture, as many columns and rows."""
        p, dense, bands = int(place.spacing), replace(place, spacing=1.0), []
        x = left * p + np.arange(columns * p, dtype=np.float64) + 0.5
        for first in range(0, rows, BAND_ROWS // p):
            y = (top + first) * p + np.arange(min(BAND_ROWS // p, rows - first) * p, dtype=np.float64) + 0.5
            row, column = dense.texel_at(x[None], y[:, None])
            at = column.astype(np.float32), row.astype(np.float32)
            texels = cv2.remap(texture, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
            means = cv2.resize(texels, (columns, y.size // p), interpolation=cv2.INTER_AREA)
            middle = slice(p // 2, None, p), slice(p // 2, None, p)
            down, across = (np.rint(one[middle]).astype(np.int32) // TEXTURE_BLOCK for one in (row, column))
            blocks_wide = -(-place.width // TEXTURE_BLOCK)
            bands.append((means, down * blocks_wide + across % blocks_wide))
        return cls(left, top, *(np.concatenate(parts) for parts in zip(*bands, strict=True)))

    def image(self, strips: Strips, image: PolarImage) -> ImageArray:
        """A rectangle of it, with what no adopted block needs smoothly continued."""
        rows = slice(image.top - self.top, image.top - self.top + image.rows)
        columns = slice(image.left - self.left, image.left - self.left + image.columns)
        adopted = np.zeros(math.prod(strips[0].selection.lattice.shape.blocks), np.uint8)
        adopted[blocks_of(strips)] = 1
        within = adopted[self.block[rows, columns]]
        for strip in strips:
            within[_narrow_places(strip.selection, image)] = 1
        seen = cv2.dilate(within, np.ones((3, 3), np.uint8)).astype(np.bool_)
        return smoothed(self.texels[rows, columns], seen, FILL_CELL)


def _reach(height: int) -> float:
    """How many rows of a texture lie on a map."""
    return FARTHEST_RAD / math.pi * height


def _narrow_places(selection: Selection, image: PolarImage) -> tuple[IntArray, IntArray]:
    """Rows and columns of an image where texels of blocks lie that may hold no sample: narrow ones, and at the pole."""
    place, block = image.place, selection.y.block
    top = block * TEXTURE_BLOCK
    ends = place.radius(top), place.radius(top + selection.y.size - 1)
    wide = selection.adopted.sum(axis=1) * np.maximum(*ends) * (2 * np.pi * TEXTURE_BLOCK / place.width)
    some, columns = np.nonzero(selection.adopted & (np.minimum(wide, np.minimum(*ends)) < NARROW)[:, None])
    row = (top[some][:, None] + np.arange(TEXTURE_BLOCK)).clip(max=place.height - 1)
    radius, angle = place.radius(row), place.angle(selection.x.block[columns] * TEXTURE_BLOCK + TEXTURE_BLOCK // 2)
    x, y = radius * np.cos(angle)[:, None] - image.left, radius * np.sin(angle)[:, None] - image.top
    return y.ravel().astype(np.int64), x.ravel().astype(np.int64)


def _maps_of(texture: ImageArray) -> Iterator[tuple[PolarMap, _MapPart]]:
    height, width = texture.shape[:2]
    for lower in (False, True):
        for p in SPACINGS:
            place = PolarMap(width, height, p, lower)
            row = _reach(height)
            reach = math.ceil(place.radius(np.array(height - 1 - row if lower else row))) + MARGIN
            yield place, _MapPart.of(texture, place, -reach, -reach, 2 * reach, 2 * reach)
