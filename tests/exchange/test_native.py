"""Grids as .npz: bit for bit there and back, and a clear refusal of everything else."""

import io
import struct
import tracemalloc
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given

from exchange.errors import ExchangeError
from exchange.formats import read_scan
from exchange.native import read_native, write_native
from protocol.grid import Grid
from tests.exchange.grids import grids, vase

FIELDS: dict[str, Any] = {
    "depth_u16": np.arange(12, dtype=np.uint16).reshape(3, 4),
    "scale_mm": 0.01,
    "z_min_mm": 10.0,
    "z_max_mm": 25.0,
    "theta0_rad": 0.5,
    "name": "bust",
}
TEXTURE = np.full((5, 6, 3), (200, 20, 10), np.uint8)


def packed(**changed: Any) -> io.BytesIO:
    file = io.BytesIO()
    np.savez_compressed(file, **{key: value for key, value in (FIELDS | changed).items() if value is not None})
    return file


@given(grids())
def test_a_grid_comes_back_bit_for_bit(grid: Grid) -> None:
    file = io.BytesIO()
    write_native(grid, file, "vase")
    name, back, _ = read_native(file)
    assert name == "vase" and back.spec == grid.spec
    assert np.array_equal(back.range_steps, grid.range_steps) and np.array_equal(back.texture, grid.texture)


def test_repairs_come_back_and_only_where_the_grid_has_such_cells() -> None:
    repairs = np.array([[0, 3, 0], [2, 1, 700]], np.int32)
    file = io.BytesIO()
    write_native(replace(vase(), repairs=repairs), file)
    back = read_native(file)[1]
    assert np.array_equal(back.repairs, repairs)
    assert np.argwhere(back.filled).tolist() == [[r, c] for r, c, _ in repairs.tolist() if back.range_steps[r, c]]
    for wrong in ([[0, 0, 0], [0, 0, 0]], [[0, 3, 0], [0, 2, 0]], [[3, 0, 0]], [[0, 4, 0]], [[0, 0, 65536]], [[0, 0]]):
        with pytest.raises(ExchangeError, match="repairs"):
            read_native(packed(texture=TEXTURE, repairs=np.array(wrong, np.int32)))


def test_a_grid_as_make_cyl_writes_it_with_its_image_beside(tmp_path: Path) -> None:
    (tmp_path / "grid.npz").write_bytes(packed(meta="{}").getvalue())
    cv2.imwrite(str(tmp_path / "colour.png"), TEXTURE[..., ::-1])
    name, grid, _ = read_scan(tmp_path / "grid.npz", tmp_path / "colour.png")
    spec = grid.spec
    assert name == "bust" and np.array_equal(grid.range_steps, FIELDS["depth_u16"])
    assert (spec.step_mm, spec.pitch_mm, spec.z_max_mm, spec.theta0_rad) == (0.01, 5.0, 25.0, 0.5)
    assert np.array_equal(grid.texture, TEXTURE)


def test_fortran_order_and_big_endian_samples_are_understood() -> None:
    depth = np.asfortranarray(FIELDS["depth_u16"].astype(">u2"))
    grid = read_native(packed(depth_u16=depth, texture=TEXTURE))[1]
    assert np.array_equal(grid.range_steps, FIELDS["depth_u16"]) and grid.range_steps.dtype == np.uint16


def test_a_grid_without_a_name_is_called_by_its_file(tmp_path: Path) -> None:
    (tmp_path / "torso.npz").write_bytes(packed(name=None, texture=TEXTURE).getvalue())
    assert read_scan(tmp_path / "torso.npz")[0] == "torso"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"depth_u16": None}, "depth_u16: missing"),
        ({"theta0_rad": None}, "theta0_rad: missing"),
        ({"texture": None}, "texture: missing; give its image with --texture"),
        ({"depth_u16": np.zeros((3, 4), np.float32)}, "depth_u16: expected 2 dimensions of uint16"),
        ({"depth_u16": np.zeros(12, np.uint16)}, "depth_u16: expected 2 dimensions"),
        ({"depth_u16": np.zeros((0, 4), np.uint16)}, "pitch_mm|height"),
        ({"depth_u16": np.array([[{}]], dtype=object)}, "depth_u16: expected 2 dimensions of uint16, got object"),
        ({"texture": np.zeros((4, 4, 4), np.uint8)}, "texture must be"),
        ({"scale_mm": -1.0}, "step_mm"),
        ({"scale_mm": np.nan}, "scale_mm: must be finite"),
        ({"scale_mm": np.zeros(3)}, "scale_mm: expected 0 dimensions"),
        ({"scale_mm": np.array("fine")}, "scale_mm: expected 0 dimensions of floating"),
        ({"z_max_mm": 10.0}, "pitch_mm"),
        ({"pitch_mm": 4.9}, "pitch_mm: 4.9 contradicts"),
        ({"name": "x" * 201}, "name: 201 characters"),
        ({"name": 5}, "name: expected"),
        ({f"extra{n}": 0 for n in range(70)}, "members, at most"),
    ],
)
def test_a_file_that_is_no_grid_is_refused_by_field(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ExchangeError, match=message):
        read_native(packed(**{"texture": TEXTURE} | changed))


def _claiming(shape: tuple[int, ...]) -> io.BytesIO:
    """A grid whose depth says it has this shape, and holds next to nothing."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<u2", "fortran_order": False, "shape": shape})
    file = packed(depth_u16=None, texture=TEXTURE)
    with zipfile.ZipFile(file, "a") as archive:
        archive.writestr("depth_u16.npy", header.getvalue() + bytes(24))
    return file


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ((10**9, 10**9), "depth_u16: 2000000000000000000 bytes, at most"), ((3, 5), "24 of 30"), ((3, 3), "or more"),
        ((-1, 4), "depth_u16: is no array"), ((-3, -4), "depth_u16: is no array"),
    ],
)  # fmt: skip
def test_a_shape_is_checked_before_anything_is_allocated(shape: tuple[int, ...], message: str) -> None:
    with pytest.raises(ExchangeError, match=message):
        read_native(_claiming(shape))


HEADER = b"{'descr': '<u2', 'fortran_order': False, 'shape': (-1, 4), }\n"
BOMBS = {
    "a shape below nought": b"\x93NUMPY\x01\x00" + struct.pack("<H", len(HEADER)) + HEADER,
    "a header of gigabytes": b"\x93NUMPY\x02\x00" + struct.pack("<I", 0xFFFFFFFF),
}


@pytest.mark.parametrize("beginning", BOMBS.values(), ids=BOMBS)
def test_an_array_that_unpacks_without_end_is_not_unpacked(beginning: bytes) -> None:
    file = packed(depth_u16=None, texture=TEXTURE)
    with zipfile.ZipFile(file, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("depth_u16.npy", beginning + bytes(32 << 20))
    tracemalloc.start()
    try:
        with pytest.raises(ExchangeError, match="depth_u16: is no array"):
            read_native(file)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


def test_a_reader_with_less_room_says_so() -> None:
    with pytest.raises(ExchangeError, match="texture: 90 bytes, at most 80"):
        read_native(packed(texture=TEXTURE), array_bytes_max=80)


@pytest.mark.parametrize("content", [b"", b"garbage", b"PK\x03\x04 not really"])
def test_garbage_is_refused(content: bytes) -> None:
    with pytest.raises(ExchangeError, match=r"is no \.npz file, or damaged"):
        read_native(io.BytesIO(content))


@pytest.mark.parametrize("cut", [1, 40, 300])
def test_a_cut_file_is_refused(cut: int) -> None:
    with pytest.raises(ExchangeError, match=r"is no \.npz file, or damaged"):
        read_native(io.BytesIO(packed(texture=TEXTURE).getvalue()[:-cut]))


def test_a_rotten_byte_is_refused() -> None:
    file = io.BytesIO()
    write_native(vase(), file)
    data = bytearray(file.getvalue())
    data[data.index(b"depth_u16.npy") + 900] ^= 1
    with pytest.raises(ExchangeError, match="damaged"):
        read_native(io.BytesIO(data))


def test_a_header_that_is_no_python_is_a_damaged_array() -> None:
    damaged = io.BytesIO()
    with zipfile.ZipFile(packed(texture=TEXTURE)) as sound, zipfile.ZipFile(damaged, "w") as archive:
        for name in sound.namelist():
            archive.writestr(name, sound.read(name).replace(b"'<u2'", b"'<02'"))
    with pytest.raises(ExchangeError, match="depth_u16: is no array"):
        read_native(damaged)
