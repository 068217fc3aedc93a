"""Strokes on the sheet: they land where they are told, and touch nothing else."""

import numpy as np
import pytest

from protocol.grid import GridSpec
from simulators.noise import Plane
from simulators.sheet import Sheet, add_bump, add_curve, add_spot, range_sheet, smooth_step, texture_sheet


@pytest.fixture
def sheet() -> Sheet:
    return Sheet(np.linspace(-50, 50, 201, dtype=np.float32), np.linspace(40, -40, 161, dtype=np.float32))


def at(plane: Plane, sheet: Sheet, s: float, z: float) -> float:
    return float(plane[np.abs(sheet.z - z).argmin(), np.abs(sheet.s - s).argmin()])


def test_a_bump_peaks_at_its_centre_and_ends(sheet: Sheet) -> None:
    plane = np.zeros(sheet.shape, np.float32)
    add_bump(plane, sheet, (10, -5), (3, 2), 4.0)
    assert at(plane, sheet, 10, -5) == plane.max() == pytest.approx(4)
    assert at(plane, sheet, 13, -5) == pytest.approx(4 * np.exp(-0.5))
    assert at(plane, sheet, 10, 5) == 0


def test_a_curve_runs_through_its_points(sheet: Sheet) -> None:
    plane = np.zeros(sheet.shape, np.float32)
    add_curve(plane, sheet, [(-20, 0), (0, 10), (20, 0)], 1.0, -2.0)
    assert at(plane, sheet, 0, 10) == pytest.approx(-2, abs=0.05)
    assert at(plane, sheet, 0, 0) == 0 and at(plane, sheet, 40, 0) == 0


def test_a_spot_is_full_inside_and_nothing_outside(sheet: Sheet) -> None:
    plane = np.zeros(sheet.shape, np.float32)
    add_spot(plane, sheet, (0, 0), 4.0, 1.5)
    assert at(plane, sheet, 0, 0) == pytest.approx(1.5)
    assert at(plane, sheet, 8, 0) == 0


def test_a_stroke_off_the_sheet_changes_nothing(sheet: Sheet) -> None:
    plane = np.zeros(sheet.shape, np.float32)
    add_bump(plane, sheet, (200, 0), (3, 3), 4.0)
    add_curve(plane, sheet, [(100, 90), (120, 95)], 1.0, 1.0)
    add_spot(plane, sheet, (0, -90), 4.0, 1.0)
    assert not plane.any()


def test_range_and_texture_share_one_sheet() -> None:
    spec = GridSpec(360, 100, 1024, 256, 0.01, 2.0, 90.0, np.pi)
    for sheet in (range_sheet(spec), texture_sheet(spec)):
        assert sheet.s[0] == pytest.approx(-sheet.s[-1], abs=1e-3)
        assert sheet.z[0] + sheet.z[-1] == pytest.approx(2 * 90 - 200, abs=1e-3)


def test_smooth_step_is_flat_outside() -> None:
    assert smooth_step(np.array([-1, 0, 0.5, 1, 2])).tolist() == [0, 0, 0.5, 1, 1]
