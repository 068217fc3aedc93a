"""The generated head: anatomy, relief, voids and colour, by what a scan of a person would show."""

import cv2
import numpy as np
import pytest

from exchange.formats import SIZES
from protocol.grid import VOID, Grid
from simulators.head import head, relief_mm
from simulators.marks import marks
from simulators.sheet import range_sheet


@pytest.fixture(scope="module")
def scan() -> Grid:
    return head(SIZES["M"], seed=0)


def range_at(scan: Grid, degrees: float, z_mm: float) -> float:
    """Median range round a place on the head, 0 degrees in front, counter-clockwise from above. [mm]"""
    spec = scan.spec
    column = int(((np.radians(degrees) - spec.theta0_rad) / (2 * np.pi) % 1) * spec.width)
    row = int((spec.z_max_mm - z_mm) / spec.pitch_mm)
    return float(np.nanmedian(scan.range_mm[row - 2 : row + 3, column - 2 : column + 3]))


def test_the_nose_stands_out_and_the_eyes_lie_deep(scan: Grid) -> None:
    assert range_at(scan, 0, -22) > range_at(scan, 0, 8) + 10
    assert range_at(scan, 21, 14) < range_at(scan, 21, 28) - 2


def test_the_ears_stand_off_the_head(scan: Grid) -> None:
    for degrees in (100, -100):
        assert range_at(scan, degrees, 14) > range_at(scan, np.sign(degrees) * 76, 14) + 8


def test_the_chin_overhangs_the_neck(scan: Grid) -> None:
    assert range_at(scan, 0, -78) > range_at(scan, 0, -120) + 25


def test_a_few_percent_are_void_and_the_face_is_not(scan: Grid) -> None:
    void = scan.range_steps == VOID
    assert 0.02 < void.mean() < 0.05
    face = void[int(45 / scan.spec.pitch_mm) : int(200 / scan.spec.pitch_mm), 560:880]
    assert face.mean() < 0.002


def test_relief_is_fine_and_moles_are_raised() -> None:
    sheet = range_sheet(head(SIZES["S"], seed=0).spec)
    found = marks(0)
    with_moles = relief_mm(sheet, found, 0)
    raised = [mole for mole in found.moles if mole.height_mm > 0]
    assert len(raised) == 8 and all(0.3 < mole.height_mm < 1.5 for mole in raised)
    assert np.abs(with_moles).max() < 6.0


def test_texture_costs_what_real_skin_costs(scan: Grid) -> None:
    options = [cv2.IMWRITE_JPEG_QUALITY, 90, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    _, jpeg = cv2.imencode(".jpg", scan.texture, options)
    real_bytes_per_texel = 0.098  # lps_head at M, measured the same way
    assert 0.5 < jpeg.size / scan.texture[..., 0].size / real_bytes_per_texel < 2


def test_skin_is_lit_and_above_the_crown_is_black(scan: Grid) -> None:
    red, green, blue = scan.texture[900:1500, 1200:2900].reshape(-1, 3).mean(axis=0)
    assert red > green > blue > 60
    assert not scan.texture[:10].any()


def test_another_seed_is_another_person(scan: Grid) -> None:
    assert marks(0) == marks(0) and marks(0) != marks(1)
