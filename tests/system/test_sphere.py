"""A closed object seen by direction: acceptance tests AT-14 to AT-16, through the public client and a real daemon."""

from __future__ import annotations

import asyncio
import io
import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import aiohttp
import numpy as np
import pytest
from numpy.typing import NDArray

from client import Model, RequestRefused, connect
from client.shared import open_shared, refinements_in
from client.transfer import send_scan
from exchange.native import write_native
from foveascan import started
from protocol.errors import LocalWireError
from protocol.grid import BoolArray, FloatArray, Grid, GridSpec, IntArray
from protocol.lattice import QUARTERS, Channel, Parameters
from protocol.messages import PROTOCOL, Hello, Open, Refused, decode_message, encode_message
from protocol.refinement import spacing_byte
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid, great_circle_rad, vectors
from protocol.sphere_fovea import SphereParameters
from protocol.strips import build_strips
from tests.system.line import surveyed

EXACT = {"range": {"p": 1, "quantum": 1}}
STEP_MM = 0.02
SIZE = (360, 184, 720, 360)
FINE = (1440, 1024, 360, 184)  # a block is 2 degrees wide: what it takes more than the cap hardly counts
WINDOW = 0.05
UPRIGHT = np.eye(3)
TIPPED = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # what faced along x looks straight up


def knob_mm(towards: FloatArray) -> FloatArray:
    """Distance of a lumpy object's surface from its centre, along unit vectors (..., 3)."""
    x, y, z = np.moveaxis(towards, -1, 0)
    lumps = np.sin(5 * x + 1) * np.cos(4 * y) + 0.6 * np.sin(5 * z - 3 * x) + 0.3 * np.cos(4 * y + 5 * x - 6 * z)
    return np.asarray(60 + lumps)


def pebble_mm(towards: FloatArray) -> FloatArray:
    """The same of a rough object: waves of every length, from everywhere."""
    random = np.random.default_rng(5)
    surface = np.full(towards.shape[:-1], 60.0)
    for waves in (2, 4, 8, 16, 32, 64):
        for along in random.normal(size=(6, 3)):
            surface += 3 / waves * np.sin(waves * towards @ along + random.uniform(0, 6))
    return surface


def spindle_mm(towards: FloatArray) -> FloatArray:
    """The same of an object that is round about its axis."""
    return np.asarray(60 + 5 * np.cos(6 * towards[..., 2]))


Shape = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Objects:
    """A node, and its scans by name."""

    url: str
    scans: dict[str, str]


def dense(width: int, height: int, turn: FloatArray) -> FloatArray:
    """The object's own direction along each dense direction, when it stands turned."""
    grid = DirectionGrid(width, height)
    row, column = np.mgrid[:height, :width]
    return vectors(grid.theta_v(row), grid.theta_h(column)) @ turn


def scan_of(shape_mm: Shape, turn: FloatArray, size: tuple[int, int, int, int] = SIZE) -> Grid:
    width, height, texture_width, texture_height = size
    steps = np.rint(shape_mm(dense(width, height, turn)) / STEP_MM).astype(np.uint16)
    colour = 128 + 90 * dense(texture_width, texture_height, turn)
    spec = GridSpec(*size, STEP_MM, math.pi * 60 / height, 40.0, 0.0, "sphere")
    return thin_grid(Grid(spec, steps, np.rint(colour).astype(np.uint8)))


SCANS: dict[str, tuple[Shape, FloatArray] | tuple[Shape, FloatArray, tuple[int, int, int, int]]] = {
    "knob": (knob_mm, UPRIGHT),
    "knob tipped": (knob_mm, TIPPED),
    "pebble": (pebble_mm, UPRIGHT),
    "fine pebble": (pebble_mm, UPRIGHT, FINE),
    "fine pebble tipped": (pebble_mm, TIPPED, FINE),
    "spindle": (spindle_mm, UPRIGHT),
}
SAME_PLACE = {"": (math.pi / 2, 0.0), " tipped": (0.0, 0.0)}


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Objects]:
    folder = tmp_path_factory.mktemp("sphere")
    serve = ["serve", "--library", str(folder), "--listen", "127.0.0.1:0", "--insecure", "--json"]
    with started(*serve) as (_, ready):
        yield Objects(ready["url"], {name: bring(ready["url"], name) for name in SCANS})


def bring(url: str, name: str) -> str:
    file = io.BytesIO()
    write_native(scan_of(*SCANS[name]), file, name)
    file.seek(0)
    return asyncio.run(send_scan(url, file, moved=lambda done, total: None)).scan


def left_in_cap(
    model: Model, true_mm: NDArray[np.floating[Any]], theta_v: float, theta_h: float, window: float = WINDOW
) -> tuple[FloatArray, FloatArray]:
    """How far off the model is in the window round a direction, and each sample's solid angle. (n,) [mm], (n,)"""
    inside, area = cap_of(true_mm.shape, theta_v, theta_h, window)
    return np.abs(model.range_mm - true_mm)[inside], area


@lru_cache(maxsize=8)
def cap_of(shape: tuple[int, int], theta_v: float, theta_h: float, window: float) -> tuple[BoolArray, FloatArray]:
    """Which dense directions are in the window round one, and the solid angles of those. (H, W), (n,)"""
    height, width = shape
    grid = DirectionGrid(width, height)
    row, column = np.mgrid[:height, :width]
    towards = vectors(grid.theta_v(row), grid.theta_h(column))
    edge_rad = 0.95 * math.acos(1 - 2 * window)  # sides of a window are whole samples
    inside = great_circle_rad(towards, vectors(theta_v, theta_h)) < edge_rad
    return inside, np.sin(grid.theta_v(row))[inside]


async def test_a_spherical_scan_opens_whole_with_its_geometry(objects: Objects) -> None:
    async with connect(objects.url) as session:
        model = await session.open(objects.scans["knob"])
        assert model.info.geometry == model.spec.geometry == "sphere"
        assert (model.range_steps > 0).all()
        assert np.median(left_in_cap(model, knob_mm(dense(*SIZE[:2], UPRIGHT)), 1.0, 1.0)[0]) < 1.0


@pytest.mark.parametrize(("down", "round_", "vertices", "faces"), [(8, 12, 86, 168), (12, 16, 178, 352)])
async def test_default_mesh(objects: Objects, down: int, round_: int, vertices: int, faces: int) -> None:  # AT-14
    async with connect(objects.url) as session:
        mesh = (await session.open(objects.scans["knob"])).default_mesh(down, round_)
    assert (len(mesh.positions_mm), len(mesh.faces)) == (vertices, faces)
    edges = {(int(a), int(b)) for face in mesh.faces for a, b in zip(face, np.roll(face, -1), strict=True)}
    assert len(edges) == 3 * faces and {(b, a) for a, b in edges} == edges
    on_axis = np.hypot(mesh.positions_mm[:, 0], mesh.positions_mm[:, 1]) < 1e-9
    assert np.flatnonzero(on_axis).tolist() == [0, vertices - 1]


@pytest.mark.parametrize("theta_v", [0.0, math.pi])
async def test_a_click_on_a_pole_refines_all_quadrants_alike(objects: Objects, theta_v: float) -> None:  # AT-15
    async with connect(objects.url) as session:
        model = await session.open(objects.scans["spindle"])
        coarse = model.range_steps.copy()
        (sent,) = (await session.look_direction(theta_v, 1.0, parameters=EXACT)).parameters
        strips = build_strips(model.shapes[Channel.RANGE], sent.parameters)
    assert sum(lattice.listed.any() for lattice in strips) > 1
    for lattice in strips:
        columns = np.unique(lattice.x.at // QUARTERS % lattice.shape.own_width) * lattice.shape.stride
        counted = np.bincount(columns // (SIZE[0] // 4))
        assert counted.max() - counted.min() <= 1
    changed = _by_quadrant(model.range_steps != coarse)
    assert changed.max() - changed.min() <= 1
    near_pole = slice(0, 16) if theta_v == 0 else slice(-16, None)
    assert np.array_equal(model.range_steps[near_pole], scan_of(*SCANS["spindle"]).range_steps[near_pole])


def _by_quadrant(cells: BoolArray) -> IntArray:
    return np.array([quarter.sum() for quarter in np.split(cells, 4, axis=1)])


async def test_a_turned_object_looks_the_same_at_the_same_place(objects: Objects) -> None:  # AT-15
    async with connect(objects.url) as session:
        for name, place in SAME_PLACE.items():
            model = await session.open(objects.scans[f"knob{name}"])
            await session.look_direction(*place, parameters=EXACT)
            shape_mm, turn = SCANS[f"knob{name}"][:2]
            true_mm = np.rint(shape_mm(dense(*SIZE[:2], turn)) / STEP_MM) * STEP_MM
            assert left_in_cap(model, true_mm, *place)[0].max() < 1.01 * STEP_MM


@pytest.mark.parametrize("window", [0.04, 0.05, 0.1])
async def test_a_turned_object_is_as_good_for_as_many_bytes(objects: Objects, window: float) -> None:  # AT-15
    """By the odd quanta: an even one takes more bytes than the next smaller odd one, and leaves more error."""
    upright, tipped = [
        [await _bytes_and_error(objects, f"fine pebble{turned}", place, window, quantum) for quantum in (9, 7, 5, 3, 1)]
        for turned, place in SAME_PLACE.items()
    ]
    assert upright[-1][1] == tipped[-1][1] == 0 and tipped[-1][0] <= 1.2 * upright[-1][0]
    curves = [np.log(curve[:-1]) for curve in (upright, tipped)]
    assert all((np.diff(curve, axis=0) * (1, -1) > 0).all() for curve in curves)
    size = np.linspace(max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves), 5)
    more = np.interp(size, *curves[1].T) - np.interp(size, *curves[0].T)
    assert np.exp(more).max() <= 1.1


async def _bytes_and_error(
    objects: Objects, name: str, place: tuple[float, float], window: float, quantum: int
) -> tuple[int, float]:
    """Payload and mean error in the window of one look at range, on a fresh model."""
    sampling = {"range": {"p": 1, "quantum": quantum}}
    async with connect(objects.url) as session:
        model = await session.open(objects.scans[name])
        update = await session.look_direction(*place, window=window, parameters=sampling)
    error, area = left_in_cap(model, truth_mm(name), *place, window)
    return update.payload_bytes, float(error @ area / area.sum())


@lru_cache(maxsize=2)
def truth_mm(name: str) -> FloatArray:
    """Range of a scan."""
    return np.asarray(scan_of(*SCANS[name]).range_mm, np.float64)


async def test_the_papers_lattices_send_radial_values_only(objects: Objects) -> None:  # AT-16
    async with connect(objects.url) as session:
        for lattice, theta_v in itertools.product(("literal", "rotated"), (math.pi / 2, 0.3, 0.0)):
            model = await session.open(objects.scans["knob"], profile="classic")
            sphere = {"lattice": lattice, "m": 5, "n": 3, "alpha": 0.5, "s": 20.0}
            update = await session.look_direction(theta_v, 1.0, parameters={"range": {}, "sphere": sphere})
            (sent,) = update.parameters
            assert isinstance(sent.parameters, SphereParameters)
            at_v, at_h = model.directions(Channel.RANGE, sent.parameters)
            assert len(at_v) == update.samples and update.payload_bytes == 2 * update.samples
            assert update.samples == 11 * 7 - (6 if lattice == "literal" and theta_v == 0 else 0)
            row, column = DirectionGrid(*SIZE[:2]).snap(at_v, at_h)
            assert np.array_equal(model.range_steps[row, column], scan_of(*SCANS["knob"]).range_steps[row, column])
            assert (model.owner[row, column] == 1).all() and 0 < (model.owner == 1).mean() < 0.2


@pytest.mark.parametrize("theta_v", [0.0, 1.0, math.pi])
async def test_rings_round_a_direction_by_the_classic_profile(objects: Objects, theta_v: float) -> None:
    async with connect(objects.url) as session:
        model = await session.open(objects.scans["knob"], profile="classic")
        first = left_in_cap(model, knob_mm(dense(*SIZE[:2], UPRIGHT)), theta_v, 2.0)[0].mean()
        update = await session.look_direction(theta_v, 2.0)
        assert [sent.channel for sent in update.parameters] == ["range", "texture"]
        assert left_in_cap(model, knob_mm(dense(*SIZE[:2], UPRIGHT)), theta_v, 2.0)[0].mean() < 0.7 * first
        parameters = update.parameters[0].parameters
        assert isinstance(parameters, SphereParameters)
        at_v, at_h = model.directions(Channel.RANGE, parameters)
        if theta_v in (0.0, math.pi):
            counts = np.bincount((at_h // (math.pi / 2)).astype(int) % 4, minlength=4)
            assert counts.max() - counts.min() <= 1  # AT-15
        again = await session.look_direction(theta_v, 2.0)
        assert again.samples == 0 and session.stats.resyncs == 0
        little = await session.look_direction(math.pi - theta_v, 2.0, max_bytes=3000)
        assert little.reason == "byte limit" and 0 < little.bytes_received <= 3000


async def test_a_cylinder_and_a_sphere_keep_their_own_lattices(objects: Objects) -> None:
    async with connect(objects.url) as session:
        await session.open(objects.scans["knob"], profile="classic")
        with pytest.raises(RequestRefused, match="sphere"):
            await session.look_direction(1.0, 1.0, parameters={"range": {"s": 20.0}})
        with pytest.raises(RequestRefused, match="beyond pi"):
            sphere = {"lattice": "literal", "m": 1000, "alpha": 0.5, "s": 20.0}
            await session.look_direction(1.0, 1.0, parameters={"range": {}, "sphere": sphere})
        with pytest.raises(LocalWireError):
            await session.look_direction(1.0, 1.0, parameters={"range": {}, "sphere": {"cap_rad": math.nan}})


async def test_clicks_all_over_end_with_the_exact_scan(objects: Objects) -> None:
    async with connect(objects.url) as session:
        model = await session.open(objects.scans["pebble"])
        for theta_v, theta_h in itertools.product((0.0, 0.3, 1.1, 2.0, math.pi), (0.0, 2.1, 4.2)):
            await session.look_direction(theta_v, theta_h, window=0.3, parameters=EXACT)
        again = await session.look_direction(1.1, 2.1, window=0.3, parameters=EXACT)
        assert np.array_equal(model.range_steps, scan_of(*SCANS["pebble"]).range_steps)
        assert (session.holdings("range").level == 0).all()
        assert again.samples == again.payload_bytes == 0
        assert session.stats.resyncs == 0


async def test_a_look_by_direction_reaches_its_quality_across_a_pole(objects: Objects) -> None:
    async with connect(objects.url) as session:
        await session.open(objects.scans["pebble"])
        update = await session.look_direction(0.1, 5.0, range_mm=0.1, texture_db=40)
        assert update.reason == "complete"
        assert update.texture_db is not None and update.texture_db >= 40
        budget = await session.look_direction(3.0, 5.0, range_mm=0.1, texture_db=40, max_bytes=1000)
        assert 0 < budget.bytes_received <= 1000


async def test_a_pole_by_plain_http_is_planned_once_and_as_good_as_by_the_stream(objects: Objects) -> None:
    scan, asked = objects.scans["pebble"], {"range_mm": 0.1, "texture_db": 40.0}
    async with connect(objects.url) as session:
        await session.open(scan)
        await surveyed(objects.url)  # before, it guesses, and may plan the same look in two ways
    async with aiohttp.ClientSession() as http:
        plan = f"{objects.url}/v1/scans/{scan}/fovea?u=0&v=0&range_mm=0.1&texture_db=40"
        places = []
        for _ in range(2):
            async with http.get(plan, allow_redirects=False) as planned:
                assert planned.status == 303
                places.append(planned.headers["Location"])
        async with http.get(objects.url + places[0]) as response:
            body = await response.read()
    assert places[0] == places[1]
    listed = refinements_in(body)
    range_numbers = [int(part) for part in places[0].split("/")[-2].split(".")]
    assert listed[0].self_contained and isinstance(listed[0].parameters, Parameters)
    assert range_numbers[:2] == [spacing_byte(listed[0].parameters), listed[0].parameters.block_x]
    async with open_shared(objects.url, scan) as viewer, connect(objects.url) as session:
        streamed = await session.open(scan)
        await session.look_direction(0.0, 0.0, **asked)
        assert await viewer.look(0.0, 0.0, **asked) == len(body)
        assert viewer.model.digest() == streamed.digest()
        await viewer.look(0.0, 1 / 3, window=0.1, range_mm=0)  # overlaps: what is finer is adopted, as planned or not
        held = viewer.model.digest()
        await viewer.look(0.0, 1 / 3, window=0.1, range_mm=0)
        assert viewer.model.digest() == held
        true_mm = scan_of(*SCANS["pebble"]).range_mm
        error, _ = left_in_cap(viewer.model, true_mm, 0.0, 0.0)
        assert np.percentile(error, 99) <= 0.1 + STEP_MM / 100


@pytest.mark.parametrize("bad", [(math.nan, 0.0), (0.0, math.inf), (-0.1, 0.0), (3.2, 0.0)])
async def test_directions_that_are_none_are_refused(objects: Objects, bad: tuple[float, float]) -> None:
    async with connect(objects.url) as session:
        await session.open(objects.scans["knob"])
        with pytest.raises(LocalWireError):
            await session.look_direction(*bad)


async def test_a_client_that_shows_cylinders_only_may_open_no_sphere(objects: Objects) -> None:
    stream = f"{objects.url}/v1/stream"
    async with aiohttp.ClientSession() as http, http.ws_connect(stream, protocols=[PROTOCOL]) as socket:
        await socket.receive()
        await socket.send_str(encode_message(Hello(PROTOCOL)))
        await socket.receive()
        await socket.send_str(encode_message(Open(1, objects.scans["knob"])))
        refused = decode_message((await socket.receive()).data)
    assert isinstance(refused, Refused) and "sphere" in refused.message
