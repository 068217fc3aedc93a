"""What the node remembers of one client's model: its holdings, and how wrong each block of its range still is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from node.library import Scan
from protocol.grid import RANGE_BLOCK, VOID, IntArray, StepArray
from protocol.holdings import ChannelHoldings, Holdings
from protocol.lattice import Channel, ChannelShape, channel_shapes
from protocol.reconstruct import coarse_to_range, pad_blocks
from protocol.region import Region


@dataclass(slots=True, eq=False)
class ClientState:
    """One client's model of one scan, as the node believes it to be.

    error : (blocks_y, blocks_x) uint16 largest range error left in each block. [steps]
    far : (8 blocks_y, blocks_x) uint8 a bit for each cell, the leftmost highest: further off than its block's
        target_steps, (blocks_y, blocks_x) float32; infinite where the bits mean nothing.
    missed : (texture blocks_y, blocks_x) float32 squared error per value left in each block; NaN where not measured.
    first_error : as error, with the first view alone; shared between copies.

    Clients share states until they differ: whoever changes one makes a copy first.
    """

    shapes: dict[Channel, ChannelShape]
    holdings: Holdings
    error: StepArray
    far: NDArray[np.uint8]
    target_steps: NDArray[np.float32]
    missed: NDArray[np.float32]
    first_error: StepArray

    def copy(self) -> ClientState:
        """An independent copy, to plan on."""
        arrays = self.error.copy(), self.far.copy(), self.target_steps.copy(), self.missed.copy()
        return ClientState(self.shapes, self.holdings.copy(), *arrays, self.first_error)

    def as_said(self, channels: dict[Channel, ChannelHoldings]) -> ClientState:
        """The state of a client that states what it holds; shares the arrays in which nothing is news.

        Blocks that it holds as we thought keep their known errors. Of others, level 0 is off by half a quantum at most;
        anything else is taken for as bad as the first view.
        """
        ours, theirs = self.holdings.channels[Channel.RANGE], channels[Channel.RANGE]
        other = (ours.level != theirs.level) | (ours.rank != theirs.rank)
        error, target_steps, missed = self.error, self.target_steps, self.missed
        if other.any():
            bound = np.where(theirs.level == 0, (65535 - theirs.rank.astype(np.int64)) // 2, self.first_error)
            error = np.where(other, bound, error).astype(np.uint16)
            target_steps = np.where(other, np.float32(np.inf), target_steps)
        held, said = self.holdings.channels[Channel.TEXTURE], channels[Channel.TEXTURE]
        unknown = (held.level != said.level) | (held.rank != said.rank)
        if unknown.any():
            missed = np.where(unknown, np.float32(np.nan), missed)
        agreed = {Channel.RANGE: theirs if other.any() else ours, Channel.TEXTURE: said if unknown.any() else held}
        return ClientState(self.shapes, Holdings(agreed), error, self.far, target_steps, missed, self.first_error)

    def cells_beyond(self, target_steps: float, region: Region) -> IntArray:
        """At most how many cells of each block that a region touches lie in it and are further off than target_steps.

        Returns (blocks_high, blocks_wide) int64.
        """
        left, top, wide, high = region.blocks(RANGE_BLOCK)
        place = np.arange(top, top + high)[:, None], np.arange(left, left + wide)[None, :] % self.error.shape[1]
        row = np.arange(top * RANGE_BLOCK, (top + high) * RANGE_BLOCK)
        cells = region.inside(row, range(left * RANGE_BLOCK, (left + wide) * RANGE_BLOCK))
        if region.turn % RANGE_BLOCK:
            cells |= cells.any(axis=1, keepdims=True)  # behind a cut block columns are not where they seem: count all
        inside = np.packbits(cells, axis=1)
        known = self.target_steps[place] <= target_steps
        bits = np.where(known.repeat(RANGE_BLOCK, axis=0), self.far[row[:, None], place[1]], 0xFF) & inside
        count = np.bitwise_count(bits).reshape(high, RANGE_BLOCK, wide).sum(axis=1, dtype=np.int64)
        return np.where(self.error[place] <= target_steps, 0, count)


def scan_shapes(scan: Scan) -> dict[Channel, ChannelShape]:
    """Shapes of both channels of a scan."""
    rows, columns = scan.coarse.texture.shape[:2]
    return channel_shapes(scan.spec, scan.coarse.range_steps.shape, (rows, columns))


def first_state(scan: Scan, coarse_steps: StepArray) -> ClientState:
    """The state of a client that has the first view of a scan and nothing else; coarse_steps as it was sent."""
    shapes = scan_shapes(scan)
    dense = coarse_to_range(coarse_steps, shapes[Channel.RANGE])
    blocks = [np.diff(np.append(np.arange(0, size, RANGE_BLOCK), size)) for size in dense.shape]
    error, far = block_errors(dense, scan.range_steps, blocks[0], blocks[1], math.inf)
    target = np.full(error.shape, np.inf, np.float32)  # so that nothing counts as good enough
    missed = np.full(shapes[Channel.TEXTURE].blocks, np.nan, np.float32)
    return ClientState(shapes, Holdings.coarse(shapes), error, far, target, missed, error)


def block_errors(
    patch: StepArray, truth: StepArray, heights: IntArray, widths: IntArray, target_steps: float, stride: int = 1
) -> tuple[StepArray, NDArray[np.uint8]]:
    """Of each block of a rectangle: the largest |patch - truth| where measured, and which cells are beyond the target.

    heights, widths : cells of each row and column of blocks.  stride : how many grid columns each cell stands for.
    Returns (rows, columns) uint16 [steps], and (8 rows, columns) uint8 of bits.
    """
    difference = np.asarray(cv2.absdiff(patch, np.asarray(truth)), np.uint16)
    difference[truth == VOID] = 0
    padded = pad_blocks(difference.repeat(stride, axis=1), heights, widths * stride, RANGE_BLOCK)
    rows, columns = heights.size, widths.size
    largest = padded.reshape(rows, RANGE_BLOCK, -1).max(axis=1).reshape(rows, columns, RANGE_BLOCK).max(axis=2)
    return largest, np.packbits(padded > target_steps, axis=1)
