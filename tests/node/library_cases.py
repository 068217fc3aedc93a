"""Small libraries for tests: their scans are noise, and what lies in their folders can be compared."""

from pathlib import Path

import numpy as np

from node.library import About, Library
from node.library_folder import OWN
from protocol.grid import Grid, GridSpec

SPEC = GridSpec(24, 16, 64, 48, step_mm=0.05, pitch_mm=1.0, z_max_mm=12.5, theta0_rad=0.25)
ABOUT = About(1e9, "sweep", "head")


def noise(seed: int, spec: GridSpec = SPEC) -> Grid:
    rng = np.random.default_rng(seed)
    range_steps = rng.integers(0, 3, (spec.height, spec.width)).astype(np.uint16)
    texture = rng.integers(0, 256, (spec.texture_height, spec.texture_width, 3)).astype(np.uint8)
    return Grid(spec, range_steps, texture)


def reopened(library: Library) -> Library:
    """The library as the next start of the node finds it."""
    library.close()
    return Library(library.folder)


def entries(folder: Path) -> set[str]:
    """What lies in a library beside its own things."""
    return {path.name for path in folder.iterdir()} - OWN


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
