"""The table's axis where it is not where the sensor believes it: what a sample then means, and the inverse.

The sensor's frame: x points from the axis that it believes in towards the sensor, along the line of sight; z is up its
rows; y completes them. The true axis passes the plane z = height at (-radial, -lateral), and leans. A sample (column at
angle theta, range r, row at height z) is a point s of that frame, counted from there, and one of the table's own, p:

    s = (r + radial, lateral, z - height)                                                                   Eq. (1)
    p = Rx(-side) Ry(lean) s, turned about the axis by theta                                                Eq. (2)

So rho = hypot(p_x, p_y) is its distance from the true axis; it stands at the angle theta + chi, chi = atan2(p_y, p_x)
before the turn, which is not its column's; and at the height z' = height + p_z. For small leans the two offsets simply
change with height: radial + lean (z - height) and lateral + side (z - height).

A turn of the sensor about z is no parameter: it would turn every scan by as much, and nothing shows it. A shift along
the axis is none either, it is the zero of heights. Lengths in mm, angles in rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

OFFSET_MAX_MM = 1000.0
LEAN_MAX_RAD = 0.1

Lengths = NDArray[np.floating]  # double or single precision, as it comes


@dataclass(frozen=True, slots=True)
class Axis:
    """Where a scanner's true axis is. lateral_mm, radial_mm : what its line of sight passes the axis by, and what is to
    be added to its range, at height_mm.  lean_rad, side_rad : how that grows with height, radial and lateral.

    Raises ValueError when out of bounds.
    """

    lateral_mm: float
    radial_mm: float
    lean_rad: float = 0.0
    side_rad: float = 0.0
    height_mm: float = 0.0

    def __post_init__(self) -> None:
        bounds = {"lean_rad": LEAN_MAX_RAD, "side_rad": LEAN_MAX_RAD, "height_mm": 1e6}
        for field in fields(self):
            value, most = getattr(self, field.name), bounds.get(field.name, OFFSET_MAX_MM)
            if not (math.isfinite(value) and abs(value) <= most):
                raise ValueError(f"{field.name} must be between -{most:g} and {most:g}, got {value}")

    @property
    def leans(self) -> bool:
        """Whether heights change, too."""
        return bool(self.lean_rad or self.side_rad)


def seen_to_true(axis: Axis, range_mm: Lengths, height_mm: Lengths) -> tuple[Lengths, Lengths, Lengths]:
    """Where samples are: Eq. (1) and (2). range_mm, height_mm : any shapes that go together.

    Returns their distance from the axis [mm], by how much they are ahead of their column [rad], and their height [mm].
    What lies beyond the axis, seen from the sensor, is ahead by more than pi/2.
    """
    cos_lean, sin_lean, cos_side, sin_side = _turns(axis)
    x, h = range_mm + axis.radial_mm, height_mm - axis.height_mm
    p_x = x * cos_lean + h * sin_lean
    level = h * cos_lean - x * sin_lean
    p_y = level * sin_side + axis.lateral_mm * cos_side
    return np.hypot(p_x, p_y), np.arctan2(p_y, p_x), level * cos_side + (axis.height_mm - axis.lateral_mm * sin_side)


def true_to_seen(axis: Axis, radius_mm: Lengths, height_mm: Lengths) -> tuple[Lengths, Lengths, Lengths]:
    """Inverse of seen_to_true: the range a point is seen at, by how much it is ahead of that column, the row's height.

    NaN where the line of sight passes the axis further away than the point.
    """
    cos_lean, sin_lean, cos_side, sin_side = _turns(axis)
    p_z = height_mm - axis.height_mm
    p_y = (p_z * sin_side + axis.lateral_mm) / cos_side
    with np.errstate(invalid="ignore"):
        p_x = np.sqrt(radius_mm * radius_mm - p_y * p_y)
    level = p_z * cos_side + p_y * sin_side
    x = p_x * cos_lean - level * sin_lean
    return x - axis.radial_mm, np.arctan2(p_y, p_x), p_x * sin_lean + level * cos_lean + axis.height_mm


def true_height(axis: Axis, radius_mm: Lengths, row_height_mm: Lengths) -> Lengths:
    """The height of samples of which the distance from the axis is known, and the row that saw them. [mm]"""
    cos_lean, sin_lean, cos_side, sin_side = _turns(axis)
    h = row_height_mm - axis.height_mm
    rise = sin_side * sin_lean / cos_lean  # p_y = flat - rise p_x, put into p_x^2 + p_y^2 = radius^2
    flat = h * (sin_side / cos_lean) + axis.lateral_mm * cos_side
    square = radius_mm * radius_mm * (1 + rise * rise) - flat * flat
    p_x = (flat * rise + np.sqrt(np.maximum(square, 0))) / (1 + rise * rise)
    level = h / cos_lean - p_x * (sin_lean / cos_lean)
    return level * cos_side + (axis.height_mm - axis.lateral_mm * sin_side)


def _turns(axis: Axis) -> tuple[float, float, float, float]:
    """Cosine and sine of both leans."""
    lean, side = axis.lean_rad, axis.side_rad
    return math.cos(lean), math.sin(lean), math.cos(side), math.sin(side)
