"""Range refinements that list their blocks: what a client holds is mended where a new window needs it better.

Sending a window at spacing 2 and its creased blocks again at spacing 1 was tried too: since range is coded by lifting,
which spends nothing where interpolation suffices, it saved 0.1% over 15 windows of real scans, and is not done.

Source: REQUIREMENTS F-07b (bitmaps) and F-09c (what is adopted).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from node.coded import Coded
from node.library import Scan
from node.refine_range import (
    PERCENTILE,
    client_range,
    code_range_lattice,
    range_lattice,
)
from node.state import ClientState
from protocol.grid import RANGE_BLOCK, VOID
from protocol.holdings import COARSE_RANK
from protocol.lattice import Channel, ChannelShape, mask_to_runs
from protocol.messages import RangeParameters
from protocol.reconstruct import cut
from protocol.region import Region

LISTED_SHARE = 0.1  # of a window held well enough already: from there on a bitmap saves more than it takes
FEW_CELLS = 1  # too far off in a block that counts as good


def mend_range(
    scan: Scan, state: ClientState, region: Region, wanted: RangeParameters, target_steps: float
) -> Coded | None:
    """Encode a refinement after which the whole region is within target_steps, held blocks included.

    Blocks held well enough are left out by a bitmap. Others may have been good enough for the window they were sent for
    and be too poor, all together, for this one: where they are, they are sent again, finer, and nothing else is.
    """
    held = state.holdings.channels[Channel.RANGE]
    good = _of_region((held.rank > COARSE_RANK) & (state.cells_beyond(target_steps) <= FEW_CELLS), region)
    listed = mask_to_runs(~good) if good.mean() >= LISTED_SHARE else None
    coded = code_range_lattice(scan, state, replace(range_lattice(region, wanted), listed=listed), wanted.quantum)
    kept = np.ones(held.shape.blocks, np.bool_)
    if coded is not None:
        kept.ravel()[coded.selection.adopted_blocks()] = False
    poor = np.where(_of_region(kept, region), _of_region(state.cells_beyond(target_steps), region), 0)
    poor = np.minimum(poor, _cells_inside(held.shape, region))
    if poor.sum() + _cells_beyond(scan, coded, region, target_steps) <= _allowed_beyond(scan, region):
        return coded
    finer = 65535 - int(_of_region(held.rank, region)[poor > 0].max(initial=0)) - 1
    quantum = min(wanted.quantum, 2 * int(target_steps) + 1, finer)
    if quantum < 1:
        return coded
    again = mask_to_runs((poor > 0) | ~_of_region(kept, region))
    exact = RangeParameters(p=1, quantum=quantum, s=None)  # at spacing 1 no cell is off by more than half a quantum
    return code_range_lattice(scan, state, replace(range_lattice(region, exact), listed=again), quantum)


def _cells_inside(shape: ChannelShape, region: Region) -> NDArray[np.int64]:
    """How many cells of each block that a region touches lie in it. (blocks_high, blocks_wide)"""
    left, top, wide, high = region.blocks(RANGE_BLOCK)
    row = np.arange(top * RANGE_BLOCK, (top + high) * RANGE_BLOCK)
    column = np.arange(left * RANGE_BLOCK, (left + wide) * RANGE_BLOCK)
    rows = ((row >= region.top) & (row < region.top + region.height)).reshape(high, RANGE_BLOCK).sum(axis=1)
    across = ((column - region.left) % region.turn < region.width).reshape(wide, RANGE_BLOCK).sum(axis=1)
    return np.asarray(np.multiply.outer(rows, across), np.int64)


def _allowed_beyond(scan: Scan, region: Region) -> int:
    """How many measured cells of a region may be further off than its target (99th percentile, "higher")."""
    measured = int(np.count_nonzero(scan.range_steps[region.rows][:, region.columns]))
    return max(measured - 1, 0) * (100 - PERCENTILE) // 100


def _cells_beyond(scan: Scan, coded: Coded | None, region: Region, target_steps: float) -> int:
    """How many of a region's cells a refinement leaves further off than target_steps."""
    if coded is None:
        return 0
    selection = coded.selection
    rows = selection.y.start + np.arange(selection.y.low.size)
    columns = selection.x.start + np.arange(selection.x.low.size)
    inside = (rows >= region.top) & (rows < region.top + region.height)
    across = (columns - region.left) % region.turn < region.width
    truth = np.asarray(cut(scan.range_steps, selection), np.int32)
    far = np.abs(client_range(scan, coded).astype(np.int32) - truth) > target_steps
    far &= (truth != VOID) & selection.adopted_cells()
    return int(np.count_nonzero(far[inside][:, across]))


def _of_region(blocks: NDArray[Any], region: Region) -> NDArray[Any]:
    """The part of a block array that a region touches. (blocks_high, blocks_wide)"""
    left, top, wide, high = region.blocks(RANGE_BLOCK)
    columns = np.arange(left, left + wide) % blocks.shape[1]
    return blocks[top : top + high][:, columns]
