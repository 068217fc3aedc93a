"""What the node says of itself over HTTP."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import aiohttp
import pytest

from node import health
from node.capture import Capture, CaptureStatus
from node.coarse import FIRST_VIEW_BYTES
from node.config import Config, Server
from node.durable import EASY_BYTES
from node.exhibits import Exhibits
from node.library import About, Library
from node.live import Live
from node.serve import NodeServer
from protocol import messages as m
from tests.node.scans import make_grid

CONFIG = Config(server=Server(listen="127.0.0.1:0", insecure=True))
INFO = m.ServerInfo(m.PROTOCOL, "n1", "node", "0")


class Turntable:
    """What the server asks of a Capture."""

    def __init__(self) -> None:
        self.status = CaptureStatus("ready", sweeps=2)

    def request_sweep(self) -> bool:
        self.status = CaptureStatus("starting", sweeps=2)
        return True


class Rig:
    """A node's server, and what it serves. Paths are asked with `get` and `post`: (status, JSON)."""

    def __init__(self, http: aiohttp.ClientSession, url: str, library: Library) -> None:
        self._http, self._url, self.library = http, url, library

    async def get(self, path: str) -> tuple[int, Any]:
        async with self._http.get(self._url + path) as answer:
            return answer.status, await answer.json()

    async def post(self, path: str) -> tuple[int, Any]:
        async with self._http.post(self._url + path) as answer:
            return answer.status, await answer.json()


@asynccontextmanager
async def served(folder: Path, turntable: Turntable | None = None) -> AsyncIterator[Rig]:
    with closing(Library(folder)) as library, closing(Exhibits(library, FIRST_VIEW_BYTES, workers=1)) as exhibits:
        capture = cast("Capture | None", turntable)
        server = NodeServer(CONFIG, INFO, exhibits, Live(lambda: None), capture)
        host, port = await server.start()
        try:
            async with aiohttp.ClientSession() as http:
                yield Rig(http, f"http://{host}:{port}", library)
        finally:
            await server.stop()


async def test_a_node_without_a_scanner_says_as_much_of_it_as_one_with(tmp_path: Path) -> None:
    async with served(tmp_path / "with", Turntable()) as rig:
        _, swept = await rig.get("/v1/node")
    async with served(tmp_path / "without") as rig:
        _, node = await rig.get("/v1/node")
        status, refused = await rig.post("/v1/sweeps")
    assert node["capture"] == {"phase": "no scanner", "progress": 0.0, "sweeps": 0, "why": ""}
    assert node["capture"].keys() == swept["capture"].keys()
    assert (status, "--scanner" in refused["message"]) == (409, True)


async def test_a_sweep_that_was_asked_for_is_starting(tmp_path: Path) -> None:
    async with served(tmp_path, Turntable()) as rig:
        assert await rig.post("/v1/sweeps") == (202, {"phase": "starting", "progress": 0.0, "sweeps": 2, "why": ""})


async def test_a_scan_says_when_it_was_made(tmp_path: Path) -> None:
    async with served(tmp_path) as rig:
        for seed, (unix_s, created) in enumerate(
            [(1795314511.73, "2026-11-22T02:28:31Z"), (0.0, "1970-01-01T00:00:00Z"), (1e300, None)]
        ):
            scan = rig.library.add(make_grid(40, 24, seed=seed), About(unix_s))
            _, info = await rig.get(f"/v1/scans/{scan.id}")
            assert info.get("created") == created


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The library's disk: free_bytes is what is left of it."""
    disk = SimpleNamespace(free_bytes=EASY_BYTES)
    monkeypatch.setattr(health, "free_bytes", lambda folder: disk.free_bytes)
    return disk


async def test_health_is_ready_while_all_is_well(tmp_path: Path, disk: SimpleNamespace) -> None:
    async with served(tmp_path / "without") as rig:
        _, alone = await rig.get("/healthz")
    async with served(tmp_path / "with", Turntable()) as rig:
        assert await rig.get("/healthz") == (
            200,
            {
                "status": "ready",
                "reasons": [],
                "capture": {"phase": "ready", "progress": 0.0, "sweeps": 2, "why": ""},
            },
        )
    assert (alone["status"], alone["reasons"], alone["capture"]["phase"]) == ("ready", [], "no scanner")


async def test_health_is_degraded_and_names_every_reason(tmp_path: Path, disk: SimpleNamespace) -> None:
    (tmp_path / "holiday").mkdir()
    table = Turntable()
    async with served(tmp_path, table) as rig:
        disk.free_bytes = EASY_BYTES - 1
        table.status = CaptureStatus("connecting", why="/dev/ttyUSB0: no such device")
        status, said = await rig.get("/healthz")
    assert (status, said["status"]) == (200, "degraded")
    scanner, full, unsound = said["reasons"]
    assert scanner == "the scanner is not connected: /dev/ttyUSB0: no such device"
    assert full == f"the disk is nearly full: {EASY_BYTES - 1} bytes are free"
    assert unsound.startswith("the library holds what is no sound scan: holiday: ")


async def test_health_of_a_node_that_stops_is_503(tmp_path: Path, disk: SimpleNamespace) -> None:
    table = Turntable()
    async with served(tmp_path, table) as rig:
        table.status = CaptureStatus("stopped")
        status, said = await rig.get("/healthz")
    assert (status, said["status"], said["reasons"]) == (503, "stopping", [])
