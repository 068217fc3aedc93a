"""Texture round a pole as one image: a map of the hemisphere, on which no strips meet.

The map is Lambert's azimuthal one: polar angle a lies 2 sin(a / 2) from the pole, so that what is as large is as large
on the map, and by the angle round the axis, unturned. Its samples stand at spacing p, in samples of the equator, from
the pole on: k + 1/2 of them away, k a whole number. An image is the smallest rectangle of it, of odd sides, round all
that is adopted. A client interpolates between its samples for every own sample of the strips, which are the same as
ever; so holdings know nothing of it. What is exact, at spacing 1, has strips alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.grid import TEXTURE_BLOCK, FloatArray, ImageArray, IntArray
from protocol.lattice import Lattice
from protocol.reconstruct import Selection

Places = tuple[NDArray[np.float32], NDArray[np.float32]]  # columns and rows of an image, (rows, columns) each
PLACE_DIGITS = 6  # of a place on the map before it is cut to whole samples: no machine's sine decides


@dataclass(frozen=True, slots=True)
class PolarMap:
    """The map of one hemisphere of a texture.

    width, height : of the texture.   spacing : p.   lower : whether it is the lower hemisphere.
    """

    width: int
    height: int
    spacing: float
    lower: bool

    @classmethod
    def of(cls, lattice: Lattice) -> PolarMap:
        """The map that a refinement's samples lie on."""
        shape, parameters = lattice.shape, lattice.parameters
        lower = 2 * parameters.block_y * shape.block >= shape.height
        return cls(shape.width, shape.height, parameters.spacing, lower)

    def radius(self, row: IntArray | FloatArray) -> FloatArray:
        """How far from the pole rows (n,) lie, which may be fractions. (n,) [map samples]"""
        from_pole = self.height - 1 - row if self.lower else row
        return 2 * np.sin(np.pi * (from_pole + 0.5) / (2 * self.height)) * self._a_radian

    def angle(self, column: IntArray | FloatArray) -> FloatArray:
        """In which direction columns (n,) lie, not wrapped. (n,) [rad]"""
        return 2 * np.pi * (column + 0.5) / self.width

    def texel_at(self, x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Which row and column, of fractions, lies at places of the map (broadcast), columns from -1/2 to W - 1/2.

        Within half a row of the pole it is the first row, beyond the farthest point the last.
        """
        angle = 2 * np.arcsin(np.minimum(np.hypot(x, y) / (2 * self._a_radian), 1.0))
        from_pole = np.clip(angle * self.height / np.pi - 0.5, 0, self.height - 1)
        column = np.arctan2(y, x) * (self.width / (2 * np.pi)) % self.width - 0.5
        return self.height - 1 - from_pole if self.lower else from_pole, column

    @property
    def _a_radian(self) -> float:
        return max(2 * self.height, self.width) / (2 * math.pi * self.spacing)


@dataclass(frozen=True, slots=True)
class PolarImage:
    """A rectangle of such a map. left, top : its first column and row, from the pole.  columns, rows : odd."""

    place: PolarMap
    left: int
    top: int
    columns: int
    rows: int

    @property
    def sample_shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def samples(self) -> int:
        """Number of values."""
        return self.rows * self.columns

    def patch(self, selection: Selection, image: ImageArray) -> ImageArray:
        """What texture_patch is for a strip's own samples: the same from this image of the map. (rows, columns, 3)"""
        rows = selection.y.start + np.arange(selection.y.low.size)
        columns = (selection.x.start + np.arange(selection.x.low.size)) * selection.lattice.shape.stride
        return texels_at(self.places(rows, columns), image)

    def places(self, rows: IntArray, columns: IntArray) -> Places:
        """Where some rows and columns lie in it."""
        radius, angle = self.place.radius(rows).astype(np.float32), self.place.angle(columns)
        x, y = (
            np.multiply.outer(radius, along.astype(np.float32)) - np.float32(first + 0.5)
            for along, first in ((np.cos(angle), self.left), (np.sin(angle), self.top))
        )
        return x, y


def texels_at(places: Places, image: ImageArray) -> ImageArray:
    """Texels of an image at places, interpolated. (rows, columns, 3) uint8"""
    return np.asarray(cv2.remap(image, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def polar_image(selections: Sequence[Selection]) -> PolarImage:
    """The image that strips, at least one, travel in."""
    place = PolarMap.of(selections[0].lattice)
    blocks = np.concatenate([selection.adopted_blocks() for selection in selections])
    row, column = np.divmod(blocks, selections[0].lattice.shape.blocks[1])
    top, left = (TEXTURE_BLOCK * np.arange(int(among.max()) + 1) for among in (row, column))
    radius = [place.radius(edge)[row] for edge in (top, np.minimum(top + TEXTURE_BLOCK, place.height) - 1)]
    angle = [place.angle(edge) for edge in (left, np.minimum(left + TEXTURE_BLOCK, place.width))]
    (first_column, columns), (first_row, rows) = (
        _run(np.concatenate([far * turn(way)[column] for far in radius for way in angle])) for turn in (np.cos, np.sin)
    )
    return PolarImage(place, first_column, first_row, columns, rows)


def _run(places: FloatArray) -> tuple[int, int]:
    """The first of the samples between which places lie, and how many, an odd number."""
    first, last = (math.floor(round(float(end) - 0.5, PLACE_DIGITS)) for end in (places.min(), places.max()))
    return first, (last - first + 2) | 1
