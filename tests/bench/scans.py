"""The scans that benchmarks run on, and where they look: DESIGN 8's four, or any grid file."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from exchange.formats import read_scan
from node.library import About, Library, Scan
from protocol.grid import VOID, Grid
from simulators.specimen import GENERATORS, make_specimen

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
SHAPES = {"S": ("360x100", "1024x256"), "M": ("1440x1024", "4096x2048")}
REAL = ("lps_head", "mustard", "james")
STANDARD = (*REAL, "head")
SEED = 7

Click = tuple[float, float]


class Skipped(Exception):
    """Something cannot be measured here; the text says why."""


@dataclass(frozen=True, eq=False)
class BenchScan:
    """A scan under test."""

    name: str
    size: str
    grid: Grid

    @cached_property
    def key(self) -> str:
        """Tells its samples from any other's, for cached results."""
        digest = hashlib.sha256(np.ascontiguousarray(self.grid.range_steps).data)
        digest.update(np.ascontiguousarray(self.grid.texture).data)
        return f"{self.name}-{self.size}-{digest.hexdigest()[:12]}"

    def clicks(self, count: int) -> list[Click]:
        """Foveae (u, v), uniform over measured cells, the same every time."""
        cells = np.argwhere(self.grid.range_steps != VOID)
        chosen = cells[np.random.default_rng(SEED).integers(len(cells), size=count)]
        height, width = self.grid.range_steps.shape
        return [((column + 0.5) / width, (row + 0.5) / height) for row, column in chosen.tolist()]

    def published(self, folder: Path) -> Scan:
        """The scan as a node has it, kept in a library folder."""
        return Library(folder).add(self.grid, About(0.0, "import", self.name))


def load(specimen: str, size: str, texture: str | None = None) -> BenchScan:
    """A generated specimen, one of the real scans by name, or a grid file. Raises Skipped where its data is missing."""
    if specimen in GENERATORS:
        return BenchScan(specimen, size, make_specimen(specimen, size).grid)
    if specimen not in REAL:
        name, grid, _ = read_scan(Path(specimen), Path(texture) if texture else None)
        return BenchScan(name, "file", grid)
    if size not in SHAPES:
        raise Skipped(f"{specimen}: exists at {' and '.join(SHAPES)} only")
    cells, texels = SHAPES[size]
    path = DATA / specimen / f"{specimen}_depth_{cells}.npz"
    images = sorted(path.parent.glob(f"{specimen}_tex_{texels}.*"))
    if not (path.exists() and images):
        raise Skipped(f"{specimen}: not in {DATA.parent.name}/{DATA.name} beside this checkout")
    return BenchScan(specimen, size, read_scan(path, images[0])[1])
