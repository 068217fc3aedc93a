"""Texture for a look: which spacing and quality reach the PSNR asked for, and the refinement that carries them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from node.coded import Coded, Part, fewest_strips, own_inside, region_lattice, rho_of
from node.library import Scan
from node.polar import PolarTexture, polar_samples
from node.sample import texture_samples
from node.state import ClientState
from node.texture_model import SPACINGS
from protocol.codec import JPEG_QUALITY_MAX, JPEG_QUALITY_MIN, LOSSY_MAX, TextureCodec, decode_texture, encode_textures
from protocol.grid import TEXTURE_BLOCK, BoolArray, ImageArray
from protocol.holdings import ChannelHoldings, texture_rank
from protocol.lattice import Channel, Lattice, Parameters
from protocol.messages import CodecName, TextureParameters
from protocol.polar import texels_at
from protocol.reconstruct import Selection, cut, texture_patch
from protocol.region import Region
from protocol.strips import (
    Strip,
    Strips,
    build_strips,
    image_shape,
    image_shapes,
    join_parts,
    select_strips,
    split_parts,
)

CODECS = {"jpeg": TextureCodec.JPEG, "htj2k": TextureCodec.HTJ2K}
NARROW_ROWS, NARROW_TO = 4, 3 * TEXTURE_BLOCK  # rows from a pole whose texels' width changes within a block
SAMPLED_FROM, SAMPLED_MORE = 1 << 16, 1.003  # texels of a window; a quarter of so many tells its error to 0.15%
SHARE_OF_ERROR = 0.3  # of the squared error allowed, what the spacing may take; the codec has the rest


def choose_spacing(scan: Scan, state: ClientState, region: Region, target_db: float, codec: CodecName) -> float:
    """The widest plateau spacing that leaves the codec enough of the error allowed in the region.

    HTJ2K finds the right scale by itself: at spacing 1 it was best or within a few percent on every scan tried. JPEG,
    whose blocks stay 8 texels wide, gains by fewer texels where the texture is smooth.
    """
    if codec == "htj2k":
        return 1
    allowed = mse_of_db(target_db) * SHARE_OF_ERROR
    for p in SPACINGS[:-1]:
        strips = _whole(state, region, p)
        total, count = 0.0, 0.0
        for selection in (strip.selection for strip in strips):
            patch = texture_patch(selection, texture_samples(scan, selection))
            error, values = Compared(scan, selection, region).error(patch)
            total, count = total + error, count + values
        if strips and total <= allowed * count:
            return p
    return 1


def code_texture(
    scan: Scan,
    state: ClientState,
    region: Region,
    wanted: TextureParameters,
    *,
    quick: bool = False,
    merged: bool = True,
) -> Coded | None:
    """Encode a refinement of the region's blocks, or None when the client holds all of it already.

    quick : where the link is fast, spare time rather than bytes.   merged : as texture_lattice has it.
    Where a block that would become finer is held at a better quality, the whole refinement takes that one (F-09c).
    Raises LatticeError for a spacing that does not fit, CodecError for a quality the codec does not have.
    """
    parameters = texture_lattice(state, region, wanted, merged=merged)
    best, codec = _best_needed(state, parameters, wanted.quality), CODECS[wanted.codec]
    if best > wanted.quality and codec is TextureCodec.JPEG and best > JPEG_QUALITY_MAX:
        codec = TextureCodec.HTJ2K  # JPEG ends below what the client holds
    return code_texture_lattice(scan, state, parameters, best, codec, quick=quick)


def code_texture_lattice(
    scan: Scan, state: ClientState, parameters: Parameters, quality: float, codec: TextureCodec, *, quick: bool = False
) -> Coded | None:
    """The same for a lattice that is given, at this quality: blocks that are held at a better one stay as they are."""
    strips = select_texture_lattice(state, parameters, quality)
    if not strips:
        return None
    return code_texture_strips(strips, texture_images(scan, strips, codec), quality, codec, quick=quick)


def select_texture_lattice(state: ClientState, parameters: Parameters, quality: float) -> Strips:
    """What that would carry, if anything."""
    held = state.holdings.channels[Channel.TEXTURE]
    return select_strips(build_strips(held.shape, parameters), held, texture_rank(int(quality)))


def code_texture_strips(
    strips: Strips, images: Sequence[ImageArray], quality: float, codec: TextureCodec, *, quick: bool
) -> Coded:
    """Encode what was selected, as it travels."""
    payload = join_parts(encode_textures(images, codec, quality, quick=quick))
    return Coded(tuple(Part(strip) for strip in strips), texture_rank(int(quality)), quality, codec, payload)


def texture_images(
    scan: Scan, strips: Strips, codec: TextureCodec, maps: PolarTexture | None = None
) -> list[ImageArray]:
    """The texels of each image as they travel, whatever the quality.   maps : of the scan's texture, if there are."""
    if (polar := strips[0].polar) is not None:
        return [polar_samples(scan.texture, strips, polar) if maps is None else maps.image(strips, polar)]
    return [_image(scan, strip.selection, codec) for strip in strips]


def _image(scan: Scan, selection: Selection, codec: TextureCodec) -> ImageArray:
    texels = texture_samples(scan, selection)
    more = image_shape(selection, codec)[0] - len(texels)
    return np.concatenate([texels, texels[-1:]]) if more else texels


def select_texture(state: ClientState, region: Region, wanted: TextureParameters) -> tuple[Strips, int]:
    """What code_texture would carry, if anything, and how good."""
    held, parameters = state.holdings.channels[Channel.TEXTURE], texture_lattice(state, region, wanted)
    best = _best_needed(state, parameters, wanted.quality)
    return select_strips(build_strips(held.shape, parameters), held, texture_rank(best)), best


def _best_needed(state: ClientState, parameters: Parameters, quality: int) -> int:
    """The quality at which every block that a lattice would make finer is adopted, this one at least."""
    held = state.holdings.channels[Channel.TEXTURE]
    return max([quality, *(_best_held(held, lattice) for lattice in build_strips(held.shape, parameters))])


def texture_lattice(
    state: ClientState, region: Region, wanted: TextureParameters, *, merged: bool = True
) -> Parameters:
    """The lattice of a region's blocks; merged : of a sphere in as few strips as saves bytes, else as saves time."""
    strides = fewest_strips(state.shapes[Channel.TEXTURE], region, quick=not merged)
    return region_lattice(region, Channel.TEXTURE, round(2 * wanted.p), rho_of(wanted.s), strides)


def settle_texture(scan: Scan, state: ClientState, coded: Coded) -> None:
    """Record in a client's state the error that a texture refinement leaves in its blocks, where that was measured."""
    for part in coded.parts:
        rows, columns = np.nonzero(part.selection.adopted)
        blocks = part.selection.y.block[rows], part.selection.x.block[columns]
        state.missed[blocks] = np.nan if part.image is None else _block_errors(scan, part)[rows, columns]


def _block_errors(scan: Scan, part: Part) -> NDArray[np.float32]:
    """Squared error per value in each block of a measured strip's rectangle."""
    selection = part.selection
    missed = cv2.absdiff(part.texture, np.asarray(cut(scan.texture, selection)))[:, : int(selection.x.size.sum())]
    squared = cv2.multiply(missed, missed, dtype=cv2.CV_32F).reshape(len(missed), -1)
    ends_y, ends_x = (np.cumsum(window.size) for window in (selection.y, selection.x))
    bands = (squared[end - high : end] for high, end in zip(selection.y.size.tolist(), ends_y.tolist(), strict=True))
    rows = np.concatenate([cv2.reduce(band, 0, cv2.REDUCE_SUM) for band in bands])
    total = np.add.reduceat(rows, 3 * (ends_x - selection.x.size), axis=1)
    return np.asarray(total / (3 * np.multiply.outer(selection.y.size, selection.x.size)), np.float32)


def measured(coded: Coded) -> Coded:
    """A refinement with the images that a client decodes."""
    if coded.parts[0].image is not None:
        return coded
    codec, quality = TextureCodec(coded.codec), int(coded.quality)
    shapes = image_shapes(coded.strips, codec)
    payloads = zip(split_parts(coded.payload, len(shapes)), shapes, strict=True)
    images = [decode_texture(data, codec, quality, shape) for data, shape in payloads]
    parts = zip(coded.parts, images * len(coded.parts) if coded.parameters.polar else images, strict=True)
    return replace(coded, parts=tuple(replace(part, image=image) for part, image in parts))


class Compared:
    """What a strip's patches are held against: the texture at its adopted own texels in a region."""

    def __init__(self, scan: Scan, selection: Selection, region: Region) -> None:
        wanted = selection.adopted_cells() & own_inside(region, selection)
        self._own = slice(0, wanted.shape[1])
        truth = np.ascontiguousarray(np.asarray(cut(scan.texture, selection))[:, self._own])
        self._against = _Against(truth, wanted, tuple(_bands(selection)))

    def error(self, patch: ImageArray) -> tuple[float, float]:
        """Squared error of a patch there, and of how many values. On a sphere a value counts for the area it has, 1 on
        the equator."""
        return self._against.error(np.ascontiguousarray(patch[:, self._own]))

    def part_error(self, part: Part) -> tuple[float, float]:
        """The same of a measured strip's patch."""
        return self.error(part.texture)


class ComparedPolar:
    """The same of a strip that travels in an image of a pole.

    Of a window of many texels every second is taken, along and across: taking more texels out of an image is what
    takes most time then, and tells no more. What is left is called SAMPLED_MORE worse for that.
    """

    def __init__(self, scan: Scan, strip: Strip, region: Region) -> None:
        assert strip.polar is not None
        selection, (self._more, every) = strip.selection, (SAMPLED_MORE, 2) if region.area >= SAMPLED_FROM else (1.0, 1)
        inside = own_inside(region, selection, every)
        rows = selection.y.start + every * np.arange(inside.shape[0])
        columns = (selection.x.start + every * np.arange(inside.shape[1])) * selection.lattice.shape.stride
        truth = scan.texture[rows[0] : rows[-1] + 1 : every].take(columns % scan.spec.texture_width, axis=1)
        bands = ((slice(-(-b.start // every), -(-b.stop // every)), every**2 * area) for b, area in _bands(selection))
        self._places = strip.polar.places(rows, columns)
        self._against = _Against(truth, selection.adopted_cells()[::every, ::every] & inside, tuple(bands))

    def part_error(self, part: Part) -> tuple[float, float]:
        """As of Compared."""
        assert part.image is not None  # measured before
        error, values = self._against.error(texels_at(self._places, part.image))
        return self._more * error, values


def compared_with(scan: Scan, strip: Strip, region: Region) -> Compared | ComparedPolar:
    """What a strip is held against."""
    if strip.polar is not None:
        return ComparedPolar(scan, strip, region)
    return Compared(scan, strip.selection, region)


class _Against:
    """Texels that others are held against, where they are wanted. bands : of rows, each with the area of a texel."""

    def __init__(self, truth: ImageArray, wanted: BoolArray, bands: tuple[tuple[slice, float], ...]) -> None:
        self._truth, self._wanted, self._bands = truth, wanted.view(np.uint8), bands
        self._values = sum(area * 3 * cv2.countNonZero(self._wanted[rows]) for rows, area in bands)

    def error(self, patch: ImageArray) -> tuple[float, float]:
        truth, wanted = self._truth, self._wanted
        norms = (area * cv2.norm(patch[rows], truth[rows], cv2.NORM_L2SQR, wanted[rows]) for rows, area in self._bands)
        return sum(norms), self._values


def _bands(selection: Selection) -> Iterator[tuple[slice, float]]:
    """Rows of a patch over which texels are about as wide, and the area of one there, in texels of the equator."""
    shape, first, rows = selection.lattice.shape, selection.y.start, selection.y.low.size
    if not shape.sphere:
        yield slice(0, rows), 1.0
        return
    top = 0
    while top < rows:
        from_pole = min(first + top, shape.height - TEXTURE_BLOCK - first - top)
        bottom = min(top + (NARROW_ROWS if from_pole < NARROW_TO else TEXTURE_BLOCK), rows)
        yield slice(top, bottom), shape.stride * math.sin(math.pi * (first + (top + bottom) / 2) / shape.height)
        top = bottom


def mse_of_db(db: float) -> float:
    """Squared error per value of a PSNR over 8 bits."""
    return float(255.0**2 / 10 ** (db / 10))


def db_of_mse(mse: float) -> float:
    """PSNR over 8 bits of a squared error per value; 100 where there is none."""
    return min(float(10 * np.log10(255.0**2 / mse)), 100.0) if mse > 0 else 100.0


def quality_bounds(codec: str) -> tuple[int, int]:
    """Lowest and highest lossy quality of a codec."""
    return (JPEG_QUALITY_MIN, JPEG_QUALITY_MAX) if codec == "jpeg" else (0, LOSSY_MAX)


def _whole(state: ClientState, region: Region, p: float) -> Strips:
    """What a client that has the first view alone would be sent of a region at a spacing, if it fits at all."""
    shape, parameters = state.shapes[Channel.TEXTURE], texture_lattice(state, region, TextureParameters(p=p))
    if parameters.blocks_wide == shape.blocks[1] and 2 * shape.width % parameters.half_spacing:
        return ()
    return select_strips(build_strips(shape, parameters), ChannelHoldings.coarse(shape), texture_rank(0))


def _best_held(held: ChannelHoldings, lattice: Lattice) -> int:
    """Best quality held in the blocks that the lattice would make finer; 0 where nothing is."""
    where = np.ix_(lattice.y.block, lattice.x.block)
    improves = lattice.listed & (lattice.level < held.level[where])
    return max(int(held.rank[where][improves].max(initial=0)) - 1, 0)
