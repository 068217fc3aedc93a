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
    SPACINGS,
    code_range,
    code_range_lattice,
    range_lattice,
)
from node.state import ClientState
from protocol.grid import RANGE_BLOCK, VOID
from protocol.holdings import COARSE_RANK
from protocol.lattice import Channel, mask_to_runs
from protocol.messages import RangeParameters
from protocol.reconstruct import cut
from protocol.region import Region

MENDS_MAX = 3


def mend_range(
    scan: Scan, state: ClientState, region: Region, wanted: RangeParameters, target_steps: float
) -> Coded | None:
    """Encode a refinement after which the whole region is within target_steps, held blocks included.

    Held blocks may have been good enough for the window they were sent for and be too poor for this one: where they
    are, they are sent again, finer, and with a bitmap so that no other block is.
    """
    allowed = _allowed_beyond(scan, region)
    held = state.holdings.channels[Channel.RANGE]
    beyond = state.cells_beyond(target_steps)
    coded = code_range(scan, state, region, wanted)
    for _ in range(MENDS_MAX):
        kept = np.ones(held.shape.blocks, np.bool_)
        if coded is not None:
            kept.ravel()[coded.selection.adopted_blocks()] = False
        poor = _of_region(np.where(kept, beyond, 0), region)
        if poor.sum() + _cells_beyond(scan, coded, region, target_steps) <= allowed or not poor.any():
            return coded
        rank, level = (_of_region(array, region)[poor > 0] for array in (held.rank, held.level))
        quantum = min(wanted.quantum, 65535 - int(rank.max())) - 1
        if quantum < 1:
            return coded
        p = next(p for p in SPACINGS if p == 1 or (p <= wanted.p and p * p <= 2 ** int(level.min())))
        wanted = RangeParameters(p=p, quantum=quantum, s=None)
        listed = mask_to_runs((poor > 0) | (_of_region(held.rank, region) == COARSE_RANK))
        coded = code_range_lattice(scan, state, replace(range_lattice(region, wanted), listed=listed), quantum)
    return coded


def _allowed_beyond(scan: Scan, region: Region) -> float:
    """How many cells of a region may be further off than its target."""
    return (100 - PERCENTILE) / 100 * np.count_nonzero(scan.range_steps[region.rows][:, region.columns])


def _cells_beyond(scan: Scan, coded: Coded | None, region: Region, target_steps: float) -> int:
    """How many of a region's cells a refinement leaves further off than target_steps."""
    if coded is None or coded.patch is None:
        return 0
    selection = coded.selection
    rows = selection.y.start + np.arange(selection.y.low.size)
    columns = selection.x.start + np.arange(selection.x.low.size)
    inside = (rows >= region.top) & (rows < region.top + region.height)
    across = (columns - region.left) % region.turn < region.width
    truth = np.asarray(cut(scan.range_steps, selection), np.int32)
    far = np.abs(coded.patch.astype(np.int32) - truth) > target_steps
    far &= (truth != VOID) & selection.adopted_cells()
    return int(np.count_nonzero(far[inside][:, across]))


def _of_region(blocks: NDArray[Any], region: Region) -> NDArray[Any]:
    """The part of a block array that a region touches. (blocks_high, blocks_wide)"""
    left, top, wide, high = region.blocks(RANGE_BLOCK)
    columns = np.arange(left, left + wide) % blocks.shape[1]
    return blocks[top : top + high][:, columns]
