"""Cylindrical scans as spheres and back: every direction against solids with a formula, and what must be refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from exchange.closing import close_scan, closes
from exchange.ends import find_end
from exchange.errors import ExchangeError
from exchange.unrolling import unroll
from protocol.grid import FloatArray, Grid, GridSpec, StepArray
from protocol.rings import thin_rings
from protocol.sphere import DirectionGrid, vectors
from simulators import shapes
from simulators.nutcracker import nutcracker

SHAPE = (96, 120, 240, 160)  # texels are no multiple of samples
STEP_MM = 0.002
BALL_MM = 80.0
CAN_MM, CAN_HIGH_MM = 50.0, 150.0


def scan(
    profile_mm: Callable[[FloatArray], FloatArray], low_mm: float, high_mm: float, shape: shapes.Shape = SHAPE
) -> Grid:
    """A body of revolution. profile_mm : range at heights, NaN where nothing is."""
    spec = shapes.spec_for(shape, low_mm, high_mm)
    range_mm = profile_mm(spec.height_mm(np.arange(spec.height)))
    steps = np.where(np.isnan(range_mm), 0, np.rint(np.nan_to_num(range_mm) / STEP_MM)).astype(np.uint16)
    return Grid(spec, np.tile(steps[:, None], (1, spec.width)), drawing(spec))


def drawing(spec: GridSpec) -> np.ndarray:
    """Red tells the angle, green the height: in a texture of any geometry's, a colour names the place on the object."""
    theta, z_mm = shapes.texture_axes(spec)
    red = 128 + 100 * np.cos(theta)[None, :] + 0 * z_mm[:, None]
    green = 128 + z_mm[:, None] + 0 * theta[None, :]
    return np.rint(np.clip(np.stack([red, green, red], axis=-1), 0, 255)).astype(np.uint8)


def ball(shape: shapes.Shape = SHAPE) -> Grid:
    return Grid((made := shapes.sphere(shape, 0)).spec, made.range_steps, drawing(made.spec))


def can() -> Grid:
    return Grid((made := shapes.cylinder(SHAPE, 0)).spec, made.range_steps, drawing(made.spec))


def polar(grid: Grid) -> FloatArray:
    return DirectionGrid.of(grid.spec).theta_v(np.arange(grid.spec.height))


def with_void(grid: Grid, rows: slice, columns: slice) -> Grid:
    steps: StepArray = grid.range_steps.copy()
    steps[rows, columns] = 0
    return Grid(grid.spec, steps, grid.texture)


def test_a_ball_swept_from_its_side_is_whole() -> None:
    closed, said = close_scan(ball())
    assert closed.spec.geometry == "sphere"
    assert said.hidden == said.open == said.capped == 0
    assert 0 < said.rounded < 0.02
    np.testing.assert_allclose(closed.range_mm, BALL_MM, atol=0.25)  # chords between rows, at grazing ones too
    middle = slice(closed.spec.height // 4, -closed.spec.height // 4)
    np.testing.assert_allclose(closed.range_mm[middle], BALL_MM, atol=0.01)


def test_a_can_with_caps_is_met_where_geometry_says() -> None:
    closed, said = close_scan(can(), caps=True)
    high_mm = CAN_HIGH_MM / 2 * (1 - 1 / SHAPE[1])  # the last row stands half a row below the edge
    v = polar(closed)
    true_mm = np.minimum(CAN_MM / np.sin(v), high_mm / np.abs(np.cos(v)))
    assert said.centre_mm == pytest.approx(CAN_HIGH_MM / 2)
    np.testing.assert_allclose(closed.range_mm, np.tile(true_mm[:, None], (1, SHAPE[0])), atol=0.005)
    assert said.capped == pytest.approx(1 - np.cos(np.arctan(CAN_MM / high_mm)), abs=0.01)
    assert "made up" in str(said)


def test_nothing_is_made_up_that_was_not_asked_for() -> None:
    closed, said = close_scan(can())
    covered = np.abs(np.cos(polar(closed))) < 0.99 * np.cos(np.arctan2(CAN_MM, CAN_HIGH_MM / 2))
    assert said.capped == said.rounded == 0
    assert (closed.range_steps[covered] > 0).all()
    assert (closed.range_steps[0] == 0).all() and (closed.range_steps[-1] == 0).all()
    assert not closed.texture[0].any()
    assert said.open == pytest.approx(1 - np.cos(np.arctan2(CAN_MM, CAN_HIGH_MM / 2)), abs=0.02)


@pytest.mark.parametrize(
    ("grid", "expected"),
    [(ball(), True), (can(), False), (with_void(ball(), slice(20), slice(None)), False), (nutcracker(SHAPE, 0), False)],
    ids=["ball", "can", "ball without its top", "not star-shaped"],
)
def test_what_is_seen_from_nearly_everywhere_closes(grid: Grid, expected: bool) -> None:
    assert closes(grid) is expected


def test_what_goes_on_beyond_the_scan_has_no_round_end() -> None:
    whole = ball()
    spec = whole.spec
    cut = next(row for row in range(spec.height) if whole.range_steps[row].any())
    cropped = GridSpec(
        spec.width, spec.height - cut, spec.texture_width, spec.texture_height, spec.step_mm, spec.pitch_mm,
        float(spec.height_mm(np.array(cut)) + spec.pitch_mm / 2), spec.theta0_rad,
    )  # fmt: skip
    grid = Grid(cropped, whole.range_steps[cut:], whole.texture)  # nobody looked above its first row
    assert find_end(cropped, grid.range_steps, "top", cap=False) is None
    assert find_end(cropped, grid.range_steps, "bottom", cap=False) is not None


@given(st.floats(0.02, 1.0), st.integers(40, 200))
def test_a_ball_is_round_wherever_its_rows_fall(offset: float, rows: int) -> None:
    pitch_mm = 2 * BALL_MM / rows
    grid = scan(
        lambda z: np.sqrt(np.where(np.abs(z) < BALL_MM, BALL_MM**2 - z**2, np.nan)),
        -BALL_MM - 2 * pitch_mm + offset * pitch_mm, BALL_MM + 2 * pitch_mm + offset * pitch_mm,
        (8, rows + 4, 16, 16),
    )  # fmt: skip
    end = find_end(grid.spec, grid.range_steps, "top", cap=False)
    assert end is not None
    assert end.apex_mm == pytest.approx(BALL_MM, abs=0.07 * pitch_mm)


def test_colours_follow_their_places() -> None:
    closed, _ = close_scan(ball())
    spec = closed.spec
    texels = DirectionGrid(spec.texture_width, spec.texture_height, spec.theta0_rad)
    v, h = texels.theta_v(np.arange(spec.texture_height)), texels.theta_h(np.arange(spec.texture_width))
    middle = slice(spec.texture_height // 8, -spec.texture_height // 8)
    red, green = closed.texture[middle, :, 0].astype(int), closed.texture[middle, :, 1].astype(int)
    np.testing.assert_allclose(red, np.tile(128 + 100 * np.cos(h), (len(red), 1)), atol=1.5)
    z_mm = BALL_MM * np.cos(v[middle])[:, None]
    np.testing.assert_allclose(green, np.tile(128 + z_mm, (1, green.shape[1])), atol=2.5)


def test_a_caps_colours_run_from_the_last_rows_to_their_mean() -> None:
    closed, _ = close_scan(can(), caps=True)
    red, green = closed.texture[..., 0].astype(float), closed.texture[..., 1].astype(float)
    rim = can().texture[0].astype(float)
    np.testing.assert_allclose(red[0], rim[:, 0].mean(), atol=2)  # one turn's wave has faded at the pole
    np.testing.assert_allclose(green[0], rim[:, 1].mean(), atol=1)
    rows = closed.spec.texture_height
    out_mm = CAN_HIGH_MM / 2 * (1 - 1 / SHAPE[1]) * np.tan(np.pi * (np.arange(rows) + 0.5) / rows)
    on_cap = (out_mm > 0) & (out_mm < 0.98 * CAN_MM)
    assert on_cap.sum() > 40
    np.testing.assert_allclose(np.ptp(red, axis=1)[on_cap], np.ptp(rim[:, 0]) * out_mm[on_cap] / CAN_MM, atol=6)


def holed_mm(rows: slice) -> FloatArray:
    return ball().spec.height_mm(np.arange(rows.start, rows.stop))


def test_voids_stay_voids_and_nothing_leaks_out_of_them() -> None:
    whole, _ = close_scan(ball())
    holed, said = close_scan(with_void(ball(), slice(50, 70), slice(10, 30)))
    void = holed.range_steps == 0
    assert 0.02 < said.open < 0.05
    rows, columns = np.nonzero(void)
    hole_rad = np.ptp(np.arcsin(holed_mm(slice(50, 70)) / BALL_MM))
    assert columns.min() >= 10 and columns.max() < 30
    np.testing.assert_array_equal(holed.range_steps[~void], whole.range_steps[~void])
    assert np.ptp(rows) == pytest.approx(holed.spec.height * hole_rad / np.pi, abs=3)


def test_a_scan_turned_by_whole_columns_is_closed_turned() -> None:
    shape = (96, 80, 192, 96)
    grid = with_void(ball(shape), slice(30, 40), slice(5, 25))
    uneven = grid.range_steps + np.where(grid.range_steps > 0, 300 * np.arange(96, dtype=np.uint16) // 96, 0)
    grid = Grid(grid.spec, uneven.astype(np.uint16), grid.texture)
    closed, _ = close_scan(grid, centre_mm=0.0)
    rolled = Grid(grid.spec, np.roll(grid.range_steps, 8, 1), np.roll(grid.texture, 16, 1))
    turned, _ = close_scan(rolled, centre_mm=0.0)
    np.testing.assert_array_equal(turned.range_steps, np.roll(closed.range_steps, 8, 1))
    np.testing.assert_allclose(turned.texture.astype(int), np.roll(closed.texture, 16, 1).astype(int), atol=1)


def test_of_several_hits_the_outermost_counts() -> None:
    """A narrow waist with a wide brim above it: rays through the brim's underside meet it once more outside."""
    brim = scan(lambda z: np.where(np.abs(z - 40) < 4, 44.5, 40.0), -75, 75)
    closed, said = close_scan(brim, caps=True, centre_mm=0.0)
    v = polar(closed)
    up_mm = np.tan(np.pi / 2 - v) * 44.5
    on_brim = (up_mm > 37.5) & (up_mm < 42.5)
    np.testing.assert_allclose(closed.range_mm[on_brim, 0], 44.5 / np.sin(v[on_brim]), rtol=0.002)
    assert 0.005 < said.hidden < 0.05  # the brim's underside, and the side in its shadow


@pytest.mark.parametrize("centre_mm", [-300.0, 81.5, 300.0])
def test_a_centre_outside_is_refused(centre_mm: float) -> None:
    with pytest.raises(ExchangeError, match="not inside"):
        close_scan(ball(), centre_mm=centre_mm)


def test_an_object_beside_the_axis_is_refused() -> None:
    with pytest.raises(ExchangeError, match="axis does not pass through"):
        close_scan(with_void(ball(), slice(0, None), slice(40, None)))


def test_an_object_that_hides_much_of_itself_is_refused_with_what_to_do() -> None:
    with pytest.raises(ExchangeError, match=r"\d+\.\d% of its surface is hidden.*keep it as a cylinder"):
        close_scan(nutcracker((96, 100, 128, 96), 0))


def test_nothing_measured_is_refused() -> None:
    with pytest.raises(ExchangeError, match="nothing is measured"):
        close_scan(with_void(ball(), slice(None), slice(None)))


def test_a_sphere_is_no_cylinder_and_the_other_way_round() -> None:
    closed, _ = close_scan(ball())
    with pytest.raises(ExchangeError, match="sphere already"):
        close_scan(closed)
    with pytest.raises(ExchangeError, match="cylinder already"):
        unroll(ball())


def test_a_sphere_unrolled_is_what_a_turntable_sees_of_it() -> None:
    spec = GridSpec(96, 160, 240, 160, STEP_MM, 1.0, 12.0, 0.4, "sphere")
    grid = DirectionGrid.of(spec)
    towards = vectors(grid.theta_v(np.arange(160))[:, None], grid.theta_h(np.arange(96)))
    radius_mm = 1 / np.sqrt(((towards / (50, 40, 60)) ** 2).sum(axis=-1))  # an ellipsoid
    steps = thin_rings(np.rint(radius_mm / STEP_MM).astype(np.uint16))
    level = unroll(Grid(spec, steps, np.full((160, 240, 3), 90, np.uint8)))
    z_mm, angle = level.spec.height_mm(np.arange(160))[:, None] - 12, level.spec.angle_rad(np.arange(96))
    square = 1 - (z_mm / 60) ** 2
    true_mm = np.sqrt(np.maximum(square, 0) / ((np.cos(angle) / 50) ** 2 + (np.sin(angle) / 40) ** 2))
    assert (level.range_steps[[0, -1]] == 0).all() and (level.range_steps[1:-1] > 0).all()
    side = slice(8, -8)
    np.testing.assert_allclose(level.range_mm[side], true_mm[side], atol=0.06)
    assert closes(level)
    assert (level.texture[2:-2] == 90).all()


def test_there_and_back_is_the_same_side() -> None:
    level = unroll(close_scan(ball())[0])
    inner = np.abs(level.spec.height_mm(np.arange(level.spec.height))) < 70
    true_mm = np.sqrt(BALL_MM**2 - level.spec.height_mm(np.arange(level.spec.height))[inner] ** 2)
    np.testing.assert_allclose(level.range_mm[inner], np.tile(true_mm[:, None], (1, SHAPE[0])), atol=0.1)
