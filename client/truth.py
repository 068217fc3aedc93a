"""Holding a model against the truth it was made from: how a demonstration or a test knows that detail has arrived."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from client.model import Model
from exchange.native import read_native
from protocol.grid import RANGE_BLOCK, TEXTURE_BLOCK, BoolArray, FloatArray, Geometry, ImageArray, IntArray, StepArray
from protocol.region import region_round
from protocol.rings import ring_strides
from protocol.sphere import cap_region

SEED = 7
WINDOW = 0.05
RANGE_MM = 0.1
TEXTURE_DB = 40.0
PERCENTILE = 99
PSNR_MAX_DB = 100.0


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What a scan should be: range_steps (H, W) uint16, 0 = void; texture (Ht, Wt, 3) uint8; step_mm; geometry."""

    range_steps: StepArray
    texture: ImageArray
    step_mm: float
    geometry: Geometry = "cylinder"

    @classmethod
    def read(cls, path: str | Path) -> Truth:
        """A file that `foveascan simulate` writes, --truth or --closed. Raises OSError, ExchangeError."""
        with open(path, "rb") as file:
            grid = read_native(file).grid
        return cls(grid.range_steps, grid.texture, grid.spec.step_mm, grid.spec.geometry)

    def clicks(self, count: int) -> list[tuple[float, float]]:
        """Places (u, v) on measured cells, spread evenly at random, the same every time.

        Of a sphere both poles come first.
        """
        cells = np.argwhere(self.range_steps > 0)
        height, width = self.range_steps.shape
        random = np.random.default_rng(SEED)
        if self.geometry == "sphere":
            narrow = np.sin(np.pi * (cells[:, 0] + 0.5) / height)
            poles = np.array([[0, width // 2], [height - 1, 0]])
            chosen = np.concatenate([poles, cells[random.choice(len(cells), count, p=narrow / narrow.sum())]])
        else:
            chosen = cells[random.integers(len(cells), size=count)]
        return [((column + 0.5) / width, (row + 0.5) / height) for row, column in chosen.tolist()]

    def compare(self, model: Model, u: float, v: float, window: float = WINDOW) -> dict[str, float | bool]:
        """What is left between model and truth in the window round (u, v).

        range_error_mm_p99 : 99th percentile ("higher") over cells measured in both.   texture_psnr_db : over RGB.
        ok : both within DESIGN 8's target, and voids where the truth has them and nowhere else.
        """
        height, width = self.range_steps.shape
        inside = self._inside(u, v, window, height, width, RANGE_BLOCK)
        held, true = model.range_steps[inside], self.range_steps[inside]
        measured = (held > 0) & (true > 0)
        error_mm = np.abs(held[measured].astype(np.int64) - true[measured]) * self.step_mm
        error = float(np.percentile(error_mm, PERCENTILE, method="higher")) if error_mm.size else 0.0
        psnr = self._psnr_db(model, u, v, window)
        voids_agree = bool(np.array_equal(held == 0, true == 0))
        reached = error <= RANGE_MM and psnr >= TEXTURE_DB
        return {"range_error_mm_p99": error, "texture_psnr_db": psnr, "ok": reached and voids_agree}

    def _psnr_db(self, model: Model, u: float, v: float, window: float) -> float:
        height, width = self.texture.shape[:2]
        inside = self._inside(u, v, window, height, width, TEXTURE_BLOCK)
        missed = np.mean((model.texture[inside].astype(np.float64) - self.texture[inside]) ** 2, axis=-1)
        area = np.broadcast_to(self._area(width, height)[:, None], inside.shape)[inside]
        squared = float(np.average(missed, weights=area))
        return PSNR_MAX_DB if squared == 0 else min(10 * math.log10(255**2 / squared), PSNR_MAX_DB)

    def _inside(self, u: float, v: float, window: float, height: int, width: int, side: int) -> BoolArray:
        """Cells of a window; on a sphere those that are samples of their own, since they are equally far apart."""
        if self.geometry == "cylinder":
            region = region_round(u, v, window, width, height)
            return region.inside(np.arange(height), range(width))
        inside = cap_region(u, v, window, width, height).inside(np.arange(height), range(width))
        return np.asarray(inside & (np.arange(width) % _strides(width, height, side)[:, None] == 0))

    def _area(self, width: int, height: int) -> FloatArray:
        """Of a texel of its own in each row, in texels of the equator. (height,)"""
        if self.geometry == "cylinder":
            return np.ones(height)
        narrow = np.sin(np.pi * (np.arange(height) + 0.5) / height)
        return np.asarray(_strides(width, height, TEXTURE_BLOCK) * narrow, np.float64)


def _strides(width: int, height: int, side: int) -> IntArray:
    """How many columns a sample of its own is wide in each row of a sphere. (height,)"""
    return np.asarray(np.repeat(ring_strides(width, height, side), side)[:height])
