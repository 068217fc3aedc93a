"""Closed meshes as spheres: the centre found and checked, what is hidden or open refused, exports watertight."""

from __future__ import annotations

import io
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from exchange.cast import Mesh
from exchange.errors import ExchangeError
from exchange.formats import ReadOptions, read_scan
from exchange.mesh import GridMesh, Seam
from exchange.native import read_native, write_native
from exchange.star import choose_centre, close_mesh, turns_round
from protocol.grid import FloatArray, Grid, GridSpec
from protocol.rings import thin_rings
from protocol.sphere import DirectionGrid, vectors

SIZE = (96, 48, 64, 32)
untyped: Any = trimesh  # for what it has no types for


def grey(solid: Any) -> Mesh:
    corners = np.asarray(solid.triangles, np.float64)
    m = len(corners)
    colours = np.full((m, 3, 3), 128, np.uint8)
    return Mesh(corners, np.full(m, -1), np.zeros((m, 3, 2), np.float32), colours, ())


def ball(radius_mm: float = 50, at: tuple[float, float, float] = (0, 0, 0)) -> Any:
    return untyped.creation.icosphere(4, radius_mm).apply_translation(at)


def joined(*solids: Any) -> Any:
    return untyped.util.concatenate(list(solids))


def potato() -> Grid:
    """A spherical grid with a bump on every side, and no void."""
    spec = GridSpec(*SIZE, 0.01, 3.0, 12.0, 0.4, "sphere")
    grid = DirectionGrid.of(spec)
    v, h = grid.theta_v(np.arange(48))[:, None], grid.theta_h(np.arange(96))
    radius_mm = 50 + 5 * np.cos(3 * v) + 4 * np.sin(v) ** 2 * np.cos(2 * h)
    return Grid(spec, thin_rings(np.rint(radius_mm / 0.01).astype(np.uint16)), np.full((32, 64, 3), 90, np.uint8))


def test_a_ball_is_as_far_away_everywhere() -> None:
    grid, seen = close_mesh(grey(ball()), SIZE)
    assert seen.hidden == seen.open == 0
    assert abs(seen.centre_mm) < 1e-9
    distance_mm = grid.range_steps * grid.spec.step_mm
    assert 49.7 < distance_mm.min() and distance_mm.max() <= 50.001  # facets lie a little inside
    assert grid.spec.pitch_mm == pytest.approx(math.pi * 50 / 48, rel=0.01)


def test_a_box_is_cast_exactly() -> None:
    grid, seen = close_mesh(grey(untyped.creation.box((40, 60, 100)).apply_translation((0, 0, 30))), SIZE)
    row, column = np.mgrid[:48, :96]
    directions = DirectionGrid.of(grid.spec)
    towards = np.abs(vectors(directions.theta_v(row), directions.theta_h(column)))
    true_mm = np.min(np.array([20, 30, 50]) / np.maximum(towards, 1e-9), axis=-1)
    assert seen.centre_mm == pytest.approx(30)
    thin = thin_rings(np.rint(true_mm / grid.spec.step_mm).astype(np.uint16))
    assert np.abs(grid.range_steps.astype(int) - thin).max() <= 1


def test_the_centre_stands_where_nothing_is_hidden() -> None:
    pear = joined(ball(30, (0, 0, 0)))
    vertices = np.asarray(pear.vertices)
    vertices[vertices[:, 2] > 0] *= (0.25, 0.25, 4.0)  # a ball with a long neck: its middle sees the shoulders edge-on
    centre_mm = choose_centre(np.asarray(trimesh.Trimesh(vertices, pear.faces, process=False).triangles))
    assert -30 < centre_mm < 30


@pytest.mark.parametrize("inward", [False, True])
def test_inside_is_inside_however_triangles_wind(inward: bool) -> None:
    corners = np.asarray(ball().triangles)
    corners = corners[:, ::-1] if inward else corners
    assert turns_round(corners, 10)[0] == pytest.approx(1, abs=1e-6)
    assert turns_round(corners, 10)[1] == 0
    assert turns_round(corners, 60)[0] == pytest.approx(0, abs=1e-6)


def test_a_centre_outside_is_refused() -> None:
    with pytest.raises(ExchangeError, match="not inside"):
        close_mesh(grey(ball()), SIZE, centre_mm=70)


@pytest.mark.parametrize("solid", [ball(at=(200, 0, 0)), untyped.creation.torus(50, 10)], ids=["beside", "torus"])
def test_an_object_the_axis_misses_is_refused(solid: Any) -> None:
    with pytest.raises(ExchangeError, match="axis"):
        close_mesh(grey(solid), SIZE)


def test_an_open_object_is_refused() -> None:
    whole = ball()
    bowl = trimesh.Trimesh(whole.vertices, whole.faces[whole.triangles_center[:, 2] < 25], process=False)
    with pytest.raises(ExchangeError, match="not closed"):
        close_mesh(grey(bowl), SIZE)


def test_an_object_that_is_not_star_shaped_is_refused_with_what_it_hides() -> None:
    dumbbell = joined(ball(20, (0, 0, 40)), untyped.creation.cylinder(5, 80), ball(20, (0, 0, -40)))
    with pytest.raises(ExchangeError, match=r"\d+\.\d% of its surface is hidden.*--geometry cylinder"):
        close_mesh(grey(dumbbell), SIZE)


def test_the_outermost_surface_counts_and_what_lies_inside_is_hidden() -> None:
    grid, seen = close_mesh(grey(joined(ball(50), ball(9))), SIZE)
    assert grid.range_steps.min() * grid.spec.step_mm > 49.5
    assert 0.02 < seen.hidden < 0.05


def test_coordinates_that_are_not_finite_are_refused() -> None:
    mesh = grey(ball())
    corners = mesh.corners.copy()
    corners[3, 1, 2] = np.nan
    with pytest.raises(ExchangeError, match="finite"):
        close_mesh(replace(mesh, corners=corners), SIZE)


def test_a_spheres_mesh_is_watertight_and_faces_outward() -> None:
    grid = potato()
    mesh = GridMesh(grid, Seam.SHARED)
    positions = np.concatenate([mesh.positions(band) for band in mesh.bands()])
    normals = np.concatenate([mesh.normals(band) for band in mesh.bands()])
    faces = np.concatenate(list(mesh.face_bands()))
    solid = trimesh.Trimesh(positions, faces, process=False)
    assert len(faces) == mesh.faces
    assert solid.is_watertight and solid.is_winding_consistent and solid.euler_number == 2
    assert solid.volume > 0
    np.testing.assert_array_equal(np.concatenate(list(mesh.triangle_bands())), positions[faces])
    turned = np.einsum("fcx,fx->fc", normals[faces], solid.face_normals)
    assert turned.min() > 0.8


def test_a_lid_is_missing_where_its_row_is_not_whole() -> None:
    grid = potato()
    steps = grid.range_steps.copy()
    steps[0, :8] = 0
    whole, holed = (GridMesh(Grid(grid.spec, r, grid.texture), Seam.SHARED) for r in (grid.range_steps, steps))
    assert holed.faces <= whole.faces - (SIZE[0] - 2)


def test_a_mesh_of_a_sphere_is_cast_back_to_it_within_a_step() -> None:
    grid = potato()
    corners: FloatArray = np.concatenate(list(GridMesh(grid, Seam.SHARED).triangle_bands()))
    solid = trimesh.Trimesh(**untyped.triangles.to_kwargs(corners), process=False)
    back, seen = close_mesh(grey(solid), SIZE, 0.4, 12.0)
    assert seen.hidden == 0
    np.testing.assert_allclose(back.range_mm, grid.range_mm, atol=0.02)


def test_a_mesh_is_a_sphere_if_it_is_closed_and_seen_whole_or_wanted_so(tmp_path: Path) -> None:
    dumbbell = joined(ball(20, (0, 0, 40)), untyped.creation.cylinder(5, 80), ball(20, (0, 0, -40)))
    whole = ball()
    bowl = trimesh.Trimesh(whole.vertices, whole.faces[whole.triangles_center[:, 2] < 25], process=False)
    solids = ("ball", whole, "sphere"), ("bell", dumbbell, "cylinder"), ("bowl", bowl, "cylinder")
    for name, solid, expected in solids:
        solid.export(tmp_path / f"{name}.ply")
        found = read_scan(tmp_path / f"{name}.ply", options=ReadOptions(SIZE))
        assert found.grid.spec.geometry == expected, name
        assert ("closed mesh" in found.note) is (expected == "sphere")
        level = read_scan(tmp_path / f"{name}.ply", options=ReadOptions(SIZE, geometry="cylinder"))
        assert level.grid.spec.geometry == "cylinder"
    with pytest.raises(ExchangeError, match=r"bowl\.ply: mesh: .* not closed.*--geometry cylinder"):
        read_scan(tmp_path / "bowl.ply", options=ReadOptions(SIZE, geometry="sphere"))
    with pytest.raises(ExchangeError, match="not inside"):
        read_scan(tmp_path / "ball.ply", options=ReadOptions(SIZE, geometry="sphere", centre_mm=70))


def test_points_are_no_sphere(tmp_path: Path) -> None:
    untyped.PointCloud(ball().vertices).export(tmp_path / "points.ply")
    with pytest.raises(ExchangeError, match="points are not closed"):
        read_scan(tmp_path / "points.ply", options=ReadOptions(SIZE, geometry="sphere"))


def test_a_grid_keeps_its_geometry_unless_another_is_wanted(tmp_path: Path) -> None:
    with open(tmp_path / "potato.npz", "wb") as file:
        write_native(potato(), file, "potato", "grown")
    path = tmp_path / "potato.npz"
    assert read_scan(path).grid.spec == potato().spec and read_scan(path).note == "grown"
    level = read_scan(path, options=ReadOptions(geometry="cylinder"))
    assert level.grid.spec.geometry == "cylinder" and level.note.startswith("grown. ")
    with open(tmp_path / "level.npz", "wb") as file:
        write_native(level.grid, file)
    closed = read_scan(tmp_path / "level.npz", options=ReadOptions(geometry="sphere", caps=True))
    assert closed.grid.spec.geometry == "sphere" and "A cylinder seen from a centre" in closed.note
    with pytest.raises(ExchangeError, match="--geometry sphere"):
        ReadOptions(geometry="cylinder", caps=True)


def test_a_vertex_at_the_centre_has_no_direction_and_does_no_harm() -> None:
    spoke = trimesh.Trimesh([[0, 0, 0], [20, 0, 0], [20, 3, 0]], [[0, 1, 2]], process=False)
    grid, seen = close_mesh(grey(joined(ball(), spoke)), SIZE, centre_mm=0.0)
    assert grid.range_steps.min() * grid.spec.step_mm > 49.5
    assert 0 < seen.hidden < 0.01


def test_a_spherical_grid_file_comes_back_and_must_be_thinned() -> None:
    file = io.BytesIO()
    write_native(potato(), file, "potato")
    name, grid, _ = read_native(file)
    assert (name, grid.spec) == ("potato", potato().spec)
    steps = grid.range_steps.copy()
    steps[0, 1] += 1
    write_native(Grid(grid.spec, steps, grid.texture), file := io.BytesIO())
    with pytest.raises(ExchangeError, match="thinned"):
        read_native(file)
