"""Directions, meshes over them and lattices round them: AT-14, and the pure half of AT-15 and AT-16."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LatticeError
from protocol.grid import FloatArray, GridSpec
from protocol.lattice import RHO_ONE
from protocol.region import region_round
from protocol.sphere import (
    DirectionGrid,
    Spread,
    cap_region,
    click_of,
    default_mesh,
    directions,
    folded,
    frame_at,
    great_circle_rad,
    literal_lattice,
    plateau_and_skirt,
    region_on,
    ring_lattice,
    ring_vectors,
    rotated_lattice,
    vectors,
)

GOLDEN = Path(__file__).parents[1] / "golden" / "sphere" / "lattices.json"
SKIRT = round(RHO_ONE * math.e)
polar = st.floats(0, math.pi)
around = st.floats(0, 2 * math.pi, exclude_max=True)


# -- AT-14 -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("down", "round_", "vertices", "faces"), [(8, 12, 86, 168), (12, 16, 178, 352)])
def test_the_papers_meshes_have_its_counts(down: int, round_: int, vertices: int, faces: int) -> None:
    mesh = default_mesh(down, round_)
    assert (mesh.theta_v.size, len(mesh.faces)) == (vertices, faces)
    assert np.count_nonzero(mesh.theta_v == 0) == np.count_nonzero(mesh.theta_v == np.pi) == 1


@given(st.integers(2, 20), st.integers(2, 20))
def test_default_meshes_are_watertight_spheres_facing_outward(down: int, half_round: int) -> None:
    mesh = default_mesh(down, 2 * half_round)
    edges = {(int(a), int(b)) for face in mesh.faces for a, b in zip(face, np.roll(face, -1), strict=True)}
    assert len(edges) == 3 * len(mesh.faces)  # no edge twice in one direction
    assert all((b, a) in edges for a, b in edges)  # and every one also in the other
    assert mesh.theta_v.size - len(edges) // 2 + len(mesh.faces) == 2
    corners = vectors(mesh.theta_v, mesh.theta_h)[mesh.faces]
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    assert (volumes > -1e-12).all()
    assert volumes.sum() > 0


@pytest.mark.parametrize(("down", "round_"), [(1, 12), (8, 11), (8, 2), (0, 0)])
def test_no_mesh_of_too_few_or_odd_intervals(down: int, round_: int) -> None:
    with pytest.raises(LatticeError):
        default_mesh(down, round_)


# -- directions --------------------------------------------------------------------------------------------------------


@given(st.floats(-20, 20), st.floats(-20, 20))
def test_folding_keeps_the_direction_and_bounds_the_angles(v: float, h: float) -> None:
    theta_v, theta_h = folded(v, h)
    assert 0 <= theta_v <= np.pi
    assert 0 <= theta_h < 2 * np.pi
    np.testing.assert_allclose(vectors(theta_v, theta_h), vectors(v, h), atol=1e-9)


def test_folding_goes_on_past_a_pole_down_the_opposite_meridian() -> None:
    v, h = folded(np.array([-0.1, np.pi + 0.1]), np.array([0.2, 0.2]))
    np.testing.assert_allclose(v, [0.1, np.pi - 0.1])
    np.testing.assert_allclose(h, [0.2 + np.pi] * 2)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_directions_that_are_none_are_refused(bad: float) -> None:
    with pytest.raises(LatticeError):
        folded(np.array([bad]), np.array([0.0]))
    with pytest.raises(LatticeError):
        click_of(bad, 0.0)
    with pytest.raises(LatticeError):
        DirectionGrid(16, 8).snap(np.array([0.3]), np.array([bad]))


@pytest.mark.parametrize("theta_v", [-0.01, math.pi + 0.01])
def test_a_click_needs_a_polar_angle_between_the_poles(theta_v: float) -> None:
    with pytest.raises(LatticeError):
        click_of(theta_v, 0.0)


def test_a_vector_without_length_has_no_direction() -> None:
    with pytest.raises(LatticeError):
        directions(np.zeros((2, 3)))


@given(polar, around, st.floats(0.1, 1000))
def test_directions_of_vectors_give_the_vectors_back(v: float, h: float, length: float) -> None:
    towards = vectors(v, h)
    np.testing.assert_allclose(vectors(*directions(length * towards)), towards, atol=1e-12)


@given(polar, around, st.floats(-7, 7))
def test_a_click_stands_where_its_direction_snaps_to(v: float, h: float, theta0: float) -> None:
    grid = DirectionGrid(360, 184, theta0)
    click_u, click_v = click_of(v, h, theta0)
    row, column = grid.snap(v, h)
    assert abs(int(click_v * 184) - row) <= 1
    assert min((int(click_u * 360) - column) % 360, (column - int(click_u * 360)) % 360) <= 1
    away = great_circle_rad(vectors(grid.theta_v(row), grid.theta_h(column)), vectors(v, h))
    assert away < 1.01 * math.hypot(math.pi / 360, math.pi / 368)


def test_dense_directions_snap_to_themselves() -> None:
    grid = DirectionGrid(40, 24, 0.7)
    row, column = np.mgrid[:24, :40]
    snapped = grid.snap(grid.theta_v(row), grid.theta_h(column))
    np.testing.assert_array_equal(snapped, (row, column))


# -- rings -------------------------------------------------------------------------------------------------------------


def test_rings_hold_as_much_along_as_across() -> None:
    rings = plateau_and_skirt(0.3, 0.02, SKIRT, 0.4)
    assert rings.radius_rad[15] == pytest.approx(0.3)
    steps = np.diff(rings.radius_rad)
    np.testing.assert_allclose(steps[:15], 0.02)
    np.testing.assert_allclose(steps[15:], [0.02 * math.e, 0.02 * math.e**2], rtol=1e-4)
    assert steps[-1] <= 0.4 < steps[-1] * math.e
    spacing = 2 * np.pi * np.sin(rings.radius_rad[1:]) / rings.bearings[1:]
    assert (spacing <= steps + 1e-12).all()
    assert (rings.bearings[1:] - 2 * np.pi * np.sin(rings.radius_rad[1:]) / steps <= 4).all()
    assert (rings.bearings[1:] % 4 == 0).all()
    assert rings.bearings[0] == 1


@given(polar, around, polar, around)
def test_unsnapped_rings_turn_with_the_fovea(v: float, h: float, other_v: float, other_h: float) -> None:
    rings = plateau_and_skirt(0.2, 0.05, SKIRT, 0.5)
    here, there = frame_at(v, h), frame_at(other_v, other_h)
    turn = there @ here.T
    np.testing.assert_allclose(ring_vectors(here, rings) @ turn.T, ring_vectors(there, rings), atol=1e-9)


@given(polar, around)
def test_a_ring_keeps_its_distance_and_its_order(v: float, h: float) -> None:
    rings = plateau_and_skirt(0.2, 0.05, SKIRT, 0.5)
    towards = ring_vectors(frame_at(v, h), rings)
    away = great_circle_rad(towards, vectors(v, h))
    np.testing.assert_allclose(away, np.repeat(rings.radius_rad, rings.bearings), atol=1e-9)


@given(polar, around)
def test_snapped_rings_are_unique_dense_directions(v: float, h: float) -> None:
    grid = DirectionGrid(360, 184)
    row, column = ring_lattice(grid, v, h, plateau_and_skirt(0.1, 0.005, SKIRT, 0.3))
    assert np.unique(row * 360 + column).size == row.size
    assert row.min() >= 0 and row.max() < 184 and column.min() >= 0 and column.max() < 360


@pytest.mark.parametrize("theta_v", [0.0, math.pi])
def test_rings_round_a_pole_give_every_quadrant_as_many(theta_v: float) -> None:  # AT-15
    row, column = ring_lattice(DirectionGrid(360, 184), theta_v, 0.0, plateau_and_skirt(0.4, 0.02, SKIRT, 0.4))
    counts = np.bincount(column // 90, minlength=4)
    assert counts.max() - counts.min() <= 1


# -- the paper's own lattice, and the same turned ----------------------------------------------------------------------


def test_the_literal_lattice_counts_as_the_paper_would() -> None:  # AT-16
    down, across = Spread(8, 0.5, 20.0), Spread(8, 0.5, 20.0)
    assert literal_lattice(np.pi / 2, 1.0, down, across)[0].size == 17 * 17 == 289
    assert literal_lattice(0.0, 1.0, down, across)[0].size == 273


@given(st.floats(1.0, 2.0), around, st.integers(0, 5), st.integers(0, 5))
def test_the_literal_lattice_is_the_papers_offsets(v: float, h: float, m: int, n: int) -> None:
    down, across = Spread(m, 0.5, 20.0), Spread(n, 0.3, 30.0)
    theta_v, theta_h = literal_lattice(v, h, down, across)
    wanted = {
        (round(v + sv * (math.exp(i / 20) - 1) / 0.5, 9), round((h + sh * (math.exp(j / 30) - 1) / 0.3) % math.tau, 7))
        for i, j, sv, sh in itertools.product(range(m + 1), range(n + 1), (-1, 1), (-1, 1))
    }
    assert theta_v.size == (2 * m + 1) * (2 * n + 1) == len(wanted)
    found = set(zip(np.round(theta_v, 9).tolist(), np.round(theta_h, 7).tolist(), strict=True))
    assert all(min(abs(a - c) + min(abs(b - d), math.tau - abs(b - d)) for c, d in wanted) < 1e-6 for a, b in found)


@given(polar, around)
def test_the_rotated_lattice_turns_with_the_fovea(v: float, h: float) -> None:
    spread = Spread(4, 0.5, 20.0)
    here = vectors(*rotated_lattice(v, h, spread, spread))
    level = vectors(*rotated_lattice(np.pi / 2, 0.0, spread, spread))
    turn = frame_at(v, h) @ frame_at(np.pi / 2, 0.0).T
    np.testing.assert_allclose(level @ turn.T, here, atol=1e-9)
    np.testing.assert_allclose(level, vectors(*literal_lattice(np.pi / 2, 0.0, spread, spread)), atol=1e-9)


@pytest.mark.parametrize("spread", [Spread(100, 0.5, 20.0), Spread(-1, 0.5, 20.0)])
def test_offsets_beyond_half_a_turn_are_refused(spread: Spread) -> None:
    with pytest.raises(LatticeError):
        spread.offsets()


@pytest.mark.parametrize(
    ("cap", "spacing", "rho"), [(math.nan, 0.1, 0), (4.0, 0.1, 0), (0.1, 0.0, 0), (0.1, 0.1, 5), (1.0, 1e-7, 0)]
)
def test_rings_out_of_bounds_are_refused(cap: float, spacing: float, rho: int) -> None:
    with pytest.raises(LatticeError):
        plateau_and_skirt(cap, spacing, rho, 0.3)


# -- the rectangle of a click ------------------------------------------------------------------------------------------


@given(polar, around, st.floats(0.001, 1))
def test_a_caps_rectangle_holds_the_cap(v: float, h: float, share: float) -> None:
    grid = DirectionGrid(72, 40)
    region = cap_region(*click_of(v, h), share, 72, 40)
    row, column = np.mgrid[:40, :72]
    fovea_row, fovea_column = int(click_of(v, h)[1] * 40), int(click_of(v, h)[0] * 72)
    fovea = vectors(grid.theta_v(fovea_row), grid.theta_h(fovea_column))
    away = great_circle_rad(vectors(grid.theta_v(row), grid.theta_h(column)), fovea)
    inside = np.zeros((40, 72), bool)
    inside[np.ix_(np.arange(40)[region.rows], region.columns)] = True
    assert 0 <= region.top and region.top + region.height <= 40 and 1 <= region.width <= 72
    sure = math.acos(1 - 2 * share) - 1.5 * math.pi / 36  # to within a column's width
    assert inside[away <= sure].all()


def test_a_caps_rectangle_takes_its_share_of_the_sphere() -> None:
    grid = DirectionGrid(720, 360)
    for v, most in ((0.0, 1.03), (math.pi / 2, 1.5)):  # a square round a circle has 4 / pi
        region = cap_region(*click_of(v, 1.0), 0.05, 720, 360)
        area = np.sin(grid.theta_v(np.arange(360)[region.rows])).sum() * region.width
        assert 0.95 < area / (np.sin(grid.theta_v(np.arange(360))).sum() * 720) / 0.05 < most


def test_the_whole_sphere_is_a_region_too() -> None:
    region = cap_region(0.3, 0.4, 1.0, 36, 20)
    assert (region.width, region.top, region.height) == (36, 0, 20)


def test_a_cylinders_region_stays_what_it_was() -> None:
    spec = GridSpec(360, 100, 1024, 256, 0.1, 0.5)
    assert region_on(spec, 0.2, 0.3, 0.05, 360, 100) == region_round(0.2, 0.3, 0.05, 360, 100)


# -- golden ------------------------------------------------------------------------------------------------------------


def _case(name: str) -> list[Any]:
    cases: list[Any] = json.loads(GOLDEN.read_text())[name]
    return cases


@pytest.mark.parametrize("case", _case("rings"), ids=lambda case: str(case["fovea"]))
def test_golden_rings(case: Any) -> None:
    grid = DirectionGrid(*(int(n) for n in case["grid"]))
    rings = plateau_and_skirt(*_plateau(case["plateau"]))
    assert rings.bearings.tolist() == case["bearings"]
    row, column = ring_lattice(grid, case["fovea"][0], case["fovea"][1], rings)
    assert [row.tolist(), column.tolist()] == [case["row"], case["column"]]


def _plateau(numbers: list[float]) -> tuple[float, float, int, float]:
    return numbers[0], numbers[1], int(numbers[2]), numbers[3]


@pytest.mark.parametrize("case", _case("literal"), ids=lambda case: str(case["fovea"]))
def test_golden_literal_lattices(case: Any) -> None:
    down, across = (Spread(int(count), alpha, s) for count, alpha, s in (case["down"], case["across"]))
    for lattice in (literal_lattice, rotated_lattice):
        found: tuple[FloatArray, FloatArray] = lattice(case["fovea"][0], case["fovea"][1], down, across)
        row, column = DirectionGrid(*(int(n) for n in case["grid"])).snap_unique(*found)
        kind = "literal" if lattice is literal_lattice else "rotated"
        assert [row.tolist(), column.tolist()] == [case[f"{kind}_row"], case[f"{kind}_column"]]
