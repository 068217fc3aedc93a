"""The `classic` profile: the paper's letter. Real sample positions, clipping, and the nearest fovea owns a sample.

A fovea is a few numbers; both ends compute from them where its samples stand, which of them are kept, and which dense
samples they fill. A dense sample belongs to the fovea nearest to it (L1, cyclic in x) among those that delivered
there, the older one where two are equally near. That depends on the list of foveae alone, so no map travels and none is
kept in step: only the list is.

Source: Cheng, Basu, Pan 2003, Eqs. (4)-(14), with REQUIREMENTS F-03, F-04, F-09, F-10.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from protocol.bilinear import Between, between
from protocol.errors import LatticeError, LocalWireError, RemoteWireError
from protocol.fovea import cyclic_positions, fovea_table, open_positions, view_to_radius
from protocol.grid import BoolArray, FloatArray, IntArray
from protocol.lattice import Channel, ChannelShape
from protocol.sphere_fovea import SphereLattice

PARAMETERS = struct.Struct("<HHHffff")
SAMPLES_MAX = 1 << 23
ALPHA_BOUNDS = (1e-3, 100.0)
S_BOUNDS = (1e-3, 1e5)
RANGE_SPACING = (18, 10)  # of the paper's first view, columns and rows
TEXTURE_SPACING = (4, 4)
RANGE_CELLS_MAX = 8192
TEXTURE_CELLS_MAX = 32768
COARSE = 0
_FAR = 1 << 30


@dataclass(frozen=True, slots=True)
class ClassicParameters:
    """What travels of a fovea in one channel.

    fovea : its number in the opening, from 1.    x, y : the dense sample it stands on.
    alpha_x, alpha_y, s_x, s_y : distortion and scale of both axes, exact in float32.
    """

    fovea: int
    x: int
    y: int
    alpha_x: float
    alpha_y: float
    s_x: float
    s_y: float

    @property
    def spacing(self) -> float:
        """Distance of the first samples from the fovea, the wider axis. [dense samples]"""
        first = np.array([1.0])
        x, y = (view_to_radius(first, *axis)[0] for axis in ((self.alpha_x, self.s_x), (self.alpha_y, self.s_y)))
        return float(max(x, y))

    def to_bytes(self) -> bytes:
        """Wire form, 22 bytes. Raises LocalWireError when they do not fit it."""
        try:
            return PARAMETERS.pack(self.fovea, self.x, self.y, self.alpha_x, self.alpha_y, self.s_x, self.s_y)
        except (struct.error, OverflowError) as error:
            raise LocalWireError(f"parameters of a fovea out of bounds: {error}") from None

    @classmethod
    def from_bytes(cls, data: bytes) -> ClassicParameters:
        """Inverse of to_bytes. Raises RemoteWireError when the bytes are not whole."""
        if len(data) != PARAMETERS.size:
            raise RemoteWireError(f"parameters of a fovea take {PARAMETERS.size} bytes, got {len(data)}")
        return cls(*PARAMETERS.unpack(data))


def single(value: float) -> float:
    """The value as it travels, in float32."""
    return float(np.float32(value))


def first_view_shape(width: int, height: int, channel: Channel) -> tuple[int, int]:
    """Rows and columns of a first view: the paper's spacing, doubled while there are more than 8192 (32768) samples.

    360 x 100 range samples give 10 x 20, 1024 x 256 texels 64 x 256 (F-18).
    """
    is_range = channel is Channel.RANGE
    across, down = RANGE_SPACING if is_range else TEXTURE_SPACING
    most = RANGE_CELLS_MAX if is_range else TEXTURE_CELLS_MAX
    while True:
        rows, columns = max(round(height / down), min(height, 2)), max(round(width / across), 1)
        if rows * columns <= most:
            return rows, columns
        across, down = 2 * across, 2 * down


def first_view_positions(shape: ChannelShape) -> tuple[FloatArray, FloatArray]:
    """Where the first view's samples stand: rows from the first to the last one, columns all round. (h,), (w,) float64

    Source: REQUIREMENTS C5.
    """
    rows = np.linspace(0, shape.height - 1, shape.coarse_height)
    columns = np.arange(shape.coarse_width) * (shape.width / shape.coarse_width)
    return rows, columns.astype(np.float64)


def first_view_places(shape: ChannelShape) -> tuple[Between, Between]:
    """Places of all dense rows and columns among the first view's samples; its first column stands behind the last."""
    rows, columns = first_view_positions(shape)
    x = between(np.append(columns, shape.width), np.arange(shape.width))
    return between(rows, np.arange(shape.height)), Between(x.low, x.high % shape.coarse_width, x.part)


def first_view_spacing(shape: ChannelShape) -> tuple[float, float]:
    """R_x and R_y, the first view's sample spacing. [dense samples]"""
    return shape.width / shape.coarse_width, max(shape.height - 1, 1) / max(shape.coarse_height - 1, 1)


def first_view_quads(shape: ChannelShape) -> IntArray:
    """The first view's polygons, an open cylinder: (w (h - 1), 4) flat sample indices, 180 at the paper's size."""
    rows, columns = np.mgrid[: shape.coarse_height - 1, : shape.coarse_width]
    right = (columns + 1) % shape.coarse_width
    corners = ((rows, columns), (rows + 1, columns), (rows + 1, right), (rows, right))
    return np.stack([row * shape.coarse_width + column for row, column in corners], axis=-1).reshape(-1, 4)


@dataclass(frozen=True, slots=True, eq=False)
class ClassicLattice:
    """A fovea's samples, clipped, and the dense samples between them, which it delivers.

    x, y : (nx,), (ny,) float64 ascending positions, x not wrapped.
    columns, rows : (n,) int64 dense columns and rows inside, columns not wrapped.
    """

    shape: ChannelShape
    parameters: ClassicParameters
    x: FloatArray
    y: FloatArray
    columns: IntArray
    rows: IntArray

    @property
    def wrapped_columns(self) -> IntArray:
        """Dense columns inside, as indices. (n,) int64"""
        return self.columns % self.shape.width

    def places(self) -> tuple[Between, Between]:
        """Places of the dense rows and columns inside among the samples."""
        return between(self.y, self.rows), between(self.x, self.columns)

    def distances(self, rows: IntArray, columns: IntArray) -> tuple[IntArray, IntArray]:
        """Distance of dense rows and columns (n,) from the fovea along each axis; far off outside of what it delivers.

        Source: the terms of Eq. (14), cyclic in x.
        """
        away = (columns - self.columns[0]) % self.shape.width
        offset = self.columns[0] + away - self.parameters.x
        across = np.where(away < self.columns.size, np.abs(offset), _FAR)
        inside = (rows >= self.rows[0]) & (rows <= self.rows[-1])
        return np.where(inside, np.abs(rows - self.parameters.y), _FAR), across


@lru_cache(maxsize=64)
def build_classic(shape: ChannelShape, parameters: ClassicParameters) -> ClassicLattice:
    """Compute a fovea's lattice from what travelled. Raises LatticeError when the parameters describe none.

    Source: Eqs. (6), (7), (10)-(12) by their inverse (2), rows outside the grid dropped.
    """
    p = parameters
    _check(shape, p)
    coarse_x, coarse_y = first_view_spacing(shape)
    x = cyclic_positions(fovea_table(p.alpha_x, p.s_x, coarse_x, shape.width / 2), p.x, shape.width)
    y = open_positions(fovea_table(p.alpha_y, p.s_y, coarse_y, max(shape.height - 1.0, 0.5)), p.y, shape.height)
    if x.size * y.size > SAMPLES_MAX:
        raise LatticeError(f"{y.size} x {x.size} samples are more than {SAMPLES_MAX}")
    return ClassicLattice(shape, p, x, y, _whole(x), _whole(y))


def nearest_fovea(foveae: Iterable[ClassicLattice], rows: IntArray, columns: IntArray) -> tuple[IntArray, IntArray]:
    """Which fovea owns each dense sample of rows x columns, 0 = none, and its distance.

    foveae : oldest first.  columns : may be unwrapped.  Returns two (rows, columns) int64.
    Source: Eqs. (13), (14); replaced only if strictly nearer, and only where the fovea delivers.
    """
    owner = np.full((rows.size, columns.size), COARSE, np.int64)
    distance = np.full((rows.size, columns.size), _FAR, np.int64)
    for fovea in foveae:
        down, across = fovea.distances(rows, columns)
        if down.min() < _FAR and across.min() < _FAR:
            new = np.add.outer(down, across)
            nearer = new < distance
            owner[nearer] = fovea.parameters.fovea
            distance[nearer] = new[nearer]
    return owner, distance


def claim(new: ClassicLattice, older: Iterable[ClassicLattice]) -> BoolArray:
    """Which dense samples inside a new fovea's lattice become its own. (rows, columns) bool."""
    held = nearest_fovea(older, new.rows, new.columns)[1]
    down, across = new.distances(new.rows, new.columns)
    claimed: BoolArray = np.add.outer(down, across) < held
    return claimed


def kept_samples(lattice: ClassicLattice, claimed: BoolArray) -> BoolArray:
    """Which of a lattice's samples travel: those that a claimed dense sample hangs on or is next to. (ny, nx) bool.

    Nearer to an older fovea are all others (F-10); beside the border both foveae's samples are needed.
    """
    count = np.zeros((claimed.shape[0] + 1, claimed.shape[1] + 1), np.int64)
    count[1:, 1:] = claimed.cumsum(0).cumsum(1)
    top, bottom = _served(lattice.y, lattice.rows)
    left, right = _served(lattice.x, lattice.columns)
    inside = count[bottom][:, right] - count[top][:, right] - count[bottom][:, left] + count[top][:, left]
    kept: BoolArray = inside > 0
    return kept


def bounds(kept: BoolArray) -> tuple[slice, slice]:
    """The smallest rectangle round the true values of a mask, which has some: rows, columns."""
    rows, columns = np.nonzero(kept)
    return slice(int(rows.min()), int(rows.max()) + 1), slice(int(columns.min()), int(columns.max()) + 1)


@dataclass(frozen=True, slots=True)
class Held:
    """One refinement taken in: its lattice, and the checksums of everything up to it."""

    lattice: ClassicLattice | SphereLattice
    crc: int
    content: int


@dataclass(frozen=True, slots=True)
class Foveae:
    """What both ends agree a client has beyond the first view: the refinements it took in, in their order."""

    held: tuple[Held, ...] = ()

    def of(self, channel: Channel) -> list[ClassicLattice]:
        """Lattices of one channel, oldest first."""
        return [one for one in self._all_of(channel) if isinstance(one, ClassicLattice)]

    def on_sphere(self, channel: Channel) -> list[SphereLattice]:
        """The same of a sphere."""
        return [one for one in self._all_of(channel) if isinstance(one, SphereLattice)]

    def _all_of(self, channel: Channel) -> list[ClassicLattice | SphereLattice]:
        return [one.lattice for one in self.held if one.lattice.shape.channel is channel]

    def adopt(self, lattice: ClassicLattice | SphereLattice, claimed: BoolArray, steps: bytes = b"") -> Foveae:
        """With one more refinement; steps: of range, its values as they travel raw."""
        last = self.held[-1] if self.held else Held(lattice, 0, 0)
        crc = zlib.crc32(lattice.parameters.to_bytes(), zlib.crc32(bytes([lattice.shape.channel]), last.crc))
        crc = zlib.crc32(np.packbits(claimed).tobytes(), crc)
        return Foveae((*self.held, Held(lattice, crc, zlib.crc32(steps, last.content))))

    def first(self, count: int) -> Foveae:
        """What was held after the first `count` refinements. Raises LatticeError when there are fewer."""
        if not 0 <= count <= len(self.held):
            raise LatticeError(f"{count} refinements of {len(self.held)}")
        return Foveae(self.held[:count])

    def digest(self) -> str:
        """16 hex digits: CRC-32 of what was claimed by whom, then of the range received."""
        return f"{self.held[-1].crc:08x}{self.held[-1].content:08x}" if self.held else "0" * 16


def _check(shape: ChannelShape, p: ClassicParameters) -> None:
    if not (1 <= p.fovea and 0 <= p.x < shape.width and 0 <= p.y < shape.height):
        raise LatticeError(f"fovea {p.fovea} at column {p.x}, row {p.y} is not on a grid of {shape.width} columns")
    for name, values, (low, high) in (("alpha", (p.alpha_x, p.alpha_y), ALPHA_BOUNDS), ("s", (p.s_x, p.s_y), S_BOUNDS)):
        if not all(low <= value <= high for value in values):
            raise LatticeError(f"{name} must be between {low} and {high}, got {values}")


def _whole(at: FloatArray) -> IntArray:
    """Whole positions from the first to the last sample."""
    return np.arange(int(np.ceil(at[0])), int(np.floor(at[-1])) + 1)


def _served(at: FloatArray, cells: IntArray) -> tuple[IntArray, IntArray]:
    """For each sample the run of dense positions that hang on it or are nearest to it: first and past-last index."""
    before, after = np.append(-np.inf, at[:-1]), np.append(at[1:], np.inf)
    own = np.clip(np.rint(at) - cells[0], 0, cells.size - 1)
    start = np.minimum(np.maximum(np.floor(before) + 1 - cells[0], 0), own)
    stop = np.maximum(np.minimum(np.ceil(after) - cells[0], cells.size), own + 1)
    return start.astype(np.int64), stop.astype(np.int64)
