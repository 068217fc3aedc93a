"""Grids from meshes: what we write comes back, and trimesh's own rays see what ours see."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from exchange import cast
from exchange.cast import Mesh, cast_mesh, fit_spec
from exchange.errors import ExchangeError
from exchange.formats import ReadOptions, read_scan, writer_of
from exchange.mesh import GridMesh, Seam
from exchange.mesh_file import Placing
from exchange.mesh_file import read_mesh as read_anything
from exchange.points import Points, bin_points
from protocol.grid import VOID, BoolArray, FloatArray, Grid, GridSpec
from tests.exchange.grids import grids, vase

SIZE = (96, 50, 64, 40)
untyped: Any = trimesh  # for what it has no types for


def grey(corners: FloatArray) -> Mesh:
    m = len(corners)
    colours = np.full((m, 3, 3), 128, np.uint8)
    return Mesh(np.asarray(corners, np.float64), np.full(m, -1), np.zeros((m, 3, 2), np.float32), colours, ())


def read_mesh(path: Path, *more: Any, **options: Any) -> Mesh:
    mesh = read_anything(path, *more, **options)
    assert isinstance(mesh, Mesh)
    return mesh


def triangles_of(grid: Grid) -> FloatArray:
    return np.concatenate(list(GridMesh(grid, Seam.SHARED).triangle_bands()))


def in_a_face(grid: Grid) -> BoolArray:
    """Samples that some triangle has; others are in no mesh."""
    mesh = GridMesh(grid, Seam.SHARED)
    used = np.zeros(mesh.vertices, bool)
    for faces in mesh.face_bands():
        used[faces] = True
    found = np.zeros(grid.range_steps.shape, bool)
    found[grid.range_steps != VOID] = used
    return found


@given(grids())
def test_a_mesh_of_a_grid_is_cast_back_to_the_same_grid_within_a_step(grid: Grid) -> None:
    back = cast_mesh(grey(triangles_of(grid)), grid.spec)
    expected = np.where(in_a_face(grid), grid.range_steps, VOID).astype(int)
    assert np.array_equal(back.range_steps != VOID, expected != VOID)
    assert np.abs(back.range_steps - expected).max() <= 1


@pytest.mark.parametrize("suffix", [".glb", ".ply", ".stl", ".obj"])
@pytest.mark.parametrize("holes", [False, True])
def test_an_exported_file_is_imported_as_the_same_grid_within_a_step(suffix: str, holes: bool, tmp_path: Path) -> None:
    grid, path = vase(holes), tmp_path / f"model{suffix}"
    if suffix == ".obj":
        with open(tmp_path / "zipped", "w+b") as file:
            writer_of(".obj.zip")(grid, file)
        zipfile.ZipFile(tmp_path / "zipped").extractall(tmp_path)
    else:
        with open(path, "w+b") as file:
            writer_of(suffix)(grid, file)
    back = cast_mesh(read_mesh(path), grid.spec)
    expected = np.where(in_a_face(grid), grid.range_steps, VOID).astype(int)
    assert np.array_equal(back.range_steps != VOID, expected != VOID)
    assert np.abs(back.range_steps - expected).max() <= 1
    if suffix in (".glb", ".obj"):
        seen = back.texture.any(axis=2)
        assert np.abs(back.texture[seen].astype(int) - grid.texture[seen]).max() <= 2
        assert seen.mean() > (0.8 if holes else 0.95)


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_ranges_are_those_of_a_brute_force(seed: int) -> None:
    """Triangles anywhere, also round and through the axis, against the textbook's ray and triangle."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-20, 20, (6, 3, 3))
    spec = GridSpec(24, 12, 1, 1, step_mm=0.001, pitch_mm=3, z_max_mm=18, theta0_rad=float(rng.uniform(-9, 9)))
    try:
        ours = cast_mesh(grey(corners), spec).range_mm
    except ExchangeError:
        ours = np.full((12, 24), np.nan)
    truth, doubtful = brute_force(corners, spec)
    assert (
        np.array_equal(np.isnan(ours), np.isnan(truth), equal_nan=True)
        or (np.isnan(ours) != np.isnan(truth))[~doubtful].sum() == 0
    )
    clear = ~doubtful & ~np.isnan(truth)
    assert np.abs(ours - truth)[clear].max(initial=0) < 0.002


def brute_force(corners: FloatArray, spec: GridSpec) -> tuple[FloatArray, BoolArray]:
    """Largest range at which each ray meets any triangle, and whether a ray runs too near an edge to tell."""
    angle, height = np.meshgrid(spec.angle_rad(np.arange(spec.width)), spec.height_mm(np.arange(spec.height)))
    direction = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    origin = np.stack([np.zeros_like(angle), np.zeros_like(angle), height], axis=-1)
    found, doubtful = np.full(angle.shape, np.nan), np.zeros(angle.shape, bool)
    for a, b, c in corners:
        matrix = np.stack(
            [np.broadcast_to(b - a, direction.shape), np.broadcast_to(c - a, direction.shape), -direction], -1
        )
        p, q, distance = np.moveaxis(np.linalg.solve(matrix, (origin - a)[..., None])[..., 0], -1, 0)
        least = np.minimum(np.minimum(p, q), 1 - p - q)
        doubtful |= (np.abs(least) < 1e-3) | (np.abs(distance) < 0.01)
        hit = (least >= 0) & (distance > 0)
        found = np.where(hit & ~(distance <= found), distance, found)
    return found, doubtful


def test_batches_and_bands_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=40)
    mesh = grey(np.asarray(sphere.triangles))
    at_once = cast_mesh(mesh, fit_spec(mesh.corners, SIZE))
    monkeypatch.setattr(cast, "BAND_RAYS", 300)
    monkeypatch.setattr(cast, "BATCH_TRIALS", 50)
    in_parts = cast_mesh(mesh, fit_spec(mesh.corners, SIZE))
    assert np.array_equal(at_once.range_steps, in_parts.range_steps)
    assert np.array_equal(at_once.texture, in_parts.texture)


def test_a_sphere_is_a_sphere() -> None:
    mesh = grey(np.asarray(trimesh.creation.icosphere(subdivisions=5, radius=40).triangles))
    grid = cast_mesh(mesh, fit_spec(mesh.corners, SIZE))
    height = grid.spec.height_mm(np.arange(grid.spec.height))
    expected = np.sqrt(40**2 - height**2)[:, None]
    assert np.abs(grid.range_mm - expected).max() < 0.08  # of the sphere, by 20,480 flat triangles
    assert (grid.texture == 128).all()


def test_the_outermost_surface_is_seen() -> None:
    inner, outer = (trimesh.creation.cylinder(radius, 20, sections=64) for radius in (10, 30))
    mesh = grey(np.concatenate([np.asarray(outer.triangles), np.asarray(inner.triangles)]))
    assert cast_mesh(mesh, fit_spec(mesh.corners, SIZE)).range_mm.min() > 29.9


def test_a_surface_behind_the_axis_is_not_seen() -> None:
    wall = np.array([[[10.0, -5, -5], [10, 5, -5], [10, 0, 5]]])
    mesh = grey(wall)
    grid = cast_mesh(mesh, fit_spec(mesh.corners, (360, 20, 8, 8)))
    seen = np.flatnonzero((grid.range_steps != VOID).any(axis=0))
    assert set(seen) <= {*range(27), *range(333, 360)} and len(seen) > 40


def test_progress_ends_at_one() -> None:
    told: list[float] = []
    mesh = grey(np.asarray(trimesh.creation.icosphere().triangles))
    cast_mesh(mesh, fit_spec(mesh.corners, SIZE), told.append)
    assert told == sorted(told) and told[-1] == 1


@pytest.mark.parametrize(
    ("corners", "message"),
    [
        (np.zeros((0, 3, 3)), "none"),
        (np.full((1, 3, 3), np.inf), "finite"),
        (np.zeros((1, 3, 3)), "pitch_mm"),
        (np.arange(9.0).reshape(1, 3, 3) * 1e6, "pitch_mm"),
    ],
)
def test_a_mesh_no_grid_can_hold_is_refused(corners: FloatArray, message: str) -> None:
    with pytest.raises(ExchangeError, match=message):
        fit_spec(corners, SIZE)


def test_a_mesh_that_takes_too_long_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = grey(np.asarray(trimesh.creation.icosphere().triangles))
    monkeypatch.setattr(cast, "TRIALS_MAX", 100)
    with pytest.raises(ExchangeError, match="1280 faces need"):
        cast_mesh(mesh, fit_spec(mesh.corners, SIZE))


def test_a_mesh_no_ray_meets_is_refused() -> None:
    mesh = grey(np.asarray(trimesh.creation.icosphere().triangles))
    with pytest.raises(ExchangeError, match="no ray"):
        cast_mesh(mesh, GridSpec(8, 8, 8, 8, step_mm=0.1, pitch_mm=1, z_max_mm=1000))


@pytest.mark.parametrize("up", ["z", "y", "x", "-z", "-y", "-x"])
def test_the_axis_that_points_up_is_up(up: str, tmp_path: Path) -> None:
    axis, sign = "xyz".index(up[-1]), -1 if up[0] == "-" else 1
    cone = trimesh.creation.cone(10, 50)  # its point at z = 50
    towards = np.zeros(3)
    towards[axis] = sign
    cone.apply_transform(untyped.geometry.align_vectors([0, 0, 1], towards))
    cone.export(tmp_path / "cone.stl")
    mesh = read_mesh(tmp_path / "cone.stl", Placing(up=up))
    radius = np.hypot(mesh.corners[..., 0], mesh.corners[..., 1])
    assert mesh.corners[..., 2].max() == pytest.approx(50, abs=1e-4) and radius[mesh.corners[..., 2] > 49].max() < 1e-3
    assert (np.einsum("ij,ij->i", *_normals_and_centres(mesh)) > 0).mean() > 0.45  # not turned inside out


def _normals_and_centres(mesh: Mesh) -> tuple[FloatArray, FloatArray]:
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    return np.cross(b - a, c - a), (mesh.corners.mean(axis=1) - mesh.corners.mean(axis=(0, 1)))


def test_a_mesh_beside_the_axis_is_refused_and_centred_on_demand(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(radius=5)
    ball.apply_translation([20, 0, 0])
    ball.export(tmp_path / "ball.ply")
    with pytest.raises(ExchangeError, match="--centre"):
        read_mesh(tmp_path / "ball.ply")
    centred = read_mesh(tmp_path / "ball.ply", Placing(centred=True, unit_mm=2))
    assert np.abs(centred.corners).max() == pytest.approx(10, rel=0.01)


def test_colours_of_faces_and_vertices_are_kept(tmp_path: Path) -> None:
    for kind in ("vertex_colors", "face_colors"):
        ball = trimesh.creation.icosphere(radius=5)
        setattr(ball.visual, kind, [10, 200, 30, 255])
        ball.export(tmp_path / "ball.ply")
        mesh = read_mesh(tmp_path / "ball.ply")
        assert (cast_mesh(mesh, fit_spec(mesh.corners, SIZE)).texture == (10, 200, 30)).all()


def test_a_material_s_plain_colour_is_kept(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(radius=0.005)
    ball.visual = untyped.visual.TextureVisuals(
        material=untyped.visual.material.PBRMaterial(baseColorFactor=[9, 99, 199])
    )
    ball.export(tmp_path / "ball.glb")
    mesh = read_mesh(tmp_path / "ball.glb")
    assert (cast_mesh(mesh, fit_spec(mesh.corners, SIZE)).texture == (9, 99, 199)).all()


def test_an_image_for_a_mesh_without_texture_coordinates_is_refused(tmp_path: Path) -> None:
    trimesh.creation.icosphere(radius=5).export(tmp_path / "ball.ply")
    with pytest.raises(ExchangeError, match="no texture coordinates"):
        read_mesh(tmp_path / "ball.ply", texture=np.zeros((4, 4, 3), np.uint8))


def test_texture_coordinates_that_no_image_repeats_to_are_refused(tmp_path: Path) -> None:
    faces = "f 1/1 2/1 3/1\nf 1/1 3/1 4/1\nf 1/1 4/1 2/1\nf 2/1 4/1 3/1\n"
    corners = "v 0 0 9\nv 5 0 0\nv -5 5 0\nv -5 -5 0\n"
    for u, message in (("1e30", "texture coordinates: beyond"), ("nan", "not finite")):
        (tmp_path / "a.obj").write_text(f"{corners}vt {u} 0\n{faces}")
        with pytest.raises(ExchangeError, match=message):
            read_mesh(tmp_path / "a.obj", texture=np.zeros((4, 4, 3), np.uint8))


def test_parts_stand_where_the_scene_puts_them_and_keep_their_own_textures(tmp_path: Path) -> None:
    scene = untyped.Scene()
    for name, height, colour in (("top", 0.03, 200), ("bottom", 0.0, 50)):
        with open(tmp_path / f"{name}.glb", "w+b") as file:
            spec = GridSpec(24, 6, 8, 4, step_mm=0.01, pitch_mm=5, z_max_mm=15)
            colours = np.full((4, 8, 3), colour, np.uint8)
            writer_of(".glb")(Grid(spec, np.full((6, 24), 3000, np.uint16), colours), file)
        ((part, _),) = [
            (scene_part, 0) for scene_part in trimesh.load_scene(tmp_path / f"{name}.glb").geometry.values()
        ]
        scene.add_geometry(part, name, transform=untyped.transformations.translation_matrix([0, height, 0]))
    scene.export(tmp_path / "both.glb")
    mesh = read_mesh(tmp_path / "both.glb")
    grid = cast_mesh(mesh, GridSpec(24, 11, 24, 11, step_mm=0.01, pitch_mm=5, z_max_mm=42.5))
    rows = grid.texture[:, 0, 0].tolist()
    assert rows == [200] * 5 + [0] + [50] * 5 and (grid.range_steps[:5] == 3000).all()


def _glb(path: Path, count: object) -> None:
    head = (
        b'{"asset":{"version":"2.0"},"accessors":[{"count":%s,"componentType":5126,"type":"VEC3"}]}'
        % str(count).encode()
    )
    head += b" " * (-len(head) % 4)
    path.write_bytes(
        b"glTF" + b"".join(n.to_bytes(4, "little") for n in (2, 20 + len(head), len(head))) + b"JSON" + head
    )


@pytest.mark.parametrize("count", [10**13, -1, '"many"', "1e400", "NaN"])
def test_a_glb_that_would_allocate_without_bound_is_refused_by_field(count: object, tmp_path: Path) -> None:
    _glb(tmp_path / "bomb.glb", count)
    with pytest.raises(ExchangeError, match=r"accessors\[0\]\.count|is no .glb file"):
        read_mesh(tmp_path / "bomb.glb")


@pytest.mark.parametrize("suffix", [".glb", ".gltf", ".obj", ".ply", ".stl", ".off"])
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"garbage \xff\x00" * 40,
        b"glTF" + bytes(30),
        b"ply\nformat binary_little_endian 1.0\nelement vertex 99999999999\nproperty float x\nend_header\n",
    ],
)
def test_bytes_that_are_no_mesh_are_refused(suffix: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / f"bad{suffix}").write_bytes(content)
    with pytest.raises(ExchangeError, match="bad"):
        read_mesh(tmp_path / f"bad{suffix}")


def test_points_are_binned_to_the_cells_they_are_seen_in(tmp_path: Path) -> None:
    grid = vase(holes=True)
    mesh = GridMesh(grid, Seam.SHARED)
    (band,) = mesh.bands()
    cloud = untyped.PointCloud(np.concatenate([mesh.positions(band), mesh.positions(band) * (0.5, 0.5, 1)]))
    cloud.colors = np.concatenate([mesh.colours(band), np.zeros_like(mesh.colours(band))])
    cloud.export(tmp_path / "vase.ply")
    points = read_anything(tmp_path / "vase.ply")
    assert isinstance(points, Points)
    back = bin_points(points, GridSpec(48, 30, 48, 30, 0.01, 1.5, 31.0, 0.4))
    assert np.array_equal(back.range_steps != VOID, grid.range_steps != VOID)
    assert np.abs(back.range_steps.astype(int) - grid.range_steps).max() <= 1
    assert np.array_equal(back.texture[grid.range_steps != VOID], mesh.colours(band))
    name, fitted, _ = read_scan(tmp_path / "vase.ply", None, ReadOptions((48, 29, 9, 9), theta0_rad=0.4))
    assert name == "vase" and fitted.texture.shape == (29, 48, 3)


def test_a_range_grid_is_read_as_its_points(tmp_path: Path) -> None:
    """The PLY dialect of Cyberware and Stanford: a grid of lists with one vertex or none."""
    head = "ply\nformat ascii 1.0\nobj_info num_cols 2\nobj_info num_rows 2\nelement vertex 3\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    head += "element range_grid 4\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "grid.ply").write_text(head + "10 0 0\n-10 0 5\n0 10 9\n1 0\n1 1\n0\n1 2\n")
    points = read_anything(tmp_path / "grid.ply")
    assert isinstance(points, Points) and points.positions.tolist() == [[10, 0, 0], [-10, 0, 5], [0, 10, 9]]
    assert (points.colours == 128).all()
