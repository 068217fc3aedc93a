"""Every mesh format, opened by trimesh and held against the grid it was made from."""

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from numpy.typing import NDArray

from exchange import glb as glb_module
from exchange import ply as ply_module
from exchange.errors import ExchangeError
from exchange.formats import writer_of
from exchange.glb import write_glb
from exchange.mesh import BAND_CELLS, GridMesh, Seam, sample_lattice
from exchange.ply import write_ply
from protocol.grid import VOID, FloatArray, Grid, GridSpec
from tests.exchange.grids import grids, texture, vase

FORMATS = [".glb", ".ply", ".obj.zip", ".stl"]
Y_UP_METRES = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) / 1000


def opened(grid: Grid, suffix: str, folder: Path) -> trimesh.Trimesh:
    """A grid as trimesh sees it in a file, in millimetres and with z up again."""
    path = folder / f"model{suffix}"
    with open(path, "w+b") as file:
        writer_of(suffix)(grid, file)
    if suffix == ".obj.zip":
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        path = folder / "model.obj"
    (mesh,) = trimesh.load_scene(path, process=False).dump()
    assert isinstance(mesh, trimesh.Trimesh)
    if suffix == ".glb":
        mesh.apply_transform(np.block([[Y_UP_METRES.T * 1e6, np.zeros((3, 1))], [np.zeros((1, 3)), np.eye(1)]]))
    return mesh


def welded(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Joined where positions are the same, whatever their texture coordinates."""
    plain = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    plain.merge_vertices(digits_vertex=4)
    return plain


def true_positions(grid: Grid) -> FloatArray:
    rows, columns = np.nonzero(grid.range_steps)
    radius, angle = grid.range_steps[rows, columns] * grid.spec.step_mm, grid.spec.angle_rad(columns)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), grid.spec.height_mm(rows)], axis=1)


def boundary_heights(mesh: trimesh.Trimesh) -> NDArray[np.float64]:
    """Heights of the ends of every edge that only one face has."""
    edges, faces = np.unique(np.asarray(mesh.edges_sorted), axis=0, return_counts=True)
    heights: FloatArray = np.asarray(mesh.vertices)[edges[faces == 1]][..., 2]
    return heights


@pytest.mark.parametrize("suffix", FORMATS)
def test_vertices_are_the_measured_samples_in_millimetres(suffix: str, tmp_path: Path) -> None:
    grid = vase(holes=True)
    mesh, truth = opened(grid, suffix, tmp_path), true_positions(grid)
    distance = np.linalg.norm(np.asarray(mesh.vertices)[:, None] - truth, axis=2)
    assert distance.min(axis=1).max() < 1e-4
    lone = 0 if suffix in (".glb", ".ply") else 1  # no triangle has it: not in an STL, and dropped here from an OBJ
    assert np.count_nonzero(distance.min(axis=0) > 1e-4) == lone


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_seam_is_closed(suffix: str, tmp_path: Path) -> None:
    spec = vase().spec
    heights = boundary_heights(welded(opened(vase(), suffix, tmp_path)))
    assert len(heights) == 2 * spec.width
    assert set(np.round(heights.ravel(), 3)) == set(np.round(spec.height_mm(np.array([0, spec.height - 1])), 3))


@pytest.mark.parametrize("suffix", FORMATS)
def test_triangles_wind_outward(suffix: str, tmp_path: Path) -> None:
    mesh = opened(vase(holes=True), suffix, tmp_path)
    outward = np.asarray(mesh.triangles_center) * (1, 1, 0)
    assert (np.einsum("ij,ij->i", np.asarray(mesh.face_normals), outward) > 0).all()


def test_normals_are_those_of_the_surface() -> None:
    spec = GridSpec(360, 100, 8, 8, step_mm=0.001, pitch_mm=0.4)
    radius, around, up = vase_mm(spec)
    mesh = GridMesh(Grid(spec, np.rint(radius / spec.step_mm).astype(np.uint16), texture(8, 8)), Seam.SHARED)
    normals = np.concatenate([mesh.normals(band) for band in mesh.bands()]).reshape(100, 360, 3)
    angle = spec.angle_rad(np.arange(360))
    cos, sin = np.cos(angle), np.sin(angle)
    expected = np.stack([radius * cos + around * sin, radius * sin - around * cos, -radius * up], axis=-1)
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    assert (normals * expected).sum(axis=-1)[1:-1].min() > 0.99999
    assert (normals * expected).sum(axis=-1).min() > 0.9999


def test_files_carry_the_normals() -> None:
    grid = vase(holes=True)
    written = io.BytesIO(), io.BytesIO()
    write_ply(grid, written[0])
    write_glb(grid, written[1])
    ply = np.frombuffer(written[0].getvalue().partition(b"end_header\n")[2], ply_module.VERTEX, count=1361)
    head = int.from_bytes(written[1].getvalue()[12:16], "little")
    glb = np.frombuffer(written[1].getvalue(), glb_module.VERTEX, count=1361, offset=28 + head)
    for vertices, seam in ((ply, Seam.SHARED), (glb, Seam.DOUBLED)):
        mesh = GridMesh(grid, seam)
        normals = np.concatenate([mesh.normals(band) for band in mesh.bands()])[:1361]
        assert np.array_equal(vertices["normal"], normals[:, [0, 2, 1]] * (1, 1, -1) if vertices is glb else normals)


def vase_mm(spec: GridSpec) -> tuple[FloatArray, FloatArray, FloatArray]:
    """A vase's range and its slopes round the axis and up. (H, W) [mm, mm / rad, mm / mm]"""
    turn = 2 * np.pi * (np.arange(spec.width) + 0.5) / spec.width
    height = -spec.height_mm(np.arange(spec.height))[:, None] / 10
    radius = 40 + 3 * np.cos(3 * turn) + 5 * np.sin(height)
    return radius, -9 * np.sin(3 * turn) + 0 * height, -0.5 * np.cos(height) + 0 * turn


@pytest.mark.parametrize("suffix", FORMATS)
def test_holes_are_holes_and_a_corner_of_three_is_a_triangle(suffix: str, tmp_path: Path) -> None:
    grid = vase(holes=True)
    measured = grid.range_steps != VOID
    closed = np.concatenate([measured, measured[:, :1]], axis=1)
    corners = closed[:-1, :-1].astype(int) + closed[:-1, 1:] + closed[1:, :-1] + closed[1:, 1:]
    mesh = opened(grid, suffix, tmp_path)
    assert len(mesh.faces) == 2 * np.count_nonzero(corners == 4) + np.count_nonzero(corners == 3)


@pytest.mark.parametrize("suffix", [".glb", ".obj.zip"])
def test_the_texture_shows_each_vertex_its_own_colour(suffix: str, tmp_path: Path) -> None:
    grid = vase(holes=True)
    mesh = opened(grid, suffix, tmp_path)
    visual: Any = mesh.visual
    picture = visual.material.baseColorTexture if suffix == ".glb" else visual.material.image
    image = np.asarray(picture.convert("RGB"))
    assert np.array_equal(image, grid.texture)
    u, v = np.asarray(visual.uv).T
    angle = np.arctan2(*np.asarray(mesh.vertices)[:, [1, 0]].T)
    expected_u = (angle - grid.spec.theta0_rad) / (2 * np.pi)
    assert np.abs((u - expected_u + 0.5) % 1 - 0.5).max() < 1e-6
    expected_v = 1 - (grid.spec.z_max_mm - np.asarray(mesh.vertices)[:, 2]) / (grid.spec.height * grid.spec.pitch_mm)
    assert np.abs(v - expected_v).max() < 1e-6
    across_faces = np.ptp(u[np.asarray(mesh.faces)], axis=1)
    assert across_faces.max() < 1.5 / grid.spec.width  # no face runs the long way round the texture


def test_ply_vertices_have_the_texture_s_colours(tmp_path: Path) -> None:
    grid = vase(holes=True)
    visual: Any = opened(grid, ".ply", tmp_path).visual
    colours = np.asarray(visual.vertex_colors)[:, :3]
    rows, columns = np.nonzero(grid.range_steps)
    turn = 2 * np.pi * (columns + 0.5) / grid.spec.width
    down = (rows + 0.5) / grid.spec.height
    expected = np.stack([128 + 100 * np.cos(turn), 128 + 100 * np.sin(turn), 20 + 200 * down], axis=1)
    assert np.abs(colours - expected).max() <= 2


def test_sampling_is_exact_at_texel_centres_and_cyclic() -> None:
    image = texture(10, 6)
    u, v = (np.arange(-10, 20) + 0.5) / 10, (np.arange(6) + 0.5) / 6
    assert np.array_equal(sample_lattice(image, u, v), np.tile(image, (1, 3, 1)))


def test_the_doubled_column_is_exactly_the_first() -> None:
    mesh = GridMesh(vase(), Seam.DOUBLED)
    (band,) = mesh.bands()
    of_rows = mesh.positions(band).reshape(vase().spec.height, -1, 3), mesh.normals(band).reshape(30, -1, 3)
    for values in of_rows:
        assert np.array_equal(values[:, 0], values[:, -1])


@given(grids())
def test_bands_of_any_height_give_the_same_mesh(grid: Grid) -> None:
    def everything(seam: Seam) -> list[NDArray[np.generic]]:
        mesh = GridMesh(grid, seam)
        whole = [np.concatenate(list(mesh.face_bands())), np.concatenate(list(mesh.triangle_bands()))]
        for part in (mesh.positions, mesh.normals, mesh.texture_coordinates, mesh.colours):
            whole.append(np.concatenate([part(band) for band in mesh.bands()]))
        assert (len(whole[0]), len(whole[2])) == (mesh.faces, mesh.vertices)
        return whole

    for seam in Seam:
        with pytest.MonkeyPatch.context() as patch:
            at_once = everything(seam)
            patch.setattr("exchange.mesh.BAND_CELLS", grid.spec.width)
            for one, other in zip(at_once, everything(seam), strict=True):
                assert np.array_equal(one, other)
    assert BAND_CELLS > grid.spec.width


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("shape", [(2, 5), (5, 1)])
def test_a_grid_without_a_surface_is_refused(suffix: str, shape: tuple[int, int]) -> None:
    spec = GridSpec(*shape, 1, 1, step_mm=0.1, pitch_mm=1)
    grid = Grid(spec, np.full(shape[::-1], 9, np.uint16), np.zeros((1, 1, 3), np.uint8))
    with pytest.raises(ExchangeError, match="spans no surface"):
        writer_of(suffix)(grid, io.BytesIO())


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_grid_with_nothing_measured_is_refused(suffix: str) -> None:
    grid = vase()
    empty = Grid(grid.spec, np.zeros_like(grid.range_steps), grid.texture)
    with pytest.raises(ExchangeError, match="nothing is measured"):
        writer_of(suffix)(empty, io.BytesIO())


@pytest.mark.parametrize("suffix", [*FORMATS, ".npz"])
def test_the_same_grid_gives_the_same_file(suffix: str) -> None:
    files = io.BytesIO(), io.BytesIO()
    for file in files:
        writer_of(suffix)(vase(), file)
    assert files[0].getvalue() == files[1].getvalue()
