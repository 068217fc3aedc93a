"""The void mask: which samples of a window were not measured.

Void regions are few and their edges run on from row to row. So each row is XORed with the row above (the first with
nothing), and the distances between the ones that remain travel as variable-length integers, deflated without a wrapper.
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from protocol.errors import CodecError

BoolArray = NDArray[np.bool_]


def encode(mask: BoolArray) -> bytes:
    """An (h, w) bool mask as bytes; a mask without a true sample is empty."""
    changes = mask.copy()
    changes[1:] ^= mask[:-1]
    gaps = np.diff(np.flatnonzero(changes), prepend=-1) - 1
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    return deflate.compress(_to_varints(gaps)) + deflate.flush() if gaps.size else b""


def decode(payload: bytes, shape: tuple[int, int]) -> BoolArray:
    """The (h, w) bool mask of a payload. Raises CodecError for one that is cut short or does not fit."""
    changes = np.zeros(shape, np.bool_)
    if payload:
        at = np.cumsum(_from_varints(_inflate(payload, 3 * changes.size)) + 1) - 1
        if at[-1] >= changes.size:
            raise CodecError("mask runs past its end")
        changes.flat[at] = True
    return np.logical_xor.accumulate(changes, axis=0)


def _inflate(payload: bytes, limit_bytes: int) -> bytes:
    inflate = zlib.decompressobj(-15)
    try:
        data = inflate.decompress(payload, limit_bytes)
    except zlib.error as error:
        raise CodecError(f"mask does not inflate: {error}") from error
    if not inflate.eof or inflate.unused_data or not data:
        raise CodecError("mask is cut short, overlong or empty")
    return data


def _to_varints(values: NDArray[np.intp]) -> bytes:
    """Little-endian groups of seven bits, the top bit set on all but the last of a value; values below 2**28."""
    groups = np.stack([values >> shift & 0x7F for shift in (0, 7, 14, 21)], axis=1)
    last = np.maximum.reduce([(values >= 1 << 7 * n) * n for n in (1, 2, 3)])
    place = np.arange(4)
    groups |= (place < last[:, None]) << 7
    return groups[place <= last[:, None]].astype(np.uint8).tobytes()


def _from_varints(data: bytes) -> NDArray[np.int64]:
    octets = np.frombuffer(data, np.uint8).astype(np.int64)
    ends = np.flatnonzero(octets < 0x80)
    if not ends.size or ends[-1] != octets.size - 1:
        raise CodecError("mask ends inside a number")
    starts = np.concatenate(([0], ends[:-1] + 1))
    if (ends - starts).max() > 3:
        raise CodecError("mask holds a number of more than four bytes")
    place = np.arange(octets.size) - np.repeat(starts, ends - starts + 1)
    return np.add.reduceat((octets & 0x7F) << 7 * place, starts)
