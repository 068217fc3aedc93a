"""Noise on the surface of a turn: cyclic in angle, and the same object at every grid size.

An octave is drawn on a lattice of cells of fixed size in mm and interpolated to the grid at hand; octaves too fine for
the grid are left out, as an area average would leave them out.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]


def lattice_noise(rng: np.random.Generator, cells: tuple[int, int], shape: tuple[int, int]) -> Plane:
    """One octave. cells : lattice (rows, columns), columns a multiple of 8. Returns `shape`, about unit deviation.

    Columns wrap: `shape[1]` must be a multiple of 8 (every size class is).
    """
    # Drawn even where it is left out: what comes next must not depend on the size.
    lattice = rng.standard_normal(cells, dtype=np.float32)
    if 2 * shape[0] < cells[0] or 2 * shape[1] < cells[1]:
        return np.zeros(shape, np.float32)
    return _spread(lattice, shape)


def fractal_noise(
    rng: np.random.Generator, cells: tuple[int, int], shape: tuple[int, int], octaves: int, gain: float = 0.6
) -> Plane:
    """Octaves of doubling fineness, each `gain` times the one before. Returns `shape`, about unit deviation."""
    total = np.zeros(shape, np.float32)
    for octave in range(octaves):
        fine = cells[0] << octave, cells[1] << octave
        total += np.float32(gain**octave) * lattice_noise(rng, fine, shape)
    return total / np.float32(np.sqrt(sum(gain ** (2 * octave) for octave in range(octaves))))


def _spread(lattice: Plane, shape: tuple[int, int]) -> Plane:
    """Cubic interpolation of a lattice to a grid, cyclic in x. (rows, columns) -> shape"""
    columns = lattice.shape[1]
    # Whole lattice cells and whole grid columns must pad alike: an eighth of a turn, or half of a tiny lattice.
    share = 8 if columns >= 32 else 2
    padded = np.pad(lattice, ((0, 0), (columns // share, columns // share)), mode="wrap")
    edge = shape[1] // share
    wide = cv2.resize(padded, (shape[1] + 2 * edge, shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.ascontiguousarray(wide[:, edge : edge + shape[1]], dtype=np.float32)
