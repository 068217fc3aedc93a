"""The dense model of a scan opened with the `classic` profile: the nearest fovea owns a sample.

Range is interpolated at real positions, so it is kept in fractions of a step. A dense sample takes what the fovea
nearest to it delivered, and keeps it until a nearer one comes.

Source: Cheng, Basu, Pan 2003, section 2, with REQUIREMENTS F-08 to F-12.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from client.errors import HoldingsDiffer
from client.model import Model, name_of, texture_of
from protocol import codec_jpeg, sphere_fovea
from protocol.bilinear import LightArray, blend, blend_colour, steps_with_holes, whole_steps
from protocol.classic import (
    COARSE,
    ClassicLattice,
    ClassicParameters,
    Foveae,
    bounds,
    build_classic,
    claim,
    first_view_places,
    first_view_quads,
    first_view_spacing,
    kept_samples,
)
from protocol.codec import RangeCodec, TextureCodec
from protocol.errors import CodecError, RemoteWireError
from protocol.fovea import spacing_at
from protocol.grid import BoolArray, FloatArray, ImageArray, IntArray, StepArray
from protocol.lattice import Channel
from protocol.messages import ScanInfo, Statement
from protocol.refinement import Refinement
from protocol.sphere import DirectionGrid, folded
from protocol.sphere_fovea import SphereParameters, build_sphere_lattice


class ClassicModel(Model):
    """Dense state of one scan, classic profile. `holdings` stays as it begins: here a fovea owns samples, not blocks.

    foveae : what both ends agree we took in.
    coarse_range_mm : (h, w) float32 the first view's range, NaN = void.   coarse_texture : (ht, wt, 3) uint8.
    """

    def __init__(self, info: ScanInfo) -> None:
        super().__init__(info)
        self.foveae = Foveae()
        self.coarse_range_mm: LightArray = np.zeros((0, 0), np.float32)
        self.coarse_texture: ImageArray = np.zeros((0, 0, 3), np.uint8)
        self._fine_mm: LightArray = np.full((info.height, info.width), np.nan, np.float32)
        self._owner = np.full((info.height, info.width), COARSE, np.int32)
        coarsest = max(first_view_spacing(self.shapes[Channel.RANGE]))
        self._spacings: LightArray = np.full((info.height, info.width), coarsest, np.float32)

    @property
    def owner(self) -> NDArray[np.int32]:
        """Which fovea each range cell's value is of: its number in this opening, from 1; 0 = first view. (H, W) copy.

        Every look counts, also one that brought nothing. Source: Eq. (13).
        """
        return self._owner.copy()

    @property
    def range_mm(self) -> LightArray:
        """Distance from the axis, NaN = void, between whole steps too. (H, W) float32 [mm], read-only, as of now."""
        if self._range_mm is None:
            self._range_mm = self._fine_mm.copy()
            self._range_mm.flags.writeable = False
        return self._range_mm

    @property
    def spacing(self) -> LightArray:
        """Local sample spacing held at each range cell, the wider axis. (H, W) float32 [columns], copy."""
        return self._spacings.copy()

    @property
    def coarse_quads(self) -> IntArray:
        """The first view's polygons: (w (h - 1), 4) flat indices into coarse_range_mm."""
        return first_view_quads(self.shapes[Channel.RANGE])

    def positions(self, channel: Channel, parameters: ClassicParameters) -> tuple[FloatArray, FloatArray]:
        """Where a fovea's samples stand: rows (ny,) and columns (nx,), ascending, columns not wrapped. float64"""
        lattice = build_classic(self.shapes[channel], parameters)
        return lattice.y.copy(), lattice.x.copy()

    def digest(self) -> str:
        """What proves to the node that both ends agree on what we hold."""
        return self.foveae.digest()

    def state(self) -> Statement:
        """Empty: what we hold are the refinements before the one we wait for, which the node knows."""
        return Statement([], [])

    def _fill(self, refinement: Refinement, coarse_shape: tuple[int, int]) -> None:
        y, x = first_view_places(self.shapes[refinement.channel])
        if refinement.channel is Channel.RANGE:
            coarse = steps_with_holes(_raw_steps(refinement).reshape(coarse_shape))
            self.coarse_range_mm = self._to_mm(coarse)
            steps = blend(coarse, y, x)
            self._steps, self._fine_mm, self._range_mm = whole_steps(steps), self._to_mm(steps), None
        else:
            self.coarse_texture = texture_of(refinement, coarse_shape)
            self._texels = blend_colour(self.coarse_texture, y, x)

    def directions(self, channel: Channel, parameters: SphereParameters) -> tuple[FloatArray, FloatArray]:
        """The dense directions a spherical fovea samples: theta_v, theta_h (n,), in the order of its values. [rad]"""
        shape = self.shapes[channel]
        grid = DirectionGrid(shape.width, shape.height, self.spec.theta0_rad)
        row, column = np.divmod(build_sphere_lattice(shape, parameters).sample, shape.width)
        return folded(grid.theta_v(row), grid.theta_h(column))

    def _apply_sphere(self, refinement: Refinement, parameters: SphereParameters) -> IntArray:
        lattice = build_sphere_lattice(self.shapes[refinement.channel], parameters)
        claimed = sphere_fovea.claim(lattice, self.foveae.on_sphere(refinement.channel))
        kept = sphere_fovea.kept_samples(lattice, claimed)
        cells, expected = lattice.cells[claimed], np.count_nonzero(kept)
        if not expected or expected != refinement.samples:
            raise HoldingsDiffer(f"{name_of(refinement)}: {refinement.samples} samples, {expected} expected")
        if refinement.channel is Channel.RANGE:
            values = np.full(lattice.sample.size, np.nan)
            values[kept] = steps_with_holes(_raw_steps(refinement))
            steps = lattice.blend(values)[claimed]
            self._steps.reshape(-1)[cells] = whole_steps(steps)
            self._fine_mm.reshape(-1)[cells] = self._to_mm(steps)
            self._spacings.reshape(-1)[cells] = lattice.spacing[claimed] * lattice.shape.height / np.pi
            self._owner.reshape(-1)[cells] = parameters.fovea
            self._range_mm = None
        else:
            rows, columns = bounds(kept[lattice.node])
            shape = rows.stop - rows.start, columns.stop - columns.start
            texels = np.zeros((lattice.sample.size, 3))
            texels[lattice.node[rows, columns]] = _jpeg_of(refinement, shape)
            self._texels.reshape(-1, 3)[cells] = np.rint(lattice.blend(texels)[claimed]).astype(np.uint8)
        steps_sent = refinement.payload if refinement.channel is Channel.RANGE else b""
        self.foveae = self.foveae.adopt(lattice, claimed, steps_sent)
        row, column = np.divmod(cells, lattice.shape.width)
        side = lattice.shape.block
        return np.unique(row // side * lattice.shape.blocks[1] + column // side)

    def _apply_fovea(self, refinement: Refinement) -> IntArray:
        if isinstance(refinement.parameters, SphereParameters):
            return self._apply_sphere(refinement, refinement.parameters)
        if not isinstance(refinement.parameters, ClassicParameters) or self.spec.geometry == "sphere":
            raise RemoteWireError(f"{name_of(refinement)}: of another profile than the scan was opened with")
        lattice = build_classic(self.shapes[refinement.channel], refinement.parameters)
        claimed = claim(lattice, self.foveae.of(refinement.channel))
        kept = kept_samples(lattice, claimed)
        expected = np.count_nonzero(kept)
        if not expected or expected != refinement.samples:
            raise HoldingsDiffer(f"{name_of(refinement)}: {refinement.samples} samples, {expected} expected")
        if refinement.channel is Channel.RANGE:
            self._take_range(lattice, claimed, kept, _raw_steps(refinement))
        else:
            self._take_texture(lattice, claimed, kept, refinement)
        steps = refinement.payload if refinement.channel is Channel.RANGE else b""
        self.foveae = self.foveae.adopt(lattice, claimed, steps)
        return _blocks(lattice, claimed)

    def _take_range(self, lattice: ClassicLattice, claimed: BoolArray, kept: BoolArray, values: StepArray) -> None:
        samples = np.full(kept.shape, np.nan)
        samples[kept] = steps_with_holes(values)
        steps = blend(samples, *lattice.places())
        p = lattice.parameters
        spacing_y = spacing_at(np.abs(lattice.rows - float(p.y)), p.alpha_y, p.s_y)
        spacing_x = spacing_at(np.abs(lattice.columns - float(p.x)), p.alpha_x, p.s_x)
        _paste(self._steps, lattice, claimed, whole_steps(steps))
        _paste(self._fine_mm, lattice, claimed, self._to_mm(steps))
        _paste(self._spacings, lattice, claimed, np.maximum.outer(spacing_y, spacing_x))
        _paste(self._owner, lattice, claimed, np.full(claimed.shape, p.fovea))
        self._range_mm = None

    def _take_texture(
        self, lattice: ClassicLattice, claimed: BoolArray, kept: BoolArray, refinement: Refinement
    ) -> None:
        rows, columns = bounds(kept)
        shape = rows.stop - rows.start, columns.stop - columns.start
        texels = np.zeros((*kept.shape, 3), np.uint8)
        texels[rows, columns] = _jpeg_of(refinement, shape)
        _paste(self._texels, lattice, claimed, blend_colour(texels, *lattice.places()))

    def _to_mm(self, steps: FloatArray) -> LightArray:
        return (steps * self.spec.step_mm).astype(np.float32)


def _raw_steps(refinement: Refinement) -> StepArray:
    """Values of a raw range payload, 0 = void. (samples,) uint16"""
    if refinement.mask or refinement.codec != RangeCodec.RAW or refinement.quality != 1:
        raise CodecError(f"classic range travels raw, exact and without a mask, not by codec {refinement.codec}")
    if len(refinement.payload) != 2 * refinement.samples:
        raise CodecError(f"{refinement.samples} range values in {len(refinement.payload)} bytes")
    return np.frombuffer(refinement.payload, "<u2").astype(np.uint16)


def _jpeg_of(refinement: Refinement, shape: tuple[int, int]) -> ImageArray:
    """The image of a texture payload. shape + (3,) uint8"""
    if refinement.mask or refinement.codec != TextureCodec.JPEG or not 1 <= refinement.quality <= 100:
        raise CodecError(f"classic texture is a JPEG of Q 1..100, not codec {refinement.codec}")
    return codec_jpeg.decode(refinement.payload, shape, refinement.quality)


def _paste(dense: NDArray[np.generic], lattice: ClassicLattice, claimed: BoolArray, patch: NDArray[np.generic]) -> None:
    """Overwrite the claimed cells; every other one stays as it is."""
    rows, columns = np.nonzero(claimed)
    dense[lattice.rows[rows], lattice.wrapped_columns[columns]] = patch[rows, columns]


def _blocks(lattice: ClassicLattice, claimed: BoolArray) -> IntArray:
    """Flat indices of the dense blocks that hold a claimed cell. (n,) int64, ascending."""
    rows, columns = np.nonzero(claimed)
    shape = lattice.shape
    return np.unique(
        lattice.rows[rows] // shape.block * shape.blocks[1] + lattice.wrapped_columns[columns] // shape.block
    )
