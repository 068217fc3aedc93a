"""Meshes as other programs write them (GLB, glTF, OBJ, PLY, STL, OFF), read by trimesh, in the turntable's frame."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import trimesh

from exchange.cast import Mesh
from exchange.errors import ExchangeError
from exchange.points import Points
from protocol.grid import HEIGHT_MAX, WIDTH_MAX, FloatArray, ImageArray

FILE_BYTES_MAX = 1 << 30
JSON_BYTES_MAX = 1 << 26
FACES_MAX = 20_000_000
UV_MAX = 1e6
GREY = 128
NO_MESH = "is no {} file, or damaged: open it in the program that wrote it, and export it anew"
MM_PER_M = 1000.0

# Rows: where x, y and z of the turntable come from.
UP: Mapping[str, FloatArray] = MappingProxyType(
    {
        "z": np.eye(3),
        "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
        "x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
        "-z": np.diag([1.0, -1, -1]),
        "-y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
        "-x": np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]]),
    }
)
GLTF = (".glb", ".gltf")
Solid = trimesh.Trimesh | trimesh.PointCloud
SUFFIXES = (*GLTF, ".obj", ".ply", ".stl", ".off")


@dataclass(frozen=True, slots=True)
class Placing:
    """How a mesh stands on the turntable.

    up : the file's axis that points up (a key of UP).    unit_mm : millimetres of the file's unit.
    centred : put the middle of its bounds on the axis, else the axis is where the file has it.
    None: as the format demands: glTF in metres with y up; any other in millimetres with z up.
    """

    up: str | None = None
    unit_mm: float | None = None
    centred: bool = False


def read_mesh(path: Path, placing: Placing = Placing(), texture: ImageArray | None = None) -> Mesh | Points:
    """The triangles of a file, or its points where it has none. texture : an image instead of the file's own.

    A face without texture has its corners', its own or its material's colour, and grey without any. Raises
    ExchangeError for a file that is no mesh we read, or one that stands beside the axis; OSError for one that cannot
    be opened.
    """
    suffix = path.suffix.lower()
    if path.stat().st_size > FILE_BYTES_MAX:
        raise ExchangeError(f"{path}: larger than {FILE_BYTES_MAX} bytes")
    if suffix in GLTF:
        _check_gltf(path)
    up = UP[placing.up or ("y" if suffix in GLTF else "z")]
    turn = up * (placing.unit_mm or (MM_PER_M if suffix in GLTF else 1.0))
    found = _load(path)
    parts = [_part(geometry, matrix, texture) for geometry, matrix in found if isinstance(geometry, trimesh.Trimesh)]
    if texture is not None and not any(part.images for part in parts):
        raise ExchangeError(f"{path}: has no texture coordinates for the image given")
    if not parts:
        points = _points(found)
        return Points(_on_axis(path, points.positions @ turn.T, placing.centred), points.colours)
    mesh = _joined(path, parts)
    corners = _on_axis(path, mesh.corners @ turn.T, placing.centred)
    return Mesh(corners, mesh.image, mesh.uv, mesh.colours, mesh.images)


def _load(path: Path) -> list[tuple[Solid, FloatArray]]:
    """Every mesh and point cloud of a file, and the 4 x 4 matrix by which its scene places it."""
    try:
        scene = trimesh.load_scene(path, process=False)
        nodes = [scene.graph[name] for name in scene.graph.nodes_geometry]
    except OSError:
        raise
    except Exception as problem:  # readers of a dozen formats raise whatever comes to their mind over bad bytes
        raise ExchangeError(f"{path}: {NO_MESH.format(path.suffix.lower())}") from problem
    placed = [(scene.geometry[name], np.asarray(matrix, np.float64)) for matrix, name in nodes]
    found = [(solid, matrix) for solid, matrix in placed if isinstance(solid, Solid) and _size(solid)]
    size = sum(_size(solid) for solid, _ in found)
    if not size:
        raise ExchangeError(f"{path}: has no faces and no points, so it is empty or damaged")
    if size > FACES_MAX:
        raise ExchangeError(f"{path}: {size} faces or points, at most {FACES_MAX}")
    return found


def _size(solid: Solid) -> int:
    return len(solid.faces if isinstance(solid, trimesh.Trimesh) else solid.vertices)


def _points(found: list[tuple[Solid, FloatArray]]) -> Points:
    """Point clouds as one; grey where they have no colours."""
    positions = [_placed(cloud, matrix) for cloud, matrix in found]
    colours = [_point_colours(cloud) for cloud, _ in found]
    return Points(np.concatenate(positions), np.concatenate(colours))


def _placed(solid: Solid, matrix: FloatArray) -> FloatArray:
    """Where a scene has a solid's vertices. (n, 3) float64"""
    vertices = np.asarray(solid.vertices, np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ExchangeError(f"vertices: expected three numbers each, got an array of {vertices.shape}")
    turned: FloatArray = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    return turned


def _point_colours(cloud: Any) -> ImageArray:
    colours = np.asarray(cloud.colors)
    if len(colours) == len(cloud.vertices):
        return colours[:, :3].astype(np.uint8)
    return np.full((len(cloud.vertices), 3), GREY, np.uint8)


def _part(geometry: trimesh.Trimesh, placed: FloatArray, texture: ImageArray | None) -> Mesh:
    faces = np.asarray(geometry.faces)
    if faces.min() < 0 or faces.max() >= len(geometry.vertices):
        raise ExchangeError("faces: a vertex that does not exist")
    corners = _placed(geometry, placed)[faces]
    visual = geometry.visual
    uv = getattr(visual, "uv", None)
    if uv is not None and np.shape(uv) != (len(geometry.vertices), 2):
        uv = None  # not two numbers for each vertex
    image = texture if texture is not None else _image(visual)
    if uv is not None and image is not None:
        return _coloured(corners, np.asarray(uv, np.float32)[faces], None, image)
    return _coloured(corners, None, _corner_colours(visual, faces), None)


def _coloured(corners: FloatArray, uv: Any, colours: Any, image: ImageArray | None) -> Mesh:
    """One part; uv, or colours, or neither for grey."""
    m = len(corners)
    uv = np.zeros((m, 3, 2), np.float32) if uv is None else uv
    colours = np.broadcast_to(np.uint8(GREY), (m, 3, 3)) if colours is None else colours
    return Mesh(corners, np.full(m, -1 if image is None else 0), uv, colours, () if image is None else (image,))


def _image(visual: Any) -> ImageArray | None:
    """The picture of a material as trimesh found it (a Pillow image), bounded before it is decoded."""
    material = getattr(visual, "material", None)
    picture = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    if picture is None:
        return None
    if picture.width > WIDTH_MAX or picture.height > HEIGHT_MAX:
        raise ExchangeError(f"texture: {picture.width} x {picture.height} texels, at most {WIDTH_MAX} x {HEIGHT_MAX}")
    try:
        return np.asarray(picture.convert("RGB"))
    except (OSError, ValueError, SyntaxError) as problem:
        raise ExchangeError(f"texture: a damaged image of {picture.width} x {picture.height} texels") from problem


def _corner_colours(visual: Any, faces: Any) -> Any:
    kind = getattr(visual, "kind", None)
    if kind == "vertex":
        return np.asarray(visual.vertex_colors, np.uint8)[:, :3][faces]
    if kind == "face":
        return np.repeat(np.asarray(visual.face_colors, np.uint8)[:, None, :3], 3, axis=1)
    colour = getattr(getattr(visual, "material", None), "main_color", None)
    return None if colour is None else np.broadcast_to(np.asarray(colour, np.uint8)[:3], (*faces.shape, 3))


def _joined(path: Path, parts: list[Mesh]) -> Mesh:
    images: list[ImageArray] = []
    numbers = []
    for part in parts:
        numbers.append(np.where(part.image < 0, -1, part.image + len(images)))
        images += part.images
    corners, uv, colours = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("corners", "uv", "colours")
    )
    if not np.isfinite(corners).all() or not np.isfinite(uv).all():
        raise ExchangeError(f"{path}: vertices: a coordinate is not finite")
    if (np.abs(uv) > UV_MAX).any():
        raise ExchangeError(f"{path}: texture coordinates: beyond {UV_MAX:g} repeats of the image")
    return Mesh(corners, np.concatenate(numbers), uv, colours, tuple(images))


def _on_axis(path: Path, corners: FloatArray, centred: bool) -> FloatArray:
    low, high = corners.reshape(-1, 3).min(axis=0), corners.reshape(-1, 3).max(axis=0)
    if centred:
        middle: FloatArray = (low + high) / 2 * (1, 1, 0)
        return np.subtract(corners, middle)
    if (low[:2] > 0).any() or (high[:2] < 0).any():
        raise ExchangeError(f"{path}: stands beside the axis x = y = 0 of the turntable; centre it: --centre")
    return corners


def _check_gltf(path: Path) -> None:
    """Bound what the counts in a glTF make its reader allocate: an accessor without data is filled with zeros."""
    try:
        accessors = json.loads(_gltf_json(path)).get("accessors", [])
        for number, accessor in enumerate(accessors):
            if not 0 <= int(accessor["count"]) <= 3 * FACES_MAX:
                raise ExchangeError(f"{path}: accessors[{number}].count: {accessor['count']}, at most {3 * FACES_MAX}")
    except (ValueError, OverflowError, TypeError, KeyError, AttributeError, RecursionError, struct.error) as problem:
        raise ExchangeError(f"{path}: {NO_MESH.format(path.suffix.lower())}") from problem


def _gltf_json(path: Path) -> bytes:
    with open(path, "rb") as file:
        size = JSON_BYTES_MAX
        if path.suffix.lower() == ".glb":
            magic, _, _, size, kind = struct.unpack("<4sIII4s", file.read(20))
            if magic != b"glTF" or kind != b"JSON" or size > JSON_BYTES_MAX:
                raise ValueError(f"a first chunk {kind!r} of {size} bytes")
        return file.read(size)
