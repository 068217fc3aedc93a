"""GLB: binary glTF 2.0 with its texture inside. Metres, Y up: (x, y, z) of the scan becomes (x, z, -y) / 1000."""

from __future__ import annotations

import json
import struct
from typing import Any, BinaryIO

import numpy as np

from exchange.errors import ExchangeError
from exchange.image import encode_png
from exchange.mesh import GridMesh, Seam
from protocol.grid import Grid

MM_PER_M = 1000
BYTES_MAX = 2**32 - 1
FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
LINEAR, LINEAR_MIPMAP_LINEAR, REPEAT, CLAMP_TO_EDGE = 9729, 9987, 10497, 33071
VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("uv", "<f4", 2)])
FACE_BYTES = 12


def write_glb(grid: Grid, file: BinaryIO) -> None:
    """Write a grid as GLB. Raises ExchangeError for one that spans no surface or is too large for the format."""
    mesh = GridMesh(grid, Seam.DOUBLED)
    texture = encode_png(grid.texture)
    texture += bytes(-len(texture) % 4)
    views = [mesh.vertices * VERTEX.itemsize, mesh.faces * FACE_BYTES, len(texture)]
    head = json.dumps(_document(mesh, views), separators=(",", ":")).encode()
    head += b" " * (-len(head) % 4)
    total = 12 + 8 + len(head) + 8 + sum(views)
    if total > BYTES_MAX:
        raise ExchangeError(f"a GLB of {total} bytes; the format ends at {BYTES_MAX}: export .ply instead")
    file.write(struct.pack("<4sII", b"glTF", 2, total))
    file.write(struct.pack("<I4s", len(head), b"JSON") + head)
    file.write(struct.pack("<I4s", sum(views), b"BIN\0"))
    _write_vertices(mesh, file)
    for faces in mesh.face_bands():
        file.write(faces.astype("<u4").tobytes())
    file.write(texture)


def _write_vertices(mesh: GridMesh, file: BinaryIO) -> None:
    for band in mesh.bands():
        position = _y_up(mesh.positions(band)) / MM_PER_M
        vertices = np.empty(len(position), VERTEX)
        vertices["position"] = position
        vertices["normal"] = _y_up(mesh.normals(band))
        vertices["uv"] = mesh.texture_coordinates(band)
        file.write(vertices.tobytes())


def _y_up(vectors: Any) -> Any:
    """(x, y, z) with z up to (x, z, -y) with y up. (n, 3)"""
    return vectors[:, [0, 2, 1]] * np.array([1, 1, -1], vectors.dtype)


def _bounds(mesh: GridMesh) -> tuple[list[float], list[float]]:
    """Smallest and largest coordinates, as float32 like the vertices they bound."""
    lows, highs = [], []
    for band in mesh.bands():
        position = (_y_up(mesh.positions(band)) / MM_PER_M).astype(np.float32)
        if len(position):
            lows.append(position.min(0))
            highs.append(position.max(0))
    return np.min(lows, 0).tolist(), np.max(highs, 0).tolist()


def _document(mesh: GridMesh, views: list[int]) -> dict[str, Any]:
    """The JSON part: one mesh, one material, one texture. views : bytes of vertices, faces and texture."""
    low, high = _bounds(mesh)
    vertices: dict[str, Any] = {"bufferView": 0, "componentType": FLOAT, "count": mesh.vertices}
    return {
        "asset": {"version": "2.0", "generator": "foveascan"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{
            "attributes": {"POSITION": 0, "NORMAL": 1, "TEXCOORD_0": 2}, "indices": 3, "material": 0,
        }]}],
        "materials": [{"pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0}, "metallicFactor": 0, "roughnessFactor": 1,
        }}],
        "textures": [{"source": 0, "sampler": 0}],
        "images": [{"bufferView": 2, "mimeType": "image/png"}],
        "samplers": [{
            "magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": REPEAT, "wrapT": CLAMP_TO_EDGE,
        }],
        "accessors": [
            {**vertices, "byteOffset": 0, "type": "VEC3", "min": low, "max": high},
            {**vertices, "byteOffset": 12, "type": "VEC3"},
            {**vertices, "byteOffset": 24, "type": "VEC2"},
            {"bufferView": 1, "componentType": UNSIGNED_INT, "count": 3 * mesh.faces, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": views[0], "byteStride": VERTEX.itemsize,
             "target": ARRAY_BUFFER},
            {"buffer": 0, "byteOffset": views[0], "byteLength": views[1], "target": ELEMENT_ARRAY_BUFFER},
            {"buffer": 0, "byteOffset": views[0] + views[1], "byteLength": views[2]},
        ],
        "buffers": [{"byteLength": sum(views)}],
    }  # fmt: skip
