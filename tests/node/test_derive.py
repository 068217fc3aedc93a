"""Scans made of scans: what a node makes of its own, when asked and by itself, and what it says of that."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from exchange.closing import close_scan, closes
from exchange.native import NOTE_MAX, read_native
from node import derive
from node.bodies import Derivation
from node.durable import NoRoom
from node.first_view import build_first_view, texture_as_seen
from node.library import About, Library, content_id
from node.serve import NodeServer
from node.texture_model import TextureModel
from protocol.grid import Grid
from protocol.messages import Look
from simulators.nutcracker import nutcracker
from simulators.pebble import pebble
from simulators.shapes import cylinder, sphere
from tests.exchange.grids import vase
from tests.exchange.tipped import lying, swept
from tests.node.planning import plan_look
from tests.node.served import Client, served

SHAPE = (96, 80, 96, 64)
TIPPED_SHAPE = (240, 120, 240, 120)
BALL, CAN = sphere(SHAPE, 0), cylinder(SHAPE, 0)


@asynccontextmanager
async def node(folder: Path, *grids: Grid) -> AsyncIterator[tuple[Client, NodeServer, Library, list[str]]]:
    """Whom to ask, and the ids of the scans it begins with."""
    library = Library(folder / "library")
    ids = [library.add(grid, About(1e9, name="thing")).id for grid in grids]
    async with served(library) as (client, server):
        yield client, server, library, ids
        await server.derivation.stop()


async def derived(client: Client, scan: str, **wanted: Any) -> dict[str, Any]:
    answer = await client.post(f"/v1/scans/{scan}/derive", json=wanted)
    assert answer.status == 201, await answer.text()
    said: dict[str, Any] = await answer.json()
    return said


async def test_a_sphere_is_a_scan_of_its_own_that_says_where_it_comes_from(tmp_path: Path) -> None:
    async with node(tmp_path, BALL) as (client, _, library, [ball]):
        said = await derived(client, ball, geometry="sphere")
        assert said["id"] == content_id(close_scan(BALL)[0])
        about = await (await client.get(f"/v1/scans/{said['id']}")).json()
        assert (about["geometry"], about["madeFrom"], about["note"]) == ("sphere", [ball], said["note"])
        listed = {scan["id"]: scan for scan in await (await client.get("/v1/scans")).json()}
        assert [listed[scan]["geometry"] for scan in (ball, said["id"])] == ["cylinder", "sphere"]
        assert (listed[said["id"]]["source"], listed[said["id"]]["name"]) == ("derived", "thing")
        assert library.open(ball).about.made_from == ()


async def test_what_has_a_long_note_can_be_derived_and_the_newest_of_it_is_kept(tmp_path: Path) -> None:
    async with node(tmp_path) as (client, _, library, _):
        can = library.add(CAN, About(1e9, note="x" * NOTE_MAX)).id
        said = await derived(client, can, geometry="sphere", caps=True)
        assert len(said["note"]) == NOTE_MAX and said["note"].startswith("... xx") and "made up" in said["note"]


async def test_a_full_disk_is_no_unknown_scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async with node(tmp_path, BALL) as (client, _, library, [ball]):
        monkeypatch.setattr(library, "add", Mock(side_effect=NoRoom("the disk is full")))
        answer = await client.post(f"/v1/scans/{ball}/derive", json={"geometry": "sphere"})
        assert (answer.status, (await answer.json())["message"]) == (507, "the disk is full")
        assert (await client.post(f"/v1/scans/{'0' * 32}/derive", json={"geometry": "sphere"})).status == 404


async def test_what_is_made_up_is_said_and_stays_said(tmp_path: Path) -> None:
    async with node(tmp_path, CAN) as (client, _, _, [can]):
        said = await derived(client, can, geometry="sphere", caps=True)
        assert "made up" in said["note"]
        file = await (await client.get(f"/v1/scans/{said['id']}.npz")).read()
        (tmp_path / "can.npz").write_bytes(file)
        with open(tmp_path / "can.npz", "rb") as exported:
            assert read_native(exported).note == said["note"]
    async with node(tmp_path / "other") as (client, _, library, _):
        brought = await (await client.post("/v1/scans", data=file)).json()
        assert brought["id"] == said["id"]
        assert library.open(brought["id"]).about.note == said["note"]


async def test_a_sphere_becomes_a_cylinder_on_demand(tmp_path: Path) -> None:
    async with node(tmp_path, BALL) as (client, _, library, [ball]):
        closed = await derived(client, ball, geometry="sphere")
        back = await derived(client, closed["id"], geometry="cylinder")
        assert back["geometry"] == "cylinder"
        assert library.open(back["id"]).about.made_from == (closed["id"],)
        assert "axis" in back["note"] and closed["note"] in back["note"]


def test_where_no_error_is_left_a_byte_limit_is_no_reason_to_fail(tmp_path: Path) -> None:
    library = Library(tmp_path)
    ball = derive.derive(library, library.add(vase(), About(1e9)).id, Derivation("sphere"), lambda share: None)
    view = build_first_view(ball, "htj2k", 32768)
    model = TextureModel(ball.texture, texture_as_seen(view))
    look = Look(1, 0, 0, scale=5e-324, texture_db=10, range_mm=0)
    assert plan_look(ball, view.state, look, "htj2k", 1 << 40, model=model).reason == "complete"


@pytest.mark.parametrize(
    ("wanted", "status", "message"),
    [
        ({"geometry": "cylinder"}, 422, "cylinder already"),
        ({"geometry": "sphere", "centreHeightMm": 500}, 422, "not inside"),
        ({"geometry": "cylinder", "caps": True}, 422, "go with a sphere"),
        ({"geometry": "cone"}, 400, "geometry"),
        ({"geometry": "cylinder", "top": "latest"}, 422, "go with a sphere"),
        ({"geometry": "sphere", "tipDeg": 181}, 400, "tipDeg"),
        ({"geometry": "sphere", "lids": True}, 400, "lids"),
        ({}, 400, "geometry"),
        ({"geometry": "sphere", "centreHeightMm": 1e9}, 400, "centreHeightMm"),
    ],
)
async def test_what_cannot_be_made_is_refused(
    tmp_path: Path, wanted: dict[str, Any], status: int, message: str
) -> None:
    async with node(tmp_path, CAN) as (client, _, library, [can]):
        answer = await client.post(f"/v1/scans/{can}/derive", json=wanted)
        assert answer.status == status and message in await answer.text()
        assert len(library.scans()) == 1
        assert (await client.post("/v1/scans/0/derive", json={"geometry": "sphere"})).status == 404
        assert (await client.post(f"/v1/scans/{can}/derive", data=b"\xff")).status == 400


async def test_what_hides_much_of_itself_is_refused_with_a_cure(tmp_path: Path) -> None:
    async with node(tmp_path, nutcracker(SHAPE, 0)) as (client, _, _, [doll]):
        answer = await client.post(f"/v1/scans/{doll}/derive", json={"geometry": "sphere"})
        assert answer.status == 422 and "keep it as a cylinder" in await answer.text()


async def test_a_second_sweep_of_the_tipped_object_closes_the_first(tmp_path: Path) -> None:
    stone = pebble(TIPPED_SHAPE, 0)
    upright = swept(stone, np.eye(3), np.zeros(3), TIPPED_SHAPE)
    laid = lying(stone, (4.0, -3.0, 2.0), np.array([1.0, -1.0, 50.0]), TIPPED_SHAPE)
    async with node(tmp_path, upright, laid, CAN) as (client, _, library, [first, second, can]):
        said = await derived(client, first, geometry="sphere", top=second[:8], bottom=second)
        assert "from other sweeps" in said["note"] and "void" not in said["note"]
        assert library.open(said["id"]).about.made_from == (first, second)
        alone = await derived(client, first, geometry="sphere")
        assert "void" in alone["note"]
        refused = (can, 422, "is it the same"), ("123456", 404, "no scan"), (said["id"], 422, "give the cylinder")
        for other, status, message in refused:
            answer = await client.post(f"/v1/scans/{first}/derive", json={"geometry": "sphere", "top": other})
            assert answer.status == status and message in await answer.text()


async def test_a_sweep_of_a_closed_object_is_kept_as_a_sphere_too(tmp_path: Path) -> None:
    async with node(tmp_path, BALL, CAN) as (_, server, library, ids):
        for number, scan in enumerate(ids, 1):
            server.swept(scan, number)
        await asyncio.gather(*server.derivation._tasks)
        made = [scan for scan in library.scans() if scan.about.made_from]
        assert [scan.about.made_from for scan in made] == [(ids[0],)]
        assert made[0].spec.geometry == "sphere"
        assert library.resolve("latest") == made[0].id
        assert library.resolve("latest", ("cylinder",)) == ids[1]


async def test_a_node_that_stops_leaves_what_it_was_deriving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with node(tmp_path, BALL) as (_, server, library, [ball]):

        def closes_at_the_end(grid: Grid) -> bool:
            server.derivation._stopping.set()
            return closes(grid)

        monkeypatch.setattr(derive, "closes", closes_at_the_end)
        server.swept(ball, 1)
        await asyncio.gather(*server.derivation._tasks)
        assert len(library.scans()) == 1


async def test_only_one_is_made_at_a_time(tmp_path: Path) -> None:
    async with node(tmp_path, BALL) as (client, server, _, [ball]):
        async with server.derivation._place:
            answer = await client.post(f"/v1/scans/{ball}/derive", json={"geometry": "sphere"})
        assert answer.status == 503 and "busy" in await answer.text()


def test_a_scan_of_nothing_but_voids_does_not_close() -> None:
    assert not closes(Grid(BALL.spec, np.zeros_like(BALL.range_steps), BALL.texture))
