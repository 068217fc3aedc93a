"""Round bodies as a sensor sees them about an axis that is off centre: every ray meets the body by a formula."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from node.axes import KnownAxis
from node.axis import Axis
from node.axis_correction import correct
from node.axis_fit import Estimate
from protocol.grid import FloatArray, Grid, GridSpec, mm_to_steps

TALL_MM = 150.0
FOUND = Estimate(Axis(0.8, -0.5, 0.002, -0.001, 75.0), 0.002, 1e-4, 1e-6, 3e-5, 0.02, 0.0, 18.0, 36000, 1.0)
KNOWN = KnownAxis("SIM-0001", (1 << 64) - 1, FOUND, "0" * 32, 80.0, 1795314511.7)
"""What a node may know of a scanner that saw one."""


@dataclass(frozen=True)
class Body:
    """A cylinder on the table. x_mm, y_mm : where its axis passes the height 0.  x_lean, y_lean : how that leans."""

    radius_mm: float = 40.0
    x_mm: float = 15.0
    y_mm: float = 10.0
    x_lean: float = 0.0
    y_lean: float = 0.0


def spec_of(width: int = 360, height: int = 100, tall_mm: float = TALL_MM) -> GridSpec:
    return GridSpec(width, height, 8, 8, 0.002, tall_mm / height, tall_mm, math.pi)


def seen_mm(axis: Axis, body: Body, spec: GridSpec) -> FloatArray:
    """(H, W) range at which each ray meets a body, nan where it does not. By |o + x d| = R off the body's axis."""
    lean, side = axis.lean_rad, axis.side_rad
    about_y = np.array([[math.cos(lean), 0, math.sin(lean)], [0, 1, 0], [-math.sin(lean), 0, math.cos(lean)]])
    about_x = np.array([[1, 0, 0], [0, math.cos(side), math.sin(side)], [0, -math.sin(side), math.cos(side)]])
    theta = spec.angle_rad(np.arange(spec.width))
    zero = np.zeros_like(theta)
    cos, sin = np.cos(theta), np.sin(theta)
    turn = np.stack([[cos, -sin, zero], [sin, cos, zero], [zero, zero, zero + 1]])
    to_table = np.einsum("ijw,jk->wik", turn, about_x @ about_y)  # (W, 3, 3)
    heights = spec.height_mm(np.arange(spec.height)) - axis.height_mm
    start = np.stack([np.zeros_like(heights), np.full_like(heights, axis.lateral_mm), heights])  # (3, H), at x = 0
    origin = np.einsum("wik,kh->hwi", to_table, start) + [0, 0, axis.height_mm] - [body.x_mm, body.y_mm, 0]
    along = np.array([body.x_lean, body.y_lean, 1]) / math.hypot(body.x_lean, body.y_lean, 1)
    across = np.eye(3) - np.outer(along, along)
    o, d = origin @ across, np.broadcast_to(to_table[None, :, :, 0] @ across, origin.shape)
    dd, od, oo = (d * d).sum(-1), (o * d).sum(-1), (o * o).sum(-1)
    root = od * od - dd * (oo - body.radius_mm**2)
    with np.errstate(invalid="ignore"):
        x = (-od + np.sqrt(root)) / dd
    return np.asarray(np.where(x > 0, x - axis.radial_mm, np.nan))


def swept(
    axis: Axis, body: Body = Body(), spec: GridSpec | None = None, *, noise_mm: float = 0.0, outliers: float = 0.0
) -> Grid:
    """What a sweep of it gives, with noise and a share of samples that are anything."""
    spec = spec or spec_of()
    rng = np.random.default_rng(3)
    range_mm = seen_mm(axis, body, spec)
    range_mm = range_mm + rng.normal(0, noise_mm, range_mm.shape)
    strays = rng.random(range_mm.shape) < outliers
    range_mm = np.where(strays, rng.uniform(20, 90, range_mm.shape), range_mm)
    steps = mm_to_steps(np.where(range_mm > 1, range_mm, np.nan), spec.step_mm)
    return Grid(spec, steps, np.zeros((spec.texture_height, spec.texture_width, 3), np.uint8))


def corrected(grid: Grid, axis: Axis) -> Grid:
    """A copy of a grid, laid about an axis."""
    copy = Grid(grid.spec, grid.range_steps.copy(), grid.texture.copy())
    correct(copy, axis)
    return copy
