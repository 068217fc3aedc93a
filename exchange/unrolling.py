"""A spherical scan as a cylinder: what the axis sees of a closed object, column by column."""

from __future__ import annotations

import numpy as np

from exchange.cast import STEP_MIN_MM, to_steps
from exchange.errors import ExchangeError
from exchange.profile import columns_mm, meet, profiles, sample_rows, strips
from exchange.rays import LevelRays
from protocol.grid import STEPS_MAX, FloatArray, Grid, GridSpec

MARGIN_ROWS = 1  # at each end: nothing is beyond it


def unroll(grid: Grid) -> Grid:
    """A spherical scan as a cylindrical one of as many samples, with a void row at each end.

    Raises ExchangeError for a grid that is no sphere, or that spans nothing.
    """
    if grid.spec.geometry != "sphere":
        raise ExchangeError(f"scan: is a {grid.spec.geometry} already")
    spec = _fitted(grid)
    range_mm = np.full((spec.height, spec.width), np.nan)
    for columns in _strips(spec.height, spec.width):
        range_mm[:, columns] = _look(grid, spec, columns, spec.width, spec.height)[0]
    texture = np.zeros((spec.texture_height, spec.texture_width, 3), np.uint8)
    rows_of = spec.texture_height / spec.height
    for columns in _strips(spec.texture_height, spec.texture_width):
        _, place = _look(grid, spec, columns, spec.texture_width, spec.texture_height)
        strip = sample_rows(grid.texture[:, columns], (np.nan_to_num(place) - 0.5) * rows_of - 0.5)
        texture[:, columns] = np.where(np.isnan(place)[..., None], 0, strip)
    return Grid(spec, to_steps(range_mm, spec.step_mm), texture)


def _strips(rows: int, width: int) -> list[slice]:
    return strips(width, rows + 2)


def _fitted(grid: Grid) -> GridSpec:
    spec = grid.spec
    low, high, reach = np.inf, -np.inf, 0.0
    for columns in _strips(spec.height, spec.width):
        out, z = _points(grid, columns, spec.width)
        if not np.isnan(z).all():
            low, high, reach = min(low, np.nanmin(z)), max(high, np.nanmax(z)), max(reach, np.nanmax(out))
    if not low < high or spec.height <= 2 * MARGIN_ROWS:
        raise ExchangeError("scan: spans no surface")
    pitch_mm = float(high - low) / (spec.height - 2 * MARGIN_ROWS)
    step_mm = max(STEP_MIN_MM, spec.step_mm, float(reach) / (STEPS_MAX - 1))
    shape = spec.width, spec.height, spec.texture_width, spec.texture_height
    try:
        return GridSpec(*shape, step_mm, pitch_mm, float(high) + MARGIN_ROWS * pitch_mm, spec.theta0_rad)
    except ValueError as problem:
        raise ExchangeError(f"scan: its extent makes no cylinder ({problem})") from problem


def _look(grid: Grid, spec: GridSpec, columns: slice, width: int, rows: int) -> tuple[FloatArray, FloatArray]:
    rays = LevelRays(width, rows, spec.theta0_rad, spec.z_max_mm, spec.height * spec.pitch_mm / rows)
    return meet(*_points(grid, columns, width), rays)


def _points(grid: Grid, columns: slice, width: int) -> tuple[FloatArray, FloatArray]:
    """The profiles of columns, from the axis to the axis where a pole is closed."""
    spec = grid.spec
    out, z = profiles(spec, columns_mm(spec, grid.range_steps, width, columns))
    first, last = (np.full((1, out.shape[1]), float(row.mean())) for row in grid.range_steps[[0, -1]])
    up = np.cos(np.pi * 0.5 / spec.height) * spec.step_mm
    upper = np.where((grid.range_steps[0] > 0).all(), spec.z_max_mm + first * up, np.nan)
    lower = np.where((grid.range_steps[-1] > 0).all(), spec.z_max_mm - last * up, np.nan)
    return np.concatenate([0 * upper, out, 0 * lower]), np.concatenate([upper, z, lower])
