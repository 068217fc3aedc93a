"""A refinement as the node holds it before it is sent: what it carries, and what it does to a client's state."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np

from node.state import ClientState
from protocol.grid import RANGE_BLOCK, TEXTURE_BLOCK, VOID, BoolArray, ImageArray, StepArray
from protocol.lattice import (
    NO_SKIRT,
    RHO_MAX,
    RHO_ONE,
    STRIDE_SETS,
    STRIDES,
    Channel,
    ChannelShape,
    Parameters,
    mask_to_runs,
)
from protocol.reconstruct import Selection, range_patch
from protocol.refinement import CRC, HEADER, Generator, Refinement, pack_parameters
from protocol.region import Cap, Region
from protocol.rings import ring_strides
from protocol.strips import Strip, Strips, join_parts, samples_of, strip_texture

FRAME_BYTES = 10  # WebSocket's own, at most
MERGED_SAMPLES = 2.0
DENSER_MAX = 2  # along a row than across
MERGED_QUICKLY = 1.1  # where time counts as well, which more samples take


@dataclass(frozen=True, eq=False)
class Part:
    """What one strip of a refinement carries, encoded.

    mask, decoded, void : range only, the samples as a client decodes them and which cells of its patch are void.
    image : texture only, what it travels in as a client decodes it; None where nobody measured it.
    """

    strip: Strip
    mask: bytes = b""
    decoded: StepArray | None = None
    void: BoolArray | None = None
    image: ImageArray | None = None

    @property
    def selection(self) -> Selection:
        """What the strip carries."""
        return self.strip.selection

    @cached_property
    def range_steps(self) -> StepArray:
        """The patch that a client makes of a strip's range, voids included. (rows, columns) uint16"""
        assert self.decoded is not None and self.void is not None  # of range
        patch = range_patch(self.selection, self.decoded)
        patch[self.void] = VOID
        patch.flags.writeable = False
        return patch

    @cached_property
    def texture(self) -> ImageArray:
        """The patch that a client makes of a measured strip's texture. (rows, columns, 3) uint8"""
        assert self.image is not None  # measured before
        return strip_texture(self.strip, self.image)


@dataclass(frozen=True, slots=True, eq=False)
class Coded:
    """Samples of a lattice, encoded: in one part, on a sphere in one for each strip.

    rank, quality, codec : as in protocol.holdings and protocol.refinement; of HTJ2K quality has sixteenths.
    payload : its values.
    """

    parts: tuple[Part, ...]
    rank: int
    quality: float
    codec: int
    payload: bytes

    @property
    def channel(self) -> Channel:
        """What it carries."""
        return self.parts[0].selection.lattice.shape.channel

    @property
    def parameters(self) -> Parameters:
        """What travels of its lattice."""
        return self.parts[0].selection.lattice.parameters

    @property
    def strips(self) -> Strips:
        """What it carries, before it was encoded."""
        return tuple(part.strip for part in self.parts)

    @property
    def mask(self) -> bytes:
        """Where it is void."""
        return join_parts([part.mask for part in self.parts])

    @property
    def wire_bytes(self) -> int:
        """What it takes on the wire, carrier included."""
        return framed(message_overhead(self.parameters) + len(self.mask) + len(self.payload))

    def refinement(self, epoch: int, seq: int, look: int) -> Refinement:
        """The wire record."""
        return Refinement(
            Generator.FOVEA, self.channel, epoch, seq, look, self.codec, int(self.quality), samples_of(self.strips),
            self.payload, self.mask, self.parameters,
        )  # fmt: skip

    def note(self, state: ClientState) -> None:
        """Record in a client's state that it holds this now."""
        for strip in self.strips:
            state.holdings.channels[self.channel].adopt(strip.selection.lattice, strip.adopted, self.rank)


@dataclass(frozen=True, slots=True)
class Packed:
    """The same without what only planning needs, so that it is quickly handed from process to process."""

    unnumbered: Refinement

    @classmethod
    def of(cls, coded: Coded) -> Packed:
        """What of it travels."""
        return cls(coded.refinement(0, 0, 0))

    def refinement(self, epoch: int, seq: int, look: int) -> Refinement:
        """The wire record."""
        return replace(self.unnumbered, epoch=epoch, seq=seq, look=look)


def message_overhead(parameters: Parameters) -> int:
    """Bytes of a refinement apart from its mask and payload."""
    return HEADER.size + CRC.size + len(pack_parameters(parameters))


def framed(message_bytes: int) -> int:
    """What a message takes on a WebSocket, its frame's header included."""
    return message_bytes + (2 if message_bytes < 126 else 4 if message_bytes < 1 << 16 else FRAME_BYTES)


def rho_of(s: float | None) -> int:
    """Growth of the skirt for S', round(65536 exp(1/S')); None is no skirt (F-07b)."""
    if s is None:
        return NO_SKIRT
    return min(max(round(RHO_ONE * math.exp(1 / s)), RHO_ONE), RHO_MAX)


def region_lattice(
    region: Region, channel: Channel, half_spacing: int, rho: int = NO_SKIRT, strides: tuple[int, ...] = STRIDES
) -> Parameters:
    """The lattice of the blocks that a region touches; of a cap they are listed, and it has no skirt."""
    side = RANGE_BLOCK if channel is Channel.RANGE else TEXTURE_BLOCK
    touched = region.touched(side)
    if touched.all():
        rho = NO_SKIRT if isinstance(region, Cap) else rho
        return Parameters(half_spacing, *region.blocks(side), rho, rho, strides=strides)
    return Parameters(half_spacing, *region.blocks(side), listed=mask_to_runs(touched), strides=strides)


@lru_cache(maxsize=64)
def fewest_strips(shape: ChannelShape, region: Region, quick: bool = False) -> tuple[int, ...]:
    """The strides of strips that a region's texture best travels in: few strips, of not many more samples.

    Where strips meet a wavelet pays for both edges, which costs more than samples that lie a little denser. Samples
    much denser along rows than across would show as spokes round a pole. Range, which travels as one payload, has as
    many strips as there are.   quick : spare time rather than bytes.
    """
    if not shape.sphere:
        return STRIDES
    wide = region.touched(shape.block).sum(axis=1)  # block rows' runs, all round one column
    own = ring_strides(shape.width, shape.height, shape.block)[region.blocks(shape.block)[1] :][: wide.size]
    starts = [0, *(np.flatnonzero(own[1:] != own[:-1]) + 1).tolist(), wide.size]
    rows = [_Rows(stop - start, int(wide[start:stop].max()), int(own[start])) for start, stop in pairwise(starts)]
    most = (MERGED_QUICKLY if quick else MERGED_SAMPLES) * _strips_of(rows, STRIDES)[1]
    offers = [(*_strips_of(rows, strides), strides) for strides in STRIDE_SETS]
    return min((count, samples, strides) for count, samples, strides in offers if samples <= most)[2]


class _Rows(NamedTuple):
    """Rows of blocks of one stride: how many, and how many columns a region touches in them."""

    high: int
    wide: int
    own: int


def _strips_of(rows: list[_Rows], strides: tuple[int, ...]) -> tuple[int, float]:
    """How many strips rows make with some strides, and their samples in blocks of stride 1; infinite: too dense."""
    count, samples = 0, 0.0
    for stride, joined in groupby(rows, lambda part: max(stride for stride in strides if stride <= part.own)):
        parts = list(joined)
        if max(part.own for part in parts) > DENSER_MAX * stride:
            return count, math.inf
        count += 1
        samples += sum(part.high for part in parts) * max(part.wide for part in parts) / stride
    return count, samples


def own_inside(region: Region, selection: Selection, every: int = 1) -> BoolArray:
    """Which own samples of a selection's rectangle lie in a region, or of every so many of its rows and columns.

    (rows, columns) bool, read-only
    """
    stride, (left, width) = selection.lattice.shape.stride, (selection.x.start, int(selection.x.size.sum()))
    rows = selection.y.start, selection.y.start + selection.y.low.size, every
    return _inside(region, rows, range(left * stride, (left + width) * stride, every * stride))


@lru_cache(maxsize=16)
def _inside(region: Region, rows: tuple[int, int, int], columns: range) -> BoolArray:
    inside = region.inside(np.arange(*rows), columns)
    inside.flags.writeable = False
    return inside
