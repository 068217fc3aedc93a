"""A scan as regular grids round the turntable's axis, or round a point: its geometry, its samples, its void rule.

Range is the distance from the axis. In memory that leaves the process and on every wire it is whole steps in uint16,
0 where nothing was measured; as millimetres it is float32 with NaN there. Row 0 is the top. Column c stands at angle
`theta0 + 2 pi (c + 0.5) / W`, counter-clockwise seen from above, and is cyclic; row r at `z_max - (r + 0.5) * pitch`.
The texture shares that frame at its own resolution. A spherical scan has the same two grids over directions instead of
places: range is the distance from a centre on the axis, and rows are polar angles (protocol.sphere).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

VOID = 0
STEPS_MAX = 65535
WIDTH_MAX = 16384
HEIGHT_MAX = 16384
RANGE_BLOCK = 8
TEXTURE_BLOCK = 16

Geometry = Literal["cylinder", "sphere"]
GEOMETRIES: tuple[Geometry, ...] = ("cylinder", "sphere")
FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
StepArray = NDArray[np.uint16]
ImageArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]
RepairArray = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class GridSpec:
    """Geometry of a scan, without its samples.

    width, height : range columns W and rows H.       texture_width, texture_height : texels Wt and Ht.
    step_mm : range of one step.                      pitch_mm : height of one range row.
    z_max_mm : height of the top edge of row 0.       theta0_rad : angle of the left edge of column 0.
    geometry : a sphere's rows are polar angles; its pitch_mm is what one is wide on the object, about, and its z_max_mm
    the height of the centre.
    Raises ValueError when a shape or a length is out of bounds.
    """

    width: int
    height: int
    texture_width: int
    texture_height: int
    step_mm: float
    pitch_mm: float
    z_max_mm: float = 0.0
    theta0_rad: float = 0.0
    geometry: Geometry = "cylinder"

    def __post_init__(self) -> None:
        for name in ("width", "texture_width"):
            _check_between(name, getattr(self, name), 1, WIDTH_MAX)
        for name in ("height", "texture_height"):
            _check_between(name, getattr(self, name), 1, HEIGHT_MAX)
        for name in ("step_mm", "pitch_mm"):
            _check_between(name, getattr(self, name), 1e-6, 1e3)
        for name in ("z_max_mm", "theta0_rad"):
            _check_between(name, getattr(self, name), -1e6, 1e6)

    def angle_rad(self, column: FloatArray | IntArray) -> FloatArray:
        """Angle of range columns (any shape). [rad, counter-clockwise from above]"""
        return self.theta0_rad + 2 * np.pi * (np.asarray(column, np.float64) + 0.5) / self.width

    def height_mm(self, row: FloatArray | IntArray) -> FloatArray:
        """Height of a cylinder's range rows (any shape). [mm, row 0 at the top]"""
        return self.z_max_mm - (np.asarray(row, np.float64) + 0.5) * self.pitch_mm

    def cell_at(self, u: float, v: float) -> tuple[int, int]:
        """Range cell (row, column) under a click (u, v) in [0, 1); ValueError outside."""
        for name, value in (("u", u), ("v", v)):
            if not (math.isfinite(value) and 0 <= value < 1):
                raise ValueError(f"{name} must be in [0, 1), got {value}")
        return int(v * self.height), int(u * self.width)


def no_repairs() -> RepairArray:
    """The repairs of a grid that is as it was measured. (0, 3)"""
    return np.empty((0, 3), np.int32)


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A scan's samples: range_steps (H, W) uint16, 0 = void; texture (Ht, Wt, 3) uint8 RGB.

    repairs : (n, 3) int32, the range cells that are not as they were measured, row by row: row, column, and the steps
    that were measured there, 0 for nothing. Raises ValueError where shapes or types do not fit, or repairs leave the
    grid or their order.
    """

    spec: GridSpec
    range_steps: StepArray
    texture: ImageArray
    repairs: RepairArray = field(default_factory=no_repairs)

    def __post_init__(self) -> None:
        s = self.spec
        if self.range_steps.shape != (s.height, s.width) or self.range_steps.dtype != np.uint16:
            raise ValueError(f"range_steps must be ({s.height}, {s.width}) uint16")
        if self.texture.shape != (s.texture_height, s.texture_width, 3) or self.texture.dtype != np.uint8:
            raise ValueError(f"texture must be ({s.texture_height}, {s.texture_width}, 3) uint8")
        _check_repairs(self.repairs, s.height, s.width)

    @property
    def filled(self) -> BoolArray:
        """(H, W) cells whose range was not measured but made up from what is round them."""
        rows, columns = self.repairs[:, 0], self.repairs[:, 1]
        filled = np.zeros(self.range_steps.shape, np.bool_)
        filled[rows, columns] = self.range_steps[rows, columns] != VOID
        return filled

    @property
    def range_mm(self) -> NDArray[np.float32]:
        """Distance from the axis. (H, W) float32 [mm], NaN where void."""
        return steps_to_mm(self.range_steps, self.spec.step_mm)


def steps_to_mm(range_steps: StepArray, step_mm: float) -> NDArray[np.float32]:
    """Whole steps to millimetres, same shape, float32; void (0) becomes NaN."""
    range_mm = range_steps.astype(np.float32) * np.float32(step_mm)
    range_mm[range_steps == VOID] = np.nan
    return range_mm


def mm_to_steps(range_mm: NDArray[np.floating], step_mm: float) -> StepArray:
    """Millimetres to whole steps, same shape, uint16; NaN becomes void (0).

    Raises ValueError where a measured range does not fit 1..65535 steps: nothing is clamped.
    """
    measured = ~np.isnan(range_mm)
    steps = np.rint(np.where(measured, range_mm, step_mm) / step_mm)
    if steps.size and not (1 <= steps.min() and steps.max() <= STEPS_MAX):
        raise ValueError(f"range outside 1..{STEPS_MAX} steps of {step_mm} mm")
    return np.where(measured, steps, VOID).astype(np.uint16)


def quantise(range_steps: StepArray, quantum: int) -> StepArray:
    """Range to multiples of `quantum` steps: k = (z + quantum // 2) // quantum, same shape, uint16."""
    return ((range_steps.astype(np.uint32) + np.uint32(quantum // 2)) // np.uint32(quantum)).astype(np.uint16)


def dequantise(values: StepArray, quantum: int) -> StepArray:
    """Inverse of quantise, to within quantum // 2 steps: clamp(k quantum, 1, 65535); never void."""
    range_steps: StepArray = np.clip(values.astype(np.uint32) * np.uint32(quantum), 1, STEPS_MAX).astype(np.uint16)
    return range_steps


def _check_repairs(repairs: RepairArray, height: int, width: int) -> None:
    if repairs.ndim != 2 or repairs.shape[1] != 3 or repairs.dtype != np.int32:
        raise ValueError(f"repairs must be (n, 3) int32, got {repairs.shape} {repairs.dtype}")
    if not repairs.size:
        return
    if repairs.min() < 0 or (repairs.max(axis=0) >= (height, width, STEPS_MAX + 1)).any():
        raise ValueError(f"repairs lie outside {height} rows, {width} columns and {STEPS_MAX} steps")
    if (np.diff(repairs[:, 0] * np.int64(width) + repairs[:, 1]) <= 0).any():
        raise ValueError("repairs must go row by row, each cell once")


def _check_between(name: str, value: float, low: float, high: float) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ValueError(f"{name} must be between {low} and {high}, got {value}")
