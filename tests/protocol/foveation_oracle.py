"""F-07b, F-09c and F-11 once more, slowly: fractions, dictionaries and single cells, written from REQUIREMENTS only.

Positions are Fractions of a source sample, not wrapped; nothing here comes from protocol.lattice but its parameters.
"""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass
from fractions import Fraction

from protocol.lattice import Channel, ChannelShape, Parameters

Place = tuple[int, int]  # row, column
Stencil = tuple[int, int, Fraction]  # the two samples beside a cell and its place between them


@dataclass(frozen=True)
class OracleAxis:
    """position : of every entry, ascending.  sample : which sample stands there.  cells : borders of texture cells."""

    position: list[Fraction]
    sample: list[int]
    cells: list[tuple[Fraction, Fraction]]

    def stencil(self, cell: int) -> tuple[int, int] | None:
        """Entries at or beside a cell; None outside the hull."""
        low = bisect.bisect_right(self.position, cell) - 1
        high = bisect.bisect_left(self.position, cell)
        return (low, high) if low >= 0 and high < len(self.position) else None

    def gap(self, cells: range) -> Fraction | None:
        """Widest interval that the cells' stencils touch, at least 1; None when one of them leaves the hull.

        A single texture cell that a single texel is the centre of has no interval: its own width counts.
        """
        widest = Fraction(1)
        for cell in cells:
            beside = self.stencil(cell)
            if beside is None:
                return None
            if beside[0] != beside[1]:
                widest = max(widest, self.position[beside[1]] - self.position[beside[0]])
            elif self.cells and len(cells) == 1:
                low, high = self.cells[self.sample[beside[0]]]
                widest = max(widest, high - low)
        return widest

    def place(self, cell: int) -> Stencil:
        """Samples beside a cell and its place between them."""
        beside = self.stencil(cell)
        assert beside is not None
        low, high = beside
        if low == high:
            return self.sample[low], self.sample[low], Fraction(0)
        part = (cell - self.position[low]) / (self.position[high] - self.position[low])
        return self.sample[low], self.sample[high], part


def level_of(gap: Fraction) -> int:
    """Smallest L with g^2 <= 2^L."""
    return next(level for level in range(64) if gap * gap <= 2**level)


def coarse_level(shape: ChannelShape) -> int:
    """Level of the first view: its spacing is W/w by H/h."""
    spacing = Fraction(shape.width, shape.coarse_width), Fraction(shape.height, shape.coarse_height)
    return level_of(max(spacing))


def growing_steps(p: Fraction, rho: int, limit: int) -> list[int]:
    """Whole skirt steps up to the limit (at most 4000 of them); none when rho is 0."""
    if rho == 0:
        return []
    steps, scaled = [], int(p * 65536)
    for _ in range(4000):
        scaled = (scaled * rho + 32768) >> 16
        step = (scaled + 32768) >> 16
        if step > limit:
            break
        steps.append(step)
    return steps


def skirt(shape: ChannelShape, p: Fraction, rho: int, size: int, coarse: int) -> list[Fraction]:
    """Steps away from the plateau: a texture cell of the plateau's own size first, unless texels are sent singly."""
    steps = [Fraction(step) for step in growing_steps(p, rho, max(1, size // coarse))]
    return [p, *steps] if shape.channel is Channel.TEXTURE and p > 1 else steps


def axis_y(shape: ChannelShape, parameters: Parameters) -> OracleAxis:
    """Rows: the plateau and its skirt, which stops at the edges of the grid."""
    p, top = Fraction(parameters.half_spacing, 2), parameters.block_y * shape.block
    bottom = min(top + parameters.blocks_high * shape.block, shape.height)
    texture = shape.channel is Channel.TEXTURE
    edge = shape.height if texture else shape.height - 1
    mark = [Fraction(top)]
    while mark[-1] < min(bottom, edge):
        mark.append(min(mark[-1] + p, Fraction(edge)))
    steps = skirt(shape, p, parameters.rho_y, shape.height, shape.coarse_height)
    for step in steps:
        if mark[-1] < edge:
            mark.append(min(mark[-1] + step, Fraction(edge)))
    for step in steps:
        if mark[0] > 0:
            mark.insert(0, max(mark[0] - step, Fraction(0)))
    if not texture:
        return OracleAxis(mark, list(range(len(mark))), [])
    cells = list(zip(mark, mark[1:], strict=False))
    position = [(low + high - 1) / 2 for low, high in cells]
    sample = list(range(len(position)))
    if mark[0] == 0:
        position.insert(0, position[0] - (cells[0][1] - cells[0][0]))
        sample.insert(0, 0)
    if mark[-1] == edge:
        position.append(position[-1] + cells[-1][1] - cells[-1][0])
        sample.append(sample[-1])
    return OracleAxis(position, sample, cells)


def axis_x(shape: ChannelShape, parameters: Parameters) -> OracleAxis:
    """Columns: a ring when the plateau goes all round, else a hull of at most W - 1 columns that may cross the seam."""
    p, width, block = Fraction(parameters.half_spacing, 2), shape.width, shape.block
    columns = -(-width // block)
    texture = shape.channel is Channel.TEXTURE
    if parameters.blocks_wide == columns:
        count = int(width / p)
        offset = (p - 1) / 2 if texture else Fraction(0)
        position = [k * p + offset for k in range(-1, count + 1)]
        cells = [(k * p, (k + 1) * p) for k in range(count)] if texture else []
        return OracleAxis(position, [k % count for k in range(-1, count + 1)], cells)
    start = parameters.block_x * block
    wrapped = [(parameters.block_x + i) % columns for i in range(parameters.blocks_wide)]
    length = sum(min(block, width - index * block) for index in wrapped)
    mark = [Fraction(start)]
    while mark[-1] < start + length:
        mark.append(mark[-1] + p)
    right = left = True
    for step in skirt(shape, p, parameters.rho_x, width, shape.coarse_width):
        right = right and mark[-1] + step - mark[0] <= width - 1
        if right:
            mark.append(mark[-1] + step)
        left = left and mark[-1] - mark[0] + step <= width - 1
        if left:
            mark.insert(0, mark[0] - step)
    cells = list(zip(mark, mark[1:], strict=False)) if texture else []
    position = [(low + high - 1) / 2 for low, high in cells] if texture else mark
    return OracleAxis(position, list(range(len(position))), cells)


def covered(axis: OracleAxis, size: int, block: int, cyclic: bool) -> dict[int, tuple[range, Fraction]]:
    """Blocks of an axis whose cells all lie in the hull: their cells, not wrapped, and the widest interval touched."""
    found: dict[int, tuple[range, Fraction]] = {}
    for turn in (0, -1, 1) if cyclic else (0,):
        for index in range(-(-size // block)):
            cells = range(index * block + turn * size, min((index + 1) * block, size) + turn * size)
            gap = axis.gap(cells)
            if gap is not None:
                if index in found and found[index][0] != cells:
                    assert len(axis.position) > 2 and _is_ring(axis, size), f"block {index} is covered twice"
                    continue
                found[index] = cells, gap
    return found


def _is_ring(axis: OracleAxis, size: int) -> bool:
    return axis.position[-1] - axis.position[0] > size


def listed_blocks(shape: ChannelShape, parameters: Parameters) -> set[Place] | None:
    """Blocks (row, column) that may be adopted; None for all."""
    if parameters.listed is None:
        return None
    columns = -(-shape.width // shape.block)
    chosen, index, on = set(), 0, False
    for run in parameters.listed:
        for _ in range(run):
            row, column = divmod(index, parameters.blocks_wide)
            if on:
                chosen.add((parameters.block_y + row, (parameters.block_x + column) % columns))
            index += 1
        on = not on
    return chosen


@dataclass
class OracleClient:
    """A dense grid and its holdings as dictionaries of single cells and blocks."""

    shape: ChannelShape
    level: dict[Place, int]
    rank: dict[Place, int]

    @classmethod
    def coarse(cls, shape: ChannelShape) -> OracleClient:
        rows, columns = -(-shape.height // shape.block), -(-shape.width // shape.block)
        every = [(row, column) for row in range(rows) for column in range(columns)]
        return cls(shape, dict.fromkeys(every, coarse_level(shape)), dict.fromkeys(every, 0))

    def apply(self, parameters: Parameters, rank: int) -> tuple[dict[Place, int], dict[Place, tuple[Stencil, Stencil]]]:
        """Adopt what a refinement improves: the adopted blocks' levels, the stencils (y, x) of every adopted cell."""
        shape = self.shape
        y, x = axis_y(shape, parameters), axis_x(shape, parameters)
        rows = covered(y, shape.height, shape.block, cyclic=False)
        columns = covered(x, shape.width, shape.block, cyclic=True)
        listed, margin = listed_blocks(shape, parameters), 1 if shape.channel is Channel.RANGE else 3
        adopted: dict[Place, int] = {}
        cells: dict[Place, tuple[Stencil, Stencil]] = {}
        for row, (row_cells, row_gap) in rows.items():
            for column, (column_cells, column_gap) in columns.items():
                block, level = (row, column), level_of(max(row_gap, column_gap))
                finer = level < self.level[block] and rank >= self.rank[block]
                better = level == self.level[block] and rank >= self.rank[block] + margin
                allowed = (listed is None or block in listed) and level < coarse_level(shape)
                if not (allowed and (finer or better)):
                    continue
                adopted[block] = level
                for r in row_cells:
                    for c in column_cells:
                        cells[r, c % shape.width] = y.place(r), x.place(c)
        for block, level in adopted.items():
            self.level[block], self.rank[block] = level, rank
        return adopted, cells


def bilinear(corner: dict[Place, int], y: Stencil, x: Stencil) -> int:
    """Nearest integer to the bilinear mean of four samples, halves up, in exact arithmetic."""
    exact = sum(
        corner[row, column] * wy * wx
        for row, wy in ((y[0], 1 - y[2]), (y[1], y[2]))
        for column, wx in ((x[0], 1 - x[2]), (x[1], x[2]))
        if wy * wx
    )
    return math.floor(exact + Fraction(1, 2))
