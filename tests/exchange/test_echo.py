"""Cyberware Echo files: where their samples stand, and a refusal by field of what is none."""

import io
import math
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from exchange.echo import read_echo
from exchange.errors import ExchangeError
from exchange.formats import read_scan
from protocol.grid import VOID

NLG, NLT = 8, 5
HEADER = {
    "NAME": "Jane Doe",
    "SPACE": "CYLINDRICAL",
    "NLG": NLG,
    "NLT": NLT,
    "LGINCR": round(2e6 * math.pi / NLG),
    "LTINCR": 700,
    "RSHIFT": 3,
}
RADII = np.arange(100, 100 + NLG * NLT).reshape(NLG, NLT)  # longitude by longitude, from the lowest latitude


def echo(radii: NDArray[np.int64] = RADII, /, **changed: object) -> bytes:
    fields = {key: value for key, value in (HEADER | changed).items() if value is not None}
    lines = ["Cyberware Digitizer Data", *(f"{key}={value}" for key, value in fields.items()), "DATA="]
    return "\n".join(lines).encode() + b"\n" + radii.astype(">i2").tobytes()


def placed(longitude: int, latitude: int, handed: int) -> tuple[float, float, float]:
    """x, y, z [mm] of a sample: longitude 0 at the back (y), going clockwise (or not) seen from above."""
    radius = RADII[longitude, latitude] * 8 / 1000
    angle = math.pi / 2 + handed * longitude * 2 * math.pi / NLG
    return radius * math.cos(angle), radius * math.sin(angle), (latitude - NLT // 2) * 0.7


@pytest.mark.parametrize(("flag", "handed"), [({}, -1), ({"THETA_RIGHTHAND": "TRUE"}, 1)])
def test_every_sample_stands_where_the_scanner_saw_it(flag: dict[str, str], handed: int) -> None:
    grid = read_echo(io.BytesIO(echo(**flag)))
    spec = grid.spec
    row, column = np.mgrid[:NLT, :NLG]
    angle, radius = spec.angle_rad(column), grid.range_mm.astype(np.float64)
    ours = np.stack([radius * np.cos(angle), radius * np.sin(angle), spec.height_mm(row)], axis=-1).reshape(-1, 3)
    truth = np.array([placed(g, t, handed) for g in range(NLG) for t in range(NLT)])
    distance = np.linalg.norm(ours[:, None] - truth, axis=2)
    assert distance.min(axis=1).max() < 1e-5 and distance.min(axis=0).max() < 1e-5


def test_radii_stay_exact_steps_and_void_is_void() -> None:
    radii = RADII.copy()
    radii[3, 1] = -0x8000
    grid = read_echo(io.BytesIO(echo(radii)))
    assert grid.spec.step_mm == 0.008 and grid.spec.pitch_mm == 0.7
    assert np.count_nonzero(grid.range_steps == VOID) == 1 and grid.range_steps[NLT - 2, NLG - 4] == VOID
    assert np.array_equal(grid.range_steps[::-1, ::-1].T[radii > 0], radii[radii > 0])


@given(st.integers(1, 8))
def test_longitudes_missing_to_a_turn_are_void(longitudes: int) -> None:
    grid = read_echo(io.BytesIO(echo(RADII[:longitudes], NLG=longitudes)))
    assert grid.spec.width == 8 and np.count_nonzero(grid.range_steps) == longitudes * NLT
    assert np.array_equal(grid.range_steps[::-1, ::-1].T[:longitudes], RADII[:longitudes])


def test_its_colour_image_beside_it_is_turned_with_it(tmp_path: Path) -> None:
    (tmp_path / "head.echo").write_bytes(echo())
    image = np.zeros((NLT, NLG, 3), np.uint8)
    image[0, 1] = (10, 20, 200)  # the highest latitude of longitude 1
    cv2.imwrite(str(tmp_path / "head.png"), image[..., ::-1])
    name, grid, _ = read_scan(tmp_path / "head.echo")
    assert name == "head" and tuple(grid.texture[0, NLG - 2]) == (10, 20, 200)
    assert grid.range_steps[0, NLG - 2] == RADII[1, NLT - 1]


def test_without_an_image_it_is_grey() -> None:
    assert (read_echo(io.BytesIO(echo())).texture == 128).all()


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        *(({key: None}, f"{key}: missing") for key in ("NLG", "NLT", "LGINCR", "LTINCR", "RSHIFT")),
        *(({key: "many"}, f"{key}: expected a whole number") for key in ("NLG", "NLT", "LGINCR", "LTINCR", "RSHIFT")),
        ({"NLG": 10**9}, "NLG: expected a whole number from 1 to"),
        ({"NLT": -5}, "NLT: expected"),
        ({"NLT": "9" * 5000}, "NLT: expected"),
        ({"NLG": 9}, "LGINCR: .* into 9 columns"),
        ({"LGINCR": 5_000_000}, "LGINCR: "),
        ({"LGINCR": 1}, "LGINCR: "),
        ({"RSHIFT": 16}, "RSHIFT: "),
        ({"LTINCR": 5_000_000}, "pitch_mm"),
        ({"NLT": NLT + 1}, "DATA: expected 96 bytes for NLG x NLT, got 80"),
        ({"NLT": NLT - 1}, "DATA: expected 64 bytes for NLG x NLT, got more"),
        ({"SPACE": "CARTESIAN"}, "SPACE: 'CARTESIAN'"),
        ({"INSIDE_OUT": "1"}, "INSIDE_OUT"),
        ({"NAME": "caf\xe9"}, "header: not ASCII"),
    ],
)
def test_a_file_that_is_none_is_refused_by_field(changed: dict[str, object], message: str) -> None:
    with pytest.raises(ExchangeError, match=message):
        read_echo(io.BytesIO(echo(**changed)))


def test_a_radius_that_is_none_is_refused() -> None:
    radii = RADII.copy()
    radii[0, 0] = -3
    with pytest.raises(ExchangeError, match="DATA: a radius of 0 or less"):
        read_echo(io.BytesIO(echo(radii)))


@pytest.mark.parametrize("content", [b"", b"NLG=3\n", struct.pack(">h", 5) * 40000])
def test_a_file_without_data_is_refused(content: bytes) -> None:
    with pytest.raises(ExchangeError, match="DATA: no such line"):
        read_echo(io.BytesIO(content))
