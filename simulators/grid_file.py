"""Grids on disk: an .npz with the keys of make_cyl.py and its image; the truth that a simulation leaves behind.

    depth_u16 (H, W) uint16, 0 = void    scale_mm, z_min_mm, z_max_mm, theta0_rad    name
    texture (Ht, Wt, 3) uint8 RGB: in truth files only
"""

from __future__ import annotations

import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.errors import ConfigError
from protocol.grid import HEIGHT_MAX, WIDTH_MAX, Grid, GridSpec, ImageArray

MEMBER_BYTES_MAX = WIDTH_MAX * HEIGHT_MAX * 3 + 4096
GEOMETRY = "scale_mm", "z_min_mm", "z_max_mm", "theta0_rad"


def read_grid(path: Path, texture_path: Path | None) -> tuple[str, Grid]:
    """A grid and its name. texture_path : an image; not needed where the file carries its texture.

    Raises ConfigError for a file that is no such grid, OSError for one that cannot be opened.
    """
    members = _read_members(path)
    try:
        depth = members["depth_u16"]
        texture = _read_texture(texture_path) if texture_path else members["texture"]
        grid = Grid(_spec(members, depth.shape, texture.shape), depth, texture)
    except KeyError as missing:
        cure = "; give its image with --texture" if missing.args == ("texture",) else ""
        raise ConfigError(f"specimen: {path} has no {missing}{cure}") from None
    except (TypeError, ValueError) as problem:
        raise ConfigError(f"specimen: {path}: {problem}") from problem
    return str(members.get("name", path.stem)), grid


def write_truth(path: Path, name: str, grid: Grid) -> None:
    """Write a grid with its texture so that the file is either whole or absent. read_grid reads it back."""
    spec = grid.spec
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", suffix=".tmp", delete=False) as file:
        try:
            np.savez(
                file,
                depth_u16=grid.range_steps,
                texture=grid.texture,
                scale_mm=np.float64(spec.step_mm),
                z_min_mm=np.float64(spec.z_max_mm - spec.height * spec.pitch_mm),
                z_max_mm=np.float64(spec.z_max_mm),
                theta0_rad=np.float64(spec.theta0_rad),
                name=np.str_(name),
            )
            file.flush()
            os.fsync(file.fileno())
            os.replace(file.name, path)
        except BaseException:
            os.unlink(file.name)
            raise


def _read_members(path: Path) -> Mapping[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(path) as archive:
            largest = max((member.file_size for member in archive.infolist()), default=0)
        if largest > MEMBER_BYTES_MAX:
            raise ConfigError(f"specimen: {path} holds an array of {largest} bytes, more than any grid")
        with np.load(path, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files}
    except ConfigError:
        raise
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError) as problem:
        raise ConfigError(f"specimen: {path} is no .npz grid: {problem}") from problem


def _read_texture(path: Path) -> ImageArray:
    data = np.frombuffer(path.read_bytes(), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if data.size else None
    if image is None:
        raise ConfigError(f"texture: {path} is no image that OpenCV reads")
    return np.asarray(image, np.uint8)


def _spec(members: Mapping[str, NDArray[Any]], depth: tuple[int, ...], texture: tuple[int, ...]) -> GridSpec:
    if len(depth) != 2 or len(texture) != 3:
        raise ValueError(f"depth_u16 {depth} and texture {texture} must have 2 and 3 dimensions")
    scale_mm, z_min_mm, z_max_mm, theta0_rad = (float(members[key]) for key in GEOMETRY)
    pitch_mm = (z_max_mm - z_min_mm) / depth[0]
    return GridSpec(depth[1], depth[0], texture[1], texture[0], scale_mm, pitch_mm, z_max_mm, theta0_rad)
