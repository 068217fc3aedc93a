"""Scans as files over HTTP: out as they are, in whole or not at all."""

import asyncio
import io
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import trimesh
from aiohttp import web
from aiohttp.test_utils import TestClient, TestServer
from aiohttp.typedefs import Handler

from exchange.native import read_native, write_native
from node import exchange_routes
from node.auth import LOGIN, Login
from node.durable import NoRoom
from node.exchange_routes import ExchangeRoutes
from node.exhibits import Exhibits
from node.library import About, Library, content_id
from protocol import messages as m
from protocol.errors import LibraryError
from protocol.grid import Grid
from tests.exchange.grids import vase

Client = TestClient[web.Request, web.Application]


@asynccontextmanager
async def serving(folder: Path) -> AsyncIterator[tuple[Client, Exhibits, list[m.Published]]]:
    """A client of the routes over a library, and what was published."""

    @web.middleware
    async def admit(request: web.Request, handler: Handler) -> web.StreamResponse:
        request[LOGIN] = Login("somebody", "operate")
        try:
            return await handler(request)
        except LibraryError as problem:
            raise web.HTTPNotFound(text=str(problem)) from problem

    published: list[m.Published] = []
    exhibits = Exhibits(Library(folder / "library"), 32768, 1)
    app = web.Application(middlewares=[admit], client_max_size=65536)
    app.add_routes(ExchangeRoutes(exhibits, published.append).routes())
    app.add_routes([web.get("/v1/scans/{scan}", _about)])
    async with TestClient(TestServer(app)) as client:
        yield client, exhibits, published
    exhibits.close()


async def _about(request: web.Request) -> web.Response:
    """What else lives beside these routes."""
    if not request.match_info["scan"].isalnum():
        raise web.HTTPNotFound
    return web.Response(text="about")


def native(grid: Grid, name: str = "vase") -> bytes:
    file = io.BytesIO()
    write_native(grid, file, name)
    return file.getvalue()


def kept(folder: Path) -> set[str]:
    return {path.name for path in (folder / "library").iterdir() if len(path.name) == 32}


async def test_a_scan_comes_out_in_every_format(tmp_path: Path) -> None:
    async with serving(tmp_path) as (client, exhibits, _):
        scan = exhibits.library.add(vase(), About(0.0))
        for suffix, magic in (
            (".glb", b"glTF"),
            (".ply", b"ply\n"),
            (".stl", b"fove"),
            (".obj.zip", b"PK"),
            (".npz", b"PK"),
        ):
            for name in (scan.id, "latest"):
                answer = await client.get(f"/v1/scans/{name}{suffix}")
                body = await answer.read()
                assert answer.status == 200 and answer.content_length == len(body) and body.startswith(magic)
                assert answer.headers["Content-Disposition"] == f'attachment; filename="{scan.id}{suffix}"'
        assert await (await client.get(f"/v1/scans/{scan.id}")).text() == "about"
        glb = await (await client.get(f"/v1/scans/{scan.id}.glb")).read()
        assert len(trimesh.load_scene(io.BytesIO(glb), "glb").geometry) == 1


async def test_what_goes_out_and_in_is_the_same_scan(tmp_path: Path) -> None:
    async with serving(tmp_path) as (client, exhibits, published):
        scan = exhibits.library.add(vase(holes=True), About(0.0, name="vase"))
        body = await (await client.get(f"/v1/scans/{scan.id}.npz")).read()
        answer = await client.post("/v1/scans", data=body)
        assert answer.status == 200 and await answer.json() == {"id": scan.id} and published == [m.Published(scan.id)]
        assert read_native(io.BytesIO(body))[1].spec == scan.spec


async def test_an_imported_grid_is_kept_and_published(tmp_path: Path) -> None:
    async with serving(tmp_path) as (client, exhibits, published):
        answer = await client.post("/v1/scans", data=native(vase(), "a vase"))
        assert answer.status == 201
        scan = exhibits.library.open((await answer.json())["id"])
        assert scan.id == content_id(vase()) and published == [m.Published(scan.id)]
        assert (scan.about.source, scan.about.name) == ("import", "a vase")
        assert np.array_equal(scan.range_steps, vase().range_steps)


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        (b"", 422, "is no .npz file, or damaged"),
        (b"garbage", 422, "is no .npz file, or damaged"),
        (native(vase())[:-1000], 422, "is no .npz file, or damaged"),
        (b"PK\x03\x04" + bytes(100), 422, "is no .npz file, or damaged"),
    ],
)
async def test_what_is_no_grid_is_refused_and_leaves_nothing(
    body: bytes, status: int, message: str, tmp_path: Path
) -> None:
    async with serving(tmp_path) as (client, _, published):
        before = set((tmp_path / "library").iterdir())
        answer = await client.post("/v1/scans", data=body)
        assert answer.status == status and message in await answer.text()
        assert set((tmp_path / "library").iterdir()) == before and published == []


async def test_a_body_too_long_is_refused_announced_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange_routes, "IMPORT_BYTES_MAX", 1000)

    async def unannounced() -> AsyncIterator[bytes]:
        for _ in range(20):
            yield bytes(100)

    async with serving(tmp_path) as (client, _, _):
        for data in (bytes(1001), unannounced()):
            assert (await client.post("/v1/scans", data=data)).status == 413
        assert kept(tmp_path) == set()


async def test_an_upload_that_ends_early_leaves_nothing(tmp_path: Path) -> None:
    async def broken() -> AsyncIterator[bytes]:
        yield native(vase())[:2000]
        raise RuntimeError("the cable was pulled")

    async with serving(tmp_path) as (client, _, published):
        with pytest.raises(Exception, match="cable|Connection|disconnected"):
            await client.post("/v1/scans", data=broken())
        assert (await client.post("/v1/scans", data=native(vase()))).status == 201  # the place is free again
        assert kept(tmp_path) == {content_id(vase())} == {news.scan for news in published}


async def test_an_upload_that_stalls_loses_its_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exchange_routes, "STALL_S", 0.05)
    async with serving(tmp_path) as (client, _, _):
        reader, writer = await _connection(client)
        writer.write(b"POST /v1/scans HTTP/1.1\r\nHost: x\r\nContent-Length: 5000\r\n\r\nPK")
        assert b" 408 " in await reader.readline()
        writer.close()
        assert kept(tmp_path) == set()


async def _connection(client: Client) -> Any:
    return await asyncio.open_connection("127.0.0.1", client.port)


async def test_a_second_import_at_the_same_time_is_told_to_wait(tmp_path: Path) -> None:
    async with serving(tmp_path) as (client, _, _):
        reader, writer = await _connection(client)
        body = native(vase())
        writer.write(
            b"POST /v1/scans HTTP/1.1\r\nHost: x\r\nExpect: 100-continue\r\nContent-Length: %d\r\n\r\n" % len(body)
        )
        assert b" 100 " in await reader.readline()  # it has the place
        while (answer := await client.post("/v1/scans", data=native(vase(holes=True)))).status == 201:
            pass
        assert answer.status == 503
        writer.write(body)
        assert await reader.readline() == b"\r\n" and b" 201 " in await reader.readline()
        writer.close()


@pytest.mark.parametrize("path", ["latest.glb", "00000000.glb", "..%2f..%2fetc.glb", "latest.exe", "latest.obj"])
async def test_what_is_not_there_is_not_found(path: str, tmp_path: Path) -> None:
    async with serving(tmp_path) as (client, _, _):
        assert (await client.get(f"/v1/scans/{path}")).status == 404


async def test_a_scan_without_a_surface_is_no_mesh_but_a_grid(tmp_path: Path) -> None:
    async with serving(tmp_path) as (client, exhibits, _):
        empty = Grid(vase().spec, np.zeros_like(vase().range_steps), vase().texture)
        scan = exhibits.library.add(empty, About(0.0))
        answer = await client.get(f"/v1/scans/{scan.id}.glb")
        assert answer.status == 422 and "nothing is measured" in await answer.text()
        assert (await client.get(f"/v1/scans/{scan.id}.npz")).status == 200


async def test_a_disk_that_fills_up_while_a_file_is_made_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with serving(tmp_path) as (client, exhibits, _):
        exhibits.library.add(vase(), About(0.0))
        monkeypatch.setattr(tempfile, "TemporaryFile", lambda dir: open("/dev/full", "r+b"))
        for answer in (
            await client.get("/v1/scans/latest.glb"),
            await client.post("/v1/scans", data=native(vase())),
        ):
            assert (answer.status, await answer.text()) == (507, "the node's disk is full")


async def test_a_full_disk_is_named_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(scan: object, suffix: str) -> None:
        raise OSError(28, "No space left on device")

    async with serving(tmp_path) as (client, exhibits, _):
        exhibits.library.add(vase(), About(0.0))
        monkeypatch.setattr(exchange_routes, "writer_of", lambda suffix: full)
        answer = await client.get("/v1/scans/latest.glb")
        assert answer.status == 507 and await answer.text() == "the node's disk is full"
        for trouble, status in ((NoRoom("cannot keep scan x: full"), 507), (LibraryError("cannot keep scan x"), 500)):
            monkeypatch.setattr(exhibits.library, "add", Mock(side_effect=trouble))
            answer = await client.post("/v1/scans", data=native(vase()))
            assert answer.status == status and "cannot keep" in await answer.text()
