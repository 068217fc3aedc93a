"""What range interpolated between every second, fourth and eighth sample misses, cell by cell: measured once a scan.

So a look knows before any trial which spacing will do at its place, and about which quantum. Of cylinders alone: on a
sphere samples stand apart as far as their row says.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from protocol.grid import VOID, GridSpec, StepArray
from protocol.region import Region

SPACINGS = (2, 4, 8)
PERCENTILE = 99
AN_OCTAVE = 15  # codes of errors, which end at 16 octaves
UNMEASURED = 255
BAND_ROWS = 256


class RangeModel:
    """Errors of range that is interpolated and not quantised. Memory: a byte for each cell and spacing.

    range_steps, filled : as of node.library.Scan.
    """

    def __init__(self, spec: GridSpec, range_steps: StepArray, filled: StepArray) -> None:
        within = spec.width if spec.geometry == "cylinder" else 0
        self._codes = {p: _error_codes(range_steps, filled, p) for p in SPACINGS if within and not within % p}

    @property
    def knows(self) -> bool:
        """Whether it can say anything of its scan."""
        return bool(self._codes)

    def error(self, region: Region, p: int) -> float:
        """99th percentile of the error over a region's measured cells, 5% too high at most; infinite where unknown."""
        if p == 1 or p not in self._codes:
            return 0.0 if p == 1 else math.inf
        counts = np.bincount(self._codes[p][region.rows][:, region.columns].ravel(), minlength=UNMEASURED + 1)
        upto = np.cumsum(counts[:UNMEASURED])
        if not upto[-1]:
            return 0.0
        wanted = math.ceil((upto[-1] - 1) * PERCENTILE / 100) + 1
        return float(2 ** (int(np.searchsorted(upto, wanted)) / AN_OCTAVE) - 1)


def _error_codes(range_steps: StepArray, filled: StepArray, p: int) -> NDArray[np.uint8]:
    """ceil(15 log2(1 + error)) of each cell; UNMEASURED where it is void. (H, W)"""
    codes = np.empty(range_steps.shape, np.uint8)
    height = range_steps.shape[0]
    for top in range(0, height, BAND_ROWS):
        rows = np.arange(top, min(top + BAND_ROWS, height))
        low = rows // p * p
        high = np.minimum(low + p, height - 1)
        part = ((rows - low) / np.maximum(high - low, 1))[:, None].astype(np.float32)
        above, below = (_along(np.asarray(filled[row]), p) for row in (low, high))
        truth = np.asarray(range_steps[rows])
        error = np.abs(above + (below - above) * part - truth)
        codes[rows] = np.where(truth == VOID, UNMEASURED, np.ceil(AN_OCTAVE * np.log2(1 + error)))
    return codes


def _along(rows: StepArray, p: int) -> NDArray[np.float32]:
    """Rows again from every p-th sample of each, round. (n, W) float32"""
    samples = rows[:, ::p].astype(np.float32)
    step = (np.roll(samples, -1, axis=1) - samples) / p
    dense = samples[:, :, None] + step[:, :, None] * np.arange(p, dtype=np.float32)
    return np.asarray(dense.reshape(rows.shape))
