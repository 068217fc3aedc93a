"""What a scan's texture costs and how good it gets, place by place, at every quality: measured once for each scan.

The whole texture is coded at a few qualities by each codec, tile by tile, when a scan is opened. From then on the first
guess at a quality is nearly always the right one, so that an update is encoded once. A tile's bytes are spread over its
cells by how much detail each keeps; what any image takes however little is in it, so that a patch has it once and not
for each of its tiles, is found by coding some tiles again, four in one. What is still missed is learned from every
update that is sent. Of a sphere the rows' own texels are coded, zone by zone of one stride (protocol.rings).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from node.polar import SPACINGS as POLAR_SPACINGS
from node.polar import PolarTexture
from protocol.codec import (
    JPEG_QUALITY_MAX,
    JPEG_QUALITY_MIN,
    LOSSLESS,
    TextureCodec,
    decode_texture,
    encode_texture,
)
from protocol.grid import BoolArray, FloatArray, ImageArray, IntArray
from protocol.lattice import STRIDES
from protocol.polar import texels_at
from protocol.region import Region
from protocol.rings import limited_strides, ring_strides

QUALITIES = {
    TextureCodec.HTJ2K: (6, 20, 34, 48, 62),
    TextureCodec.JPEG: (JPEG_QUALITY_MIN, 22, 32, 43, JPEG_QUALITY_MAX),
}
POLAR_QUALITIES = {  # what is interpolated between two is off by 0.4 dB; maps are coded so quickly that there are more
    TextureCodec.HTJ2K: (6, 20, 34, 37, 40, 44, 48, 62),
    TextureCodec.JPEG: QUALITIES[TextureCodec.JPEG],
}
SPACINGS = (8, 4, 2, 1)
CELL = 16
TILE_SIDES = 64, 256  # texels: a window that people look at has some of them
TILES_A_TURN = 16
JOINED_EVERY = 5  # of the tiles two by two, one in so many is coded as one
MSE_MIN = 1e-3
MSE_LEAST = 1e-12  # that is worth telling from none; below what any quality is known to leave, yet aimed at
FIRST_QUALITY = 38
LOG_MSE_SLOPE = 0.08  # of a step of quality, on typical skin
LOG_BYTES_SLOPE = 0.07
BIAS_WEIGHT = 0.3
WEIGHT_MIN = 0.1  # of a cell that keeps no detail, in doublings of error
COMPARED_EVERY = 4  # of a map's texels, along and across
DISC_SHARE = 0.9  # of a map's bytes: pi / 4, where the texture's blocks lie, and the edges that windows have
STRETCHED = 4  # steps of quality by which the quantiser acts finer on texels twice as dense along one axis


@dataclass(frozen=True, slots=True)
class Expected:
    """What a region's texture is expected to take and to reach, at some qualities. (one value each)"""

    qualities: tuple[int, ...]
    log_mse: FloatArray
    log_bytes: FloatArray

    def mse(self, quality: float) -> float:
        """Squared error per value at a quality."""
        return float(np.exp(self._at(quality, self.log_mse)))

    def size_bytes(self, quality: float) -> float:
        """Payload at a quality."""
        return float(np.exp(self._at(quality, self.log_bytes)))

    def beside(self, share: float, other_mse: float) -> Expected:
        """The same where only a share of the values is sent and the others keep an error of their own."""
        return Expected(self.qualities, np.log(share * np.exp(self.log_mse) + (1 - share) * other_mse), self.log_bytes)

    @classmethod
    def generic(cls, target_mse: float, size_bytes: float) -> Expected:
        """Where nothing is known of a scan: the target at FIRST_QUALITY for size_bytes, usual slopes round it."""
        qualities = QUALITIES[TextureCodec.HTJ2K]
        steps = np.array(qualities, np.float64) - FIRST_QUALITY
        return cls(qualities, np.log(target_mse) - LOG_MSE_SLOPE * steps, np.log(size_bytes) + LOG_BYTES_SLOPE * steps)

    def quality_for_mse(self, mse: float) -> float:
        """The lowest quality that should leave no more than this error."""
        falling = np.minimum.accumulate(self.log_mse)
        wanted = np.log(max(mse, MSE_LEAST))
        slope = self._last_slope(falling)
        beyond = min((wanted - falling[-1]) / slope, LOSSLESS) if slope < 0 and wanted < falling[-1] else 0
        return float(np.interp(-wanted, -falling, self.qualities) + beyond)

    def quality_for_bytes(self, size_bytes: float) -> float:
        """The highest quality that should take no more than this; -1 where none does."""
        rising = np.maximum.accumulate(self.log_bytes)
        wanted = np.log(max(size_bytes, 1.0))
        slope, first = self._last_slope(rising), self._first_slope(rising)
        beyond = max(wanted - rising[-1], 0) / slope if slope > 0 else 0
        below = max(rising[0] - wanted, 0) / first if first > 0 else LOSSLESS * float(wanted < rising[0])
        return max(float(np.interp(wanted, rising, self.qualities) + beyond - below), -1.0)

    def _at(self, quality: float, values: FloatArray) -> FloatArray:
        return _continued(quality, self.qualities, values)

    def _last_slope(self, values: FloatArray) -> float:
        return float((values[-1] - values[-2]) / (self.qualities[-1] - self.qualities[-2]))

    def _first_slope(self, values: FloatArray) -> float:
        return float((values[1] - values[0]) / (self.qualities[1] - self.qualities[0]))


def _continued(quality: float | FloatArray, qualities: tuple[int, ...], values: FloatArray) -> FloatArray:
    """Values at qualities, interpolated linearly, the first and the last slope kept beyond. Of the shape of quality."""
    first = (values[1] - values[0]) / (qualities[1] - qualities[0])
    last = (values[-1] - values[-2]) / (qualities[-1] - qualities[-2])
    beyond, below = np.maximum(quality - qualities[-1], 0) * last, np.minimum(quality - qualities[0], 0) * first
    return np.asarray(np.interp(quality, qualities, values) + beyond + below)


class _Measured:
    """What one codec makes of a texture at one spacing. (one value per quality and cell, or per quality)

    mse : squared error per value.  content : bytes, but for what every image takes.  constant : that.
    """

    def __init__(
        self, codec: TextureCodec, p: int, cells: tuple[int, int], qualities: tuple[int, ...] | None = None
    ) -> None:
        self.codec, self.p, self.qualities = codec, p, qualities or QUALITIES[codec]
        self.mse = np.empty((len(self.qualities), *cells), np.float32)
        self.content = np.empty((len(self.qualities), *cells), np.float32)
        self.constant = np.zeros(len(self.qualities))
        self.bias = 1.0  # of bytes, and of errors
        self.worse = 1.0


class Place:
    """A region of a texture, of which some blocks may be sent."""

    def __init__(
        self,
        measured: _Measured,
        content: NDArray[np.float32],
        mse: NDArray[np.float32],
        stride: IntArray,
        sent: IntArray | None,
    ) -> None:
        self._measured, self._content, self._mse, self._area = measured, content, mse, 1.0 / stride
        self._denser = np.zeros(stride.size) if sent is None else STRETCHED * np.log2(stride / sent)
        self._images = 1 if sent is None else 1 + np.count_nonzero(np.diff(sent))

    def expect(self, among: BoolArray) -> Expected:
        """What some blocks, (rows, columns) of Region.blocks, will take and reach."""
        content, mse = self._sums(among)
        area = float(self._area @ among.sum(axis=1))
        log_mse = np.log(np.maximum(self._measured.worse * mse / area, MSE_MIN)) if area else 0 * mse
        size_bytes = (content + self._images * self._measured.constant) * self._measured.bias
        return Expected(self._measured.qualities, log_mse, np.log(np.maximum(size_bytes, 1.0)))

    def _sums(self, among: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Bytes and, by area, squared error at each quality. (qualities,) each"""
        counted = among.astype(np.float32)
        if not self._denser.any():
            by_area = counted * self._area[:, None].astype(np.float32)
            pairs = (self._content, counted), (self._mse, by_area)
            content, mse = (values.reshape(len(values), -1) @ of_block.ravel() for values, of_block in pairs)
            return content.astype(np.float64), mse.astype(np.float64)
        content, mse = (
            np.einsum("qrc,rc->qr", values, counted).astype(np.float64) for values in (self._content, self._mse)
        )
        qualities = self._measured.qualities
        return _shifted(qualities, content, self._denser), _shifted(qualities, mse * self._area, self._denser)


class TextureModel:
    """Expected bytes and error of any region of one scan's texture. Safe to use from several threads.

    texture : (Ht, Wt, 3) uint8 RGB; coded whole, once, in the calling thread.
    first_view : the same as a client sees it that has nothing else; None: as bad as can be.
    sphere : rows are polar angles, and hold fewer texels of their own near the poles.   maps : then, round these.
    unwanted : asked between tiles; when true, the work is dropped and CancelledError raised.
    """

    def __init__(
        self,
        texture: ImageArray,
        first_view: ImageArray | None = None,
        unwanted: Callable[[], bool] = lambda: False,
        *,
        sphere: bool = False,
    ) -> None:
        height, width = texture.shape[:2]
        self._cells = -(-height // CELL), -(-width // CELL)
        self._first_mse = np.full(self._cells, 255.0**2, np.float32)
        if first_view is not None:
            self._first_mse[:] = _cell_errors(texture, first_view)
        self._stride = ring_strides(width, height, CELL) if sphere else np.ones(self._cells[0], np.int64)
        self._measured = {
            (codec, p, False): _Measured(codec, p, self._cells) for codec in QUALITIES for p in SPACINGS
        }
        for measured in self._measured.values():
            _survey_zones(measured, texture, self._stride, unwanted)
        self.maps = PolarTexture(texture) if sphere else None
        if self.maps is not None:
            for codec, p in product(QUALITIES, POLAR_SPACINGS):
                of_strips = self._measured[codec, p, False]
                self._measured[codec, p, True] = _survey_maps(of_strips, texture, self.maps, unwanted)

    def expect(
        self,
        region: Region,
        codec: TextureCodec,
        p: int = 1,
        among: BoolArray | None = None,
        strides: tuple[int, ...] | None = STRIDES,
    ) -> Expected:
        """What the blocks that a region touches will take and reach at a spacing, or those among them.

        p : one of SPACINGS.   among : (rows, columns) of Region.blocks, bool; None: all that it touches.
        strides : of the strips that they travel in; None: as one image of a pole.
        """
        return self.place(region, codec, p, strides).expect(region.touched(CELL) if among is None else among)

    def place(
        self, region: Region, codec: TextureCodec, p: int = 1, strides: tuple[int, ...] | None = STRIDES
    ) -> Place:
        """The same region again and again, each time with other blocks of it; arguments as of `expect`."""
        measured = self._measured[codec, p, strides is None]
        left, top, wide, high = region.blocks(CELL)
        rows, stop = slice(top, top + high), left + wide - self._cells[1]
        content, mse = (
            np.ascontiguousarray(values[:, rows, left : left + wide])
            if stop <= 0
            else np.concatenate([values[:, rows, left:], values[:, rows, :stop]], axis=2)
            for values in (measured.content, measured.mse)
        )
        stride = self._stride[rows]
        return Place(measured, content, mse, stride, None if strides is None else limited_strides(stride, strides))

    def mse_at(self, rows: IntArray, columns: IntArray, quality: IntArray) -> FloatArray:
        """Squared error per value of single blocks at qualities of their own; -1 is the first view. (n,) each"""
        if (quality < 0).all():  # nearly always: nobody looked there before
            return self._first_mse[rows, columns].astype(np.float64)
        measured = self._measured[TextureCodec.HTJ2K, 1, False]
        scale = np.array(measured.qualities, np.float64)
        above = np.clip(np.searchsorted(scale, quality), 1, scale.size - 1)
        part = np.clip((quality - scale[above - 1]) / (scale[above] - scale[above - 1]), 0, 1)
        low, high = (np.log(np.maximum(measured.mse[index, rows, columns], MSE_MIN)) for index in (above - 1, above))
        return np.where(quality < 0, self._first_mse[rows, columns], np.exp(low + part * (high - low)))

    def learn(
        self,
        codec: TextureCodec,
        p: int,
        expected_bytes: float,
        actual_bytes: int,
        *,
        polar: bool = False,
        worse: float = 1.0,
    ) -> None:
        """Take note of what a patch, or an image of a pole, really took, and how much `worse` it was."""
        if expected_bytes > 0 and actual_bytes > 0:
            measured = self._measured[codec, p, polar]  # two threads at once: one of them is not learned from
            measured.bias *= min(max(actual_bytes / expected_bytes, 0.5), 2.0) ** BIAS_WEIGHT
            measured.worse *= min(max(worse, 0.5), 2.0) ** BIAS_WEIGHT


def _shifted(qualities: tuple[int, ...], values: FloatArray, by: FloatArray) -> FloatArray:
    """The sum over rows of values (qualities, rows), each row's taken at qualities higher `by` so much. (qualities,)"""
    total = values[:, by == 0].sum(axis=1)
    scale = np.array(qualities, np.float64)
    for shift in np.unique(by[by > 0]).tolist():
        known = np.log(np.maximum(values[:, by == shift].sum(axis=1), MSE_MIN))
        total = total + np.exp(_continued(scale + shift, qualities, known))
    return np.asarray(total)


def _survey_zones(
    measured: _Measured, texture: ImageArray, stride: IntArray, unwanted: Callable[[], bool]
) -> None:
    """Survey each zone of rows of one stride as an image of its own texels; what came of it is its cells'."""
    starts, largest = np.flatnonzero(np.diff(stride, prepend=0)), 0
    for first, last in zip(starts.tolist(), [*starts[1:].tolist(), stride.size], strict=True):
        t = int(stride[first])
        own = np.ascontiguousarray(texture[first * CELL : last * CELL, ::t])
        zone = _Measured(measured.codec, measured.p, (last - first, -(-own.shape[1] // CELL)))
        _survey(zone, own, unwanted)
        columns = measured.mse.shape[2]
        measured.mse[:, first:last] = zone.mse.repeat(t, axis=2)[:, :, :columns]
        measured.content[:, first:last] = zone.content.repeat(t, axis=2)[:, :, :columns] / t
        if own.size > largest:
            largest, measured.constant = own.size, zone.constant


def _survey_maps(
    of_strips: _Measured, texture: ImageArray, maps: PolarTexture, unwanted: Callable[[], bool]
) -> _Measured:
    """What images of the poles take and miss: their maps are coded whole, and some texels held against them.

    What a map takes is spread over its blocks by how large each is on it and how much detail it keeps.
    """
    codec, p = of_strips.codec, of_strips.p
    measured = _Measured(codec, p, of_strips.mse.shape[1:], POLAR_QUALITIES[codec])
    nearest = [int(np.argmin(np.abs(np.subtract(of_strips.qualities, quality)))) for quality in measured.qualities]
    measured.mse[:], measured.content[:] = of_strips.mse[nearest], of_strips.content[nearest]
    measured.constant[:] = of_strips.constant[nearest]
    columns = np.arange(COMPARED_EVERY // 2, texture.shape[1], COMPARED_EVERY)
    for place, image, on_it in maps.halves(p):
        rows = np.arange(on_it.start * CELL + COMPARED_EVERY // 2, on_it.stop * CELL, COMPARED_EVERY)
        truth = np.ascontiguousarray(texture[rows][:, columns])
        detail = _cell_errors(truth, np.asarray(cv2.blur(truth, (9, 9)), np.uint8), CELL // COMPARED_EVERY)
        area = np.sin(np.pi * CELL * (np.arange(on_it.start, on_it.stop) + 0.5) / texture.shape[0])[:, None]
        for index, quality in enumerate(measured.qualities):
            if unwanted():
                raise CancelledError
            payload = encode_texture(image, codec, quality)
            seen = texels_at(place.places(rows, columns), decode_texture(payload, codec, quality, place.sample_shape))
            missed = _cell_errors(truth, seen, CELL // COMPARED_EVERY)
            weight = area * _weights(detail, missed)
            taken = max(DISC_SHARE * (len(payload) - measured.constant[index]), 1.0)
            measured.mse[index, on_it], measured.content[index, on_it] = missed, weight * (taken / weight.sum())
    return measured


def _survey(measured: _Measured, texture: ImageArray, unwanted: Callable[[], bool]) -> None:
    """Code a texture by tiles at every quality, and some of them again two by two, and fill in what came of it."""
    side, p, count = _tile_side(texture.shape[1]), measured.p, len(measured.qualities)
    taken = {corner: np.zeros(count) for corner in _corners(texture, side)}
    for (top, left), sizes in taken.items():
        if unwanted():
            raise CancelledError
        tile = _tile(texture, top, left, side)
        cells = _cells_at(top, left, tile)
        sampled = _averaged(tile, p)
        detail = _cell_errors(sampled, np.asarray(cv2.blur(sampled, (9, 9)), np.uint8), CELL // p)
        for index, quality in enumerate(measured.qualities):
            payload = encode_texture(sampled, measured.codec, quality)
            decoded = decode_texture(payload, measured.codec, quality, (sampled.shape[0], sampled.shape[1]))
            measured.mse[(index, *cells)] = _cell_errors(tile, _spread(decoded, p, tile))
            missed = _cell_errors(sampled, decoded, CELL // p)
            measured.content[(index, *cells)] = _weights(detail, missed)
            sizes[index] = len(payload)
    measured.constant[:] = _constant_bytes(measured, texture, taken, side)
    for (top, left), sizes in taken.items():
        weight = measured.content[:, *_cells_at(top, left, _tile(texture, top, left, side))]
        weight *= (np.maximum(sizes - measured.constant, 1.0) / weight.sum(axis=(1, 2)))[:, None, None]


def _weights(detail: NDArray[np.float32], missed: NDArray[np.float32]) -> NDArray[np.float32]:
    """How much of the bytes each cell accounts for, by the detail that it has and what is missed."""
    kept = np.log2(np.maximum(detail, MSE_MIN) / np.maximum(missed, MSE_MIN))
    return np.asarray(np.maximum(kept, 0) + WEIGHT_MIN, np.float32)


def _constant_bytes(
    measured: _Measured, texture: ImageArray, taken: dict[tuple[int, int], FloatArray], side: int
) -> FloatArray:
    """What tiles take more than the same texels in one image, for each image saved. (one value per quality)

    Four tiles each time, two where rows are too few for more.
    """
    saved = []
    for index, (top, left) in enumerate(_corners(texture, 2 * side)):
        four = [taken.get((top + y, left + x)) for y in (0, side) for x in (0, side)]
        parts = [sizes for sizes in four if sizes is not None]
        if index % JOINED_EVERY or len(parts) < min(len(four), 2 * -(-texture.shape[0] // side)):
            continue
        whole = _averaged(_tile(texture, top, left, 2 * side), measured.p)
        joined = [len(encode_texture(whole, measured.codec, quality)) for quality in measured.qualities]
        saved.append((np.sum(parts, axis=0) - joined) / (len(parts) - 1))
    if not saved:
        return np.zeros(len(measured.qualities))
    usual = np.median(list(taken.values()), axis=0)
    return np.asarray(np.clip(np.mean(saved, axis=0), 0, usual))


def _corners(texture: ImageArray, side: int) -> Iterator[tuple[int, int]]:
    """Top and left of each tile."""
    for top in range(0, texture.shape[0], side):
        for left in range(0, texture.shape[1], side):
            yield top, left


def _tile(texture: ImageArray, top: int, left: int, side: int) -> ImageArray:
    return np.ascontiguousarray(texture[top : top + side, left : left + side])


def _averaged(tile: ImageArray, p: int) -> ImageArray:
    """The samples that travel of a tile at a spacing."""
    if p == 1:
        return tile
    below, right = -tile.shape[0] % p, -tile.shape[1] % p
    whole = cv2.copyMakeBorder(tile, 0, below, 0, right, cv2.BORDER_REPLICATE) if below or right else tile
    size = whole.shape[1] // p, whole.shape[0] // p
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA))


def _spread(decoded: ImageArray, p: int, tile: ImageArray) -> ImageArray:
    """About what a client makes of them: the tile again."""
    if p == 1:
        return decoded
    size = decoded.shape[1] * p, decoded.shape[0] * p
    return np.asarray(cv2.resize(decoded, size, interpolation=cv2.INTER_LINEAR)[: tile.shape[0], : tile.shape[1]])


def _tile_side(width: int) -> int:
    smallest, largest = TILE_SIDES
    return min(max(1 << max(width // TILES_A_TURN, 1).bit_length() - 1, smallest), largest)


def _cells_at(top: int, left: int, tile: ImageArray) -> tuple[slice, slice]:
    """The cells of a tile that starts at whole ones."""
    y, x = top // CELL, left // CELL
    return slice(y, y - (-tile.shape[0] // CELL)), slice(x, x - (-tile.shape[1] // CELL))


def _cell_errors(tile: ImageArray, other: ImageArray, side: int = CELL) -> NDArray[np.float32]:
    """Squared error per value in each cell of a tile."""
    missed = cv2.absdiff(tile, np.ascontiguousarray(other))
    rows, columns = -(-tile.shape[0] // side), -(-tile.shape[1] // side)
    below, right = rows * side - tile.shape[0], columns * side - tile.shape[1]
    if below or right:
        missed = cv2.copyMakeBorder(missed, 0, below, 0, right, cv2.BORDER_REPLICATE)
    squared = cv2.resize(
        cv2.multiply(missed, missed, dtype=cv2.CV_32F), (columns, rows), interpolation=cv2.INTER_AREA
    )
    return np.asarray(squared.reshape(rows, columns, 3).mean(axis=2), np.float32)
