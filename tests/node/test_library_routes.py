import io
import tempfile
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiohttp import web
from aiohttp.test_utils import TestClient, TestServer

from node import durable
from node.auth import LOGIN, Login
from node.capture import CaptureStatus
from node.library import About, Library
from node.library_routes import LibraryRoutes
from protocol.grid import Grid, GridSpec
from protocol.scanner_messages import DeviceInfo, RangeColumn, SweepHeader, TextureColumn

SPEC = GridSpec(16, 10, 32, 12, step_mm=0.05, pitch_mm=1.0)
HEADER = SweepHeader(7, SPEC, 3200, range_rows=6, texture_rows=12)
Client = TestClient[web.Request, web.Application]


class Bench:
    """A library with one scan and one interrupted sweep behind the routes."""

    is_busy = False

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(0)
        grid = Grid(SPEC, np.ones((10, 16), np.uint16), rng.integers(0, 256, (12, 32, 3)).astype(np.uint8))
        self.library = Library(folder)
        self.scan = self.library.add(grid, About(1e9)).id
        journal = self.library.sweeps.begin(DeviceInfo("SN-1", 1, 3200, 10), HEADER, 1e9)
        journal.add(RangeColumn(7, 0, 3, 0, 700, 1, bytes(range(12))))
        journal.add(RangeColumn(7, 0, 4, 0, 900, 1, bytes(12)))
        journal.add(RangeColumn(7, 0, 4, 6, 900, 1, b"\x01\x00" * 4))
        journal.add(TextureColumn(7, 0, 9, 0, 950, 1, bytes(range(36))))
        self.sweep = self.library.sweeps.keep(journal, "unplugged").id
        self.deleted: list[str] = []
        self.resumed: list[str] = []

    @property
    def status(self) -> CaptureStatus:
        """What Capture offers, as below."""
        return CaptureStatus("sweeping" if self.is_busy else "ready")

    def request_resume(self, sweep_id: str) -> int:
        self.resumed.append(sweep_id)
        return 0 if self.is_busy else 3

    @web.middleware
    async def admit(self, request: web.Request, handler: Any) -> web.StreamResponse:
        request[LOGIN] = Login("somebody", "operate")
        response: web.StreamResponse = await handler(request)
        return response


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "library")


@pytest.fixture
async def client(bench: Bench) -> AsyncIterator[Client]:
    app = web.Application(middlewares=[bench.admit])
    app.add_routes(LibraryRoutes(bench.library, bench, bench.deleted.append).routes())  # type: ignore[arg-type]
    async with TestClient(TestServer(app)) as client:
        yield client


async def test_what_is_said_of_a_scan_is_read_and_changed(bench: Bench, client: Client) -> None:
    path = f"/v1/scans/{bench.scan}/sidecar"
    before = await client.get(path)
    assert (before.status, before.headers["ETag"], (await before.json())["revision"]) == (200, '"0"', 0)
    changed = await client.patch(path, json={"name": "knee", "pins": [{"u": 0.5, "v": 0.25}]})
    assert (changed.status, changed.headers["ETag"]) == (200, '"1"')
    said = await (await client.get(path)).json()
    assert (said["name"], said["pins"]) == ("knee", [{"u": 0.5, "v": 0.25, "label": ""}])
    assert said["history"][0]["by"] == "somebody at 127.0.0.1"
    assert bench.library.summary(bench.scan).about.name == "knee"


async def test_a_change_behind_somebody_else_s_is_refused(bench: Bench, client: Client) -> None:
    path = f"/v1/scans/{bench.scan}/sidecar"
    assert (await client.patch(path, json={"notes": "a"}, headers={"If-Match": '"0"'})).status == 200
    late = await client.patch(path, json={"notes": "b"}, headers={"If-Match": '"0"'})
    assert (late.status, "revision 1" in await late.text()) == (412, True)
    assert (await client.patch(path, json={"notes": "b"}, headers={"If-Match": "W/x"})).status == 400
    assert bench.library.sidecar(bench.scan).notes == "a"


@pytest.mark.parametrize(
    ("body", "words"),
    [(b"{", "truncated"), (b'{"subject": 3}', "subject"), (b"{}", "changes nothing"), (b" " * 100_000, "at most")],
)
async def test_a_bad_change_is_refused_by_name(bench: Bench, client: Client, body: bytes, words: str) -> None:
    answer = await client.patch(f"/v1/scans/{bench.scan}/sidecar", data=body)
    assert (answer.status, words in await answer.text()) == (400, True)
    assert bench.library.sidecar(bench.scan).revision == 0


async def test_a_scan_is_deleted_and_that_is_told(bench: Bench, client: Client) -> None:
    assert (await client.delete(f"/v1/scans/{bench.scan}")).status == 204
    assert bench.library.scans() == [] and bench.deleted == [bench.scan]
    for answer in (
        await client.delete(f"/v1/scans/{bench.scan}"),
        await client.get(f"/v1/scans/{bench.scan}/sidecar"),
        await client.post(f"/v1/scans/{bench.scan}/verify"),
        await client.patch("/v1/scans/..%2f..%2fetc/sidecar", json={"name": "x"}),
    ):
        assert answer.status == 404


async def test_a_scan_is_verified(bench: Bench, client: Client) -> None:
    path = f"/v1/scans/{bench.scan}/verify"
    assert await (await client.post(path)).json() == {"id": bench.scan, "sound": True, "reason": ""}
    file = bench.library.folder / bench.scan / "texture.npy"
    file.write_bytes(file.read_bytes()[:-1] + b"\x00")
    said = await (await client.post(path)).json()
    assert not said["sound"] and "not what they were" in said["reason"]


async def test_the_latest_scan_or_part_of_an_id_is_read_by_that_name_but_not_changed(
    bench: Bench, client: Client
) -> None:
    for name in ("latest", bench.scan[:6]):
        assert (await client.get(f"/v1/scans/{name}/sidecar")).status == 200
        assert (await (await client.post(f"/v1/scans/{name}/verify")).json())["id"] == bench.scan
        for refused in (
            await client.patch(f"/v1/scans/{name}/sidecar", json={"name": "x"}),
            await client.delete(f"/v1/scans/{name}"),
        ):
            assert (refused.status, "by its whole id" in await refused.text()) == (400, True)
    assert bench.library.sidecar(bench.scan).revision == 0
    bench.library.delete(bench.scan)
    assert (await client.get("/v1/scans/latest/sidecar")).status == 404


async def test_interrupted_sweeps_are_listed_resumed_and_deleted(bench: Bench, client: Client) -> None:
    (sweep,) = await (await client.get("/v1/sweeps")).json()
    assert (sweep["id"], sweep["held"], sweep["expected"], sweep["complete"]) == (bench.sweep, 4, 64, False)
    assert (sweep["why"], sweep["scanner"]) == ("unplugged", "SN-1")
    answer = await client.post(f"/v1/sweeps/{bench.sweep}/resume")
    assert (answer.status, await answer.json()) == (202, {**sweep, "sweep": 3})
    assert bench.resumed == [bench.sweep]
    bench.is_busy = True
    assert (await client.post(f"/v1/sweeps/{bench.sweep}/resume")).status == 409
    assert (await client.delete(f"/v1/sweeps/{bench.sweep}")).status == 204
    assert await (await client.get("/v1/sweeps")).json() == []
    for answer in (
        await client.delete(f"/v1/sweeps/{bench.sweep}"),
        await client.post(f"/v1/sweeps/{bench.sweep}/resume"),
        await client.get(f"/v1/sweeps/{bench.sweep}.npz"),
    ):
        assert answer.status == 404


async def test_an_interrupted_sweep_is_exported_as_what_it_is(bench: Bench, client: Client) -> None:
    answer = await client.get(f"/v1/sweeps/{bench.sweep}.npz")
    assert "attachment" in answer.headers["Content-Disposition"]
    with np.load(io.BytesIO(await answer.read()), allow_pickle=False) as partial:
        assert not partial["is_complete"] and "4 of 64 pieces of columns; unplugged" in str(partial["note"])
        assert not {"depth_u16", "texture"} & set(partial.files)  # no importer takes it for a grid
        range_steps, texture = partial["partial_range_steps"], partial["partial_texture"]
        assert range_steps.shape == (10, 16) and texture.shape == (12, 32, 3)
        assert np.array_equal(range_steps[:6, 3], np.frombuffer(bytes(range(12)), "<u2"))
        assert not range_steps[6:, 3].any() and (range_steps[6:, 4] == 1).all()
        assert np.flatnonzero(partial["range_column_is_whole"]).tolist() == [4]
        assert np.array_equal(texture[:, 9], np.arange(36, dtype=np.uint8).reshape(12, 3))
        assert np.flatnonzero(partial["texture_column_is_whole"]).tolist() == [9]
    assert set(bench.library.folder.iterdir()) == {
        bench.library.folder / name for name in (bench.scan, "library.json", "lock", "sweeps")
    }


async def test_a_sweep_that_the_disk_has_no_room_to_export_is_507(
    bench: Bench, client: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(tempfile, "TemporaryFile", lambda dir: open("/dev/full", "r+b"))
        answer = await client.get(f"/v1/sweeps/{bench.sweep}.npz")
        assert (answer.status, await answer.text()) == (507, "the node's disk is full")
    assert (await client.get(f"/v1/sweeps/{bench.sweep}.npz")).status == 200


async def test_a_full_disk_is_told_as_such(bench: Bench, client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(durable.os, "replace", full_disk)  # type: ignore[attr-defined]
    answer = await client.patch(f"/v1/scans/{bench.scan}/sidecar", json={"notes": "a"})
    assert (answer.status, "No space left" in await answer.text()) == (507, True)


async def test_without_a_scanner_nothing_can_be_resumed(bench: Bench) -> None:
    app = web.Application(middlewares=[bench.admit])
    app.add_routes(LibraryRoutes(bench.library, None).routes())
    async with TestClient(TestServer(app)) as client:
        assert (await client.post(f"/v1/sweeps/{bench.sweep}/resume")).status == 409
