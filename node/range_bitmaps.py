"""Range refinements that list their blocks: what a client holds is left alone, or mended where it is too poor.

Sending a window at spacing 2 and its creased blocks again at spacing 1 was tried too: since range is coded by lifting,
which spends nothing where interpolation suffices, it saved 0.1% over 15 windows of real scans, and is not done.

Source: REQUIREMENTS F-07b (bitmaps) and F-09c (what is adopted).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from node.coded import Coded, Part, own_inside
from node.library import Scan
from node.range_model import PERCENTILE
from node.refine_range import Trial, code_range_lattice, note_range, range_lattice
from node.state import ClientState
from protocol.grid import RANGE_BLOCK, VOID, BoolArray, FloatArray
from protocol.holdings import COARSE_RANK, range_rank
from protocol.lattice import Channel, ChannelShape, mask_to_runs
from protocol.messages import RangeParameters
from protocol.reconstruct import cut
from protocol.region import Region
from protocol.strips import blocks_of

LISTED_SHARE = 0.1  # of a window held well enough already: from there on a bitmap saves more than it takes
TRIES_MAX = 4
FEW_CELLS = 1  # too far off in a block that counts as good
SLACK = 1e-6  # of sums of areas


def reach_range(
    scan: Scan,
    state: ClientState,
    region: Region,
    wanted: RangeParameters,
    target_steps: float,
    *,
    quick: bool = False,
    trial: Trial | None = None,
) -> list[Coded]:
    """Encode refinements after which the whole region is within target_steps, held blocks included.

    quick : spare time rather than bytes.   trial : of the spacing wanted, if it was tried.

    Blocks held well enough are left out by a bitmap, and so are those held at better values than wanted, since what
    improves them would have to be as good throughout. Where what is kept turns out too poor for this window, it is sent
    again by itself, finer.
    """
    held = state.holdings.channels[Channel.RANGE]
    rank, touched = _of_region(held.rank, region), region.touched(RANGE_BLOCK)
    good = touched & (rank > COARSE_RANK)
    if good.any():  # counting takes as long as interpolating, and most windows are new
        good &= state.cells_beyond(target_steps, region) <= FEW_CELLS
    better = touched & (rank > range_rank(wanted.quantum))
    apart = good | better if better.any() or good[touched].mean() >= LISTED_SHARE else np.zeros_like(good)
    apart |= ~touched
    allowed = _allowed_beyond(scan, region)
    coded = _code_listed(scan, state, region, wanted, apart, quick, trial)
    beyond = _cells_beyond(scan, coded, region, target_steps)
    for _ in range(TRIES_MAX):
        if beyond <= allowed:
            break
        wanted = RangeParameters(p=wanted.p, quantum=max(wanted.quantum * 3 // 4, 1), s=wanted.s)
        coded = _code_listed(scan, state, region, wanted, apart, quick, trial)
        beyond = _cells_beyond(scan, coded, region, target_steps)
    first = [coded] if coded is not None else []
    kept = touched & ~_of_region(_adopted(held.shape, coded), region)
    if beyond <= allowed and not kept.any():
        return first
    after = state.copy()
    if coded is not None:
        note_range(scan, after, coded, target_steps)
    poor = after.cells_beyond(target_steps, region) * _block_area(region)
    if poor[kept].sum() + beyond <= allowed:
        return first
    worst = _worst(poor, allowed)
    second = _mend(scan, after, region, wanted, target_steps, worst, allowed - float(poor[~worst].sum()))
    return [*first, second] if second is not None else first


def _mend(
    scan: Scan,
    state: ClientState,
    region: Region,
    wanted: RangeParameters,
    target_steps: float,
    poor: BoolArray,
    allowed: float,
) -> Coded | None:
    """Encode the poor blocks again: at the spacing wanted where that makes them good enough, else at spacing 1.

    allowed : how many of their cells may still be too far off, by area.
    """
    held = state.holdings.channels[Channel.RANGE]
    rank, level = (_of_region(array, region)[poor] for array in (held.rank, held.level))
    best = 65535 - int(rank.max())
    if wanted.p > 1 and best > 1 and level.min() >= _level_at(wanted.p):
        coded = _code_listed(scan, state, region, RangeParameters(wanted.p, best - 1, None), ~poor)
        if coded is not None and _cells_beyond(scan, coded, region, target_steps) <= allowed:
            return coded
    quantum = max(min(2 * int(target_steps) + 1, best - 1), 1)  # at spacing 1 no cell is off by more than half of it
    return _code_listed(scan, state, region, RangeParameters(1, quantum, None), ~poor)


def _worst(beyond: FloatArray, allowed: float) -> BoolArray:
    """The fewest blocks without which no more than `allowed` cells are too far off, by area."""
    order = np.argsort(beyond, axis=None)[::-1]
    left = beyond.sum() - np.cumsum(beyond.ravel()[order])
    worst = np.zeros(beyond.size, np.bool_)
    worst[order[: int(np.argmax(left <= allowed + SLACK)) + 1]] = True
    return worst.reshape(beyond.shape)


def _level_at(p: int) -> int:
    """Level of a block at spacing p, a power of two."""
    return 2 * (p.bit_length() - 1)


def _code_listed(
    scan: Scan,
    state: ClientState,
    region: Region,
    wanted: RangeParameters,
    apart: BoolArray,
    quick: bool = False,
    trial: Trial | None = None,
) -> Coded | None:
    """Encode the region's blocks but for those apart."""
    parameters = range_lattice(region, wanted)
    if (apart & region.touched(RANGE_BLOCK)).any():
        parameters = replace(parameters, listed=mask_to_runs(~apart))
    return code_range_lattice(scan, state, parameters, wanted.quantum, quick=quick, trial=trial)


def _adopted(shape: ChannelShape, coded: Coded | None) -> BoolArray:
    """Which blocks a refinement changes. (blocks_y, blocks_x)"""
    adopted = np.zeros(shape.blocks, np.bool_)
    if coded is not None:
        adopted.ravel()[blocks_of(coded.strips)] = True
    return adopted


def _allowed_beyond(scan: Scan, region: Region) -> float:
    """How many measured cells of a region may be further off than its target, by area (99th percentile, "higher")."""
    rows = np.arange(region.top, region.top + region.height)
    void = scan.range_steps[region.rows]
    void = (void.take(region.columns, axis=1) if region.width < region.turn else void) == VOID
    area = region.area
    if void.any():
        inside = region.inside(rows, range(region.left, region.left + region.width))
        area -= float(np.count_nonzero(inside & void, axis=1) @ region.sample_area(rows))
    return max(area - 1, 0) * (100 - PERCENTILE) / 100


def _block_area(region: Region) -> FloatArray:
    """How large a cell is in each row of blocks that a region touches. (rows, 1)"""
    _, top, _, high = region.blocks(RANGE_BLOCK)
    return region.sample_area(RANGE_BLOCK * np.arange(top, top + high) + RANGE_BLOCK // 2)[:, None]


def _cells_beyond(scan: Scan, coded: Coded | None, region: Region, target_steps: float) -> float:
    """How many of a region's cells a refinement leaves further off than target_steps, by area."""
    return sum(_part_beyond(scan, part, region, target_steps) for part in coded.parts) if coded is not None else 0


def _part_beyond(scan: Scan, part: Part, region: Region, target_steps: float) -> float:
    """The same of a strip. An own sample counts for the cells up to the next one too."""
    selection, inside = part.selection, own_inside(region, part.selection)
    own = slice(0, inside.shape[1])
    truth = np.asarray(cut(scan.range_steps, selection), np.uint16)[:, own]
    far = cv2.absdiff(part.range_steps[:, own], truth) > target_steps
    far &= (truth != VOID) & selection.adopted_cells() & inside
    area = region.sample_area(selection.y.start + np.arange(len(far)))
    return selection.lattice.shape.stride * float(np.count_nonzero(far, axis=1) @ area)


def _of_region(blocks: NDArray[Any], region: Region) -> NDArray[Any]:
    """The part of a block array that a region touches. (blocks_high, blocks_wide)"""
    left, top, wide, high = region.blocks(RANGE_BLOCK)
    columns = np.arange(left, left + wide) % blocks.shape[1]
    return blocks[top : top + high][:, columns]
