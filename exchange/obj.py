"""OBJ with its material and texture in one zip file. Millimetres, z up; v counts from the texture's bottom edge."""

from __future__ import annotations

import zipfile
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from exchange.image import encode_png
from exchange.mesh import GridMesh, Seam
from protocol.grid import Grid

MATERIAL = b"newmtl scan\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd texture.png\n"
HEAD = b"# foveascan: millimetres, z up\nmtllib model.mtl\nusemtl scan\n"
WHEN = (1980, 1, 1, 0, 0, 0)  # the same scan gives the same file


def write_obj_zip(grid: Grid, file: BinaryIO) -> None:
    """Write a grid as a zip of model.obj, model.mtl and texture.png. Raises ExchangeError for no surface.

    Positions are shared across the seam, texture coordinates are doubled there.
    """
    mesh, coordinates = GridMesh(grid, Seam.SHARED), GridMesh(grid, Seam.DOUBLED)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr(_member("model.mtl"), MATERIAL)
        archive.writestr(_member("texture.png", zipfile.ZIP_STORED), encode_png(grid.texture))
        with archive.open(_member("model.obj"), "w", force_zip64=True) as text:
            text.write(HEAD)
            for band in mesh.bands():
                text.write(_lines("v %.5f %.5f %.5f\n", mesh.positions(band)))
            for band in coordinates.bands():
                text.write(_lines("vt %.7f %.7f\n", coordinates.texture_coordinates(band) * (1, -1) + (0, 1)))
            for corners, texels in zip(mesh.face_bands(), coordinates.face_bands(), strict=True):
                numbers = np.stack([corners, texels], axis=2) + 1
                text.write(_lines("f %d/%d %d/%d %d/%d\n", numbers.reshape(-1, 6)))


def _lines(pattern: str, rows: NDArray[np.generic]) -> bytes:
    """One line of text for each row of numbers."""
    return (pattern * len(rows) % tuple(rows.ravel().tolist())).encode()


def _member(name: str, compression: int = zipfile.ZIP_DEFLATED) -> zipfile.ZipInfo:
    member = zipfile.ZipInfo(name, WHEN)
    member.compress_type = compression
    return member
