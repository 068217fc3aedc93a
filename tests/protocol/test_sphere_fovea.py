"""Foveae of the classic profile on a sphere: where their samples stand, what they deliver, and whose it is."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import LatticeError, LocalWireError, RemoteWireError
from protocol.lattice import Channel, ChannelShape
from protocol.refinement import CRC, HEADER, Generator, Refinement
from protocol.sphere import DirectionGrid, Spread, literal_lattice, rotated_lattice, vectors
from protocol.sphere_fovea import (
    POLAR_MAX,
    Kind,
    SphereLattice,
    SphereParameters,
    build_sphere_lattice,
    claim,
    kept_samples,
)

WIDTH, HEIGHT = 352, 176
SHAPE = ChannelShape(Channel.RANGE, WIDTH, HEIGHT, 45, 23, True)
GRID = DirectionGrid(WIDTH, HEIGHT)
SKIRT = 178145
places = st.tuples(st.integers(0, POLAR_MAX), st.integers(0, POLAR_MAX))


def rings(polar: int, turned: int, cap: float = 0.3, spacing: float = 0.02, number: int = 1) -> SphereParameters:
    return SphereParameters(number, Kind.RINGS, polar, turned, cap, spacing, rho=SKIRT)


def axes(kind: Kind, polar: int, turned: int, m: int = 6, n: int = 4, number: int = 1) -> SphereParameters:
    return SphereParameters(number, kind, polar, turned, 0.5, 20.0, m, n)


def any_lattice(kind: Kind, place: tuple[int, int], number: int = 1) -> SphereLattice:
    made = rings(*place, number=number) if kind is Kind.RINGS else axes(kind, *place, number=number)
    return build_sphere_lattice(SHAPE, made)


@given(st.sampled_from(Kind), places)
def test_samples_are_unique_and_among_what_is_delivered(kind: Kind, place: tuple[int, int]) -> None:
    lattice = any_lattice(kind, place)
    assert np.unique(lattice.sample).size == lattice.sample.size
    assert np.isin(lattice.sample, lattice.cells).all()
    assert (np.diff(lattice.cells) > 0).all()
    assert lattice.cells[0] >= 0 and lattice.cells[-1] < WIDTH * HEIGHT
    assert set(np.unique(lattice.node)) == set(range(lattice.sample.size))


@given(st.sampled_from(Kind), places)
def test_a_sample_keeps_its_value_and_others_lie_between(kind: Kind, place: tuple[int, int]) -> None:
    lattice = any_lattice(kind, place)
    values = np.random.default_rng(1).random(lattice.sample.size)
    dense = lattice.blend(values)
    np.testing.assert_allclose(lattice.weight.sum(axis=1), 1, atol=1e-9)
    np.testing.assert_array_equal(dense[np.searchsorted(lattice.cells, lattice.sample)], values)
    corners = values[lattice.corner]
    assert (dense >= corners.min(axis=1) - 1e-9).all() and (dense <= corners.max(axis=1) + 1e-9).all()


@given(st.sampled_from(Kind), places)
def test_a_smooth_surface_is_met_wherever_the_fovea_stands(kind: Kind, place: tuple[int, int]) -> None:
    lattice = any_lattice(kind, place)
    row, column = np.divmod(lattice.cells, WIDTH)
    surface = vectors(GRID.theta_v(row), GRID.theta_h(column)) @ np.array([0.3, -0.5, 0.8])
    off = np.abs(lattice.blend(surface[np.searchsorted(lattice.cells, lattice.sample)]) - surface)
    assert off.max() < 0.05
    assert off[lattice.distance < 0.1].max() < 0.012


def test_voids_spread_to_what_hangs_on_them_only() -> None:
    lattice = any_lattice(Kind.RINGS, (POLAR_MAX // 2, 5))
    values = np.ones(lattice.sample.size)
    values[0] = np.nan
    void = np.isnan(lattice.blend(values))
    assert void[np.searchsorted(lattice.cells, lattice.sample)].sum() == 1
    assert 0 < void.sum() < 40
    assert lattice.distance[void].max() < 0.03


@pytest.mark.parametrize("polar", [0, POLAR_MAX])
def test_rings_on_a_pole_give_each_quadrant_as_many(polar: int) -> None:  # AT-15
    lattice = build_sphere_lattice(SHAPE, rings(polar, 12345))
    counts = np.bincount(lattice.sample % WIDTH // (WIDTH // 4), minlength=4)
    assert counts.max() - counts.min() <= 1
    cells = np.bincount(lattice.cells % WIDTH // (WIDTH // 4), minlength=4)
    assert cells.max() - cells.min() <= 1


@pytest.mark.parametrize(("kind", "lattice"), [(Kind.LITERAL, literal_lattice), (Kind.ROTATED, rotated_lattice)])
@pytest.mark.parametrize("polar", [0, POLAR_MAX // 9, POLAR_MAX // 2, POLAR_MAX])
def test_the_papers_lattices_are_sampled_where_it_says(kind: Kind, lattice: Any, polar: int) -> None:  # AT-16
    p, spread = axes(kind, polar, 1 << 29), (Spread(6, 0.5, 20.0), Spread(4, 0.5, 20.0))
    row, column = GRID.snap_unique(*lattice(p.theta_v, p.theta_h, *spread))
    sampled, said = build_sphere_lattice(SHAPE, p).sample, row * WIDTH + column
    assert sampled.size == said.size
    if 0 < polar < POLAR_MAX:  # on a pole any column would do
        assert set(sampled.tolist()) == set(said.tolist())
    if polar == POLAR_MAX // 2:
        assert build_sphere_lattice(SHAPE, p).sample.size == 13 * 9
    if kind is Kind.LITERAL and polar in (0, POLAR_MAX):  # a pole is one direction, whatever its theta_h
        assert build_sphere_lattice(SHAPE, p).sample.size == 13 * 9 - 8


@given(st.sampled_from(Kind), st.integers(0, POLAR_MAX), st.integers(0, 15))
def test_a_lattice_turns_with_its_fovea_round_the_axis(kind: Kind, polar: int, sixteenths: int) -> None:
    columns = WIDTH // 16 * sixteenths
    here = any_lattice(kind, (polar, 0))
    there = any_lattice(kind, (polar, sixteenths << 28))
    row, column = np.divmod(here.sample, WIDTH)
    assert set((row * WIDTH + (column + columns) % WIDTH).tolist()) == set(there.sample.tolist())


@given(st.sampled_from(Kind), places, places)
def test_the_nearer_fovea_owns_a_direction_and_older_ones_keep_what_is_as_near(
    kind: Kind, one: tuple[int, int], other: tuple[int, int]
) -> None:
    first, second = any_lattice(kind, one), any_lattice(kind, other, 2)
    everything = claim(first, [])
    assert everything.all() and kept_samples(first, everything).all()
    claimed = claim(second, [first])
    shared = np.isin(second.cells, first.cells)
    assert claimed[~shared].all()
    held = first.distance[np.searchsorted(first.cells, second.cells[shared])]
    np.testing.assert_array_equal(claimed[shared], second.distance[shared] < held)
    assert not claim(first, [first]).any() and not kept_samples(first, claim(first, [first])).any()


@given(st.integers(1, 65535), places, st.sampled_from(Kind))
def test_parameters_come_back_behind_a_short_header(number: int, place: tuple[int, int], kind: Kind) -> None:
    p = rings(*place, 0.25, 0.5, number) if kind is Kind.RINGS else axes(kind, *place, 1023, 7, number)
    assert SphereParameters.from_bytes(p.to_bytes()) == p
    refinement = Refinement(Generator.SPHERE, Channel.RANGE, 1, 2, 3, 0, 1, 2, b"abcd", b"", p)
    wire = refinement.to_bytes()
    assert len(wire) - 4 == HEADER.size + 23 + CRC.size <= 64
    assert Refinement.from_bytes(wire) == refinement


def test_parameters_that_are_none_are_refused() -> None:
    good = rings(1, 2).to_bytes()
    for bad in (good[:-1], good + b"\0", good[:2] + b"\x07" + good[3:]):
        with pytest.raises(RemoteWireError):
            SphereParameters.from_bytes(bad)
    with pytest.raises(LocalWireError):
        SphereParameters(1, Kind.RINGS, -1, 0, 0.1, 0.1).to_bytes()


@pytest.mark.parametrize("change", [
    {"fovea": 0}, {"alpha": math.nan}, {"alpha": 4.0}, {"s": 0.0}, {"s": math.inf}, {"s": 1e-7}, {"rho": 5},
    {"alpha": 3.1, "s": 1e-3}, {"kind": Kind.LITERAL, "m": 1024}, {"kind": Kind.ROTATED, "m": 800, "s": 1.0},
    {"kind": Kind.LITERAL, "alpha": 1e-9, "s": 1.0, "m": 9}, {"kind": Kind.LITERAL, "s": -1.0},
])  # fmt: skip
def test_lattices_that_are_none_are_refused(change: dict[str, Any]) -> None:
    fields: dict[str, Any] = {"fovea": 1, "kind": Kind.RINGS, "polar": 9, "turned": 9, "alpha": 0.2, "s": 0.02}
    with pytest.raises(LatticeError):
        build_sphere_lattice(SHAPE, SphereParameters(**(fields | change)))


def test_a_cylinder_has_none_and_a_large_grid_is_bounded() -> None:
    with pytest.raises(LatticeError):
        build_sphere_lattice(ChannelShape(Channel.RANGE, 720, 360, 45, 23), rings(1, 2))
    with pytest.raises(LatticeError, match="too large"):
        build_sphere_lattice(ChannelShape(Channel.TEXTURE, 8192, 4096, 128, 64, True), rings(1, 2, 3.0))
