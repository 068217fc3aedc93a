"""The node's side of the `classic` profile: its first view, what a client holds, and one fovea's samples, encoded.

Source: Cheng, Basu, Pan 2003, sections 2 and 3, with REQUIREMENTS F-08, F-12, F-13.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np

from node.coded import FRAME_BYTES
from node.first_view import scan_info
from node.library import Scan
from protocol import codec_jpeg
from protocol.bilinear import among_samples, blend, blend_colour, steps_with_holes, whole_steps, wrapped
from protocol.classic import (
    ClassicLattice,
    ClassicParameters,
    Foveae,
    bounds,
    build_classic,
    claim,
    first_view_positions,
    first_view_shape,
    kept_samples,
)
from protocol.codec import JPEG_QUALITY_MAX, LOSSLESS, RangeCodec, TextureCodec, encode_texture
from protocol.grid import BoolArray, FloatArray, ImageArray, IntArray, StepArray
from protocol.lattice import Channel, ChannelShape, channel_shapes
from protocol.messages import CodecName, ScanInfo
from protocol.refinement import CRC, HEADER, Generator, Refinement
from protocol.sphere_fovea import SphereLattice

FIRST_VIEW_REFINEMENTS = 2
OVERHEAD_BYTES = FRAME_BYTES + HEADER.size + CRC.size


@dataclass(frozen=True, slots=True, eq=False)
class ClassicState:
    """One client's model, as the node believes it to be. A value: planning makes a new one.

    looks : how many foveae were planned in this opening, also those that sent nothing.
    """

    shapes: dict[Channel, ChannelShape]
    holdings: Foveae = Foveae()
    looks: int = 0

    def at(self, next_seq: int) -> ClassicState:
        """The state of a client that waits for next_seq. Raises LatticeError where it cannot be there."""
        return replace(self, holdings=self.holdings.first(next_seq - FIRST_VIEW_REFINEMENTS))


@dataclass(frozen=True, slots=True, eq=False)
class ClassicView:
    """What every client of a classic scan receives first, range then texture, as refinements of epoch 0."""

    info: ScanInfo
    range: Refinement
    texture: Refinement
    state: ClassicState

    def refinements(self, epoch: int) -> tuple[bytes, bytes]:
        """Both refinements on the wire, for one opening."""
        return replace(self.range, epoch=epoch).to_bytes(), replace(self.texture, epoch=epoch).to_bytes()


@dataclass(frozen=True, slots=True, eq=False)
class ClassicCoded:
    """One fovea's samples in one channel, encoded.  quality : the JPEG's Q, or 1 for range."""

    lattice: ClassicLattice | SphereLattice
    claimed: BoolArray
    samples: int
    codec: int
    quality: int
    payload: bytes

    @property
    def wire_bytes(self) -> int:
        """What it takes on the wire, carrier included."""
        return OVERHEAD_BYTES + len(self.lattice.parameters.to_bytes()) + len(self.payload)

    def refinement(self, epoch: int, seq: int, look: int) -> Refinement:
        """The wire record."""
        channel = self.lattice.shape.channel
        generator = Generator.SPHERE if isinstance(self.lattice, SphereLattice) else Generator.CLASSIC
        return Refinement(
            generator, channel, epoch, seq, look, self.codec, self.quality, self.samples, self.payload,
            parameters=self.lattice.parameters,
        )  # fmt: skip

    def held_by(self, foveae: Foveae) -> Foveae:
        """What a client holds once it has this too."""
        is_range = self.lattice.shape.channel is Channel.RANGE
        return foveae.adopt(self.lattice, self.claimed, self.payload if is_range else b"")


def build_classic_view(scan: Scan, codec: CodecName) -> ClassicView:
    """The first view as the paper has it: point samples of the dense grids, exact where the codec allows."""
    s = scan.spec
    shapes = channel_shapes(
        s,
        first_view_shape(s.width, s.height, Channel.RANGE),
        first_view_shape(s.texture_width, s.texture_height, Channel.TEXTURE),
    )
    cells, texels = shapes[Channel.RANGE], shapes[Channel.TEXTURE]
    steps = point_range(scan, *first_view_positions(cells))
    image = point_texture(scan, *first_view_positions(texels))
    kind, quality = (TextureCodec.JPEG, JPEG_QUALITY_MAX) if codec == "jpeg" else (TextureCodec.HTJ2K, LOSSLESS)
    colour = encode_texture(image, kind, quality)
    return ClassicView(
        msgspec.structs.replace(
            scan_info(scan),
            profile="classic",
            coarse_width=cells.coarse_width,
            coarse_height=cells.coarse_height,
            coarse_texture_width=texels.coarse_width,
            coarse_texture_height=texels.coarse_height,
        ),
        Refinement(Generator.COARSE, Channel.RANGE, 0, 0, 0, RangeCodec.RAW, 1, steps.size, _raw(steps)),
        Refinement(Generator.COARSE, Channel.TEXTURE, 0, 1, 0, kind, quality, image.size // 3, colour),
        ClassicState(shapes),
    )


def code_classic_range(
    scan: Scan, foveae: Foveae, shape: ChannelShape, wanted: ClassicParameters
) -> ClassicCoded | None:
    """The kept Z values of a fovea, in row order, raw: n times two bytes. None when it owns nothing.

    Raises LatticeError for parameters that describe no lattice.
    """
    lattice = build_classic(shape, wanted)
    claimed = claim(lattice, foveae.of(Channel.RANGE))
    kept = kept_samples(lattice, claimed)
    values = point_range(scan, lattice.y, lattice.x)[kept]
    if not values.size:
        return None
    return ClassicCoded(lattice, claimed, values.size, RangeCodec.RAW, 1, _raw(values))


def code_classic_texture(
    scan: Scan, foveae: Foveae, shape: ChannelShape, wanted: ClassicParameters, jpeg_q: int
) -> ClassicCoded | None:
    """The foveated texture, remapped and clipped, as JPEG; discarded texels repeat the edge. None: it owns nothing."""
    lattice = build_classic(shape, wanted)
    claimed = claim(lattice, foveae.of(Channel.TEXTURE))
    kept = kept_samples(lattice, claimed)
    if not kept.any():
        return None
    rows, columns = bounds(kept)
    inside = kept[rows, columns]
    patch = replicate_edges(point_texture(scan, lattice.y[rows], lattice.x[columns]), inside)
    payload = codec_jpeg.encode(patch, jpeg_q)
    return ClassicCoded(lattice, claimed, int(np.count_nonzero(kept)), TextureCodec.JPEG, jpeg_q, payload)


def point_range(scan: Scan, y: FloatArray, x: FloatArray) -> StepArray:
    """Range at real positions, y by x, to the nearest step. (ny, nx) uint16, void as F-08 says."""
    rows, columns = among_samples(y), wrapped(among_samples(x), scan.spec.width)
    top, bottom = int(rows.low.min()), int(rows.high.max()) + 1
    near = steps_with_holes(scan.range_steps[top:bottom])
    return whole_steps(blend(near, rows.moved(-top), columns))


def point_texture(scan: Scan, y: FloatArray, x: FloatArray) -> ImageArray:
    """Colour at real positions, y by x. (ny, nx, 3) uint8."""
    return blend_colour(scan.texture, among_samples(y), wrapped(among_samples(x), scan.spec.texture_width))


def replicate_edges(patch: ImageArray, kept: BoolArray) -> ImageArray:
    """A patch whose discarded texels repeat the nearest kept one of their row, in rows without any a whole row.

    patch : (h, w, 3).  kept : (h, w), true somewhere in the first and in the last row.
    """
    filled = np.take_along_axis(patch, _last_true(kept, 1)[..., None], axis=1)
    return np.ascontiguousarray(filled[_last_true(np.any(kept, axis=1), 0)])


def _last_true(mask: BoolArray, axis: int) -> IntArray:
    """For each place the last true one at or before it, else the first true one (of the same row)."""
    index = np.where(mask, np.arange(mask.shape[axis]), -1)
    last = np.maximum.accumulate(index, axis=axis)
    return np.where(last < 0, np.expand_dims(np.argmax(mask, axis=axis), axis), last)


def _raw(steps: StepArray) -> bytes:
    return steps.astype("<u2").tobytes()
