"""STL, binary: triangles only, millimetres, z up."""

from __future__ import annotations

import struct
from typing import BinaryIO

import numpy as np

from exchange.mesh import GridMesh, Seam
from protocol.grid import Grid

TITLE = b"foveascan, millimetres, z up"  # "solid" in front would make it look like the text form
FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def write_stl(grid: Grid, file: BinaryIO) -> None:
    """Write a grid as STL. Raises ExchangeError for one that spans no surface."""
    mesh = GridMesh(grid, Seam.SHARED)
    file.write(TITLE.ljust(80, b"\0") + struct.pack("<I", mesh.faces))
    for triangles in mesh.triangle_bands():
        faces = np.zeros(len(triangles), FACE)
        faces["corners"] = triangles
        normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        faces["normal"] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        file.write(faces.tobytes())
