"""Geometry as Draco meshes (XYZ): the whole scan at once, or tiles of it at levels of a pyramid.

Vertices stand on the cylinder's grid. Draco numbers them anew, so what it decodes is put back by angle and height,
which its quantisation moves by far less than half a cell.
"""

from __future__ import annotations

from functools import lru_cache, partial

import DracoPy
import numpy as np
from numpy.typing import NDArray

from protocol.grid import VOID, StepArray
from tests.bench.cache import Cache
from tests.bench.rivals.offer import PIECE_BYTES, Offer, Unreachable, cheapest, void_mask
from tests.bench.rivals.pyramid import Rect, tiles_over
from tests.bench.rivals.range_tiles import filled_range, shown
from tests.bench.scans import BenchScan
from tests.bench.target import Window, crop

SPEED_BEST = 10  # DracoPy's compression level: 10 is smallest and slowest
BITS = range(5, 20)
LEVELS = (1, 2, 4, 8)
TILES = (16, 32, 64, 128, 256)
QUANTILES = np.linspace(0, 1, 101)


def full_offer(scan: BenchScan, window: Window, cache: Cache) -> Offer:
    """The whole scan in one mesh with as few bits as the window needs. Voids have no faces, so no mask travels."""
    for bits in BITS:
        if window.range_reached(crop(decoded_scan(scan, bits), window.range)):
            data = cache.blob("rivals.draco_range", f"{scan.key} {bits}", partial(encode_scan, scan, bits))
            return Offer(len(data), f"Draco of everything, {bits} bits")
    raise Unreachable("Draco")


def tiles_offer(scan: BenchScan, window: Window) -> Offer:
    """The cheapest tiles that show the window, with its void mask; a tile repeats the first samples of the next."""
    offers = [offer for level in LEVELS for tile in TILES for offer in _tiles(scan, window, level, tile)]
    return cheapest(offers) + void_mask(window)


@lru_cache(maxsize=2)
def decoded_scan(scan: BenchScan, bits: int) -> StepArray:
    """A scan's range as Draco gives it back."""
    grid = scan.grid
    rows, columns = np.nonzero(grid.range_steps != VOID)
    decoded = np.zeros(grid.range_steps.shape, np.uint16)
    decoded[rows, columns] = _requantised(scan, rows, columns, grid.range_steps[rows, columns], bits)
    return decoded


def encode_scan(scan: BenchScan, bits: int) -> bytes:
    """A scan as one Draco mesh."""
    grid = scan.grid
    measured = grid.range_steps != VOID
    rows, columns = np.nonzero(measured)
    points = positions(scan, rows, columns, grid.range_steps[measured])
    return _checked(points, faces(measured, cyclic=True), bits)


def positions(scan: BenchScan, rows: np.ndarray, columns: np.ndarray, steps: np.ndarray) -> NDArray[np.float32]:
    """Cartesian vertices [mm] of cells. (n, 3)."""
    s = scan.grid.spec
    angle, radius = s.angle_rad(columns), steps.astype(np.float64) * s.step_mm
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), s.height_mm(rows)], axis=1).astype(np.float32)


def faces(measured: NDArray[np.bool_], cyclic: bool) -> NDArray[np.uint32]:
    """Two triangles for each four measured cells. (n, 3) indices into the measured cells in row order."""
    index = np.cumsum(measured).reshape(measured.shape) - 1
    if cyclic:
        index, measured = np.c_[index, index[:, :1]], np.c_[measured, measured[:, :1]]
    corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
    whole = measured[:-1, :-1] & measured[1:, :-1] & measured[1:, 1:] & measured[:-1, 1:]
    a, b, c, d = (corner[whole] for corner in corners)
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.uint32)


def encode_mesh(points: NDArray[np.float32], triangles: NDArray[np.uint32], bits: int) -> bytes:
    """A Draco mesh at its smallest."""
    return bytes(DracoPy.encode(points, triangles, quantization_bits=bits, compression_level=SPEED_BEST))


def requantised(points: NDArray[np.float32], bits: int) -> NDArray[np.float64]:
    """What Draco makes of positions: multiples of the largest extent / (2^bits - 1) from the least corner."""
    low = points.min(axis=0).astype(np.float64)
    step = float((points.max(axis=0) - low).max()) / (2**bits - 1) or 1.0
    return np.asarray(low + np.floor((points - low) / step + 0.5) * step)


def _requantised(scan: BenchScan, rows: np.ndarray, columns: np.ndarray, steps: np.ndarray, bits: int) -> StepArray:
    made = requantised(positions(scan, rows, columns, steps), bits)
    return _steps_of(scan, made)


def _steps_of(scan: BenchScan, points: NDArray[np.floating]) -> StepArray:
    radius = np.hypot(points[:, 0], points[:, 1]) / scan.grid.spec.step_mm
    return np.asarray(np.clip(np.rint(radius), 1, 65535), np.uint16)


def _checked(points: NDArray[np.float32], triangles: NDArray[np.uint32], bits: int) -> bytes:
    """A mesh, after making sure that it decodes to what `requantised` says; a vertex without a face does not travel."""
    data = encode_mesh(points, triangles, bits)
    sent, received = (
        requantised(points, bits)[np.unique(triangles)],
        np.asarray(DracoPy.decode(data).points, np.float64),
    )
    # Draco rounds in float32, so what lies half way between two steps may fall to either side, and it splits vertices
    # where two sheets touch: every coordinate's distribution is compared, to a step.
    step = float(np.ptp(points, axis=0).max()) / (2**bits - 1)
    apart = np.quantile(sent, QUANTILES, axis=0) - np.quantile(received, QUANTILES, axis=0)
    assert np.abs(apart).max() <= 1.5 * step + 1e-6, "Draco decodes to something else"
    assert abs(len(sent) - len(received)) <= len(sent) // 1000, "Draco loses vertices"
    return data


def _tiles(scan: BenchScan, window: Window, level: int, tile: int) -> list[Offer]:
    """The window at one level and tile size, with as few bits as reach the target; none when none do."""
    samples = filled_range(scan)[::level, ::level]
    rect = tiles_over(window.range, scan.grid.range_steps.shape, samples.shape, tile)
    for bits in BITS:
        received = _received(scan, samples, rect, level, tile, bits)
        if window.range_reached(shown(received, rect, window, level, "point", "linear")):
            size = sum(len(_checked(*mesh, bits)) + PIECE_BYTES for mesh in _meshes(scan, samples, rect, level, tile))
            return [Offer(size, f"Draco 1/{level}, {bits} bits, tiles of {tile}")]
    return []


def _received(
    scan: BenchScan, samples: NDArray[np.float32], rect: Rect, level: int, tile: int, bits: int
) -> NDArray[np.float32]:
    made = np.empty((rect.bottom - rect.top, rect.right - rect.left), np.float32)
    for (rows, columns), (points, _) in zip(
        _pieces(samples, rect, tile), _meshes(scan, samples, rect, level, tile), strict=True
    ):
        steps = _steps_of(scan, requantised(points, bits)).reshape(len(rows), len(columns))
        target = made[rows[0] - rect.top :, columns[0] - rect.left :][: len(rows), : len(columns)]
        target[:] = steps[: target.shape[0], : target.shape[1]]
    return made


def _meshes(
    scan: BenchScan, samples: NDArray[np.float32], rect: Rect, level: int, tile: int
) -> list[tuple[NDArray[np.float32], NDArray[np.uint32]]]:
    meshes = []
    for rows, columns in _pieces(samples, rect, tile):
        row, column = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
        points = positions(scan, row * level, column * level, samples[row, column])
        meshes.append((points, faces(np.ones((len(rows), len(columns)), np.bool_), cyclic=False)))
    return meshes


def _pieces(samples: NDArray[np.float32], rect: Rect, tile: int) -> list[tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Rows and columns of each tile, with the first of the next one so that no seam gapes."""
    return [
        (np.arange(top, min(top + tile + 1, samples.shape[0])), np.arange(left, min(left + tile + 1, samples.shape[1])))
        for top in range(rect.top, rect.bottom, tile)
        for left in range(rect.left, rect.right, tile)
    ]
