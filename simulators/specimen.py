"""What stands on the simulated turntable: a grid whose every sample is known.

The turntable asks for the column at any angle. At a column's own angle the answer is that column, bit for bit; in
between it is interpolated, so a jittering encoder sees the object where the table really stood.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import numpy as np

from exchange.formats import SIZES, ReadOptions, read_scan
from exchange.unrolling import unroll
from protocol.errors import UsageError
from protocol.grid import VOID, Grid, ImageArray, StepArray
from simulators import shapes
from simulators.head import head
from simulators.nutcracker import nutcracker
from simulators.pebble import pebble

GENERATORS: Mapping[str, Callable[[shapes.Shape, int], Grid]] = MappingProxyType(
    {
        "sphere": shapes.sphere,
        "cylinder": shapes.cylinder,
        "post": shapes.post,
        "nutcracker": nutcracker,
        "head": head,
        "pebble": pebble,
    }
)
ON_COLUMN = 1e-6
Samples = TypeVar("Samples", StepArray, ImageArray)


@dataclass(frozen=True, eq=False)
class Specimen:
    """An object with known truth. Its arrays are made read-only: nobody can change the truth while it is scanned.

    grid : what the turntable sees of it.  closed : all of it, as a sphere; None of an object that is not known so.
    """

    name: str
    grid: Grid
    closed: Grid | None = None

    def __post_init__(self) -> None:
        for grid in (self.grid, self.closed or self.grid):
            grid.range_steps.flags.writeable = False
            grid.texture.flags.writeable = False

    def range_column(self, angle_rad: float) -> StepArray:
        """Range seen at an angle. (H,) uint16 steps, 0 = void

        Between two measured samples the range is interpolated; where either is void the nearer one decides.
        """
        spec, columns = self.grid.spec, self._range_columns
        left, right, weight = _columns_about(angle_rad, spec.theta0_rad, spec.width)
        before, after = columns[left], columns[right]
        if not weight:
            return before
        nearer = after if weight > 0.5 else before
        mixed = np.rint(before + weight * (after.astype(np.float64) - before))
        return np.where((before != VOID) & (after != VOID), mixed, nearer).astype(np.uint16)

    def texture_column(self, angle_rad: float) -> ImageArray:
        """Colour seen at an angle, interpolated. (Ht, 3) uint8 RGB"""
        spec, columns = self.grid.spec, self._texture_columns
        left, right, weight = _columns_about(angle_rad, spec.theta0_rad, spec.texture_width)
        before, after = columns[left], columns[right]
        if not weight:
            return before
        return np.rint(before + weight * (after.astype(np.float64) - before)).astype(np.uint8)

    @cached_property
    def _range_columns(self) -> list[StepArray]:
        """The columns, each with its samples side by side: a sweep asks for one after the other."""
        return list(_by_column(self.grid.range_steps))

    @cached_property
    def _texture_columns(self) -> list[ImageArray]:
        """Likewise."""
        return list(_by_column(self.grid.texture))


def make_specimen(
    name_or_path: str | Path, size: str = "S", texture_path: str | Path | None = None, seed: int = 0
) -> Specimen:
    """A generated specimen by its name, or what a file holds: a grid (.npz), an Echo file or a mesh.

    size : S, M or L, of a generated specimen or of the grid a mesh is cast on; other files have their own.
    seed : what a generated specimen is drawn from.
    texture_path : image of a file's texture (any format OpenCV reads); for files only.
    Raises UsageError for an unknown name or size, ExchangeError for a file that is no scan, OSError for one that
    cannot be opened.
    """
    if size not in SIZES:
        raise UsageError(f"size: {size} is none of {', '.join(SIZES)}")
    generate = GENERATORS.get(str(name_or_path))
    if generate is None:
        return _from_file(Path(name_or_path), size, None if texture_path is None else Path(texture_path))
    if texture_path is not None:
        raise UsageError(f"texture: {name_or_path} brings its own; --texture goes with a file")
    return _standing(str(name_or_path), generate(SIZES[size], seed))


def _from_file(path: Path, size: str, texture_path: Path | None) -> Specimen:
    if not path.suffix and not path.exists():
        raise UsageError(f"specimen: {path} is none of {', '.join(GENERATORS)} and no file")
    as_it_is = path.suffix.lower() == ".npz"
    found = read_scan(path, texture_path, ReadOptions(SIZES[size], geometry=None if as_it_is else "cylinder"))
    return _standing(found.name, found.grid)


def _standing(name: str, grid: Grid) -> Specimen:
    """A grid as a specimen: of a closed object the turntable sees the sides."""
    return Specimen(name, grid) if grid.spec.geometry == "cylinder" else Specimen(name, unroll(grid), grid)


def _by_column(rows: Samples) -> Samples:
    """(W, H, ...) of (H, W, ...), read-only."""
    columns: Samples = np.ascontiguousarray(np.swapaxes(rows, 0, 1))
    columns.flags.writeable = False
    return columns


def _columns_about(angle_rad: float, theta0_rad: float, width: int) -> tuple[int, int, float]:
    """The columns before and after an angle, and the weight in [0, 1) of the one after."""
    position = (angle_rad - theta0_rad) * width / (2 * math.pi) - 0.5
    whole = round(position)
    # Angles are rounded floats: a nominal angle must not become a blend of two columns.
    column, weight = (whole, 0.0) if abs(position - whole) < ON_COLUMN else (math.floor(position), position % 1)
    return column % width, (column + 1) % width, weight
