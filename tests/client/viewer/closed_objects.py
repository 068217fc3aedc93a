"""A generated closed object that looks different from every side, standing and tipped over."""

from __future__ import annotations

import asyncio
import io
import math

import numpy as np

from client.transfer import send_scan
from exchange.native import write_native
from protocol.grid import FloatArray, Grid, GridSpec
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid, vectors

SIZE = (480, 240, 1440, 720)
STEP_MM = 0.002
MEAN_MM = 60.0
CENTRE_MM = 40.0
STANDING = np.eye(3)
TIPPED = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # what faced along x looks straight up


def lumpy_mm(towards: FloatArray) -> FloatArray:
    """Distance of its surface from its centre, along its own unit vectors (..., 3). It slopes at what may be a pole."""
    random = np.random.default_rng(5)
    surface = MEAN_MM + 6 * towards[..., 1] - 5 * towards[..., 2]
    for waves in (2, 4, 8, 16):
        for along in random.normal(size=(4, 3)):
            surface = surface + 2 / waves * np.sin(waves * towards @ along + random.uniform(0, 6))
    return np.asarray(surface)


def painted(towards: FloatArray) -> FloatArray:
    """Its colour there. (..., 3) 0..255"""
    patches = np.sin(24 * towards).prod(axis=-1)
    return np.asarray(128 + 60 * towards + 45 * np.tanh(6 * patches)[..., None])


def grid_of(turn: FloatArray) -> Grid:
    """Its scan, when it stands turned."""
    width, height, texture_width, texture_height = SIZE
    steps = np.rint(lumpy_mm(_own(width, height, turn)) / STEP_MM).astype(np.uint16)
    colour = np.rint(painted(_own(texture_width, texture_height, turn))).astype(np.uint8)
    spec = GridSpec(*SIZE, STEP_MM, math.pi * MEAN_MM / height, CENTRE_MM, 0.0, "sphere")
    return thin_grid(Grid(spec, steps, colour))


def bring(url: str, turn: FloatArray) -> str:
    """Have a node keep its scan. Returns the scan's id."""
    file = io.BytesIO()
    write_native(grid_of(turn), file, "lumpy")
    file.seek(0)
    return asyncio.run(send_scan(url, file, moved=lambda done, total: None)).scan


def _own(width: int, height: int, turn: FloatArray) -> FloatArray:
    """The object's own direction along each dense direction."""
    grid = DirectionGrid(width, height)
    row, column = np.mgrid[:height, :width]
    return vectors(grid.theta_v(row), grid.theta_h(column)) @ turn
