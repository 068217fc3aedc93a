"""Sweeps of a tipped object laid on the first one: the pose found, poles filled, other objects refused."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest

from exchange.cast import cast_mesh
from exchange.closing import close_scan
from exchange.errors import ExchangeError
from exchange.fit import fit, tipped_back
from exchange.sweeps import Sweep
from protocol.grid import FloatArray, Grid, GridSpec
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid
from simulators.head import head
from simulators.pebble import pebble
from simulators.shapes import sphere
from tests.exchange.tipped import lying, surface, swept, turned_by

SIZE = (240, 120, 480, 240)
SLIP_DEG, SLIP_MM = (5.0, -7.0, 8.0), np.array([2.0, -3.0, 40.0])


@lru_cache(1)
def stone() -> Grid:
    return pebble(SIZE, 0)


@lru_cache(1)
def standing() -> Grid:
    return swept(stone(), np.eye(3), np.zeros(3), SIZE)


@lru_cache(1)
def laid() -> Grid:
    return lying(stone(), SLIP_DEG, SLIP_MM, SIZE)


def angle_deg(turn: FloatArray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))


@pytest.mark.parametrize("tip_deg", [90.0, -90.0, 0.0, 180.0, 45.0])
def test_tipping_back_sets_it_upright(tip_deg: float) -> None:
    top = np.array([np.sin(np.radians(tip_deg)), 0, np.cos(np.radians(tip_deg))])  # where it came to lie
    np.testing.assert_allclose(tipped_back(tip_deg) @ top, [0, 0, 1], atol=1e-12)


def test_the_pose_is_found_from_the_shape() -> None:
    found = Sweep(laid()).fitted(standing())
    turn = turned_by(SLIP_DEG) @ tipped_back(90).T
    assert angle_deg(found.pose.turn @ turn) < 0.05
    middle = np.array([0, 0, stone().spec.z_max_mm])
    np.testing.assert_allclose(found.pose.move(SLIP_MM), middle, atol=0.05)
    assert found.misfit_mm < 0.1


def test_what_the_shape_does_not_tell_stays_as_it_was() -> None:
    ball = sphere(SIZE, 0)
    angle, row = ball.spec.angle_rad(np.arange(240)), ball.spec.height_mm(np.arange(120))[:, None]
    x, y = ball.range_mm * np.cos(angle), ball.range_mm * np.sin(angle)
    points = np.stack(np.broadcast_arrays(x, y, row), axis=-1)[ball.range_steps > 0].astype(np.float64)
    found = fit(points + (3, -2, 5), ball, tipped_back(90))
    assert angle_deg(found.pose.turn @ tipped_back(90).T) < 0.01
    np.testing.assert_allclose(found.pose.move(np.array([3.0, -2, 5])), 0, atol=0.02)


def test_a_sweep_on_its_side_fills_both_poles_with_what_is_there() -> None:
    alone, said = close_scan(standing())
    whole, with_it = close_scan(standing(), [Sweep(laid())])
    assert said.open > 0.01 and said.swept == 0
    assert with_it.open < 0.001 and with_it.swept > said.open
    assert "from other sweeps, which fit within 0.0" in str(with_it)
    spec = whole.spec
    grid = DirectionGrid.of(spec)
    true_mm = swept_from_inside(spec).range_mm
    polar = np.abs(np.cos(grid.theta_v(np.arange(spec.height)))) > 0.9
    error_mm = np.abs(whole.range_mm - true_mm)
    assert np.nanpercentile(error_mm[polar], 95) < 0.2
    samples = (alone.range_steps > 0) & (np.abs(np.cos(grid.theta_v(np.arange(spec.height)))) < 0.5)[:, None]
    np.testing.assert_allclose(whole.range_mm[samples], alone.range_mm[samples], atol=2 * spec.step_mm)


def swept_from_inside(spec: GridSpec) -> Grid:
    """The stone itself along the directions of a grid."""
    return thin_grid(cast_mesh(surface(stone()), spec))


def test_colours_over_a_pole_are_those_of_the_sweep_that_saw_it() -> None:
    whole, _ = close_scan(standing(), [Sweep(laid())])
    true = swept_from_inside(whole.spec).texture.astype(float)
    texels = whole.spec.texture_height
    for rows in (slice(0, texels // 10), slice(-texels // 10, None)):
        difference = np.abs(whole.texture[rows] - true[rows]).mean()
        assert difference < 6 < true[rows].std()
    assert (whole.texture.max(axis=-1) > 0).mean() > 0.999


def test_a_mesh_completes_a_scan_as_a_sweep_does() -> None:
    _, said = close_scan(standing(), [Sweep(surface(stone()), tip_deg=0.0)])
    assert said.open == 0 and said.misfit_mm < 0.1


@pytest.mark.parametrize("slip_deg", [(20.0, 0.0, 0.0), (15.0, -15.0, 15.0), (0.0, 40.0, 0.0)])
def test_it_may_lie_far_from_how_it_was_meant_to(slip_deg: tuple[float, float, float]) -> None:
    found = Sweep(lying(stone(), slip_deg, SLIP_MM, SIZE)).fitted(standing())
    assert angle_deg(found.pose.turn @ turned_by(slip_deg) @ tipped_back(90).T) < 0.05


@pytest.mark.parametrize(
    "other",
    [Sweep(head(SIZE, 0)), Sweep(swept(pebble(SIZE, 1), np.eye(3), np.zeros(3), SIZE), 0.0), Sweep(laid(), 270.0)],
    ids=["a head", "another stone", "lying the other way"],
)
def test_what_does_not_fit_is_refused(other: Sweep) -> None:
    with pytest.raises(ExchangeError, match=r"sweep: only \d+% of it lies on the scan's surface; is it the same"):
        close_scan(standing(), [other])


def test_a_sphere_is_no_sweep() -> None:
    with pytest.raises(ExchangeError, match="give the cylinder it was made of"):
        Sweep(stone())


def test_a_sweep_of_the_sides_alone_adds_nothing_there() -> None:
    spec = standing().spec
    steps = standing().range_steps.copy()
    steps[: spec.height // 4] = steps[-spec.height // 4 :] = 0
    middle = Grid(spec, steps, standing().texture)
    _, said = close_scan(standing(), [Sweep(middle, tip_deg=0.0)])
    assert said.swept < 0.002 and said.open > 0.01
