"""PLY, binary: positions in millimetres, z up, with normals and the texture's colour at each vertex."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np

from exchange.mesh import GridMesh, Seam
from protocol.grid import Grid

HEADER = """ply
format binary_little_endian 1.0
comment foveascan: millimetres, z up
element vertex {vertices}
property float x
property float y
property float z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
element face {faces}
property list uchar uint vertex_indices
end_header
"""
VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("colour", "u1", 3)])
FACE = np.dtype([("corners", "u1"), ("numbers", "<u4", 3)])


def write_ply(grid: Grid, file: BinaryIO) -> None:
    """Write a grid as PLY. Raises ExchangeError for one that spans no surface."""
    mesh = GridMesh(grid, Seam.SHARED)
    file.write(HEADER.format(vertices=mesh.vertices, faces=mesh.faces).encode())
    for band in mesh.bands():
        position = mesh.positions(band)
        vertices = np.empty(len(position), VERTEX)
        vertices["position"] = position
        vertices["normal"] = mesh.normals(band)
        vertices["colour"] = mesh.colours(band)
        file.write(vertices.tobytes())
    for numbers in mesh.face_bands():
        faces = np.empty(len(numbers), FACE)
        faces["corners"] = 3
        faces["numbers"] = numbers
        file.write(faces.tobytes())
