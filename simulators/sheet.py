"""The unrolled surface of a turn in millimetres, on which a face is drawn: s sideways, z up, 0 in front.

Shape and colour use the same few strokes (bumps, curves, spots), each touching only the window of the grid that it
reaches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol.grid import FloatArray, GridSpec
from simulators.noise import Plane
from simulators.shapes import texture_axes

ROUND_MM = 90.0
Point = tuple[float, float]
Window = tuple[slice, slice]


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """Coordinates of a grid's columns and rows. s : (n,) [mm], increasing from the seam at the back; z : (m,) [mm]"""

    s: Plane
    z: Plane

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        return len(self.z), len(self.s)

    def window(self, low: Point, high: Point) -> Window:
        """Rows and columns of the grid between two corners (s, z)."""
        columns = np.searchsorted(self.s, [low[0], high[0]])
        rows = np.searchsorted(-self.z, [-high[1], -low[1]])
        return slice(*(int(row) for row in rows)), slice(*(int(column) for column in columns))

    def within(self, window: Window) -> tuple[Plane, Plane]:
        """Coordinates inside a window, ready to broadcast. (1, w), (h, 1)"""
        return self.s[None, window[1]], self.z[window[0], None]


def range_sheet(spec: GridSpec) -> Sheet:
    """The sheet of a grid's range samples."""
    return Sheet(_unrolled(spec.angle_rad(np.arange(spec.width))), spec.height_mm(np.arange(spec.height)).astype("f4"))


def texture_sheet(spec: GridSpec) -> Sheet:
    """The sheet of a grid's texels."""
    theta, z_mm = texture_axes(spec)
    return Sheet(_unrolled(theta), z_mm.astype(np.float32))


def add_bump(plane: Plane, sheet: Sheet, centre: Point, sigma: Point, amount: float) -> None:
    """A Gaussian bump. centre, sigma : (s, z) [mm]"""
    reach = 3.6
    low = centre[0] - reach * sigma[0], centre[1] - reach * sigma[1]
    high = centre[0] + reach * sigma[0], centre[1] + reach * sigma[1]
    window = sheet.window(low, high)
    s, z = sheet.within(window)
    across, up = (s - centre[0]) / sigma[0], (z - centre[1]) / sigma[1]
    plane[window] += np.float32(amount) * np.exp(-0.5 * up * up) * np.exp(-0.5 * across * across)


def add_spot(plane: Plane, sheet: Sheet, centre: Point, radius: float, amount: float, lobes: float = 0.0) -> None:
    """A disc with a soft rim. radius [mm]; lobes : phase of its irregular outline [rad]"""
    reach = 1.6 * radius
    window = sheet.window((centre[0] - reach, centre[1] - reach), (centre[0] + reach, centre[1] + reach))
    s, z = sheet.within(window)
    across, up = s - centre[0], z - centre[1]
    angle = np.arctan2(up, across)
    outline = 1 + 0.17 * np.sin(2 * angle + lobes) + 0.06 * np.sin(3 * angle - 2 * lobes)
    plane[window] += np.float32(amount) * smooth_step((1.4 - np.hypot(across, up) / (radius * outline)) / 0.8)


def add_curve(plane: Plane, sheet: Sheet, points: Sequence[Point], sigma: float, amount: float) -> None:
    """A ridge or groove of Gaussian section along a polyline, fading towards its ends. sigma [mm]"""
    path = _rounded(np.array(points, np.float32))
    low, high = path.min(0) - 3.2 * sigma, path.max(0) + 3.2 * sigma
    window = sheet.window((low[0], low[1]), (high[0], high[1]))
    patch = Sheet(sheet.s[window[1]], sheet.z[window[0]])
    distance, along = _to_path(patch, path, 3.2 * sigma)
    fade = np.minimum(1, 6 * along * (1 - along))
    plane[window] += np.float32(amount) * fade * np.exp(-0.5 * (distance / np.float32(sigma)) ** 2)


def smooth_step(value: NDArray[np.floating]) -> Plane:
    """0 below 0, 1 above 1, smooth in between."""
    clipped = np.clip(value, 0, 1)
    return np.asarray(clipped * clipped * (3 - 2 * clipped), np.float32)


def _rounded(path: Plane, parts: int = 5) -> Plane:
    """A polyline made smooth: a Catmull-Rom curve through its points. (k, 2) -> (parts (k - 1) + 1, 2)"""
    ends = np.concatenate([2 * path[:1] - path[1:2], path, 2 * path[-1:] - path[-2:-1]])[:, None]
    a, b, c, d = ends[:-3], ends[1:-2], ends[2:-1], ends[3:]
    t = (np.arange(parts, dtype=np.float32) / parts)[None, :, None]
    inner = 0.5 * (2 * b + t * (c - a) + t * t * (2 * a - 5 * b + 4 * c - d) + t**3 * (3 * b - a - 3 * c + d))
    return np.concatenate([inner.reshape(-1, 2), path[-1:]])


def _to_path(sheet: Sheet, path: Plane, reach: float) -> tuple[Plane, Plane]:
    """Distance to the nearest point of a polyline [mm], inf beyond reach; where along it that point lies, 0 to 1."""
    best = np.full(sheet.shape, np.inf, np.float32)
    along = np.zeros_like(best)
    for index, (start, end) in enumerate(zip(path[:-1], path[1:], strict=True)):
        low, high = np.minimum(start, end) - reach, np.maximum(start, end) + reach
        window = sheet.window((low[0], low[1]), (high[0], high[1]))
        s, z = sheet.within(window)
        step = end - start
        share = np.clip(((s - start[0]) * step[0] + (z - start[1]) * step[1]) / (step @ step), 0, 1)
        distance = np.hypot(s - start[0] - share * step[0], z - start[1] - share * step[1])
        nearer = distance < best[window]
        best[window] = np.where(nearer, distance, best[window])
        along[window] = np.where(nearer, (index + share) / (len(path) - 1), along[window])
    return best, along


def _unrolled(theta: FloatArray) -> Plane:
    return (ROUND_MM * (theta - 2 * np.pi)).astype(np.float32)
