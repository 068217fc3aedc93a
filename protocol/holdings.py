"""What both ends agree the client has: a level and a rank for every block, and a running digest.

Level: the smallest L with (widest sample interval)^2 <= 2^L; 0 = every sample. Rank: how good the values are, larger is
better; range 65535 - quantisation step (the scan's own step is 65534), texture the quality 0..255 plus 1, and 0 for the
first view. A covered block is adopted iff its level falls and its rank does not, or its rank rises at the same level,
by at least 1 for range and 3 for texture.

Source: REQUIREMENTS F-09c.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.errors import LatticeError
from protocol.grid import RANGE_BLOCK, BoolArray, IntArray, StepArray
from protocol.lattice import Channel, ChannelShape, Lattice

LevelArray = NDArray[np.uint8]
RankArray = NDArray[np.uint16]
HashArray = NDArray[np.uint32]

COARSE_RANK = 0
RANK_MARGIN = {Channel.RANGE: 1, Channel.TEXTURE: 3}
RANK_MAX = {Channel.RANGE: 65534, Channel.TEXTURE: 256}


def range_rank(quantum: int) -> int:
    """Rank of range values quantised to a multiple `quantum` of the scan's step, 1..65534."""
    if not 1 <= quantum <= 65534:
        raise LatticeError(f"quantum must be 1..65534 steps, got {quantum}")
    return 65535 - quantum


def texture_rank(quality: int) -> int:
    """Rank of texture coded at quality 0..255 (255 = lossless)."""
    if not 0 <= quality <= 255:
        raise LatticeError(f"quality must be 0..255, got {quality}")
    return quality + 1


@dataclass(slots=True, eq=False)
class ChannelHoldings:
    """Holdings of one channel: level (blocks_y, blocks_x) uint8, rank likewise uint16. Changed only by `adopt`."""

    shape: ChannelShape
    level: LevelArray
    rank: RankArray

    @classmethod
    def coarse(cls, shape: ChannelShape) -> ChannelHoldings:
        """What a client has after the first view."""
        level = np.full(shape.blocks, shape.coarse_level, np.uint8)
        return cls(shape, level, np.full(shape.blocks, COARSE_RANK, np.uint16))

    def adoptable(self, lattice: Lattice, rank: int) -> BoolArray:
        """Which covered blocks a refinement would be adopted in. (by, bx) bool over the lattice's covered blocks."""
        where = np.ix_(lattice.y.block, lattice.x.block)
        held_level, held_rank = self.level[where].astype(np.int64), self.rank[where].astype(np.int64)
        finer = (lattice.level < held_level) & (rank >= held_rank)
        better = (lattice.level == held_level) & (rank >= held_rank + RANK_MARGIN[self.shape.channel])
        adopted: BoolArray = lattice.listed & (finer | better) & (lattice.level < self.shape.coarse_level)
        return adopted

    def adopt(self, lattice: Lattice, adopted: BoolArray, rank: int) -> None:
        """Record that the blocks of `adopted` now hold the lattice's level at `rank`."""
        rows, columns = np.nonzero(adopted)
        blocks = lattice.y.block[rows], lattice.x.block[columns]
        self.level[blocks] = lattice.level[rows, columns]
        self.rank[blocks] = rank

    def copy(self) -> ChannelHoldings:
        """An independent copy."""
        return ChannelHoldings(self.shape, self.level.copy(), self.rank.copy())

    def to_runs(self) -> list[list[int]]:
        """Run lengths in row order: [[count, level, rank], ...]."""
        key = self.level.ravel().astype(np.int64) << 16 | self.rank.ravel()
        starts = np.flatnonzero(np.diff(key, prepend=-1))
        counts = np.diff(np.append(starts, key.size))
        runs: list[list[int]] = np.stack([counts, key[starts] >> 16, key[starts] & 0xFFFF], axis=1).tolist()
        return runs

    @classmethod
    def from_runs(cls, shape: ChannelShape, runs: list[list[int]]) -> ChannelHoldings:
        """Inverse of to_runs. Raises LatticeError unless every run is in bounds and all add up to the blocks."""
        size = shape.blocks[0] * shape.blocks[1]
        try:
            table = np.array(runs, np.int64).reshape(len(runs), 3)
        except (ValueError, OverflowError):
            raise LatticeError("holdings runs must be [count, level, rank]") from None
        if np.any(table < (1, 0, COARSE_RANK)) or np.any(table > (size, shape.coarse_level, RANK_MAX[shape.channel])):
            raise LatticeError("holdings runs must have known levels and ranks")
        if table[:, 0].sum() != size:
            raise LatticeError(f"holdings runs must cover {size} blocks")
        level = np.repeat(table[:, 1], table[:, 0]).astype(np.uint8).reshape(shape.blocks)
        return cls(shape, level, np.repeat(table[:, 2], table[:, 0]).astype(np.uint16).reshape(shape.blocks))


class Holdings:
    """Holdings of both channels and the digest that proves two ends agree.

    The digest covers every level and rank, and the decoded integer range of every block adopted since both ends last
    set out from the same word (first view or stated holdings). Texture pixels are left out: decoders differ.
    """

    def __init__(self, channels: dict[Channel, ChannelHoldings], content: int = 0) -> None:
        self.channels = channels
        self.content = content

    @classmethod
    def coarse(cls, shapes: dict[Channel, ChannelShape]) -> Holdings:
        """What a client has after the first view."""
        return cls({channel: ChannelHoldings.coarse(shape) for channel, shape in shapes.items()})

    def copy(self) -> Holdings:
        """An independent copy, to plan a series of refinements on."""
        return Holdings({channel: held.copy() for channel, held in self.channels.items()}, self.content)

    def add_content(self, block: IntArray, hashes: HashArray) -> None:
        """Count the decoded range of adopted blocks into the digest: flat block indices (n,) and their hashes (n,)."""
        mixed = mix32(hashes + np.uint32(0x9E3779B1) * (block + 1).astype(np.uint32))
        self.content = (self.content + int(mixed.sum(dtype=np.uint64))) & 0xFFFFFFFF

    def digest(self) -> str:
        """16 hex digits: CRC-32 of all levels and ranks (little-endian, range first), then the sum of content."""
        crc = 0
        for channel in Channel:
            held = self.channels[channel]
            crc = zlib.crc32(held.rank.astype("<u2").tobytes(), zlib.crc32(held.level.tobytes(), crc))
        return f"{crc:08x}{self.content:08x}"


def mix32(values: HashArray) -> HashArray:
    """Spread 32-bit values (any shape) so that sums of them tell sets apart: the finaliser of MurmurHash3."""
    h = values.astype(np.uint32)
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x85EBCA6B)
    h ^= h >> np.uint32(13)
    h *= np.uint32(0xC2B2AE35)
    h ^= h >> np.uint32(16)
    return h


_WEIGHTS = mix32(np.arange(1, RANGE_BLOCK**2 + 1, dtype=np.uint32)).reshape(RANGE_BLOCK, RANGE_BLOCK) | np.uint32(1)


def hash_blocks(cells: StepArray) -> HashArray:
    """Hash of decoded range, a block each. cells (n, 8, 8) uint16, cut blocks padded with 0. Returns (n,) uint32.

    Sum over the block's cells of value times mix32(8 row + column + 1) | 1, modulo 2^32.
    """
    hashes: HashArray = (cells.astype(np.uint32) * _WEIGHTS).sum(axis=(1, 2), dtype=np.uint32)
    return hashes
