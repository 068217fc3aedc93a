"""What every contestant must deliver round a click, and whether what it delivered is that: DESIGN 8.

The window has odd sides of sqrt(0.05) of the grid's. It is reached when the texture in it has 40 dB (RGB, void texels
counted) and 99% of its measured range cells lie within 0.1 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from protocol.grid import VOID, Grid, ImageArray, StepArray
from protocol.region import Region, region_round

PERCENTILE = 99
Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True)
class Target:
    """The quality asked for: in this share of the area, this PSNR, this range error."""

    window: float = 0.05
    texture_db: float = 40.0
    range_mm: float = 0.1


@dataclass(frozen=True)
class Window:
    """One click's windows on both grids, with the truth in them."""

    grid: Grid
    target: Target
    range: Region
    texture: Region

    @classmethod
    def round(cls, grid: Grid, click: tuple[float, float], target: Target) -> Window:
        """The windows round a click."""
        s = grid.spec
        cells = region_round(*click, target.window, s.width, s.height)
        return cls(grid, target, cells, region_round(*click, target.window, s.texture_width, s.texture_height))

    @property
    def range_steps(self) -> StepArray:
        """True range in the window. uint16 [steps]"""
        return crop(self.grid.range_steps, self.range)

    @property
    def texels(self) -> ImageArray:
        """True texture in the window."""
        return crop(self.grid.texture, self.texture)

    def range_error_mm(self, range_steps: StepArray) -> float:
        """99th percentile ("higher") of the error over measured cells; a measured cell taken for void is infinite."""
        truth = self.range_steps
        measured = truth != VOID
        if not measured.any():
            return 0.0
        error = np.abs(range_steps[measured].astype(np.float64) - truth[measured]) * self.grid.spec.step_mm
        error[range_steps[measured] == VOID] = math.inf
        return float(np.percentile(error, PERCENTILE, method="higher"))

    def texture_db(self, texels: ImageArray) -> float:
        """PSNR of the window's texture."""
        return psnr_db(texels, self.texels)

    def range_reached(self, range_steps: StepArray) -> bool:
        """Whether a window of range is as good as asked for."""
        return self.range_error_mm(range_steps) <= self.target.range_mm

    def texture_reached(self, texels: ImageArray) -> bool:
        """Whether a window of texture is as good as asked for."""
        return self.texture_db(texels) >= self.target.texture_db


def crop(dense: NDArray[Scalar], region: Region) -> NDArray[Scalar]:
    """A region of a grid, the seam joined."""
    return dense[region.rows].take(region.columns, axis=1)


def psnr_db(made: ImageArray, truth: ImageArray) -> float:
    """PSNR over 8 bits; infinite where nothing differs."""
    difference = made.astype(np.int32) - truth
    squared = float(np.mean(difference * difference))
    return 10 * math.log10(255**2 / squared) if squared else math.inf
