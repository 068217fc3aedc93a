"""The default foveation: a plateau at one spacing and a skirt that grows outward, in integers only.

A few integers travel; both ends compute the same sample positions from them, bit for bit (PROTOCOL.md, "Lattice").
Range samples sit ON source samples. Texture samples are cells: an average over a few texels, placed at the cell's
centre. Both are described by positions in quarter samples, which are exact for every spacing in use.

Source: Cheng, Basu, Pan 2003, Eqs. (1)-(12), with the plateau and skirt of REQUIREMENTS F-07b.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np

from protocol.errors import LatticeError
from protocol.grid import RANGE_BLOCK, TEXTURE_BLOCK, BoolArray, GridSpec, IntArray

QUARTERS = 4
RHO_ONE = 1 << 16
RHO_MAX = 1 << 20
NO_SKIRT = 0
STRIDES = (1, 2, 4, 8, 16)
# Those that a refinement may allow its strips, as they are numbered on the wire: all, or few for fewer strips.
STRIDE_SETS = (STRIDES, (1,), (1, 2), (1, 2, 4), (1, 2, 4, 8), (1, 2, 8), (1, 4, 16))
POLAR_HALF_SPACING_MIN = 4  # finer is exact, or would claim to be
LEVEL_MAX = 40
_LEVEL_BOUNDS = (QUARTERS * QUARTERS) * (1 << np.arange(LEVEL_MAX, dtype=np.int64))


class Channel(IntEnum):
    """What a refinement carries; the number is the one on the wire."""

    RANGE = 0
    TEXTURE = 1


@dataclass(frozen=True, slots=True)
class ChannelShape:
    """One channel of a scan, as far as lattices and holdings are concerned.

    width, height : dense samples.  coarse_width, coarse_height : samples of the first view.  block : side of a block.
    sphere : rows are directions' polar angles; near the poles they hold fewer samples of their own (protocol.rings).
    stride : of a strip of such rows: how many columns apart its samples stand.
    own_stride : and how many the rows' own do, at most; more than stride where that was limited.
    """

    channel: Channel
    width: int
    height: int
    coarse_width: int
    coarse_height: int
    sphere: bool = False
    stride: int = 1
    own_stride: int = 1

    def __post_init__(self) -> None:
        if not (1 <= self.coarse_width <= self.width and 1 <= self.coarse_height <= self.height):
            raise LatticeError("the coarse shape must lie between 1 and the dense shape")

    @property
    def block(self) -> int:
        """Side of a block: 8 range samples or 16 texels."""
        return RANGE_BLOCK if self.channel is Channel.RANGE else TEXTURE_BLOCK

    @property
    def own_width(self) -> int:
        """Samples of its own that a row has."""
        return self.width // self.stride

    @property
    def own_block(self) -> int:
        """How many of them a block is wide."""
        return self.block // self.stride

    @property
    def beyond(self) -> int:
        """How many samples right of a block its cells hang on: the next one, where there are cells between."""
        return int(self.own_stride > 1)

    @property
    def blocks(self) -> tuple[int, int]:
        """Blocks in (rows, columns); the last ones may be cut."""
        return -(-self.height // self.block), -(-self.width // self.block)

    @property
    def coarse_level(self) -> int:
        """Level of a block that holds nothing but the first view."""
        level_x = _least_level(self.width**2, self.coarse_width**2)
        level_y = _least_level(self.height**2, self.coarse_height**2)
        return max(level_x, level_y)

    @property
    def half_spacings(self) -> tuple[int, ...]:
        """Plateau spacings that may travel, doubled."""
        return (2, 4, 8, 16) if self.channel is Channel.RANGE else (2, 3, 4, 6, 8, 12, 16)


def channel_shapes(
    spec: GridSpec, coarse_range: tuple[int, int], coarse_texture: tuple[int, int]
) -> dict[Channel, ChannelShape]:
    """Shapes of both channels of a scan; coarse shapes are (rows, columns)."""
    sphere = spec.geometry == "sphere"
    return {
        Channel.RANGE: ChannelShape(Channel.RANGE, spec.width, spec.height, coarse_range[1], coarse_range[0], sphere),
        Channel.TEXTURE: ChannelShape(
            Channel.TEXTURE, spec.texture_width, spec.texture_height, coarse_texture[1], coarse_texture[0], sphere
        ),
    }


@dataclass(frozen=True, slots=True)
class Parameters:
    """What travels of a lattice.

    half_spacing : 2 p, p the plateau's sample spacing.
    block_x, block_y, blocks_wide, blocks_high : the plateau, in blocks; it may wrap in x, not in y.
    rho_x, rho_y : growth of the skirt's steps, round(65536 exp(1/S')), 65536..2^20; 0 for no skirt.
    listed : None, or run lengths over the plateau's blocks in row order, unlisted first: only listed ones are adopted.
    strides : on a sphere, how many columns apart the samples of a strip may stand, one of STRIDE_SETS: the fewer of
    these, the fewer and wider strips (protocol.strips). STRIDES everywhere else.
    polar : texture round a pole of a sphere travels as one image of it (protocol.polar).
    """

    half_spacing: int
    block_x: int
    block_y: int
    blocks_wide: int
    blocks_high: int
    rho_x: int = NO_SKIRT
    rho_y: int = NO_SKIRT
    listed: tuple[int, ...] | None = None
    strides: tuple[int, ...] = STRIDES
    polar: bool = False

    @property
    def spacing(self) -> float:
        """The plateau's sample spacing p. [source samples]"""
        return self.half_spacing / 2


@dataclass(frozen=True, slots=True, eq=False)
class Axis:
    """One axis of a lattice.

    at : (m,) int64 strictly ascending positions, in quarter samples, not wrapped; with what rings and edges repeat.
    sample : (m,) int64 which of the `count` transmitted samples stands there.
    border : int64 half-sample positions: of samples (range, (count,)), of the cells' borders (texture, (count + 1,)).
    block, start, stop : (b,) int64 the blocks this axis covers: index, first and past-last dense position, not wrapped.
    gap : (b,) int64 the widest interval each block's stencil touches, in quarter samples; where it is one sample only,
    that sample's cell (texture) or a whole sample (range).
    first, last : (b,) int64 the outermost entries of `at` in that stencil.
    """

    at: IntArray
    sample: IntArray
    count: int
    border: IntArray
    block: IntArray
    start: IntArray
    stop: IntArray
    gap: IntArray
    first: IntArray
    last: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Sample positions of a refinement and the blocks they cover.

    level : (by, bx) int64 level each covered block would reach.   listed : (by, bx) bool, which may be adopted.
    """

    shape: ChannelShape
    parameters: Parameters
    x: Axis
    y: Axis
    level: IntArray
    listed: BoolArray


@lru_cache(maxsize=64)
def build_lattice(shape: ChannelShape, parameters: Parameters) -> Lattice:
    """Compute a lattice from what travelled. Raises LatticeError when the parameters describe none."""
    check_parameters(shape, parameters)
    x, y = axis_x(shape, parameters), axis_y(shape, parameters)
    level = np.maximum.outer(level_of_gap(y.gap), level_of_gap(x.gap))
    return Lattice(shape, parameters, x, y, level, listed_blocks(shape, parameters, x, y))


def level_of_gap(gap: IntArray) -> IntArray:
    """Smallest L with g^2 <= 2^L, for gaps in quarter samples; no logarithm decides (F-09c)."""
    return np.searchsorted(_LEVEL_BOUNDS, gap * gap).astype(np.int64)


def skirt_steps(half_spacing: int, rho: int, coarse_spacing: int, reach: int) -> list[int]:
    """Steps of a skirt, outward, in whole samples: growing by rho/65536, none above coarse_spacing, enough to reach.

    s_0 = p 2^16, s_k = (s_{k-1} rho + 2^15) >> 16, step_k = (s_k + 2^15) >> 16 (F-07b). rho = 0: no steps.
    """
    steps: list[int] = []
    fixed = half_spacing << 15
    while reach > 0 and rho != NO_SKIRT:
        fixed = (fixed * rho + (1 << 15)) >> 16
        step = (fixed + (1 << 15)) >> 16
        if step > coarse_spacing:
            break
        steps.append(step)
        reach -= step
    return steps


@lru_cache(maxsize=8)
def runs_to_mask(runs: tuple[int, ...], size: int) -> BoolArray:
    """Run lengths, False first, to a mask of `size`, read-only. Raises LatticeError unless they add up to it."""
    if any(not 0 <= run <= size for run in runs) or sum(runs) != size:
        raise LatticeError(f"runs must add up to {size} blocks")
    mask = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    mask.flags.writeable = False
    return mask


def mask_to_runs(mask: BoolArray) -> tuple[int, ...]:
    """Inverse of runs_to_mask; the mask is read in row order."""
    flat = np.concatenate([[False], mask.ravel()])
    edges = np.flatnonzero(np.diff(flat.astype(np.int8)))
    return tuple(int(n) for n in np.diff(np.concatenate([[0], edges, [mask.size]])))


def check_parameters(shape: ChannelShape, p: Parameters) -> None:
    """Raise LatticeError unless the parameters describe a lattice."""
    rows, columns = shape.blocks
    if p.half_spacing not in shape.half_spacings:
        raise LatticeError(f"spacing {p.spacing} is not one of {[h / 2 for h in shape.half_spacings]}")
    if not (0 <= p.block_x < columns and 1 <= p.blocks_wide <= columns):
        raise LatticeError(f"plateau columns {p.block_x}+{p.blocks_wide} do not fit {columns} blocks")
    if not (0 <= p.block_y and 1 <= p.blocks_high and p.block_y + p.blocks_high <= rows):
        raise LatticeError(f"plateau rows {p.block_y}+{p.blocks_high} do not fit {rows} blocks")
    if any(rho != NO_SKIRT and not RHO_ONE <= rho <= RHO_MAX for rho in (p.rho_x, p.rho_y)):
        raise LatticeError(f"rho must be {NO_SKIRT} or between {RHO_ONE} and {RHO_MAX}")
    if shape.channel is Channel.RANGE and 2 * shape.width % p.half_spacing:
        raise LatticeError(f"spacing {p.spacing} does not divide the {shape.width} columns")
    if p.strides not in (STRIDE_SETS if shape.sphere else (STRIDES,)):
        raise LatticeError(f"strips with strides of {p.strides} do not fit the scan")
    if p.polar and not _fits_polar(shape, p):
        raise LatticeError("an image of a pole is texture of one hemisphere, at spacing 2 or more and without a skirt")
    if p.blocks_wide == columns and (p.block_x or 2 * shape.width % p.half_spacing):
        raise LatticeError("a plateau all round must start at block 0 and its spacing divide the width")


def _fits_polar(shape: ChannelShape, p: Parameters) -> bool:
    top, bottom = 2 * p.block_y * shape.block, 2 * (p.block_y + p.blocks_high) * shape.block
    one_hemisphere = bottom <= shape.height or top >= shape.height
    plain = p.rho_x == p.rho_y == NO_SKIRT and p.strides == STRIDES and p.half_spacing >= POLAR_HALF_SPACING_MIN
    return shape.sphere and shape.channel is Channel.TEXTURE and one_hemisphere and plain


def axis_x(shape: ChannelShape, p: Parameters) -> Axis:
    """The x axis, in samples of a row's own."""
    width, block = shape.own_width, shape.own_block
    columns = shape.blocks[1]
    start = p.block_x * block
    end = p.block_x + p.blocks_wide
    stop = min(end * block, width) if end <= columns else width + min((end - columns) * block, width)
    if p.blocks_wide == columns:
        return _ring(shape, p.half_spacing)
    plateau = _plateau(2 * start, 2 * stop, p.half_spacing)
    steps = _half_steps(shape, p.half_spacing, p.rho_x, width, shape.coarse_width)
    border = _grow_both(plateau, steps, 2 * (width - 1))
    at = _positions(shape, border)
    return _cover(at, np.arange(at.size), border, _turns(shape, (-1, 0, 1)), shape.beyond)


def axis_y(shape: ChannelShape, p: Parameters) -> Axis:
    """The y axis."""
    height, block = shape.height, shape.block
    start, stop = p.block_y * block, min((p.block_y + p.blocks_high) * block, height)
    edge = 2 * height if shape.channel is Channel.TEXTURE else 2 * (height - 1)
    plateau = np.minimum(_plateau(2 * start, 2 * stop, p.half_spacing), edge)
    if plateau[-2:].tolist() == [edge, edge]:
        plateau = plateau[:-1]
    outward = np.cumsum(_half_steps(shape, p.half_spacing, p.rho_y, height, shape.coarse_height), dtype=np.int64)
    below = _until_edge(plateau[-1] + outward, edge) if plateau[-1] < edge else outward[:0]
    above = -_until_edge(-plateau[0] + outward, 0) if plateau[0] > 0 else outward[:0]
    border = np.concatenate([above[::-1], plateau, below])
    at, sample = _repeat_edges(_positions(shape, border), shape, border)
    return _cover(at, sample, border, _turns(shape, (0,), vertical=True))


def _plateau(start: int, stop: int, half_spacing: int) -> IntArray:
    """Samples from start to the first of the next block, or cell borders from start to at least stop. [half samples]"""
    count = -(-(stop - start) // half_spacing)
    return start + half_spacing * np.arange(count + 1, dtype=np.int64)


def _half_steps(shape: ChannelShape, half_spacing: int, rho: int, size: int, coarse: int) -> list[int]:
    """Skirt steps in half samples. Texture cells get a guard first, one more cell of the plateau's spacing, so that
    the plateau's outermost texels lie between two centres; at spacing 1 they lie on them, but for cells beyond."""
    steps = [2 * step for step in skirt_steps(half_spacing, rho, max(1, size // coarse), size)]
    needs_guard = shape.channel is Channel.TEXTURE and (half_spacing > 2 or shape.beyond > 0)
    return [half_spacing, *steps] if needs_guard else steps


def _grow_both(plateau: IntArray, steps: list[int], span: int) -> IntArray:
    """Add steps right and left alternately; each side stops when the hull would exceed `span`. [half samples]"""
    right, left = [int(plateau[-1])], [int(plateau[0])]
    open_right = open_left = True
    for step in steps:
        open_right = open_right and right[-1] + step - left[-1] <= span
        if open_right:
            right.append(right[-1] + step)
        open_left = open_left and right[-1] - (left[-1] - step) <= span
        if open_left:
            left.append(left[-1] - step)
    return np.concatenate([np.array(left[:0:-1], np.int64), plateau, np.array(right[1:], np.int64)])


def _until_edge(outward: IntArray, edge: int) -> IntArray:
    """Positions before the edge, then the edge itself if a step would reach or pass it."""
    inside = outward[outward < edge]
    return np.append(inside, edge) if inside.size < outward.size else inside


def _positions(shape: ChannelShape, border: IntArray) -> IntArray:
    """Borders (half samples) to sample positions (quarter samples): themselves for range, cell centres for texture."""
    return 2 * border if shape.channel is Channel.RANGE else border[:-1] + border[1:] - 2


def _ring(shape: ChannelShape, half_spacing: int) -> Axis:
    border = np.arange(0, 2 * shape.own_width + 1, half_spacing, dtype=np.int64)
    at = _positions(shape, border)
    if shape.channel is Channel.RANGE:
        at, border = at[:-1], border[:-1]
    count, turn = at.size, QUARTERS * shape.own_width
    sample = np.concatenate([[count - 1], np.arange(count), [0]])
    at = np.concatenate([[at[-1] - turn], at, [at[0] + turn]])
    return _cover(at, sample, border, _turns(shape, (0,)), shape.beyond)


def _repeat_edges(at: IntArray, shape: ChannelShape, border: IntArray) -> tuple[IntArray, IntArray]:
    """At an image edge the outermost cell is repeated outside, so that it serves up to the edge (texture rows)."""
    sample = np.arange(at.size)
    if shape.channel is Channel.RANGE:
        return at, sample
    cell = 2 * np.diff(border)
    if border[0] == 0:
        at, sample = np.append(at[0] - cell[0], at), np.append(0, sample)
    if border[-1] == 2 * shape.height:
        at, sample = np.append(at, at[-1] + cell[-1]), np.append(sample, sample[-1])
    return at, sample


@lru_cache(maxsize=32)
def _turns(shape: ChannelShape, turns: tuple[int, ...], vertical: bool = False) -> tuple[IntArray, IntArray, IntArray]:
    """Blocks of an axis over several turns: index, first and past-last dense position."""
    size, side = (shape.height, shape.block) if vertical else (shape.own_width, shape.own_block)
    index = np.arange(shape.blocks[0 if vertical else 1])
    start = index * side
    stop = np.minimum(start + side, size)
    offset = np.repeat(np.asarray(turns, np.int64) * size, index.size)
    blocks = np.tile(index, len(turns)), np.tile(start, len(turns)) + offset, np.tile(stop, len(turns)) + offset
    for array in blocks:
        array.flags.writeable = False
    return blocks


def _cover(
    at: IntArray, sample: IntArray, border: IntArray, blocks: tuple[IntArray, IntArray, IntArray], beyond: int = 0
) -> Axis:
    """Keep the blocks whose bilinear stencil lies inside the hull, with the widest interval each one touches.

    beyond : how many positions past the block the stencil reaches.
    """
    index, start, stop = blocks
    first = np.searchsorted(at, QUARTERS * start, side="right") - 1
    last = np.searchsorted(at, QUARTERS * (stop - 1 + beyond), side="left")
    inside = (first >= 0) & (last < at.size)
    index, start, stop, first, last = (a[inside] for a in (index, start, stop, first, last))
    count = int(sample.max()) + 1
    alone = np.full(at.size, QUARTERS) if border.size == count else 2 * np.diff(border)[sample]
    gap = np.where(last > first, _widest(np.diff(at), first, last), alone[first])
    return Axis(at, sample, count, border, index, start, stop, np.maximum(gap, QUARTERS), first, last)


def _widest(intervals: IntArray, first: IntArray, last: IntArray) -> IntArray:
    """Largest of intervals[first:last] for each pair; of no meaning where a pair is a single position."""
    touched = np.concatenate([intervals, [0, 0]])
    bounds = np.stack([first, np.maximum(last, first + 1)], axis=1).ravel()
    return np.maximum.reduceat(touched, bounds)[::2] if first.size else first


def listed_blocks(shape: ChannelShape, p: Parameters, x: Axis, y: Axis) -> BoolArray:
    """Which of the blocks covered by two axes may be adopted. (by, bx)"""
    if p.listed is None:
        return np.ones((y.block.size, x.block.size), np.bool_)
    mask = runs_to_mask(p.listed, p.blocks_high * p.blocks_wide).reshape(p.blocks_high, p.blocks_wide)
    column = (x.block - p.block_x) % shape.blocks[1]
    row = y.block - p.block_y
    inside = (row[:, None] >= 0) & (row[:, None] < p.blocks_high) & (column[None, :] < p.blocks_wide)
    return inside & mask[np.clip(row, 0, p.blocks_high - 1)[:, None], np.minimum(column, p.blocks_wide - 1)[None, :]]


def _least_level(numerator: int, denominator: int) -> int:
    level = 0
    while numerator > denominator << level:
        level += 1
    return level
