"""The picture of a first view: where what was measured stands in it, what it shows, that it is drawn once."""

from __future__ import annotations

import asyncio
import math
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from node.coarse import build_coarse
from node.exhibits import Work
from node.library import About, Library
from node.picture import ELEVATION_RAD, FIELD_OF_VIEW_RAD, HEIGHT, MARGIN, draw_picture
from protocol.grid import Geometry, Grid, GridSpec, ImageArray
from tests.node.scans import make_grid
from tests.node.served import served

RADIUS_MM, HALF_MM = 40.0, 60.0


def drawn(grid: Grid) -> ImageArray:
    """RGBA, (HEIGHT, width, 4)."""
    picture = cv2.imdecode(np.frombuffer(draw_picture(build_coarse(grid)), np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture is not None
    return np.asarray(picture[..., [2, 1, 0, 3]], np.uint8)


def grid_of(geometry: Geometry, measured: bool = True) -> Grid:
    """A post 80 mm wide and 120 mm high, or a ball as wide: red in front, blue behind, on the left brighter."""
    z_max = 0.0 if geometry == "sphere" else HALF_MM
    spec = GridSpec(360, 96, 720, 192, 0.01, 2 * HALF_MM / 96, z_max, 0.0, geometry)
    steps = np.full((96, 360), int(RADIUS_MM / 0.01) * measured, np.uint16)
    texture = np.zeros((192, 720, 3), np.uint8)
    texture[:, np.r_[0:180, 540:720], 0] = 200
    texture[:, 180:540, 2] = 200
    texture[:, 540:, 1] = 100  # at negative angles: at the left, seen from angle 0
    return Grid(spec, steps, texture)


def test_a_post_stands_where_the_page_would_draw_it() -> None:
    picture = drawn(grid_of("cylinder"))
    half = math.tan(FIELD_OF_VIEW_RAD / 2)
    distance_mm = MARGIN * (RADIUS_MM + HALF_MM / half)
    assert picture.shape == (HEIGHT, round(HEIGHT * RADIUS_MM / HALF_MM), 4)
    rows, columns = np.nonzero(picture[..., 3] > 127)
    in_front = np.array([[RADIUS_MM, -HALF_MM], [RADIUS_MM, HALF_MM]])  # towards the camera, up
    sine, cosine = math.sin(ELEVATION_RAD), math.cos(ELEVATION_RAD)
    up, near = (in_front @ [[-sine, cosine], [cosine, sine]]).T
    foot = (1 - up[0] / (distance_mm - near[0]) / half) / 2 * HEIGHT
    assert rows.max() == pytest.approx(foot, abs=3)
    tangent_mm = RADIUS_MM / math.sqrt(1 - (RADIUS_MM / distance_mm) ** 2)
    assert (columns.max() - columns.min()) / HEIGHT == pytest.approx(tangent_mm / distance_mm / half, rel=0.03)
    assert columns.min() + columns.max() == pytest.approx(picture.shape[1] - 1, abs=2)


@pytest.mark.parametrize("geometry", ["cylinder", "sphere"])
def test_it_shows_the_front_the_right_way_round(geometry: Geometry) -> None:
    picture = drawn(grid_of(geometry)).astype(int)
    height, width = picture.shape[:2]
    left, right = picture[height // 2, width // 4], picture[height // 2, -width // 4]
    assert left[0] > 100 and right[0] > 100 and max(left[2], right[2]) < 60, "red, not the blue behind"
    assert left[1] > right[1] + 40
    assert (picture[height // 4 : -height // 4, width // 3 : -width // 3, 3] == 255).all(), "there are no holes"


@pytest.mark.parametrize("scale", [1e-6 * 96 / 120, 1e3 * 96 / 120])
def test_a_scan_at_a_bound_of_its_pitch_looks_like_any(scale: float) -> None:
    usual = grid_of("cylinder")
    spec = replace(usual.spec, step_mm=max(1e-6, 0.01 * scale), pitch_mm=scale * usual.spec.pitch_mm, z_max_mm=0.0)
    steps = np.full_like(usual.range_steps, round(RADIUS_MM * scale / spec.step_mm))
    picture = drawn(Grid(spec, steps, usual.texture))
    assert np.abs(picture.astype(int) - drawn(usual)).mean() < 2


def test_nothing_measured_is_transparent() -> None:
    assert not drawn(grid_of("cylinder", measured=False))[..., 3].any()


async def test_it_is_drawn_once_and_gone_with_its_scan(tmp_path: Path) -> None:
    jobs: list[Work] = []
    with closing(Library(tmp_path)) as library:
        async with served(library) as (client, server):
            server._exhibits.tell(lambda of, waited_s, took_s: jobs.append(of))
            for path, status in (("latest", 204), ("0" * 32, 204), ("no-scan", 404)):
                assert (await client.get(f"/v1/scans/{path}/picture")).status == status
            scan = library.add(make_grid(160, 96), About(0.0))
            jobs.clear()
            asked = (f"/v1/scans/{of}/picture" for of in ("latest", scan.id, scan.id[:8]))
            answers = await asyncio.gather(*map(client.get, asked))
            bodies = {await answer.read() for answer in answers}
            assert [answer.content_type for answer in answers] == ["image/webp"] * 3
            assert bodies == {draw_picture(scan.coarse)}
            assert len(jobs) == 1
            assert (await client.delete(f"/v1/scans/{scan.id}")).status == 204
            assert (await client.get(f"/v1/scans/{scan.id}/picture")).status == 204
