"""What the node remembers of one client's model: its holdings, and how wrong each block of its range still is."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from node.library import Scan
from protocol.grid import RANGE_BLOCK, VOID, IntArray, StepArray
from protocol.holdings import ChannelHoldings, Holdings
from protocol.lattice import Channel, ChannelShape, channel_shapes
from protocol.reconstruct import coarse_to_range


@dataclass(slots=True, eq=False)
class ClientState:
    """One client's model of one scan, as the node believes it to be.

    error : (blocks_y, blocks_x) uint16 largest range error left in each block. [steps]
    beyond : likewise uint8, how many of its cells are further off than target_steps, likewise float32.
    missed : (texture blocks_y, blocks_x) float32 squared error per value left in each block; NaN where not measured.
    first_error : as error, with the first view alone; shared between copies.
    """

    shapes: dict[Channel, ChannelShape]
    holdings: Holdings
    error: StepArray
    beyond: NDArray[np.uint8]
    target_steps: NDArray[np.float32]
    missed: NDArray[np.float32]
    first_error: StepArray

    def copy(self) -> ClientState:
        """An independent copy, to plan on."""
        arrays = self.error.copy(), self.beyond.copy(), self.target_steps.copy(), self.missed.copy()
        return ClientState(self.shapes, self.holdings.copy(), *arrays, self.first_error)

    def take_word(self, channels: dict[Channel, ChannelHoldings]) -> None:
        """Believe a client's own statement of what it holds.

        Blocks that it holds as we thought keep their known errors. Of others, level 0 is off by half a quantum at most;
        anything else is taken for as bad as the first view.
        """
        ours, theirs = self.holdings.channels[Channel.RANGE], channels[Channel.RANGE]
        other = (ours.level != theirs.level) | (ours.rank != theirs.rank)
        bound = np.where(theirs.level == 0, (65535 - theirs.rank.astype(np.int64)) // 2, self.first_error)
        self.error[other] = bound[other].astype(np.uint16)
        self.beyond[other], self.target_steps[other] = RANGE_BLOCK * RANGE_BLOCK, np.inf
        held, said = self.holdings.channels[Channel.TEXTURE], channels[Channel.TEXTURE]
        self.missed[(held.level != said.level) | (held.rank != said.rank)] = np.nan
        self.holdings = Holdings(channels)

    def cells_beyond(self, target_steps: float) -> IntArray:
        """At most how many cells of each block are further off than target_steps. (blocks_y, blocks_x) int64"""
        known = (self.target_steps <= target_steps) | (self.error <= target_steps)
        counted = np.where(self.error <= target_steps, 0, self.beyond)
        return np.where(known, counted, RANGE_BLOCK * RANGE_BLOCK).astype(np.int64)


def scan_shapes(scan: Scan) -> dict[Channel, ChannelShape]:
    """Shapes of both channels of a scan."""
    rows, columns = scan.coarse.texture.shape[:2]
    return channel_shapes(scan.spec, scan.coarse.range_steps.shape, (rows, columns))


def first_state(scan: Scan, coarse_steps: StepArray) -> ClientState:
    """The state of a client that has the first view of a scan and nothing else; coarse_steps as it was sent."""
    shapes = scan_shapes(scan)
    dense = coarse_to_range(coarse_steps, shapes[Channel.RANGE])
    error, beyond = block_errors(dense, scan.range_steps, math.inf)
    target = np.full(error.shape, np.inf, np.float32)  # so that nothing counts as good enough
    missed = np.full(shapes[Channel.TEXTURE].blocks, np.nan, np.float32)
    return ClientState(shapes, Holdings.coarse(shapes), error, beyond, target, missed, error)


def block_errors(patch: StepArray, truth: StepArray, target_steps: float) -> tuple[StepArray, NDArray[np.uint8]]:
    """Of each 8x8 block measured in truth: the largest |patch - truth|, and how many cells are further off than target.

    Returns (rows, columns) uint16 [steps] and uint8.
    """
    difference = np.abs(patch.astype(np.int32) - truth)
    difference[truth == VOID] = 0
    rows, columns = _starts(patch.shape[0]), _starts(patch.shape[1])
    largest = np.maximum.reduceat(np.maximum.reduceat(difference, rows, axis=0), columns, axis=1)
    far = (difference > target_steps).view(np.uint8)
    beyond = np.add.reduceat(np.add.reduceat(far, rows, axis=0), columns, axis=1)
    return largest.astype(np.uint16), beyond.astype(np.uint8)


def _starts(size: int) -> IntArray:
    return np.arange(0, size, RANGE_BLOCK)
