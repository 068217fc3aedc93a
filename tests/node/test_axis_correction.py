import math
from functools import cache

import numpy as np
import pytest

from node.axis import Axis
from node.axis_correction import correct_texture, laid_out
from node.repair import repair, undone
from protocol.grid import STEPS_MAX, VOID, Grid, GridSpec
from simulators.off_axis import OffAxis, seen_off_axis
from simulators.specimen import make_specimen
from tests.node.round_bodies import Body, corrected, seen_mm, spec_of, swept

OFFSETS = [OffAxis(0.8, -0.5), OffAxis(-1.5, 1.0, 0.3, -0.4)]


@cache
def specimen(name: str) -> Grid:
    return make_specimen(name).grid


def axis_of(off: OffAxis) -> Axis:
    return Axis(off.lateral_mm, off.radial_mm, math.radians(off.lean_deg), math.radians(off.side_deg))


def off_mm(grid: Grid, truth: Grid) -> np.ndarray:
    """Errors where both are measured, but for the rows next to the edges."""
    both = (grid.range_steps != VOID) & (truth.range_steps != VOID)
    both[:4] = both[-4:] = False
    return np.asarray(np.abs(grid.range_steps.astype(int) - truth.range_steps)[both] * truth.spec.step_mm)


def psnr_db(grid: Grid, truth: Grid) -> float:
    """Of the texels on what is measured."""
    spec = truth.spec
    rows = np.arange(spec.texture_height) * spec.height // spec.texture_height
    columns = np.arange(spec.texture_width) * spec.width // spec.texture_width
    on = truth.range_steps[np.ix_(rows, columns)] != VOID
    return float(10 * np.log10(255**2 / np.mean((grid.texture[on].astype(float) - truth.texture[on]) ** 2)))


def test_nothing_changes_where_the_axis_is_where_it_should_be() -> None:
    grid = specimen("head")
    for axis in (Axis(0.0, 0.0), Axis(0.0, 0.0, lean_rad=1e-12)):
        about = corrected(grid, axis)
        assert np.array_equal(about.range_steps, grid.range_steps) and np.array_equal(about.texture, grid.texture)


@pytest.mark.parametrize("off", OFFSETS, ids=["offset", "leaning"])
@pytest.mark.parametrize("name, fine_mm", [("sphere", 0.11), ("head", 0.4)])
def test_what_rays_saw_of_an_object_becomes_the_object(name: str, fine_mm: float, off: OffAxis) -> None:
    """The simulator follows rays into the true surface, and knows nothing of the correction."""
    truth = specimen(name)
    seen = seen_off_axis(truth, off)
    before, texture_before = off_mm(seen, truth), psnr_db(seen, truth)
    about = corrected(seen, axis_of(off))
    after = off_mm(about, truth)
    assert np.median(before) > 0.45 and np.median(after) < 0.03
    assert np.percentile(after, 95) < fine_mm < 0.5 * np.percentile(before, 95)
    assert psnr_db(about, truth) > texture_before + 6
    lost = (truth.range_steps != VOID).mean() - (about.range_steps != VOID).mean()
    assert abs(lost) < 0.01


def test_a_body_is_where_it_stands_to_a_few_steps() -> None:
    axis, spec = Axis(2.0, 1.5, 0.01, -0.02, 75.0), spec_of(1440, 200)
    truth = seen_mm(Axis(0.0, 0.0), Body(), spec)
    about = corrected(swept(axis, spec=spec), axis).range_steps * spec.step_mm
    inside = about[10:-10] != VOID
    assert inside.all() and np.abs(about - truth)[10:-10].max() < 0.004


def test_noise_does_not_grow() -> None:
    axis, spec = Axis(2.0, 1.5, 0.01, -0.02, 75.0), spec_of()
    truth = corrected(swept(axis), axis).range_steps * spec.step_mm
    noisy = corrected(swept(axis, noise_mm=0.05), axis).range_steps * spec.step_mm
    assert np.std((noisy - truth)[10:-10]) < 0.05


def test_samples_are_interpolated_between_neighbours_only() -> None:
    values = np.array([[10, 20, 0, 40, 50, 60]], np.float32)
    at = np.array([[0.5, 1.5, 2.5, 3.5, 4.5, 5.5]], np.float32)
    assert laid_out(values, at, is_cyclic=True).tolist() == [[35, 15, 20, 0, 45, 55]]
    assert laid_out(values, at, is_cyclic=False).tolist() == [[10, 15, 20, 0, 45, 55]]


def test_a_gap_that_opens_stays_void_and_the_outer_surface_hides_the_inner() -> None:
    step = np.array([[50, 50, 50, 30, 30, 30, 30, 30]], np.float32)
    columns = np.arange(8, dtype=np.float32)[None]
    apart = np.where(step == 30, columns + 2, columns)
    assert laid_out(step, apart, is_cyclic=False).tolist() == [[50, 50, 50, 0, 0, 30, 30, 30]]
    over = np.where(step == 30, columns - 2, columns)
    assert laid_out(step, over, is_cyclic=False).tolist() == [[50, 50, 50, 30, 30, 30, 0, 0]]


def test_a_lone_sample_stays_one() -> None:
    values = np.zeros((1, 6), np.float32)
    values[0, 3] = 7
    at = np.arange(6, dtype=np.float32)[None] + np.float32(0.4)
    assert laid_out(values, at, is_cyclic=True).tolist() == [[0, 0, 0, 7, 0, 0]]


def test_what_leaves_the_grid_or_the_scale_is_void() -> None:
    spec = GridSpec(16, 4, 16, 4, 0.01, 1.0)
    grid = Grid(spec, np.full((4, 16), 60_000, np.uint16), np.zeros((4, 16, 3), np.uint8))
    assert not corrected(grid, Axis(0.0, 0.01 * (STEPS_MAX + 1))).range_steps.any()
    assert not corrected(grid, Axis(0.0, -700.0)).range_steps.any()  # beyond the axis
    assert not corrected(grid, Axis(0.0, 0.0, 0.1)).range_steps.any()  # 60 mm lower


def test_texture_goes_with_its_range_where_that_is_void_too() -> None:
    spec = GridSpec(64, 32, 256, 96, 0.01, 1.0)
    columns = np.arange(256)
    texture = np.repeat(np.clip(np.abs(columns - 128), 0, 255)[None, :, None], 96, 0).repeat(3, 2).astype(np.uint8)
    steps = np.full((32, 64), 5000, np.uint16)
    steps[:, 20:30] = VOID
    steps[5] = VOID
    moved = texture.copy()
    correct_texture(moved, steps, spec, Axis(5.0, 0.0))
    ahead = 256 / (2 * np.pi) * math.asin(0.1)
    wanted = np.interp((columns - ahead) % 256, columns, texture[0, :, 0])
    assert np.abs(moved[:, 10:250, 0] - wanted[10:250]).max() <= 1
    empty = texture.copy()
    correct_texture(empty, np.zeros_like(steps), spec, Axis(5.0, 0.0))
    assert np.array_equal(empty, texture)


@pytest.mark.parametrize("axis", [Axis(1.2, 0.4), Axis(1.2, 0.4, 0.02, 0.01)], ids=["offset", "leaning"])
def test_spikes_are_taken_out_before_and_told_where_they_would_stand(axis: Axis) -> None:
    clean, grid = swept(axis), swept(axis)
    steps = grid.range_steps.copy()
    places = [(20, 40), (50, 0), (55, 359), (70, 200)]
    for place in places:
        steps[place] += 4000
    steps[30, 100] = steps[31, 100] = VOID
    repaired = repair(Grid(grid.spec, steps, grid.texture), 0.0, axis)
    truth = corrected(clean, axis).range_steps
    error = np.abs(repaired.grid.range_steps.astype(int) - truth) * grid.spec.step_mm
    assert repaired.spikes == 4 and error[8:-8].max() < 0.1
    told = undone(repaired.grid).range_steps.astype(int) - truth
    assert (told > 3500).sum() == 4
    for row, column in np.argwhere(told > 3500):
        near = [abs(row - r) + min(abs(column - c), 360 - abs(column - c)) for r, c in places]
        assert min(near) <= 7
    assert repaired.grid.filled.sum() == repaired.filled >= 5
