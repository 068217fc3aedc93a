"""The range of a selection as bytes and back: one image, or on thinned rings one for each run of equally thin rows.

Rows that keep fewer samples (protocol.rings) make a narrower image. Each is coded by itself, as if it were all there
is, behind its length (u32, little-endian). Where no row is thinned, and on every cylinder, there is one image and no
length.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from protocol.codec import RangeCodec, decode_range
from protocol.codec_lift import encode_and_decode, survey
from protocol.errors import CodecError
from protocol.grid import BoolArray, IntArray, StepArray
from protocol.reconstruct import Selection, fill_rings, thinned_rings

LENGTH = struct.Struct("<I")
Band = tuple[slice, IntArray]


def encode_selection(
    selection: Selection, samples: StepArray, quantum: int, care: BoolArray
) -> tuple[bytes, StepArray]:
    """Payload of samples (sample_shape), and what the other end decodes. care : False where any value will do."""
    bands = _bands(selection)
    if not bands:
        return encode_and_decode(samples, quantum, care)
    decoded, parts = np.zeros_like(samples), []
    for rows, columns in bands:
        part, decoded[rows, columns] = encode_and_decode(samples[rows, columns], quantum, care[rows, columns])
        parts += [LENGTH.pack(len(part)), part]
    return b"".join(parts), fill_rings(selection, decoded)


def survey_selection(
    selection: Selection, samples: StepArray, quantum: int, care: BoolArray
) -> tuple[StepArray, float]:
    """What the other end decodes, and about how many bytes that takes, without coding it."""
    bands = _bands(selection)
    if not bands:
        return survey(samples, quantum, care)
    decoded, size_bytes = np.zeros_like(samples), 0.0
    for rows, columns in bands:
        decoded[rows, columns], expected = survey(samples[rows, columns], quantum, care[rows, columns])
        size_bytes += LENGTH.size + expected
    return fill_rings(selection, decoded), size_bytes


def decode_selection(selection: Selection, payload: bytes, codec: RangeCodec, quality: int) -> StepArray:
    """Samples of a payload, those left out interpolated. sample_shape uint16. Raises CodecError."""
    bands = _bands(selection)
    if not bands:
        return decode_range(payload, codec, selection.sample_shape, quality)
    decoded = np.zeros(selection.sample_shape, np.uint16)
    for (rows, columns), part in zip(bands, _parts(payload, len(bands)), strict=True):
        decoded[rows, columns] = decode_range(part, codec, (rows.stop - rows.start, columns.size), quality)
    return fill_rings(selection, decoded)


def _bands(selection: Selection) -> list[Band]:
    """Runs of sample rows that keep the same columns; none at all where no row is thinned."""
    rings = thinned_rings(selection)
    if not rings:
        return []
    kept = {row: np.flatnonzero(ring.part == 0) for ring in rings for row in ring.row.tolist()}
    every = np.arange(selection.x.sample.size)
    bands: list[Band] = []
    for row in range(selection.y.sample.size):
        columns = kept.get(row, every)
        if bands and np.array_equal(bands[-1][1], columns):
            bands[-1] = slice(bands[-1][0].start, row + 1), columns
        else:
            bands.append((slice(row, row + 1), columns))
    return bands


def _parts(payload: bytes, count: int) -> Iterator[bytes]:
    for _ in range(count):
        if len(payload) < LENGTH.size:
            raise CodecError("the range of a ring is missing")
        end = LENGTH.size + LENGTH.unpack_from(payload)[0]
        if len(payload) < end:
            raise CodecError("the range of a ring is cut short")
        yield payload[LENGTH.size : end]
        payload = payload[end:]
    if payload:
        raise CodecError(f"{len(payload)} bytes after the last ring's range")
