"""What a scan's texture costs and how good it gets, place by place, at every quality: measured once for each scan.

The whole texture is coded at a few qualities, tile by tile, when a scan is opened. From then on the first guess at a
quality is nearly always the right one, so that an update is encoded once. Bytes of a tile and of a patch differ a
little (a patch is larger); how much is learned from every update that is sent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import CancelledError
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.codec import LOSSLESS, TextureCodec, decode_texture, encode_texture
from protocol.grid import BoolArray, FloatArray, ImageArray, IntArray
from protocol.region import Region

QUALITIES = (6, 20, 34, 48, 62)
TILE = 256
CELL = 16
MSE_MIN = 1e-3
FIRST_QUALITY = 38
LOG_MSE_SLOPE = 0.08  # of a step of quality, on typical skin
LOG_BYTES_SLOPE = 0.07
TILE_OVERHEAD_BYTES = 18  # of a code stream whatever its size: a patch has it once
BIAS_WEIGHT = 0.3
JPEG_BIAS = 1.6  # what a JPEG of equal quality takes, until an update tells


@dataclass(frozen=True, slots=True)
class Expected:
    """What a region's texture is expected to take and to reach. (one value per quality tried)"""

    log_mse: FloatArray
    log_bytes: FloatArray

    def mse(self, quality: float) -> float:
        """Squared error per value at a quality."""
        return float(np.exp(_extended(quality, self.log_mse)))

    def size_bytes(self, quality: float) -> float:
        """Payload at a quality."""
        return float(np.exp(_extended(quality, self.log_bytes)))

    @classmethod
    def generic(cls, target_mse: float, size_bytes: float) -> Expected:
        """Where nothing is known of a scan: the target at FIRST_QUALITY for size_bytes, usual slopes round it."""
        steps = np.array(QUALITIES, np.float64) - FIRST_QUALITY
        return cls(np.log(target_mse) - LOG_MSE_SLOPE * steps, np.log(size_bytes) + LOG_BYTES_SLOPE * steps)

    def quality_for_mse(self, mse: float) -> int:
        """The lowest quality that should leave no more than this error."""
        falling = np.minimum.accumulate(self.log_mse)
        wanted = np.log(max(mse, MSE_MIN))
        slope = (falling[-1] - falling[-2]) / (QUALITIES[-1] - QUALITIES[-2])
        beyond = min((wanted - falling[-1]) / slope, LOSSLESS) if slope < 0 and wanted < falling[-1] else 0
        return int(np.ceil(np.interp(-wanted, -falling, QUALITIES) + beyond))

    def quality_for_bytes(self, size_bytes: float) -> int:
        """The highest quality that should take no more than this."""
        rising = np.maximum.accumulate(self.log_bytes)
        wanted = np.log(max(size_bytes, 1.0))
        slope = (rising[-1] - rising[-2]) / (QUALITIES[-1] - QUALITIES[-2])
        beyond = max(wanted - rising[-1], 0) / slope if slope > 0 else 0
        return int(np.floor(np.interp(wanted, rising, QUALITIES) + beyond))


class TextureModel:
    """Expected bytes and error of any region of one scan's texture, at spacing 1. Safe to use from several threads.

    texture : (Ht, Wt, 3) uint8 RGB; coded whole, once, in the calling thread.
    first_view : the same as a client sees it that has nothing else; None: as bad as can be.
    unwanted : asked between tiles; when true, the work is dropped and CancelledError raised.
    """

    def __init__(
        self,
        texture: ImageArray,
        first_view: ImageArray | None = None,
        unwanted: Callable[[], bool] = lambda: False,
    ) -> None:
        self._shape = texture.shape[:2]
        rows, columns = (-(-size // TILE) for size in self._shape)
        self._bytes = np.empty((len(QUALITIES), rows, columns))
        cells = tuple(-(-size // CELL) for size in self._shape)
        self._mse = np.empty((len(QUALITIES), *cells), np.float32)
        self._first_mse = np.full(cells, 255.0**2, np.float32)
        self._bias = {TextureCodec.HTJ2K: 1.0, TextureCodec.JPEG: JPEG_BIAS}
        self._lock = threading.Lock()
        for row in range(rows):
            for column in range(columns):
                if unwanted():
                    raise CancelledError
                self._measure(texture, first_view, row, column)

    def expect(self, region: Region, codec: TextureCodec) -> Expected:
        """What the blocks that a region touches will take and reach."""
        left, top, wide, high = region.blocks(CELL)
        columns = np.arange(left, left + wide) % self._mse.shape[2]
        touched = region.touched(CELL)
        if touched.all():
            mse = self._mse[:, top : top + high][:, :, columns].mean(axis=(1, 2), dtype=np.float64)
            tiles = self._share_of_tiles(left * CELL, top * CELL, wide * CELL, high * CELL)
        else:
            mse = self._mse[:, top : top + high][:, :, columns][:, touched].mean(axis=1, dtype=np.float64)
            tiles = self._touched_tiles(top, columns, touched)
        size_bytes = (self._bytes * tiles).sum(axis=(1, 2)) * self._bias[codec]
        return Expected(np.log(np.maximum(mse, MSE_MIN)), np.log(np.maximum(size_bytes, 1.0)))

    def mse_at(self, rows: IntArray, columns: IntArray, quality: IntArray) -> FloatArray:
        """Squared error per value of single blocks at qualities of their own; -1 is the first view. (n,) each"""
        scale = np.array(QUALITIES, np.float64)
        above = np.clip(np.searchsorted(scale, quality), 1, scale.size - 1)
        part = np.clip((quality - scale[above - 1]) / (scale[above] - scale[above - 1]), 0, 1)
        low, high = (np.log(np.maximum(self._mse[index, rows, columns], MSE_MIN)) for index in (above - 1, above))
        return np.where(quality < 0, self._first_mse[rows, columns], np.exp(low + part * (high - low)))

    def learn(self, codec: TextureCodec, expected_bytes: float, actual_bytes: int) -> None:
        """Take note of what a patch really took."""
        if expected_bytes > 0 and actual_bytes > 0:
            with self._lock:
                ratio = min(max(actual_bytes / expected_bytes, 0.5), 2.0)
                self._bias[codec] *= ratio**BIAS_WEIGHT

    def _measure(self, texture: ImageArray, first_view: ImageArray | None, row: int, column: int) -> None:
        """Code one tile at every quality."""
        place = slice(row * TILE, (row + 1) * TILE), slice(column * TILE, (column + 1) * TILE)
        tile = np.ascontiguousarray(texture[place])
        y, x = row * TILE // CELL, column * TILE // CELL
        cells = slice(y, y - (-tile.shape[0] // CELL)), slice(x, x - (-tile.shape[1] // CELL))
        if first_view is not None:
            self._first_mse[cells] = _cell_errors(tile, np.ascontiguousarray(first_view[place]))
        for index, quality in enumerate(QUALITIES):
            payload = encode_texture(tile, TextureCodec.HTJ2K, quality)
            self._bytes[index, row, column] = max(len(payload) - TILE_OVERHEAD_BYTES, 1)
            decoded = decode_texture(payload, TextureCodec.HTJ2K, quality, (tile.shape[0], tile.shape[1]))
            self._mse[(index, *cells)] = _cell_errors(tile, decoded)

    def _touched_tiles(self, top: int, columns: IntArray, touched: BoolArray) -> FloatArray:
        """How much of each tile some of its cells are, 0..1. touched : of the cells from `top` on, in `columns`."""
        rows, across = np.nonzero(touched)
        counts = np.zeros(self._bytes.shape[1:])
        np.add.at(counts, ((top + rows) * CELL // TILE, columns[across] * CELL // TILE), 1)
        high, wide = (np.minimum(TILE, size - np.arange(0, size, TILE)) for size in self._shape)
        return np.asarray(counts * CELL**2 / np.multiply.outer(high, wide))

    def _share_of_tiles(self, left: int, top: int, width: int, height: int) -> FloatArray:
        """How much of each tile a rectangle covers, 0..1, cyclic in x."""
        rows = _overlap(top, height, self._bytes.shape[1], self._shape[0])
        turn = self._shape[1]
        columns = _overlap(left, min(width, turn - left), self._bytes.shape[2], turn)
        if left + width > turn:
            columns = columns + _overlap(0, left + width - turn, self._bytes.shape[2], turn)
        return np.asarray(np.multiply.outer(rows, columns))


def _cell_errors(tile: ImageArray, other: ImageArray) -> NDArray[np.float32]:
    """Squared error per value in each 16 x 16 cell of a tile."""
    missed = cv2.absdiff(tile, other)
    rows, columns = -(-tile.shape[0] // CELL), -(-tile.shape[1] // CELL)
    squared = cv2.resize(
        cv2.multiply(missed, missed, dtype=cv2.CV_32F), (columns, rows), interpolation=cv2.INTER_AREA
    )
    return np.asarray(squared.reshape(rows, columns, 3).mean(axis=2), np.float32)


def _overlap(start: int, length: int, tiles: int, size: int) -> FloatArray:
    """Share of each tile of an axis inside start..start + length."""
    begin = TILE * np.arange(tiles)
    end = np.minimum(begin + TILE, size)
    inside = np.minimum(end, start + length) - np.maximum(begin, start)
    return np.asarray(np.maximum(inside, 0) / (end - begin))


def _extended(quality: float, values: FloatArray) -> float:
    """Linear interpolation over QUALITIES, the last slope kept beyond them."""
    slope = (values[-1] - values[-2]) / (QUALITIES[-1] - QUALITIES[-2])
    beyond = max(quality - QUALITIES[-1], 0)
    return float(np.interp(quality, QUALITIES, values) + beyond * slope)
