"""Texture for a look: which spacing and quality reach the PSNR asked for, and the refinement that carries them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from node.coded import Coded, rho_of
from node.library import Scan
from node.sample import texture_samples
from node.state import ClientState
from node.texture_model import TextureModel
from protocol.codec import JPEG_QUALITY_MAX, JPEG_QUALITY_MIN, LOSSY_MAX, TextureCodec, decode_texture, encode_texture
from protocol.grid import TEXTURE_BLOCK, BoolArray, ImageArray, IntArray
from protocol.holdings import COARSE_RANK, RANK_MARGIN, ChannelHoldings, texture_rank
from protocol.lattice import Channel, ChannelShape, Lattice, Parameters, build_lattice, mask_to_runs
from protocol.messages import CodecName, TextureParameters
from protocol.reconstruct import Selection, cut, select, texture_patch
from protocol.region import Region

CODECS = {"jpeg": TextureCodec.JPEG, "htj2k": TextureCodec.HTJ2K}
SPACINGS = (8, 4, 2, 1)
LISTED_SHARE = 0.1  # of a window held well enough already: from there on a bitmap saves more than it takes
SHARE_OF_ERROR = 0.3  # of the squared error allowed, what the spacing may take; the codec has the rest


def choose_spacing(scan: Scan, state: ClientState, region: Region, target_db: float, codec: CodecName) -> float:
    """The widest plateau spacing that leaves the codec enough of the error allowed in the region.

    HTJ2K finds the right scale by itself: at spacing 1 it was best or within a few percent on every scan tried. JPEG,
    whose blocks stay 8 texels wide, gains by fewer texels where the texture is smooth.
    """
    if codec == "htj2k":
        return 1
    shape = state.shapes[Channel.TEXTURE]
    allowed = mse_of_db(target_db) * SHARE_OF_ERROR
    for p in SPACINGS[:-1]:
        selection = _whole(shape, region, p)
        if selection is None:
            continue
        patch = texture_patch(selection, texture_samples(scan, selection))
        total, count = adopted_error(scan, selection, region, patch)
        if total <= allowed * count:
            return p
    return 1


def code_texture(
    scan: Scan, state: ClientState, region: Region, wanted: TextureParameters, *, quick: bool = False
) -> Coded | None:
    """Encode a refinement of the region's blocks, or None when the client holds all of it already.

    quick : where the link is fast, spare time rather than bytes.
    Where a block that would become finer is held at a better quality, the whole refinement takes that one (F-09c).
    Raises LatticeError for a spacing that does not fit, CodecError for a quality the codec does not have.
    """
    return code_texture_lattice(
        scan, state, texture_lattice(region, wanted), wanted.quality, CODECS[wanted.codec], quick=quick
    )


def code_texture_lattice(
    scan: Scan, state: ClientState, parameters: Parameters, quality: int, codec: TextureCodec, *, quick: bool = False
) -> Coded | None:
    """The same for a lattice that is given."""
    found, best = _select(state, parameters, quality)
    if found is None:
        return None
    if best > quality and codec is TextureCodec.JPEG and best > JPEG_QUALITY_MAX:
        codec = TextureCodec.HTJ2K  # JPEG ends below what the client holds
    payload = encode_texture(texture_samples(scan, found[0]), codec, best, quick=quick)
    return Coded(*found, texture_rank(best), best, codec, payload)


def listed_texture(state: ClientState, region: Region, target_mse: float) -> tuple[int, ...] | None:
    """Runs over a region's blocks that list those not held well enough; None where nearly all are (F-07b)."""
    held = state.holdings.channels[Channel.TEXTURE]
    left, top, wide, high = region.blocks(TEXTURE_BLOCK)
    place = np.ix_(np.arange(top, top + high), np.arange(left, left + wide) % held.shape.blocks[1])
    good = (held.rank[place] > COARSE_RANK) & (state.missed[place] <= target_mse)
    return mask_to_runs(~good) if good.mean() >= LISTED_SHARE else None


def select_texture(
    state: ClientState, region: Region, wanted: TextureParameters
) -> tuple[tuple[Selection, BoolArray] | None, int]:
    """What code_texture would carry (the selection and the adopted blocks of its lattice; None: nothing), how good."""
    return _select(state, texture_lattice(region, wanted), wanted.quality)


def _select(
    state: ClientState, parameters: Parameters, quality: int
) -> tuple[tuple[Selection, BoolArray] | None, int]:
    held = state.holdings.channels[Channel.TEXTURE]
    lattice = build_lattice(held.shape, parameters)
    best = max(quality, _best_held(held, lattice))
    return select(lattice, held, texture_rank(best)), best


def texture_lattice(region: Region, wanted: TextureParameters) -> Parameters:
    """The lattice of a region's blocks."""
    rho = rho_of(wanted.s)
    return Parameters(round(2 * wanted.p), *region.blocks(16), rho, rho)


def note_texture(scan: Scan, state: ClientState, coded: Coded) -> None:
    """Record a texture refinement in a client's state: holdings, and the error left in its blocks where measured."""
    coded.note(state)
    selection = coded.selection
    rows, columns = np.nonzero(selection.adopted)
    blocks = selection.y.block[rows], selection.x.block[columns]
    state.missed[blocks] = np.nan if coded.patch is None else _block_errors(scan, coded)[rows, columns]


def _block_errors(scan: Scan, coded: Coded) -> NDArray[np.float32]:
    """Squared error per value in each block of a measured refinement's rectangle."""
    assert coded.patch is not None
    selection = coded.selection
    missed = cv2.absdiff(coded.patch, np.asarray(cut(scan.texture, selection)))
    squared = cv2.multiply(missed, missed, dtype=cv2.CV_32F).sum(axis=2)
    starts_y, starts_x = (np.cumsum(window.size) - window.size for window in (selection.y, selection.x))
    total = np.add.reduceat(np.add.reduceat(squared, starts_y, axis=0), starts_x, axis=1)
    return np.asarray(total / (3 * np.multiply.outer(selection.y.size, selection.x.size)), np.float32)


def measured(coded: Coded) -> Coded:
    """A refinement with the dense texture that a client makes of it."""
    texels = decode_texture(
        coded.payload, TextureCodec(coded.codec), coded.quality, coded.selection.sample_shape
    )
    return replace(coded, patch=texture_patch(coded.selection, texels))


def adopted_error(scan: Scan, selection: Selection, region: Region, patch: ImageArray) -> tuple[float, int]:
    """Squared error of a dense patch over a region's adopted texels, and of how many values."""
    adopted = selection.adopted_cells().view(np.uint8)
    total, count = 0.0, 0
    for rows, columns, source in selection.spans():
        for inside in _overlaps(region, columns):
            top, bottom = max(rows.start, region.top), min(rows.stop, region.top + region.height)
            if top >= bottom:
                continue
            offset = source.start - columns.start
            place = slice(top - rows.start, bottom - rows.start), slice(inside.start + offset, inside.stop + offset)
            made, mask = np.ascontiguousarray(patch[place]), np.ascontiguousarray(adopted[place])
            total += cv2.norm(made, np.ascontiguousarray(scan.texture[top:bottom, inside]), cv2.NORM_L2SQR, mask)
            count += 3 * cv2.countNonZero(mask)
    return total, count


def held_error(
    state: ClientState, coded: Coded | None, region: Region, model: TextureModel | None, target_mse: float
) -> tuple[float, int]:
    """Squared error in the blocks of a region that a refinement leaves as they are, and of how many values.

    Blocks that were never measured count as the model expects them, or as just good enough without one.
    """
    kept = np.ones(state.shapes[Channel.TEXTURE].blocks, np.bool_)
    if coded is not None:
        kept.ravel()[coded.selection.adopted_blocks()] = False
    left, top, wide, high = region.blocks(TEXTURE_BLOCK)
    columns = np.arange(left, left + wide) % kept.shape[1]
    rows, across = np.nonzero(kept[top : top + high][:, columns])
    rows, across = rows + top, columns[across]
    mse = state.missed[rows, across].astype(np.float64)
    unknown = np.isnan(mse)
    if model is None:
        mse[unknown] = target_mse
    elif unknown.any():
        quality = state.holdings.channels[Channel.TEXTURE].rank[rows, across].astype(np.int64) - 1
        mse[unknown] = model.mse_at(rows[unknown], across[unknown], quality[unknown])
    inside = _values_inside(state.shapes[Channel.TEXTURE], region, rows, across)
    return float(inside @ mse), int(inside.sum())


def quality_to_mend(state: ClientState, coded: Coded | None, region: Region, target_mse: float) -> int:
    """The quality at which the too poor blocks that a refinement leaves as they are would be sent again; 0: none is."""
    held = state.holdings.channels[Channel.TEXTURE]
    kept = np.ones(held.shape.blocks, np.bool_)
    if coded is not None:
        kept.ravel()[coded.selection.adopted_blocks()] = False
    left, top, wide, high = region.blocks(TEXTURE_BLOCK)
    place = np.ix_(np.arange(top, top + high), np.arange(left, left + wide) % kept.shape[1])
    poor = kept[place] & (state.missed[place] > target_mse)
    return int(held.rank[place][poor].max(initial=0)) - 1 + RANK_MARGIN[Channel.TEXTURE] if poor.any() else 0


def _values_inside(shape: ChannelShape, region: Region, rows: IntArray, columns: IntArray) -> IntArray:
    """How many of each block's values lie in a region."""
    top, left = rows * TEXTURE_BLOCK, columns * TEXTURE_BLOCK
    bottom = np.minimum(top + TEXTURE_BLOCK, shape.height)
    height = np.minimum(bottom, region.top + region.height) - np.maximum(top, region.top)
    size = np.minimum(TEXTURE_BLOCK, shape.width - left)
    across = (left[:, None] + np.arange(TEXTURE_BLOCK) - region.left) % region.turn < region.width
    width = (across & (np.arange(TEXTURE_BLOCK) < size[:, None])).sum(axis=1)
    return np.asarray(3 * np.maximum(height, 0) * width, np.int64)


def mse_of_db(db: float) -> float:
    """Squared error per value of a PSNR over 8 bits."""
    return float(255.0**2 / 10 ** (db / 10))


def db_of_mse(mse: float) -> float:
    """PSNR over 8 bits of a squared error per value; 100 where there is none."""
    return min(float(10 * np.log10(255.0**2 / mse)), 100.0) if mse > 0 else 100.0


def quality_bounds(codec: str) -> tuple[int, int]:
    """Lowest and highest lossy quality of a codec."""
    return (JPEG_QUALITY_MIN, JPEG_QUALITY_MAX) if codec == "jpeg" else (0, LOSSY_MAX)


def _overlaps(region: Region, columns: slice) -> Iterator[slice]:
    """The parts of a run of columns (not wrapped) that lie in the region."""
    for turn in (-region.turn, 0, region.turn):
        start, stop = max(columns.start, region.left + turn), min(columns.stop, region.left + region.width + turn)
        if start < stop:
            yield slice(start, stop)


def _whole(shape: ChannelShape, region: Region, p: float) -> Selection | None:
    parameters = texture_lattice(region, TextureParameters(p=p))
    if parameters.blocks_wide == shape.blocks[1] and 2 * shape.width % parameters.half_spacing:
        return None
    fresh = ChannelHoldings.coarse(shape)
    found = select(build_lattice(shape, parameters), fresh, texture_rank(0))
    return found[0] if found else None


def _best_held(held: ChannelHoldings, lattice: Lattice) -> int:
    """Best quality held in the blocks that the lattice would make finer; 0 where nothing is."""
    where = np.ix_(lattice.y.block, lattice.x.block)
    improves = lattice.listed & (lattice.level < held.level[where])
    return max(int(held.rank[where][improves].max(initial=0)) - 1, 0)
