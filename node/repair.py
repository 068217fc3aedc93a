"""Single bad range samples: spikes taken out, small holes filled; larger holes stay void. What was measured is kept.

A spike lies further from all eight neighbours than any surface this grid resolves could. A hole of up to three cells
is filled with the mean of the measured cells round it, weighted by nearness. Columns are cyclic, rows are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from node.axis import Axis
from node.axis_correction import correct, corrected_cells
from protocol.grid import VOID, BoolArray, Grid, IntArray, StepArray

HOLE_CELLS_MAX = 3
SPIKE_ROWS = 3.0  # a spike stands out by more than this many rows' height
SPIKE_SIGMAS = 8.0
_RING = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
_UNREACHED = int(np.iinfo(np.uint16).max)
_BAND_ROWS = 64
_NEIGHBOURS_MIN = 5  # fewer, and it is the edge of something
_OFFSETS = np.argwhere(_RING).T - 1
_NEAR = [(r, c) for r in range(-2, 3) for c in range(-2, 3) if (r, c) != (0, 0)]
_WEIGHT = np.array([1 / (r * r + c * c) for r, c in _NEAR])


@dataclass(frozen=True, slots=True, eq=False)
class Repaired:
    """A grid without spikes and small holes, which tells its repairs. spikes, filled : how many."""

    grid: Grid
    spikes: int
    filled: int


def repair(grid: Grid, noise_mm: float = 0.0, axis: Axis | None = None) -> Repaired:
    """Take spikes out and fill small holes of a grid as it was measured; one without any is returned as it is.

    The same measurement gives the same grid, bit for bit; `undone` is the inverse.
    axis : where the table's axis is, if not where the sensor believes it. Then the grid is laid about that one, in
    place: without the spikes, which would be smeared, and before holes are filled, so that a hole is a hole of the new
    grid. What was measured at a spike stands in the repairs, where it would stand.
    """
    tall_mm = max(SPIKE_ROWS * grid.spec.pitch_mm, SPIKE_SIGMAS * noise_mm)
    changed = spikes_in(grid.range_steps, tall_mm / grid.spec.step_mm)
    spikes = int(changed.sum())
    if axis is not None:
        _correct(grid, changed, axis)
    steps = np.where(changed, np.uint16(VOID), grid.range_steps) if spikes else grid.range_steps
    filled, values = fill(steps, np.argwhere(small_holes(steps == VOID)))
    changed[tuple(filled.T)] = True
    cells = np.argwhere(changed)
    if not cells.size:
        return Repaired(grid, spikes, 0)
    repairs = np.column_stack([cells, grid.range_steps[tuple(cells.T)]]).astype(np.int32)
    steps = steps.copy()
    steps[tuple(filled.T)] = values
    return Repaired(Grid(grid.spec, steps, grid.texture, repairs), spikes, len(filled))


def _correct(grid: Grid, spikes: BoolArray, axis: Axis) -> None:
    """Lay a grid about the true axis as if it had no spikes, then put them where they would be. Both in place.

    spikes : (H, W), where they are, and then where they would be.
    """
    steps = grid.range_steps
    cells = np.argwhere(spikes)
    measured = steps[tuple(cells.T)]
    steps[tuple(cells.T)] = VOID
    found, surface = fill(steps, cells)
    known = np.isin(cells @ (steps.shape[1], 1), found @ (steps.shape[1], 1))
    correct(grid, axis)
    cells, measured = corrected_cells(found, measured[known], surface, grid.spec, axis)
    steps[tuple(cells.T)] = measured
    spikes[:] = False
    spikes[tuple(cells.T)] = True


def undone(grid: Grid) -> Grid:
    """A grid as it was measured: inverse of repair."""
    steps = grid.range_steps.copy()
    rows, columns, measured = grid.repairs.T
    steps[rows, columns] = measured
    return Grid(grid.spec, steps, grid.texture)


def spikes_in(steps: StepArray, tall_steps: float) -> BoolArray:
    """(H, W) measured cells higher or lower than all measured neighbours by more than `tall_steps`; at least five."""
    padded: StepArray = np.pad(steps, 1, "wrap")
    padded[0] = padded[-1] = VOID
    far = np.empty(steps.shape, np.bool_)
    for row in range(0, len(steps), _BAND_ROWS):  # a band stays in the cache while it is looked at
        far[row : row + _BAND_ROWS] = _stands_out(padded[row : row + _BAND_ROWS + 2], tall_steps)
    cells = np.argwhere(far)
    enough = _measured_round(steps, cells) >= _NEIGHBOURS_MIN
    far[tuple(cells[~enough].T)] = False
    return far


def _stands_out(padded: StepArray, tall_steps: float) -> BoolArray:
    """(h, w) measured cells beyond all measured neighbours. padded : (h + 2, w + 2), a neighbour more on each side."""
    highest = cv2.dilate(padded, _RING)
    above = cv2.subtract(padded, highest)  # stops at 0
    lowest = cv2.erode(np.where(padded == VOID, np.uint16(_UNREACHED), padded), _RING)
    below = cv2.subtract(lowest, padded)
    far = (np.maximum(above, below) > tall_steps) & (padded != VOID)
    return np.asarray(far[1:-1, 1:-1])


def _measured_round(steps: StepArray, cells: IntArray) -> IntArray:
    """(n,) how many of the eight neighbours of each cell (n, 2) are measured."""
    rows, columns = (cells[:, axis, None] + _OFFSETS[axis] for axis in (0, 1))
    height, width = steps.shape
    inside = (0 <= rows) & (rows < height)
    measured = inside & (steps[np.clip(rows, 0, height - 1), columns % width] != VOID)
    return np.asarray(measured.sum(axis=1), np.int64)


def small_holes(void: BoolArray) -> BoolArray:
    """(H, W) void cells that hang together, at corners too, with at most two others."""
    pad = HOLE_CELLS_MAX + 1
    wide = cv2.copyMakeBorder(void.astype(np.uint8), 0, 0, pad, pad, cv2.BORDER_WRAP)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=8, ltype=cv2.CV_32S)
    is_small = stats[:, cv2.CC_STAT_AREA] <= HOLE_CELLS_MAX
    is_small[0] = False
    small: BoolArray = is_small[labels[:, pad:-pad]]
    return small


def fill(steps: StepArray, holes: IntArray) -> tuple[IntArray, StepArray]:
    """Values for void cells from what is measured within two cells. holes : (n, 2) rows and columns.

    Returns those that have measured neighbours, (m, 2), and their values, (m,) uint16.
    """
    height, width = steps.shape
    rows = holes[:, :1] + np.array([r for r, _ in _NEAR])
    columns = (holes[:, 1:] + np.array([c for _, c in _NEAR])) % width
    around = steps[np.clip(rows, 0, height - 1), columns].astype(np.float64)
    weight = _WEIGHT * ((around != VOID) & (0 <= rows) & (rows < height))
    total = weight.sum(axis=1)
    known = total > 0
    values = np.rint((around * weight).sum(axis=1)[known] / total[known]).astype(np.uint16)
    return holes[known], values
