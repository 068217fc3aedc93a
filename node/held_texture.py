"""What a client holds of the texture in one look's window, block by block: how exact, and how wrong it still is.

All of it is read once a look, since a search asks again and again: which blocks are good enough, which a refinement
would leave as they are, and what error these keep.
"""

from __future__ import annotations

import math
from functools import cached_property, lru_cache

import numpy as np

from node.coded import Coded
from node.state import ClientState
from node.texture_model import TextureModel
from protocol.grid import TEXTURE_BLOCK, BoolArray, FloatArray, IntArray
from protocol.holdings import COARSE_RANK, RANK_MARGIN
from protocol.lattice import Channel, ChannelShape, mask_to_runs
from protocol.region import Region
from protocol.strips import blocks_of

LISTED_SHARE = 0.1  # of a window held well enough already: from there on a bitmap saves more than it takes
NEVER = 1 << 16  # a quality that there is not
HELD_MARGIN = 0.95  # what is held is known block by block, not value by value


class HeldTexture:
    """What a client held of a region when a look was planned. Arrays are (rows, columns) of Region.blocks.

    Blocks whose error was never measured count as the model expects them, or as just good enough without one.

    is_refined : whether it held more than the first view of any.
    """

    def __init__(self, state: ClientState, region: Region, model: TextureModel | None, target_mse: float) -> None:
        held = state.holdings.channels[Channel.TEXTURE]
        place = _place(held.shape.blocks, region)
        self._blocks, self._place, self._target_mse = held.shape.blocks, place, target_mse
        self._shape, self._region = held.shape, region
        self.touched: BoolArray = region.touched(TEXTURE_BLOCK)
        self._level, self._quality = held.level[place].astype(np.int64), held.rank[place].astype(np.int64) - 1
        self._refined = held.rank[place] > COARSE_RANK
        self.is_refined = bool((self._refined & self.touched).any())
        self._missed = state.missed[place]
        self._model = model

    @cached_property
    def _mse(self) -> FloatArray:
        """Squared error per value in each block."""
        mse = self._missed.astype(np.float64)
        rows, columns = np.nonzero(np.isnan(mse) & self.touched)
        if self._model is None:
            mse[rows, columns] = self._target_mse
        else:
            where = self._place[0].ravel()[rows], self._place[1].ravel()[columns]
            mse[rows, columns] = self._model.mse_at(*where, self._quality[rows, columns])
        return np.where(self.touched, mse, 0.0)

    @cached_property
    def _values(self) -> tuple[FloatArray, FloatArray]:
        """How many of each block's values lie in the region, and how many it has."""
        return _values_inside(self._shape, self._region)

    @cached_property
    def _errors(self) -> tuple[FloatArray, FloatArray]:
        """Squared error in each block's part of the region: what is to be expected, and what it may be."""
        inside, whole = self._values
        expected = inside * self._mse
        beyond = np.maximum(self._mse - self._target_mse, 0.0)  # of a block that is cut, all of it may lie inside
        return expected, (expected + (whole - inside) * beyond) / HELD_MARGIN

    def error(self, kept: BoolArray, *, most: bool) -> tuple[float, float]:
        """Squared error in some of the blocks as they are held, and of how many values.

        most : so much it may be; else what is to be expected, since errors are known block by block, not value by
        value.
        """
        return float(self._errors[most][kept].sum()), float(self._values[0][kept].sum())

    def left_alone(self, coded: Coded | None) -> BoolArray:
        """Which blocks a refinement (or none) leaves as they are."""
        if coded is None:
            return self.touched
        sent = np.zeros(self._blocks, np.bool_)
        sent.ravel()[blocks_of(coded.strips)] = True
        return self.touched & ~sent[self._place]

    def listed(self, target_mse: float) -> tuple[int, ...] | None:
        """Runs that list the blocks not held well enough; None where nearly all are (F-07b)."""
        if not self.is_refined:
            return None
        good = self.touched & self._refined & (self._missed <= target_mse)
        return mask_to_runs(self.touched & ~good) if good[self.touched].mean() >= LISTED_SHARE else None

    def quality_needed(self, p: float) -> IntArray:
        """The lowest quality at which a spacing would be adopted in each block (F-09c); NEVER: it is held finer."""
        sent = math.ceil(2 * math.log2(p))
        same = np.where(self._level == sent, self._quality + RANK_MARGIN[Channel.TEXTURE], self._quality)
        return np.where(self._level < sent, NEVER, same)

    def quality_to_mend(self, kept: BoolArray, p: float) -> int:
        """The quality at which the too poor of the blocks that are kept would be sent again at a spacing; 0: none."""
        needed = self.quality_needed(p)[kept & (self._missed > self._target_mse)]
        return int(needed[needed < NEVER].max(initial=0))


def _place(blocks: tuple[int, ...], region: Region) -> tuple[IntArray, IntArray]:
    """Index of a region's blocks, those of Region.blocks."""
    left, top, wide, high = region.blocks(TEXTURE_BLOCK)
    rows, columns = np.ix_(np.arange(top, top + high), np.arange(left, left + wide) % blocks[1])
    return rows, columns


@lru_cache(maxsize=16)
def _values_inside(shape: ChannelShape, region: Region) -> tuple[FloatArray, FloatArray]:
    """How many of each block's values lie in a region, and how many it has; on a sphere those of the equator's size."""
    left, top, wide, high = region.blocks(TEXTURE_BLOCK)
    columns = (left + np.arange(wide)) % shape.blocks[1]
    sizes = np.minimum(TEXTURE_BLOCK, shape.width - columns * TEXTURE_BLOCK)
    tops = (top + np.arange(high)) * TEXTURE_BLOCK
    heights = np.minimum(TEXTURE_BLOCK, shape.height - tops)
    narrow = np.ones((1, 1))
    if shape.sphere:
        narrow = np.sin(np.pi * (tops + heights / 2) / shape.height)[:, None]
    counts = region.counts(TEXTURE_BLOCK)
    inside, whole = (np.asarray(3.0 * narrow * values) for values in (counts, np.multiply.outer(heights, sizes)))
    for values in (inside, whole):
        values.flags.writeable = False
    return inside, whole
