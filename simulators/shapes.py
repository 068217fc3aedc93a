"""Solids with a formula: their truth can be computed by hand, so an error shows at once.

Every generator takes the grid's shape and returns the whole Grid at that size; nothing is resampled from another one.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from protocol.grid import FloatArray, Grid, GridSpec, ImageArray, mm_to_steps

STEP_MM = 0.002
SPHERE_RADIUS_MM = 80.0
SPHERE_MARGIN_MM = 4.0
CYLINDER_RADIUS_MM = 50.0
CYLINDER_HEIGHT_MM = 150.0
POST_RADIUS_MM = 40.0
POST_OFF_MM = 18.0
POST_AT_RAD = 0.7
GRATICULE_RAD = np.pi / 12
GRATICULE_MM = 10.0

Shape = tuple[int, int, int, int]


def spec_for(shape: Shape, z_min_mm: float, z_max_mm: float) -> GridSpec:
    """Geometry of a generated specimen. shape : (W, H, Wt, Ht). The seam, column 0, is at the back; the front is +x."""
    width, height, texture_width, texture_height = shape
    pitch_mm = (z_max_mm - z_min_mm) / height
    return GridSpec(width, height, texture_width, texture_height, STEP_MM, pitch_mm, z_max_mm, np.pi)


def texture_axes(spec: GridSpec) -> tuple[FloatArray, FloatArray]:
    """Angle of each texel column (Wt,) [rad] and height of each texel row (Ht,) [mm]."""
    theta = spec.theta0_rad + 2 * np.pi * (np.arange(spec.texture_width) + 0.5) / spec.texture_width
    texel_mm = spec.pitch_mm * spec.height / spec.texture_height
    return theta, spec.z_max_mm - (np.arange(spec.texture_height, dtype=np.float64) + 0.5) * texel_mm


def sphere(shape: Shape, seed: int) -> Grid:
    """A sphere centred on the axis, with void above and below it."""
    extent_mm = SPHERE_RADIUS_MM + SPHERE_MARGIN_MM
    spec = spec_for(shape, -extent_mm, extent_mm)
    square = SPHERE_RADIUS_MM**2 - spec.height_mm(np.arange(spec.height)) ** 2
    range_mm = np.sqrt(np.where(square > 0, square, np.nan))
    return _turned(spec, range_mm, seed)


def cylinder(shape: Shape, seed: int) -> Grid:
    """A cylinder round the axis, as high as the scan: no void anywhere."""
    spec = spec_for(shape, 0.0, CYLINDER_HEIGHT_MM)
    return _turned(spec, np.full(spec.height, CYLINDER_RADIUS_MM), seed)


def post(shape: Shape, seed: int) -> Grid:
    """A round cylinder that stands off the axis: what an axis is calibrated with."""
    spec = spec_for(shape, 0.0, CYLINDER_HEIGHT_MM)
    ahead = spec.angle_rad(np.arange(spec.width)) - POST_AT_RAD
    outline_mm = POST_OFF_MM * np.cos(ahead) + np.sqrt(POST_RADIUS_MM**2 - (POST_OFF_MM * np.sin(ahead)) ** 2)
    return Grid(spec, mm_to_steps(np.tile(outline_mm, (spec.height, 1)), spec.step_mm), _graticule(spec, seed))


def _turned(spec: GridSpec, profile_mm: FloatArray, seed: int) -> Grid:
    """A body of revolution. profile_mm : (H,) range of each row, NaN = void."""
    range_steps = mm_to_steps(np.tile(profile_mm[:, None], (1, spec.width)), spec.step_mm)
    return Grid(spec, range_steps, _graticule(spec, seed))


def _graticule(spec: GridSpec, seed: int) -> ImageArray:
    """Hue by angle, brightness by height, dark lines every 15 degrees and 10 mm, slight grain. (Ht, Wt, 3)"""
    theta, z_mm = texture_axes(spec)
    hue = 128 + 70 * np.cos(theta[:, None] - np.array([0, 2, 4]) * np.pi / 3)
    light = 0.7 + 0.3 * np.linspace(1, 0, spec.texture_height)
    line = np.minimum(_line(theta / GRATICULE_RAD, 0.04)[None, :], _line(z_mm / GRATICULE_MM, 0.06)[:, None])
    colour = hue[None] * (light[:, None] * line)[..., None]
    grain = np.random.default_rng(seed).normal(0, 2, line.shape)[..., None]
    return np.clip(colour + grain + 0.5, 0, 255).astype(np.uint8)


def _line(phase: FloatArray, half_width: float) -> NDArray[np.float64]:
    """0.35 near whole numbers of phase, 1 elsewhere, with a soft edge."""
    distance = np.abs(phase - np.rint(phase))
    return 0.35 + 0.65 * np.clip((distance - half_width) / half_width, 0, 1)
