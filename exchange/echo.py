"""Cyberware Echo range images: a cylinder of radii behind a header of NAME=VALUE lines that ends with `DATA=`.

    NLG, NLT        longitudes (columns) and latitudes (rows), all mandatory as are
    LGINCR, LTINCR  microradians between longitudes, micrometres between latitudes
    RSHIFT          a radius is its value shifted left by so many bits [micrometres]
    SPACE           CYLINDRICAL, or absent     THETA_RIGHTHAND  longitudes go counter-clockwise seen from above
    NAME            the subject; it stays behind, since names of scans are listed freely

Then int16, big-endian, one longitude after the other, each from its lowest latitude up; 0x8000 = void. Longitude 0
stands behind the subject and longitudes go clockwise unless THETA_RIGHTHAND says otherwise. A colour image beside the
file has the longitudes as its columns, from left to right, and the highest latitude at the top.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import BinaryIO

import numpy as np

from exchange.errors import ExchangeError
from protocol.grid import HEIGHT_MAX, VOID, WIDTH_MAX, Grid, GridSpec, ImageArray, StepArray

HEADER_BYTES_MAX = 65536
HEADER_END = b"\nDATA=\n"
VOID_RADIUS = -0x8000
GREY = 128
UM_PER_MM, URAD_PER_RAD = 1000, 1_000_000
INCREMENT_MAX = 10_000_000
SHIFT_MAX = 15


def is_echo(head: bytes) -> bool:
    """Whether a file that begins so (give it HEADER_BYTES_MAX) is an Echo file."""
    return HEADER_END in head


def read_echo(file: BinaryIO, texture: ImageArray | None = None) -> Grid:
    """A grid. texture : its colour image, (Ht, Wt, 3) uint8 RGB; without one it is grey.

    Longitudes that are missing to a full turn are void. Raises ExchangeError that names the field at fault.
    """
    head = file.read(HEADER_BYTES_MAX)
    end = head.find(HEADER_END)
    if end < 0:
        raise ExchangeError(f"DATA: no such line in the first {HEADER_BYTES_MAX} bytes")
    fields = _fields(head[:end])
    longitudes, latitudes = _whole(fields, "NLG", 1, WIDTH_MAX), _whole(fields, "NLT", 1, HEIGHT_MAX)
    width = _columns_in_a_turn(longitudes, _whole(fields, "LGINCR", 1, INCREMENT_MAX))
    file.seek(end + len(HEADER_END))
    radii = _read_radii(file, longitudes, latitudes)
    steps = np.full((latitudes, width), VOID, np.uint16)
    steps[:, :longitudes] = _steps(radii).T[::-1]
    colour = _colour(texture, latitudes, longitudes, width)
    clockwise = "THETA_RIGHTHAND" not in fields
    if clockwise:
        steps, colour = np.ascontiguousarray(steps[:, ::-1]), np.ascontiguousarray(colour[:, ::-1])
    return Grid(_spec(fields, steps, colour, clockwise), steps, colour)


def _fields(head: bytes) -> Mapping[str, str]:
    try:
        lines = head.decode("ascii").splitlines()
    except UnicodeDecodeError as problem:
        raise ExchangeError(f"header: not ASCII at byte {problem.start}") from None
    pairs = (line.partition("=") for line in lines)
    fields = {key.strip(): value.strip() for key, separator, value in pairs if separator}
    if fields.get("SPACE", "CYLINDRICAL") != "CYLINDRICAL":
        raise ExchangeError(f"SPACE: {fields['SPACE'][:40]!r}, only CYLINDRICAL can be read")
    if "INSIDE_OUT" in fields:
        raise ExchangeError("INSIDE_OUT: an inner surface can not be read")
    return fields


def _whole(fields: Mapping[str, str], key: str, low: int, high: int) -> int:
    text = fields.get(key)
    if text is None:
        raise ExchangeError(f"{key}: missing")
    if not (text.isascii() and text.isdigit() and len(text) <= 12 and low <= int(text) <= high):
        raise ExchangeError(f"{key}: expected a whole number from {low} to {high}, got {text[:40]!r}")
    return int(text)


def _columns_in_a_turn(longitudes: int, increment_urad: int) -> int:
    turn_urad = 2 * math.pi * URAD_PER_RAD
    columns = round(turn_urad / increment_urad)
    if not longitudes <= columns <= WIDTH_MAX or abs(columns * increment_urad - turn_urad) >= increment_urad / 2:
        raise ExchangeError(f"LGINCR: {increment_urad} urad does not divide a turn into {longitudes} columns or more")
    return columns


def _read_radii(file: BinaryIO, longitudes: int, latitudes: int) -> np.ndarray[tuple[int, int], np.dtype[np.int16]]:
    size = 2 * longitudes * latitudes
    data = file.read(size + 1)
    if len(data) != size:
        more = "more" if len(data) > size else f"{len(data)}"
        raise ExchangeError(f"DATA: expected {size} bytes for NLG x NLT, got {more}")
    return np.frombuffer(data, ">i2").astype(np.int16).reshape(longitudes, latitudes)


def _steps(radii: np.ndarray[tuple[int, int], np.dtype[np.int16]]) -> StepArray:
    void = radii == VOID_RADIUS
    if (radii[~void] <= 0).any():
        raise ExchangeError("DATA: a radius of 0 or less that is not void")
    return np.where(void, VOID, radii).astype(np.uint16)


def _colour(texture: ImageArray | None, latitudes: int, longitudes: int, width: int) -> ImageArray:
    """The texture over a full turn: black where the range is void because the file covers less."""
    if texture is None:
        texture = np.full((latitudes, longitudes, 3), GREY, np.uint8)
    missing = round(texture.shape[1] * (width - longitudes) / longitudes)
    return np.pad(texture, ((0, 0), (0, missing), (0, 0)))


def _spec(fields: Mapping[str, str], steps: StepArray, colour: ImageArray, clockwise: bool) -> GridSpec:
    """Geometry: longitude 0 is a sample's place, and so is latitude NLT / 2 at height 0."""
    height, width = steps.shape
    pitch_mm = _whole(fields, "LTINCR", 1, INCREMENT_MAX) / UM_PER_MM
    step_mm = (1 << _whole(fields, "RSHIFT", 0, SHIFT_MAX)) / UM_PER_MM
    z_max_mm = (height - 1 - height // 2 + 0.5) * pitch_mm
    half_column = math.pi / width
    theta0_rad = math.pi / 2 + (half_column if clockwise else -half_column)
    try:
        return GridSpec(width, height, colour.shape[1], colour.shape[0], step_mm, pitch_mm, z_max_mm, theta0_rad)
    except ValueError as problem:
        raise ExchangeError(str(problem)) from problem
