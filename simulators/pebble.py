"""A pebble: a closed object, as rough and as much drawn on over its poles as anywhere, and known in every direction.

Everything is a function of the place on the unit ball: so no direction is special, and it is the same pebble at every
size of the grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from protocol.grid import FloatArray, Grid, GridSpec
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid, vectors
from simulators.noise import Plane
from simulators.shapes import STEP_MM, Shape

AXES_MM = (62.0, 54.0, 47.0)  # of the ellipsoid it is like
CENTRE_MM = 47.0  # above the table
BUMPS_MM, RELIEF_MM, GRAIN_MM = 3.0, 0.5, 0.06
SLATE, RUST, QUARTZ = np.array([[88, 96, 104], [138, 98, 72], [226, 222, 212]], np.float32)
BEDDING = np.array([0.5, 0.3, 0.8])
VEIN, SPECK = 0.09, 1.9  # how wide veins are, and from what noise on a speck is dark
BAND_PLACES = 1 << 17


def pebble(shape: Shape, seed: int) -> Grid:
    """The pebble seen from its middle. shape : (W, H, Wt, Ht) of directions."""
    width, height, texture_width, texture_height = shape
    spec = GridSpec(*shape, STEP_MM, math.pi * AXES_MM[1] / height, CENTRE_MM, np.pi, "sphere")
    stone = Pebble(seed)
    steps = np.empty((height, width), np.uint16)
    for rows, towards in _bands(width, height, spec.theta0_rad):
        steps[rows] = np.rint(stone.radius_mm(towards) / STEP_MM)
    texture = np.empty((texture_height, texture_width, 3), np.uint8)
    for rows, towards in _bands(texture_width, texture_height, spec.theta0_rad):
        texture[rows] = np.clip(np.rint(stone.colour(towards)), 0, 255)
    return thin_grid(Grid(spec, steps, texture))


class Pebble:
    """The object itself: what it is like along unit vectors (..., 3)."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng((seed, 11))
        sizes = (BUMPS_MM, 3, 2), (RELIEF_MM, 12, 3), (GRAIN_MM, 80, 2)
        self._surface = [(size, _Noise(rng, cells, octaves)) for size, cells, octaves in sizes]
        self._patches, self._vein, self._specks, self._bend, self._grain = (
            _Noise(rng, *of) for of in ((4, 3), (3, 3), (64, 1), (3, 2), (128, 1))
        )

    def radius_mm(self, towards: FloatArray) -> Plane:
        """Distance of its surface from its centre. (...)"""
        smooth = 1 / np.sqrt(((towards / AXES_MM) ** 2).sum(axis=-1))
        return np.asarray(smooth + sum(size * noise.at(towards) for size, noise in self._surface))

    def colour(self, towards: FloatArray) -> Plane:
        """RGB of its surface. (..., 3) 0..255, about"""
        bands = np.sin(6 * towards @ BEDDING + 1.5 * self._bend.at(towards))
        mixed = SLATE + _share(self._patches.at(towards), 0.0, 0.8) * (RUST - SLATE)
        mixed = mixed * (1 + 0.08 * bands[..., None])
        mixed = mixed + _share(-np.abs(self._vein.at(towards)), -VEIN, VEIN) * (QUARTZ - mixed)
        dark = 1 - 0.6 * _share(self._specks.at(towards), SPECK, 0.2)
        return np.asarray(mixed * dark + 2.5 * self._grain.at(towards)[..., None])


def _bands(width: int, height: int, theta0_rad: float) -> Iterator[tuple[slice, FloatArray]]:
    """Directions of a grid, some rows at a time."""
    grid = DirectionGrid(width, height, theta0_rad)
    rows = max(1, BAND_PLACES // width)
    for first in range(0, height, rows):
        band = slice(first, min(first + rows, height))
        yield band, vectors(grid.theta_v(np.arange(height)[band])[:, None], grid.theta_h(np.arange(width)))


def _share(value: Plane, middle: float, half_width: float) -> Plane:
    """0 well below the middle, 1 well above it, soft between. (..., 1)"""
    return np.asarray(np.clip(0.5 + 0.5 * (value - middle) / half_width, 0, 1)[..., None])


class _Noise:
    """Octaves of doubling fineness, each 0.6 times the one before, over the cube [-1, 1]^3; of about unit deviation."""

    def __init__(self, rng: np.random.Generator, cells: int, octaves: int) -> None:
        self._lattices = [rng.standard_normal(((cells << n) + 1,) * 3, dtype=np.float32) for n in range(octaves)]
        weights = 0.6 ** np.arange(octaves)
        self._weights = (1.5 * weights / np.sqrt((weights**2).sum())).tolist()  # interpolation takes a third away

    def at(self, places: FloatArray) -> Plane:
        """Its values at places (..., 3)."""
        octaves = zip(self._weights, self._lattices, strict=True)
        return np.asarray(sum(weight * _interpolated(lattice, places) for weight, lattice in octaves))


def _interpolated(lattice: Plane, places: FloatArray) -> Plane:
    side = len(lattice)
    at = (places.reshape(-1, 3).T.astype(np.float32) + 1) * ((side - 1) / 2)
    near = np.clip(at.astype(np.int32), 0, side - 2)
    share = at - near
    a, b, c = share * share * (3 - 2 * share)
    corner = (near[0] * side + near[1]) * side + near[2]
    flat = lattice.ravel()

    def along_z(offset: int) -> Plane:
        low = flat[corner + offset]
        return np.asarray(low + c * (flat[corner + (offset + 1)] - low))

    def along_y(offset: int) -> Plane:
        low = along_z(offset)
        return np.asarray(low + b * (along_z(offset + side) - low))

    low = along_y(0)
    return np.asarray(low + a * (along_y(side * side) - low)).reshape(places.shape[:-1])
