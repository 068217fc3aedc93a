"""Lossy texture as HTJ2K, its colours turned first to the axes along which this image varies.

The axes that JPEG 2000 has suit all images on average. Those of one image, of which its own red, green and blue are
best made up, take 5 to 25% off its bytes. A payload is

    sixteenths of a step of quality (u8) | the turn as a quaternion (4 i8) | an HTJ2K payload

and the image in it, of 16 bits a sample, is what HTJ2K's own colour transform makes the turned colours of.
"""

from __future__ import annotations

import math
import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol import codec_htj2k
from protocol.errors import CodecError
from protocol.grid import FloatArray, ImageArray

SIXTEENTHS = 16
_PREFIX = struct.Struct(">B4b")
_UNIT = 127  # of a quaternion's numbers
_SCALE = codec_htj2k.LEVEL / math.sqrt(3)  # of turned colours: with it the first axis of a grey image is its mean
_MIDDLE = 1 << 15
_GREY = 128
Turn = tuple[int, ...]
_EVERY = 2  # of an image's rows, with the one below: as many tell its axes, of a large one ...
_TEXELS = 1 << 15  # ... so many texels
# Colours of Y Cb Cr, and back (ISO/IEC 15444-1 G.3).
_FROM_YCC = np.array([[1, 0, 1.402], [1, -0.114 * 1.772 / 0.587, -0.299 * 1.402 / 0.587], [1, 1.772, 0]])
_TO_YCC: FloatArray = np.linalg.inv(_FROM_YCC)


def encode(image: ImageArray, quality: float, turn: Turn | None = None) -> bytes:
    """Payload of an (h, w, 3) uint8 RGB image.

    quality : 0..LOSSY_MAX in sixteenths, step 2**(-quality/8). Raises CodecError for any other.
    turn : of its colours, as of turn_of; None: the image's own.
    """
    whole, sixteenths = divmod(round(quality * SIXTEENTHS), SIXTEENTHS)
    turn = turn_of(image) if turn is None else turn
    matrix = _SCALE * _FROM_YCC @ _axes(turn)
    offset = _MIDDLE - matrix @ np.full(3, _GREY)
    turned = cv2.transform(image.astype(np.uint16), np.column_stack([matrix, offset]))
    return _PREFIX.pack(sixteenths, *turn) + codec_htj2k.encode(turned, whole + sixteenths / SIXTEENTHS)


def decode(payload: bytes, shape: tuple[int, int], quality: int) -> ImageArray:
    """(h, w, 3) uint8 RGB of a payload, shape = (h, w), quality its whole steps. Raises CodecError."""
    sixteenths, turn = _read_prefix(payload)
    exact = quality + sixteenths / SIXTEENTHS
    turned = codec_htj2k.decode(payload[_PREFIX.size :], (*shape, 3), exact)
    matrix = _axes(turn).T @ _TO_YCC / _SCALE
    offset = _GREY - matrix @ np.full(3, _MIDDLE)
    values = cv2.transform(turned, np.column_stack([matrix, offset]))
    return np.asarray(cv2.convertScaleAbs(values).reshape(values.shape), np.uint8)


def restore(payload: bytes, shape: tuple[int, int], quality: int) -> bytes:
    """The whole code stream of a payload, headers rebuilt. Raises CodecError."""
    sixteenths, _ = _read_prefix(payload)
    return codec_htj2k.restore(payload[_PREFIX.size :], (*shape, 3), quality + sixteenths / SIXTEENTHS)


def _read_prefix(payload: bytes) -> tuple[int, Turn]:
    if len(payload) < _PREFIX.size:
        raise CodecError("texture payload is cut short")
    sixteenths, *turn = _PREFIX.unpack_from(payload)
    if sixteenths >= SIXTEENTHS or not any(turn):
        raise CodecError("texture payload with more than sixteenths, or turned by nothing")
    return sixteenths, tuple(turn)


def turn_of(image: ImageArray) -> Turn:
    """The axes along which neighbouring texels of an (h, w, 3) uint8 image differ most and least. In 127ths."""
    every = max(image.shape[0] * image.shape[1] // _TEXELS, _EVERY)
    rows, below = np.ascontiguousarray(image[:-1:every]), np.ascontiguousarray(image[1::every])
    varied, steps = np.zeros((3, 3)), list[tuple[NDArray[Any], NDArray[Any]]]()
    for k in range(3 if rows.size and rows.shape[1] > 1 else 0):
        plane, plane_below = cv2.extractChannel(rows, k), cv2.extractChannel(below, k)
        across = cv2.subtract(plane[:, 1:], plane[:, :-1], dtype=cv2.CV_32F).ravel()
        steps.append((across, cv2.subtract(plane_below, plane, dtype=cv2.CV_32F).ravel()))
        varied[k, : k + 1] = [across @ other + steps[k][1] @ down for other, down in steps]
    _, axes = np.linalg.eigh(varied)  # reads the lower triangle
    axes = axes.T[::-1]
    quaternion = _quaternion(axes if np.linalg.det(axes) > 0 else -axes)
    return tuple(np.rint(_UNIT * quaternion).astype(int).tolist())


def _quaternion(m: FloatArray) -> FloatArray:
    """Of a rotation matrix, (w, x, y, z): the last eigenvector of Bar-Itzhack's symmetric matrix."""
    symmetric = np.array([
        [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
        [0, m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
        [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
        [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]],
    ])
    _, vectors = np.linalg.eigh(symmetric, UPLO="U")
    return np.asarray(vectors[:, -1])


def _axes(turn: Turn) -> FloatArray:
    """The rotation matrix of a quaternion of any length."""
    w, x, y, z = np.array(turn, np.float64) / math.hypot(*turn)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])
