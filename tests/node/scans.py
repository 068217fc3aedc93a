"""Small scans for tests of the planners: smooth and creased range, plain and busy texture, voids where asked."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from node.library import About, Library, Scan
from protocol.grid import Grid, GridSpec

STEP_MM = 0.002


def make_grid(width: int = 160, height: int = 96, texels: int = 4, voids: bool = True, seed: int = 3) -> Grid:
    """A barrel with a crease and a bump; its texture is half plain, half busy."""
    spec = GridSpec(width, height, texels * width, texels * height, STEP_MM, 0.5, height * 0.5)
    angle = 2 * np.pi * (np.arange(width) + 0.5) / width
    row = np.linspace(-1, 1, height)[:, None]
    radius_mm = 60 + 12 * np.cos(row * 1.3) + 4 * np.cos(3 * angle) + 3 * np.abs(np.sin(2 * angle)) * (row < 0.2)
    steps = np.rint(radius_mm / STEP_MM).astype(np.uint16)
    if voids:
        steps[height // 2 : height // 2 + 13, 20:31] = 0
    random = np.random.default_rng(seed)
    y, x = np.mgrid[: spec.texture_height, : spec.texture_width]
    base = 150 + 40 * np.sin(2 * np.pi * x / spec.texture_width) + 20 * np.cos(y / 40)
    busy = random.normal(0, 12, (*base.shape, 3)) * (x > spec.texture_width // 2)[..., None]
    texture = np.clip(base[..., None] + busy + np.array([20, -10, -25]), 0, 255).astype(np.uint8)
    return Grid(spec, steps, texture)


def keep(grid: Grid, folder: Path) -> Scan:
    """The grid as a published scan."""
    return Library(folder).add(grid, About(0.0))
