"""What range interpolated between every second, fourth and eighth sample misses, cell by cell: measured once a scan.

So a look knows before any trial which spacing will do at its place, and about which quantum.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.grid import RANGE_BLOCK, VOID, BoolArray, FloatArray, GridSpec, IntArray, StepArray
from protocol.region import Region
from protocol.rings import ring_strides

SPACINGS = (2, 4, 8)
PERCENTILE = 99
AN_OCTAVE = 15  # codes of errors, which end at 16 octaves
UNMEASURED = 255
MANY_CELLS, EVERY = 1 << 15, 3  # an odd number: as many of those beside a sample as of those between two
BAND_ROWS = 256
_SLACK = 1e-6  # so that no rounding of weights decides


def percentile_of(counts: FloatArray | IntArray) -> int:
    """99th percentile ("higher") of values 0, 1, 2 ..., each counted or weighed: one sample weighs 1 on the equator."""
    upto = np.cumsum(counts)
    total = float(upto[-1]) if upto.size else 0.0
    wanted = min((total - 1) * PERCENTILE / 100 + 1, total)
    return int(np.searchsorted(upto, wanted - _SLACK)) if total else 0


def how_often(values: NDArray[np.uint8] | StepArray, counts: BoolArray, largest: int | None = None) -> FloatArray:
    """How often each value 0, 1, 2 ... up to the largest stands where it counts. values, counts : (h, w)"""
    if not values.size:
        return np.zeros(1 + (largest or 0))
    mask = counts.view(np.uint8)
    if largest is None:
        largest = int(cv2.minMaxLoc(values, mask)[1]) if counts.any() else 0
    return np.asarray(cv2.calcHist([values], [0], mask, [largest + 1], [0, largest + 1]).ravel(), np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Some rows' errors, every stride-th cell.  row : (n,) int64 ascending.  codes : (n, W / stride)"""

    row: IntArray
    codes: NDArray[np.uint8]


class RangeModel:
    """Errors of range that is interpolated and not quantised. Memory: a byte for each own sample and spacing.

    range_steps, filled : as of node.library.Scan.
    """

    def __init__(self, spec: GridSpec, range_steps: StepArray, filled: StepArray) -> None:
        self._known: dict[tuple[int, int], _Rows] = {}  # by spacing, and how far apart a row's samples are
        self._strides: dict[int, IntArray] = {}
        for p in (p for p in SPACINGS if not spec.width % p):
            self._strides[p] = strides = _strides(spec, p)
            for stride in np.unique(strides).tolist():
                rows = np.flatnonzero(strides == stride)
                self._known[p, stride] = _Rows(rows, _error_codes(range_steps, filled, rows, p, stride))

    @property
    def knows(self) -> bool:
        """Whether it can say anything of its scan."""
        return bool(self._known)

    def error(self, region: Region, p: int) -> float:
        """99th percentile of the error over a region's measured cells, 5% too high at most; infinite where unknown.

        Cells are weighed by their area. Of many a ninth is looked at: off by some percent more, and by a factor of two
        where a few cells on an edge decide. What is planned by it is tried, or checked.
        """
        if p == 1 or p not in self._strides:
            return 0.0 if p == 1 else np.inf
        every = EVERY if region.area >= MANY_CELLS else 1
        rows = np.arange(region.top, region.top + region.height, every)
        sent = self._strides[p][rows]
        counts = np.zeros(UNMEASURED + 1)
        for stride in np.unique(sent).tolist():
            known, wanted = self._known[p, stride], rows[sent == stride]
            first = region.left // stride
            stop = first + -(-region.width // stride)
            place, columns = np.searchsorted(known.row, wanted), np.arange(first, stop, every) % known.codes.shape[1]
            codes = known.codes[place[:, None], columns]
            seen = range(first * stride, stop * stride, every * stride)
            counts += _counted(codes, region, wanted, seen) * (stride * every**2)
        if not counts[:UNMEASURED].any():
            return 0.0
        return float(2 ** (percentile_of(counts[:UNMEASURED]) / AN_OCTAVE) - 1)


def _strides(spec: GridSpec, p: int) -> IntArray:
    """How far apart the samples of each row stand at most at a spacing. (H,) [columns]"""
    if spec.geometry != "sphere":
        return np.ones(spec.height, np.int64)
    return ring_strides(spec.width, spec.height, RANGE_BLOCK, 2 * p).repeat(RANGE_BLOCK)[: spec.height]


def _counted(codes: NDArray[np.uint8], region: Region, rows: IntArray, columns: range) -> FloatArray:
    """How often each code stands in a region, by area. (256,)"""
    inside, area = region.inside(rows, columns), region.sample_area(rows)
    if (area == 1).all():
        return how_often(codes, inside, UNMEASURED)
    weight = np.repeat(area, np.count_nonzero(inside, axis=1))
    return np.asarray(np.bincount(codes[inside], weight, minlength=UNMEASURED + 1), np.float64)


def _error_codes(
    range_steps: StepArray, filled: StepArray, rows: IntArray, p: int, stride: int
) -> NDArray[np.uint8]:
    """ceil(15 log2(1 + error)) of some rows' cells; UNMEASURED where one is void. (n, W / stride)"""
    height, width = range_steps.shape
    codes = np.empty((rows.size, width // stride), np.uint8)
    for done in range(0, rows.size, BAND_ROWS):
        band = slice(done, done + BAND_ROWS)
        low = rows[band] // p * p
        high = np.minimum(low + p, height - 1)
        part = ((rows[band] - low) / np.maximum(high - low, 1))[:, None].astype(np.float32)
        above, below = (_along(np.asarray(filled[row][:, ::stride]), p) for row in (low, high))
        truth = np.asarray(range_steps[rows[band]][:, ::stride])
        error = np.abs(above + (below - above) * part - truth)
        codes[band] = np.where(truth == VOID, UNMEASURED, np.ceil(AN_OCTAVE * np.log2(1 + error)))
    return codes


def _along(rows: StepArray, p: int) -> NDArray[np.float32]:
    """Rows again from every p-th sample of each, round. (n, W) float32"""
    samples = rows[:, ::p].astype(np.float32)
    step = (np.roll(samples, -1, axis=1) - samples) / p
    dense = samples[:, :, None] + step[:, :, None] * np.arange(p, dtype=np.float32)
    return np.asarray(dense.reshape(rows.shape))
