"""The void mask: which samples of a window were not measured.

Void regions are few and their edges run on from row to row, so what travels is how the edges move. A row's edges are
the columns where the mask differs from its left neighbour (from false, in column 0). A band is a run of rows with
equally many edges. The message is a list of numbers, deflated without a wrapper:

    (rows, edges) of each band from the top, until the rows add up to h;
    the edges of each band's first row, left to right, as distances from the edge before (the first from column 0);
    each band's moves, edge by edge and down the rows: 2m for m columns to the right, 2m - 1 for m to the left.

each as an unsigned little-endian varint (seven bits a byte). Where that takes more bytes than the mask has bits / 8
(noise), a zero byte and the bits, row by row, the most significant first, are deflated instead. A mask without a true
sample is an empty payload.
"""

from __future__ import annotations

import zlib
from itertools import pairwise

import numpy as np

from protocol.errors import CodecError
from protocol.grid import BoolArray, IntArray
from protocol.inflate import inflate


def encode(mask: BoolArray) -> bytes:
    """An (h, w) bool mask as bytes."""
    if not mask.any():
        return b""
    numbers = _to_varints(_edge_numbers(mask))
    data = numbers if len(numbers) <= _bits_bytes(mask.shape) else b"\0" + np.packbits(mask).tobytes()
    # Matches at distance one (Z_RLE) serve short lists of small numbers best: 98 bytes against 103 on james.
    deflate = zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS, 9, zlib.Z_RLE)
    return deflate.compress(data) + deflate.flush()


def decode(payload: bytes, shape: tuple[int, int]) -> BoolArray:
    """The (h, w) bool mask of a payload. Raises CodecError for one that is cut short or does not fit the shape."""
    if not payload:
        return np.zeros(shape, np.bool_)
    data = inflate(payload, 1 + _bits_bytes(shape), "mask")
    if not data:
        raise CodecError("mask is empty")
    if data[0]:
        return _mask_from_edges(_from_varints(data), shape)
    if len(data) != 1 + _bits_bytes(shape):
        raise CodecError("mask has fewer bits than samples")
    bits = np.unpackbits(np.frombuffer(data, np.uint8, offset=1), count=shape[0] * shape[1])
    return bits.reshape(shape).astype(np.bool_)


def _edge_numbers(mask: BoolArray) -> IntArray:
    edges = mask.copy()
    edges[:, 1:] ^= mask[:, :-1]
    crossed = edges.any(axis=1)  # few rows in most windows, so only these are looked at closely
    rows, columns = np.nonzero(edges[crossed])
    counts = np.zeros(len(mask), np.int64)
    counts[crossed] = np.bincount(rows)
    heads, firsts, moves, used = [], [], [], 0
    for top, bottom in pairwise([*np.flatnonzero(np.diff(counts, prepend=-1)), len(mask)]):
        band = high, count = bottom - top, counts[top]
        paths = columns[used : used + high * count].reshape(band)
        used += high * count
        heads.append(band)
        firsts.append(paths[0, :1])
        firsts.append(paths[0, 1:] - paths[0, :-1])
        moves.append((paths[1:] - paths[:-1]).T.ravel())
    return np.concatenate([np.ravel(heads), *firsts, _to_unsigned(np.concatenate(moves))])


def _mask_from_edges(numbers: IntArray, shape: tuple[int, int]) -> BoolArray:
    bands = _bands(numbers, shape)
    firsts_at = 2 * len(bands)
    moves_at = firsts_at + sum(count for _, count in bands)
    if len(numbers) != moves_at + sum((rows - 1) * count for rows, count in bands):
        raise CodecError("mask has another number of edges than it announces")
    edges, top = np.zeros(shape, np.bool_), 0
    for rows, count in bands:
        paths = np.empty((count, rows), np.int64)
        paths[:, 0] = np.cumsum(numbers[firsts_at : firsts_at + count])
        paths[:, 1:] = _to_signed(numbers[moves_at : moves_at + (rows - 1) * count]).reshape(count, rows - 1)
        _mark(edges[top : top + rows], np.cumsum(paths, axis=1))
        top, firsts_at, moves_at = top + rows, firsts_at + count, moves_at + (rows - 1) * count
    return np.logical_xor.accumulate(edges, axis=1)


def _bands(numbers: IntArray, shape: tuple[int, int]) -> list[tuple[int, int]]:
    """(rows, edges) of each band; they add up to the height, and no row has more edges than columns."""
    bands: list[tuple[int, int]] = []
    rows_left, at = shape[0], 0
    while rows_left > 0 and at + 1 < len(numbers):
        rows, count = numbers[at : at + 2].tolist()
        if not (1 <= rows <= rows_left and count <= shape[1]):
            raise CodecError(f"mask has a band of {rows} rows with {count} edges")
        bands.append((rows, count))
        rows_left, at = rows_left - rows, at + 2
    if rows_left:
        raise CodecError("mask has too few rows")
    return bands


def _mark(edges: BoolArray, paths: IntArray) -> None:
    """Set the edges (rows, w) that paths (edges, rows) name. Raises CodecError for paths outside or out of order."""
    inside = not paths.size or (paths[0].min() >= 0 and paths[-1].max() < edges.shape[1])
    if not inside or (np.diff(paths, axis=0) <= 0).any():
        raise CodecError("mask has edges outside it or out of order")
    edges[np.arange(len(edges)), paths] = True


def _bits_bytes(shape: tuple[int, ...]) -> int:
    return (shape[0] * shape[1] + 7) // 8


def _to_unsigned(moves: IntArray) -> IntArray:
    return np.where(moves < 0, -2 * moves - 1, 2 * moves)


def _to_signed(numbers: IntArray) -> IntArray:
    return np.where(numbers & 1, -(numbers + 1 >> 1), numbers >> 1)


def _to_varints(numbers: IntArray) -> bytes:
    """Little-endian groups of seven bits, the top bit set on all but the last of a number; numbers below 2**21."""
    last = (numbers >= 1 << 7).astype(np.int64) + (numbers >= 1 << 14)
    place = np.arange(3)
    groups = numbers[:, None] >> 7 * place & 0x7F | (place < last[:, None]) << 7
    return groups[place <= last[:, None]].astype(np.uint8).tobytes()


def _from_varints(data: bytes) -> IntArray:
    octets = np.frombuffer(data, np.uint8).astype(np.int64)
    last = np.flatnonzero(octets < 0x80)
    if not last.size or last[-1] != len(data) - 1:
        raise CodecError("mask ends inside a number")
    first = np.concatenate(([0], last[:-1] + 1))
    if (last - first).max() > 2:
        raise CodecError("mask holds a number of more than three bytes")
    place = np.arange(len(data)) - np.repeat(first, last - first + 1)
    return np.add.reduceat((octets & 0x7F) << 7 * place, first)
