"""What the node remembers of one client's model: its holdings, and how wrong each block of its range still is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from node.library import Scan
from protocol.grid import RANGE_BLOCK, VOID, IntArray, StepArray
from protocol.holdings import Holdings
from protocol.lattice import Channel, ChannelShape, channel_shapes
from protocol.reconstruct import coarse_to_range


@dataclass(slots=True, eq=False)
class ClientState:
    """One client's model of one scan, as the node believes it to be.

    error : (blocks_y, blocks_x) uint16 largest range error left in each block. [steps]
    """

    shapes: dict[Channel, ChannelShape]
    holdings: Holdings
    error: StepArray

    def copy(self) -> ClientState:
        """An independent copy, to plan on."""
        return ClientState(self.shapes, self.holdings.copy(), self.error.copy())


def scan_shapes(scan: Scan) -> dict[Channel, ChannelShape]:
    """Shapes of both channels of a scan."""
    rows, columns = scan.coarse.texture.shape[:2]
    return channel_shapes(scan.spec, scan.coarse.range_steps.shape, (rows, columns))


def first_state(scan: Scan, coarse_steps: StepArray) -> ClientState:
    """The state of a client that has the first view of a scan and nothing else; coarse_steps as it was sent."""
    shapes = scan_shapes(scan)
    dense = coarse_to_range(coarse_steps, shapes[Channel.RANGE])
    return ClientState(shapes, Holdings.coarse(shapes), block_errors(dense, scan.range_steps))


def block_errors(patch: StepArray, truth: StepArray) -> StepArray:
    """Largest |patch - truth| in each 8x8 block that is measured in truth. (rows, columns) uint16 [steps]"""
    difference = np.abs(patch.astype(np.int32) - truth)
    difference[truth == VOID] = 0
    rows, columns = _starts(patch.shape[0]), _starts(patch.shape[1])
    return np.maximum.reduceat(np.maximum.reduceat(difference, rows, axis=0), columns, axis=1).astype(np.uint16)


def _starts(size: int) -> IntArray:
    return np.arange(0, size, RANGE_BLOCK)
