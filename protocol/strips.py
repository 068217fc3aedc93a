"""What a refinement carries of a sphere: its rows of blocks in strips that are as dense along as across.

Where rows of blocks have one stride (protocol.rings), they are a cylinder of own samples, W / stride columns round.
So every strip is a lattice as any other, round the blocks that are listed in it; a cylinder has a single one. Payloads
and masks of several strips stand one behind the other, each behind its length (u32, little-endian). Texture round a
pole may travel as one image instead (protocol.polar), from which each strip takes what is its own.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from protocol.codec import TextureCodec
from protocol.errors import CodecError
from protocol.grid import BoolArray, ImageArray, IntArray
from protocol.holdings import ChannelHoldings
from protocol.lattice import (
    Axis,
    ChannelShape,
    Lattice,
    Parameters,
    axis_x,
    axis_y,
    build_lattice,
    check_parameters,
    level_of_gap,
    listed_blocks,
    runs_to_mask,
)
from protocol.polar import PolarImage, polar_image
from protocol.reconstruct import Selection, select, texture_patch
from protocol.rings import limited_strides, ring_strides

LENGTH = struct.Struct("<I")


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """What one strip carries.

    adopted : (by, bx) bool over its lattice's covered blocks.   polar : the image that all strips travel in, if so.
    """

    selection: Selection
    adopted: BoolArray
    polar: PolarImage | None = None


Strips = tuple[Strip, ...]


@lru_cache(maxsize=64)
def build_strips(shape: ChannelShape, parameters: Parameters) -> tuple[Lattice, ...]:
    """The lattices of a refinement, top down, computed from what travelled. No block is covered by two.

    Raises LatticeError when the parameters describe none.
    """
    if not shape.sphere:
        return (build_lattice(shape, parameters),)
    check_parameters(shape, parameters)
    y = axis_y(shape, parameters)
    own, fitting = (
        ring_strides(shape.width, shape.height, shape.block, half)[y.block] for half in (2, parameters.half_spacing)
    )
    stride = limited_strides(fitting, parameters.strides)
    first = np.flatnonzero(np.diff(stride, prepend=0))
    strips = []
    for begin, end in zip(first.tolist(), [*first[1:].tolist(), stride.size], strict=True):
        strip_shape = replace(shape, stride=int(stride[begin]), own_stride=int(own[begin:end].max()))
        strip = _build_strip(strip_shape, parameters, _rows(y, slice(begin, end)))
        if strip is not None:
            strips.append(strip)
    return tuple(strips)


def select_strips(lattices: Sequence[Lattice], held: ChannelHoldings, rank: int) -> Strips:
    """What a refinement at `rank` would carry to a client that holds `held`; nothing when nothing would be adopted."""
    found = [chosen for chosen in (select(lattice, held, rank) for lattice in lattices) if chosen is not None]
    polar = None
    if found and found[0][0].lattice.parameters.polar:
        polar = polar_image([selection for selection, _ in found])
    return tuple(Strip(*chosen, polar) for chosen in found)


def samples_of(strips: Strips) -> int:
    """Values in a payload."""
    if strips and strips[0].polar is not None:
        return strips[0].polar.samples
    return sum(strip.selection.samples for strip in strips)


@lru_cache(maxsize=8)
def blocks_of(strips: Strips) -> IntArray:
    """Flat indices of the adopted blocks, strip after strip. (n,) int64, read-only"""
    blocks = np.concatenate([np.zeros(0, np.int64), *(strip.selection.adopted_blocks() for strip in strips)])
    blocks.flags.writeable = False
    return blocks


def image_shapes(strips: Strips, codec: TextureCodec) -> list[tuple[int, int]]:
    """Rows and columns of each image of a payload of texture."""
    if strips[0].polar is not None:
        return [strips[0].polar.sample_shape]
    return [image_shape(strip.selection, codec) for strip in strips]


def texture_patches(strips: Strips, images: Sequence[ImageArray]) -> list[ImageArray]:
    """Dense texture of each strip's rectangle from the images of a payload. (rows, columns, 3) uint8 each"""
    travelled = [images[0]] * len(strips) if strips[0].polar else images
    return [strip_texture(strip, image) for strip, image in zip(strips, travelled, strict=True)]


def strip_texture(strip: Strip, image: ImageArray) -> ImageArray:
    """The same of one strip from the image that it travels in."""
    if strip.polar is not None:
        return strip.polar.patch(strip.selection, image)
    return texture_patch(strip.selection, image[: strip.selection.sample_shape[0]])


def image_shape(selection: Selection, codec: TextureCodec) -> tuple[int, int]:
    """Rows and columns of the image in which a selection's texels travel: on a sphere as HTJ2K an odd number of rows.

    Where they were even the last one stands there twice. Else a wavelet ends on a sample that it predicts, and misses
    the last rows twice as far as others, which shows as an arc where two strips meet.
    """
    rows, columns = selection.sample_shape
    return (rows | 1 if selection.lattice.shape.sphere and codec is TextureCodec.HTJ2K else rows), columns


def join_parts(parts: Sequence[bytes]) -> bytes:
    """What strips carry as one payload or mask; of one strip as it is, of nothing but empty ones nothing."""
    if len(parts) == 1 or not any(parts):
        return b"".join(parts)
    return b"".join(LENGTH.pack(len(part)) + part for part in parts)


def split_parts(data: bytes, count: int) -> list[bytes]:
    """Inverse of join_parts for a mask, and for a payload, which is never empty. Raises CodecError."""
    if count == 1:
        return [data]
    if not data:
        return [b""] * count
    parts, at = [], 0
    for _ in range(count):
        end = at + LENGTH.size
        if end > len(data):
            raise CodecError("what a strip carries is missing")
        at, end = end, end + LENGTH.unpack_from(data, at)[0]
        if end > len(data):
            raise CodecError("what a strip carries is cut short")
        parts.append(data[at:end])
        at = end
    if at != len(data):
        raise CodecError(f"{len(data) - at} bytes after what the last strip carries")
    return parts


def _build_strip(shape: ChannelShape, p: Parameters, y: Axis) -> Lattice | None:
    plateau = _plateau_columns(shape, p, y.block)
    if plateau is None:
        return None
    x = axis_x(shape, replace(p, block_x=plateau[0], blocks_wide=plateau[1]))
    level = np.maximum.outer(level_of_gap(y.gap), level_of_gap(x.gap))
    return Lattice(shape, p, x, y, level, listed_blocks(shape, p, x, y))


def _plateau_columns(shape: ChannelShape, p: Parameters, rows: IntArray) -> tuple[int, int] | None:
    """The shortest run of block columns with all that is listed in these block rows: first, count; None: nothing is.

    Of several the one behind the first of the widest gaps, counted from the plateau's left edge.
    """
    if p.listed is None:
        return p.block_x, p.blocks_wide
    mask = runs_to_mask(p.listed, p.blocks_high * p.blocks_wide).reshape(p.blocks_high, p.blocks_wide)
    inside = rows[(rows >= p.block_y) & (rows < p.block_y + p.blocks_high)]
    all_round = shape.blocks[1]
    columns = np.flatnonzero(mask[inside - p.block_y].any(axis=0))
    if not columns.size:
        return None
    gap = np.diff(columns, append=columns[0] + all_round)
    widest = int(np.argmax(gap))
    wide = all_round - int(gap[widest]) + 1
    first = (p.block_x + int(columns[(widest + 1) % columns.size])) % all_round
    return (0 if wide == all_round else first), wide


def _rows(y: Axis, part: slice) -> Axis:
    """An axis with some of its blocks."""
    names = ("block", "start", "stop", "gap", "first", "last")
    return replace(y, **{name: getattr(y, name)[part] for name in names})
