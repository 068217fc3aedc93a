import math
import re

import numpy as np
import pytest

from node.axis import Axis
from node.axis_fit import Estimate, NotCalibrated, Samples, estimate, off_surface
from protocol.grid import Grid
from simulators.specimen import make_specimen
from tests.node.round_bodies import Body, corrected, spec_of, swept

MIDDLE_MM = 75.0
TRUE = Axis(0.8, -0.5, 0.004, -0.003, MIDDLE_MM)
FAR = Axis(-6.0, 7.0, -0.03, 0.04, MIDDLE_MM)


def errors(found: Estimate, true: Axis) -> dict[str, float]:
    """By how many standard errors each is off."""
    above_mm = found.axis.height_mm - true.height_mm
    lateral, radial = true.lateral_mm + above_mm * true.side_rad, true.radial_mm + above_mm * true.lean_rad
    return {
        "lateral": abs(found.axis.lateral_mm - lateral) / found.lateral_error_mm,
        "radial": abs(found.axis.radial_mm - radial) / found.radial_error_mm,
        "lean": abs(found.axis.lean_rad - true.lean_rad) / found.lean_error_rad,
        "side": abs(found.axis.side_rad - true.side_rad) / found.side_error_rad,
    }


def test_slopes_are_those_of_small_steps() -> None:
    rng = np.random.default_rng(1)
    angle = rng.uniform(0, 2 * math.pi, 50)
    samples = Samples(rng.uniform(20, 60, 50), rng.uniform(-50, 50, 50), np.cos(angle), np.sin(angle))
    unknowns = np.array([0.8, -0.5, 0.01, -0.02, 10, 5, 0.03, -0.01])
    _, slopes = off_surface(samples, samples.range_mm, unknowns, 40.0)
    for number in range(8):
        step = np.zeros(8)
        step[number] = 1e-6
        ends = (off_surface(samples, samples.range_mm, unknowns + sign * step, 40.0)[0] for sign in (1, -1))
        change = np.subtract(*ends) / 2e-6
        assert np.abs(change - slopes[:, number]).max() < 1e-6, number


@pytest.mark.parametrize(
    "true, body",
    [
        (TRUE, Body()),
        (TRUE, Body(x_mm=-6.5, y_mm=0)),
        (TRUE, Body(x_mm=0, y_mm=34)),
        (FAR, Body(x_lean=0.02, y_lean=-0.03)),
        (FAR, Body(radius_mm=60)),
        (Axis(0.0, 0.0, height_mm=MIDDLE_MM), Body()),
    ],
    ids=["usual", "nearly central", "far out", "leaning body", "thick", "centred"],
)
def test_the_axis_is_found_as_well_as_said(true: Axis, body: Body) -> None:
    found = estimate(swept(true, body, noise_mm=0.02), 2 * body.radius_mm)
    assert max(errors(found, true).values()) < 4
    assert found.lateral_error_mm < 0.02 and found.radial_error_mm < 0.002
    assert found.noise_mm == pytest.approx(0.02, rel=0.1) and found.fitting > 0.95
    x_mm, y_mm = body.x_mm + body.x_lean * MIDDLE_MM, body.y_mm + body.y_lean * MIDDLE_MM
    assert found.off_centre_mm == pytest.approx(math.hypot(x_mm, y_mm), abs=0.2)


def test_without_noise_it_is_found_to_a_part_of_a_step() -> None:
    found = estimate(swept(TRUE), 80.0).axis
    assert abs(found.lateral_mm - TRUE.lateral_mm) < 5e-4 and abs(found.radial_mm - TRUE.radial_mm) < 5e-5
    assert abs(found.lean_rad - TRUE.lean_rad) < 1e-5 and abs(found.side_rad - TRUE.side_rad) < 1e-5


@pytest.mark.parametrize("share", [0.05, 0.25])
def test_samples_that_are_not_of_the_body_are_left_out(share: float) -> None:
    found = estimate(swept(TRUE, noise_mm=0.02, outliers=share), 80.0)
    assert max(errors(found, TRUE).values()) < 4 and found.fitting == pytest.approx(1 - share, abs=0.01)


def test_errors_that_hang_together_widen_what_is_said() -> None:
    """Lobes of 0.02 mm: as noise that would be nothing, but they move the harmonics."""
    white = estimate(swept(TRUE, noise_mm=0.02), 80.0)
    grid = swept(TRUE, noise_mm=0.02)
    wave_mm = 0.02 * np.sin(3 * grid.spec.angle_rad(np.arange(grid.spec.width)))
    steps = (grid.range_steps + np.rint(wave_mm / grid.spec.step_mm)).astype(np.uint16)
    uneven = estimate(Grid(grid.spec, steps, grid.texture), 80.0)
    assert uneven.uneven_mm > 0.01 > 0.005 > white.uneven_mm
    assert uneven.lateral_error_mm > 5 * white.lateral_error_mm


def test_repaired_cells_do_not_count() -> None:
    grid = swept(TRUE, noise_mm=0.02)
    steps, repairs = grid.range_steps.copy(), []
    for row in range(0, 100, 2):
        repairs += [[row, column, 0] for column in range(0, 360, 3)]
    cells = np.array(repairs, np.int32)
    steps[tuple(cells[:, :2].T)] += 500
    assert estimate(Grid(grid.spec, steps, grid.texture, cells), 80.0).fitting == 1.0


def test_a_large_sweep_is_thinned() -> None:
    found = estimate(swept(TRUE, spec=spec_of(1440, 301), noise_mm=0.02), 80.0)
    assert max(errors(found, TRUE).values()) < 4 and found.samples == 60_000


def test_a_corrected_sweep_tells_the_same_axis() -> None:
    grid = swept(TRUE, noise_mm=0.005)
    wrong = Axis(-0.7, 0.3, -0.002, 0.005, 20.0)
    again = estimate(corrected(grid, wrong), 80.0, corrected_by=wrong)
    found = estimate(grid, 80.0)
    above_mm = again.axis.height_mm - found.axis.height_mm
    assert abs(again.axis.lateral_mm - found.axis.lateral_mm - above_mm * TRUE.side_rad) < 0.005
    assert abs(again.axis.radial_mm - found.axis.radial_mm - above_mm * TRUE.lean_rad) < 0.001
    assert abs(again.axis.lean_rad - found.axis.lean_rad) < 2e-5


def oval() -> Grid:
    grid = swept(TRUE, noise_mm=0.02)
    wave_mm = 0.3 * np.sin(3 * grid.spec.angle_rad(np.arange(grid.spec.width)))
    return Grid(grid.spec, (grid.range_steps + np.rint(wave_mm / 0.002)).astype(np.uint16), grid.texture)


def cone() -> Grid:
    grid = swept(TRUE)
    taper = np.rint(np.linspace(-8, 8, grid.spec.height) / 0.002)[:, None]
    return Grid(grid.spec, (grid.range_steps + taper).astype(np.uint16), grid.texture)


def beside_another() -> Grid:
    grid = swept(TRUE, noise_mm=0.02)
    steps = grid.range_steps.copy()
    steps[60:] = (30_000 + 2000 * np.sin(np.arange(360) / 9)).astype(np.uint16)
    return Grid(grid.spec, steps, grid.texture)


def nothing() -> Grid:
    grid = swept(TRUE)
    return Grid(grid.spec, np.zeros_like(grid.range_steps), grid.texture)


@pytest.mark.parametrize(
    "grid, diameter_mm, why",
    [
        (nothing(), 80, "only 0 samples of range, 2000 are needed: is the body in view?"),
        (swept(TRUE, Body(x_mm=60)), 80, "seen in 2. % of the turn only: move it nearer"),
        (swept(TRUE, Body(x_mm=1, y_mm=2), noise_mm=0.02), 80, "stands .* mm off the axis, too near"),
        (make_specimen("cylinder").grid, 100, "stands 0.0 mm off the axis, too near"),
        (swept(TRUE, noise_mm=0.9), 80, "samples lie 0.9.. mm off a cylinder of 80 mm, at most 0.400"),
        (oval(), 80, "no round cylinder of 80 mm: whole parts of it differ by 0.2.. mm"),
        (swept(TRUE, noise_mm=0.02), 82.5, "only, at most 0.041 .*: it is not quite a cylinder of that diameter"),
        (swept(TRUE, noise_mm=0.02), 40, "."),
        (cone(), 80, "the axis would lean by over 5 degrees"),
        (beside_another(), 80, "only 6. % of what was seen lies on a cylinder"),
        (swept(TRUE, spec=spec_of(360, 8, 12), noise_mm=0.3), 80, "is known to 0.[0-9]+ mm only, at most 0.040"),
        (make_specimen("head").grid, 160, "."),
        (make_specimen("sphere").grid, 160, "."),
        (make_specimen("nutcracker").grid, 80, "."),
    ],
    ids=[
        "nothing", "aside", "central", "in the middle", "noisy", "oval", "wrong diameter", "radius for diameter",
        "cone", "beside another", "low", "head", "sphere", "nutcracker",
    ],
)  # fmt: skip
def test_what_does_not_tell_the_axis_is_refused(grid: Grid, diameter_mm: float, why: str) -> None:
    with pytest.raises(NotCalibrated) as refusal:
        estimate(grid, diameter_mm)
    assert re.search(why, str(refusal.value)), refusal.value
