"""The dense model of a scan: filled by the first view, made finer by refinements, never coarser.

Source: REQUIREMENTS F-09c, F-11.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from client.errors import HoldingsDiffer
from client.export import write_grid
from protocol.codec import RangeCodec, TextureCodec, decode_mask, decode_range, decode_ranges, decode_texture
from protocol.errors import CodecError, LatticeError, RemoteWireError
from protocol.grid import VOID, FloatArray, Grid, ImageArray, IntArray, StepArray, steps_to_mm
from protocol.holdings import ChannelHoldings, Holdings, range_rank, texture_rank
from protocol.lattice import Channel, Parameters
from protocol.messages import ScanInfo, Statement
from protocol.reconstruct import (
    Selection,
    coarse_to_range,
    coarse_to_texture,
    content_hashes,
    paste,
    range_patch,
)
from protocol.refinement import Generator, Refinement
from protocol.sphere import default_mesh, ranges_on, vectors
from protocol.strips import (
    Strip,
    Strips,
    blocks_of,
    build_strips,
    image_shapes,
    samples_of,
    select_strips,
    split_parts,
    texture_patches,
)

Codec = TypeVar("Codec", RangeCodec, TextureCodec)
Array = TypeVar("Array", NDArray[np.float32], StepArray, ImageArray)


@dataclass(frozen=True, slots=True, eq=False)
class Applied:
    """What one refinement did. blocks : (n,) int64 flat indices of the dense blocks it overwrote."""

    blocks: IntArray
    apply_s: float


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles. positions_mm : (V, 3) float64, z up, NaN where nothing was measured.  faces : (F, 3) int64."""

    positions_mm: FloatArray
    faces: IntArray


class Model:
    """Dense state of one scan. Read what it offers at any time; it changes while a look is in the air.

    info : what the node says of the scan.    spec : its geometry.    holdings : what both ends agree we have.
    """

    def __init__(self, info: ScanInfo) -> None:
        self.info = info
        self.spec = info.spec()
        self.shapes = info.shapes()
        self.holdings = Holdings.coarse(self.shapes)
        self._steps: StepArray = np.zeros((info.height, info.width), np.uint16)
        self._texels: ImageArray = np.zeros((info.texture_height, info.texture_width, 3), np.uint8)
        self._viewed: set[Channel] = set()
        self._range_mm: NDArray[np.float32] | None = None
        self._spacing: NDArray[np.float32] | None = None

    @property
    def complete(self) -> bool:
        """The first view of both channels is in."""
        return len(self._viewed) == len(Channel)

    @property
    def range_steps(self) -> StepArray:
        """Range in whole steps, 0 = void. (H, W) uint16, a read-only view that follows later refinements."""
        return _read_only(self._steps.view())

    @property
    def range_mm(self) -> NDArray[np.float32]:
        """Distance from the axis, NaN = void. (H, W) float32 [mm], read-only, as of now."""
        if self._range_mm is None:
            self._range_mm = _read_only(steps_to_mm(self._steps, self.spec.step_mm))
        return self._range_mm

    @property
    def texture(self) -> ImageArray:
        """Colour. (Ht, Wt, 3) uint8 RGB, a read-only view that follows later refinements."""
        return _read_only(self._texels.view())

    @property
    def spacing(self) -> NDArray[np.float32]:
        """Sample spacing held at each range cell, 2^(level / 2). (H, W) float32 [columns], read-only, as of now."""
        if self._spacing is None:
            self._spacing = _read_only(spacing_of_levels(self.holdings.channels[Channel.RANGE]))
        return self._spacing

    @property
    def grid(self) -> Grid:
        """The model as a grid, over the same read-only views."""
        return Grid(self.spec, self.range_steps, self.texture)

    def default_mesh(self, intervals_v: int = 8, intervals_h: int = 12) -> Surface:
        """A spherical model over directions pi/intervals_v apart down and 2 pi/intervals_h round, both poles once.

        Raises LatticeError for a cylinder, and for numbers of which no mesh can be made.
        """
        mesh = default_mesh(intervals_v, intervals_h)
        range_mm = ranges_on(mesh, self._steps, self.spec)
        positions = range_mm[:, None] * vectors(mesh.theta_v, mesh.theta_h)
        return Surface(positions + np.array([0, 0, self.spec.z_max_mm]), mesh.faces)

    def export(self, path: str | Path) -> None:
        """Write the model as it is now; the suffix is the format: .glb, .ply, .obj.zip, .stl or .npz.

        Raises ExchangeError for any other suffix and where nothing is measured, OSError.
        """
        write_grid(self.grid, path)

    def digest(self) -> str:
        """What proves to the node that both ends agree on what we hold."""
        return self.holdings.digest()

    def state(self) -> Statement:
        """Its holdings as they travel. From here on the digest counts anew, as it does at the node (F-09c)."""
        self.holdings.content = 0
        return Statement(*(self.holdings.channels[channel].to_runs() for channel in Channel))

    def apply(self, refinement: Refinement) -> Applied:
        """Take in one refinement. The caller keeps them in order, one at a time.

        Raises HoldingsDiffer when it was planned over other holdings than ours, RemoteWireError when it makes no sense;
        the model is then unchanged.
        """
        started_s = time.perf_counter()
        try:
            coarse = refinement.generator is Generator.COARSE
            if not (coarse or self.complete):
                raise RemoteWireError(f"{name_of(refinement)}: a fovea before the first view")
            blocks = self._apply_first_view(refinement) if coarse else self._apply_fovea(refinement)
        except (CodecError, LatticeError) as error:
            raise RemoteWireError(f"{name_of(refinement)}: {error}") from error
        return Applied(blocks, time.perf_counter() - started_s)

    def _apply_first_view(self, refinement: Refinement) -> IntArray:
        channel = refinement.channel
        if channel in self._viewed:
            raise RemoteWireError(f"{name_of(refinement)}: a second first view")
        shape = self.shapes[channel]
        coarse_shape = shape.coarse_height, shape.coarse_width
        if refinement.samples != shape.coarse_height * shape.coarse_width:
            raise RemoteWireError(f"{name_of(refinement)}: {refinement.samples} samples for {coarse_shape}")
        self._fill(refinement, coarse_shape)
        self._viewed.add(channel)
        return np.arange(shape.blocks[0] * shape.blocks[1])

    def _fill(self, refinement: Refinement, coarse_shape: tuple[int, int]) -> None:
        """The whole of a channel from its first view."""
        shape = self.shapes[refinement.channel]
        _rank(refinement)
        if refinement.channel is Channel.RANGE:
            coarse = _decode_range(refinement, coarse_shape)
            _apply_mask(refinement.mask, coarse)
            self._steps = coarse_to_range(coarse, shape)
            self._range_mm = None
        else:
            self._texels = coarse_to_texture(texture_of(refinement, coarse_shape), shape)

    def _apply_fovea(self, refinement: Refinement) -> IntArray:
        strips = self._select(refinement)
        if refinement.channel is Channel.RANGE:
            for selection, steps in zip(_selections(strips), _range_patches(refinement, strips), strict=True):
                paste(self._steps, steps, selection)
                self.holdings.add_content(selection.adopted_blocks(), content_hashes(steps, selection))
            self._range_mm = self._spacing = None
        else:
            for selection, texels in zip(_selections(strips), _texture_patches(refinement, strips), strict=True):
                paste(self._texels, texels, selection)
        for strip in strips:
            held = self.holdings.channels[refinement.channel]
            held.adopt(strip.selection.lattice, strip.adopted, _rank(refinement))
        return np.sort(blocks_of(strips))

    def _select(self, refinement: Refinement) -> Strips:
        """Which samples arrived and which blocks they may change, from the parameters and holdings the node had too."""
        if not isinstance(refinement.parameters, Parameters):
            raise RemoteWireError(f"{name_of(refinement)}: of another profile than the scan was opened with")
        shape = self.shapes[refinement.channel]
        held, rank = self.holdings.channels[refinement.channel], _rank(refinement)
        planned_over = ChannelHoldings.coarse(shape) if refinement.self_contained else held
        strips = select_strips(build_strips(shape, refinement.parameters), planned_over, rank)
        expected = samples_of(strips)
        if not strips or expected != refinement.samples:
            raise HoldingsDiffer(f"{name_of(refinement)}: {refinement.samples} samples, {expected} expected")
        return tuple(_only_finer(strip, held, rank) for strip in strips) if refinement.self_contained else strips


def spacing_of_levels(held: ChannelHoldings) -> NDArray[np.float32]:
    """Sample spacing of each cell from the level of its block: 2^(level / 2). (height, width) float32 [samples]"""
    spacing = np.exp2(held.level / np.float32(2), dtype=np.float32)
    side, shape = held.shape.block, held.shape
    return np.repeat(np.repeat(spacing, side, axis=0)[: shape.height], side, axis=1)[:, : shape.width]


def _decode_range(refinement: Refinement, shape: tuple[int, int]) -> StepArray:
    """Transmitted range in steps, without voids."""
    return decode_range(refinement.payload, _codec(RangeCodec, refinement.codec), shape, refinement.quality)


def _selections(strips: Strips) -> list[Selection]:
    return [strip.selection for strip in strips]


def _range_patches(refinement: Refinement, strips: Strips) -> list[StepArray]:
    """What goes into each strip, voids included. Raises CodecError."""
    codec, patches = _codec(RangeCodec, refinement.codec), []
    shapes = [selection.sample_shape for selection in _selections(strips)]
    images = decode_ranges(refinement.payload, codec, shapes, refinement.quality)
    for selection, image, mask in zip(
        _selections(strips), images, split_parts(refinement.mask, len(strips)), strict=True
    ):
        steps = range_patch(selection, image)
        _apply_mask(mask, steps)
        patches.append(steps)
    return patches


def _texture_patches(refinement: Refinement, strips: Strips) -> list[ImageArray]:
    """The same of texture."""
    shapes = image_shapes(strips, _codec(TextureCodec, refinement.codec))
    payloads = split_parts(refinement.payload, len(shapes))
    images = [texture_of(refinement, shape, payload) for shape, payload in zip(shapes, payloads, strict=True)]
    return texture_patches(strips, images)


def texture_of(refinement: Refinement, shape: tuple[int, int], payload: bytes | None = None) -> ImageArray:
    """Transmitted texels, shape + (3,). payload : a strip's; None: all. Raises CodecError, RemoteWireError."""
    if refinement.mask:
        raise RemoteWireError(f"{name_of(refinement)}: texture has no voids of its own")
    codec = _codec(TextureCodec, refinement.codec)
    return decode_texture(refinement.payload if payload is None else payload, codec, refinement.quality, shape)


def _apply_mask(mask: bytes, steps: StepArray) -> None:
    if mask:
        steps[decode_mask(mask, (steps.shape[0], steps.shape[1]))] = VOID


def _rank(refinement: Refinement) -> int:
    """How good its values are. Raises LatticeError for a quantum or quality off the scale."""
    rank_of = range_rank if refinement.channel is Channel.RANGE else texture_rank
    return rank_of(refinement.quality)


def name_of(refinement: Refinement) -> str:
    """The refinement, for messages."""
    return f"refinement {refinement.seq} ({refinement.channel.name.lower()})"


def _codec(kind: type[Codec], number: int) -> Codec:
    try:
        return kind(number)
    except ValueError:
        raise CodecError(f"no codec {number}") from None


def _only_finer(strip: Strip, held: ChannelHoldings, rank: int) -> Strip:
    """Of a strip planned over the first view alone, the blocks that make what we hold finer (F-09c)."""
    selection, adopted = strip.selection, strip.adopted
    rows, columns = np.flatnonzero(adopted.any(1)), np.flatnonzero(adopted.any(0))
    finer = adopted & held.adoptable(selection.lattice, rank)
    core = finer[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return replace(strip, selection=replace(selection, adopted=core), adopted=finer)


def _read_only(array: Array) -> Array:
    array.flags.writeable = False
    return array
