"""Other sweeps of an object that was tipped, for what the first one could not see: laid on it, as triangles."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np

from exchange.cast import Mesh
from exchange.errors import ExchangeError
from exchange.fit import Fit, fit, tipped_back
from exchange.mesh import GridMesh, Seam
from protocol.grid import BoolArray, FloatArray, Grid
from protocol.sphere import DirectionGrid, directions

FACES_AT_ONCE = 1 << 18
AROUND_DEG = 2.0  # so far round what is missing a sweep's triangles are kept
TIP_DEG = 90.0


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """What an object looks like when it is tipped, by tip_deg over its front, or over its back if negative.

    surface : a cylinder's grid, or triangles. Raises ExchangeError for a sphere's grid.
    """

    surface: Grid | Mesh
    tip_deg: float = TIP_DEG

    def __post_init__(self) -> None:
        if isinstance(self.surface, Grid) and self.surface.spec.geometry != "cylinder":
            raise ExchangeError(f"sweep: is a {self.surface.spec.geometry}; give the cylinder it was made of")

    def fitted(self, base: Grid) -> Fit:
        """How it stands to the scan that it completes. Raises ExchangeError when it does not fit it."""
        return fit(self._points(), base, tipped_back(self.tip_deg))

    def pieces(self) -> Iterator[Mesh]:
        """Its triangles, some at a time, as they stand in it."""
        if isinstance(self.surface, Grid):
            no_colours = np.zeros((0, 3, 3), np.uint8)
            for corners, uv in GridMesh(self.surface, Seam.DOUBLED).textured_bands():
                v_up = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1).astype(np.float32)
                yield Mesh(corners, np.zeros(len(corners), np.int64), v_up, no_colours, (self.surface.texture,))
        else:
            for first in range(0, len(self.surface.corners), FACES_AT_ONCE):
                yield _some(self.surface, slice(first, first + FACES_AT_ONCE))

    def _points(self) -> FloatArray:
        if isinstance(self.surface, Grid):
            mesh = GridMesh(self.surface, Seam.SHARED)
            return np.concatenate([mesh.positions(band) for band in mesh.bands()])
        return np.asarray(self.surface.corners.mean(axis=1))


def surface_towards(sweep: Sweep, found: Fit, wanted: BoolArray, grid: DirectionGrid, centre_mm: float) -> Mesh | None:
    """What of a fitted sweep lies in the wanted directions (H, W) from a centre on the axis, and round them.

    None where there is nothing of it.
    """
    near = _grown(wanted)
    kept = []
    for piece in sweep.pieces():
        corners = found.pose.move(piece.corners)
        away = corners.mean(axis=1) - np.array([0.0, 0.0, centre_mm])
        away[~away.any(axis=1)] = (0, 0, 1)
        chosen = near[grid.snap(*directions(away))]
        if chosen.any():
            kept.append(_some(replace(piece, corners=corners), chosen))
    return _joined(kept) if kept else None


def _grown(wanted: BoolArray) -> BoolArray:
    height, width = wanted.shape
    rows = max(1, round(height * AROUND_DEG / 180))
    kernel = np.ones((2 * rows + 1, 2 * rows * width // (2 * height) * 2 + 3), np.uint8)
    edge = min(kernel.shape[1], width)
    wide = np.concatenate([wanted[:, -edge:], wanted, wanted[:, :edge]], axis=1).astype(np.uint8)
    return np.asarray(cv2.dilate(wide, kernel)[:, edge : edge + width] > 0)


def _some(mesh: Mesh, chosen: slice | BoolArray) -> Mesh:
    colours = mesh.colours[chosen] if len(mesh.colours) else mesh.colours
    return Mesh(mesh.corners[chosen], mesh.image[chosen], mesh.uv[chosen], colours, mesh.images)


def _joined(pieces: list[Mesh]) -> Mesh:
    """Pieces of one mesh as one."""
    corners, image, uv, colours = (
        np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("corners", "image", "uv", "colours")
    )
    return Mesh(corners, image, uv, colours, pieces[0].images)
