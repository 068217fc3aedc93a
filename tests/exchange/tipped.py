"""What a turntable sees of a closed object that was laid down on it, not quite as it was meant to lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from exchange.cast import Mesh, cast_mesh, fit_spec
from exchange.fit import tipped_back
from exchange.mesh import GridMesh, Seam
from protocol.grid import FloatArray, Grid


def turned_by(degrees: tuple[float, float, float]) -> FloatArray:
    """Turns about x, then y, then z. (3, 3)"""
    turn = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        one, other = (axis + 1) % 3, (axis + 2) % 3
        about = np.eye(3)
        about[[one, other], [one, other]] = np.cos(angle)
        about[one, other], about[other, one] = -np.sin(angle), np.sin(angle)
        turn = about @ turn
    return turn


def surface(closed: Grid) -> Mesh:
    """A closed object as triangles with its texture, poles included."""
    pieces = [*GridMesh(closed, Seam.DOUBLED).textured_bands(), *_lids(closed)]
    corners, uv = (np.concatenate(part) for part in zip(*pieces, strict=True))
    uv = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1).astype(np.float32)
    return Mesh(corners, np.zeros(len(corners), np.int64), uv, np.zeros((0, 3, 3), np.uint8), (closed.texture,))


def _lids(closed: Grid) -> list[tuple[FloatArray, FloatArray]]:
    mesh = GridMesh(closed, Seam.SHARED)
    positions, uv = (
        np.concatenate([of(band) for band in mesh.bands()]) for of in (mesh.positions, mesh.texture_coordinates)
    )
    return [(positions[faces], uv[faces]) for faces in mesh._lids()]


def swept(closed: Grid, turn: FloatArray, shift_mm: FloatArray, size: tuple[int, int, int, int]) -> Grid:
    """A sweep of an object that stands turned and shifted."""
    mesh = surface(closed)
    corners = mesh.corners @ turn.T + shift_mm
    return cast_mesh(replace(mesh, corners=corners), fit_spec(corners, size))


def lying(
    closed: Grid, slip_deg: tuple[float, float, float], slip_mm: FloatArray, size: tuple[int, int, int, int]
) -> Grid:
    """A sweep of an object tipped over its front, its middle about on the axis."""
    turn = turned_by(slip_deg) @ tipped_back(90).T
    return swept(closed, turn, slip_mm - turn @ np.array([0, 0, closed.spec.z_max_mm]), size)
