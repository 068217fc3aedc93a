"""What the node says of itself over HTTP."""

from __future__ import annotations

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from node import health
from node.capture import CaptureStatus, SweepCounts
from node.durable import EASY_BYTES
from node.library import About, Library
from node.scan_quality import ScanQuality
from tests.node.scans import make_grid
from tests.node.served import Client, served
from tests.waiting import until


class Turntable:
    """What the server asks of a Capture."""

    def __init__(self) -> None:
        self.status = CaptureStatus("ready", sweeps=2)
        self.counts = SweepCounts(range_columns=7)
        self.silent_s = 0.0

    @property
    def beat_s(self) -> float:
        return time.monotonic() - self.silent_s

    def request_sweep(self) -> int:
        if self.status.refusal:
            return 0
        self.status = CaptureStatus("starting", sweeps=2)
        return 3


async def ask(node: Client, path: str, method: str = "GET") -> tuple[int, Any]:
    async with node.request(method, path) as answer:
        return answer.status, await answer.json()


async def test_a_node_without_a_scanner_says_as_much_of_it_as_one_with(tmp_path: Path) -> None:
    async with served(Library(tmp_path / "with"), Turntable()) as (node, _):
        _, swept = await ask(node, "/v1/node")
    async with served(Library(tmp_path / "without")) as (node, _):
        _, said = await ask(node, "/v1/node")
        status, refused = await ask(node, "/v1/sweeps", "POST")
    assert said["capture"] == {"phase": "no scanner", "progress": 0.0, "sweeps": 0, "why": ""}
    assert said["capture"].keys() == swept["capture"].keys()
    assert (status, "--scanner" in refused["message"]) == (409, True)


async def test_a_sweep_that_was_asked_for_is_starting(tmp_path: Path) -> None:
    async with served(Library(tmp_path), Turntable()) as (node, _):
        status, said = await ask(node, "/v1/sweeps", "POST")
    assert (status, said) == (202, {"phase": "starting", "progress": 0.0, "sweeps": 2, "why": "", "sweep": 3})


@pytest.mark.parametrize(
    ("status", "why"),
    [
        (CaptureStatus("connecting", why="ttyUSB0: gone"), "the scanner is not connected: ttyUSB0: gone"),
        (CaptureStatus("sweeping"), "a sweep is running already"),
    ],
)
async def test_a_sweep_is_refused_with_the_reason_while_the_scanner_is_not_ready(
    tmp_path: Path, status: CaptureStatus, why: str
) -> None:
    table = Turntable()
    table.status = status
    async with served(Library(tmp_path), table) as (node, _):
        assert await ask(node, "/v1/sweeps", "POST") == (409, {"code": "conflict", "message": why})


@pytest.mark.parametrize(
    ("method", "path", "status", "message"),
    [
        ("GET", "/v1/nothing", 404, "nothing is at /v1/nothing"),
        ("DELETE", "/v1/node", 405, "/v1/node takes no DELETE"),
        ("GET", "/v1/scans/latest/coarse?codec=zzz", 400, "Invalid enum value 'zzz' - at `codec`; known: codec (jpeg, htj2k)"),  # noqa: E501
        ("GET", "/v1/scans/latest/coarse", 404, "there is no scan yet: start a sweep"),
    ],
)
async def test_what_cannot_be_is_told_in_words(
    tmp_path: Path, method: str, path: str, status: int, message: str
) -> None:
    async with served(Library(tmp_path)) as (node, _), node.request(method, path) as answer:
        assert (answer.status, (await answer.json())["message"]) == (status, message)
        assert ("Allow" in answer.headers) == (status == 405)


async def test_a_bug_is_a_line_in_the_log_and_tells_a_client_nothing_of_the_inside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def fail() -> None:
        raise KeyError("secret")

    library = Library(tmp_path)
    monkeypatch.setattr(library, "scans", fail)
    async with served(library) as (node, _):
        status, said = await ask(node, "/v1/scans")
    message, _, incident = said["message"].rpartition(" ")
    assert (status, message) == (500, "the node has failed at this: its log says how, at")
    (record,) = caplog.records
    assert record.getMessage() == f"incident {incident}: GET /v1/scans: KeyError: 'secret'" and record.exc_info is None


async def test_a_scan_says_when_it_was_made(tmp_path: Path) -> None:
    library = Library(tmp_path)
    async with served(library) as (node, _):
        for seed, (unix_s, created) in enumerate(
            [(1795314511.73, "2026-11-22T02:28:31Z"), (0.0, "1970-01-01T00:00:00Z"), (1e300, None)]
        ):
            scan = library.add(make_grid(40, 24, seed=seed), About(unix_s))
            _, info = await ask(node, f"/v1/scans/{scan.id}")
            assert info.get("created") == created


async def test_a_scan_says_what_its_sweep_was_worth(tmp_path: Path) -> None:
    library = Library(tmp_path)
    quality = ScanQuality(0.75, noise_mm=0.25, dead_rows=2, dropped_bytes=9)
    swept = library.add(make_grid(40, 24, seed=1), About(0.0, quality=quality))
    library.close()
    library = Library(tmp_path)
    brought = library.add(make_grid(40, 24, seed=2), About(0.0, "import"))
    async with served(library) as (node, _):
        _, info = await ask(node, f"/v1/scans/{swept.id}")
        assert info["quality"] == {
            "coverage": 0.75, "noiseMm": 0.25, "deadRows": 2, "droppedBytes": 9,
            "complaints": ["2 rows of the range camera measure nothing"],
        }  # fmt: skip
        _, info = await ask(node, f"/v1/scans/{brought.id}")
        assert info["quality"] is None


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The library's disk: free_bytes is what is left of it."""
    disk = SimpleNamespace(free_bytes=EASY_BYTES)
    monkeypatch.setattr(health, "free_bytes", lambda folder: disk.free_bytes)
    return disk


async def test_health_is_ready_while_all_is_well(tmp_path: Path, disk: SimpleNamespace) -> None:
    async with served(Library(tmp_path / "without")) as (node, _):
        _, alone = await ask(node, "/healthz")
    async with served(Library(tmp_path / "with"), Turntable()) as (node, _):
        assert await ask(node, "/healthz") == (
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
    async with served(Library(tmp_path), table) as (node, _):
        disk.free_bytes = EASY_BYTES - 1
        table.status = CaptureStatus("connecting", why="/dev/ttyUSB0: no such device")
        status, said = await ask(node, "/healthz")
    assert (status, said["status"]) == (200, "degraded")
    scanner, full, unsound = said["reasons"]
    assert scanner == "the scanner is not connected: /dev/ttyUSB0: no such device"
    assert full == f"the disk is nearly full: {EASY_BYTES - 1} bytes are free"
    assert unsound.startswith("the library holds what is no sound scan: holiday: ")


async def test_health_says_when_a_sweep_runs_and_when_a_thread_is_stuck(tmp_path: Path, disk: SimpleNamespace) -> None:
    table = Turntable()
    async with served(Library(tmp_path), table) as (node, _):
        table.status = CaptureStatus("sweeping", 0.5)
        assert (await ask(node, "/healthz"))[1]["status"] == "capturing"
        table.silent_s = health.STUCK_S + 1
        _, said = await ask(node, "/healthz")
    assert said["status"] == "degraded"
    assert said["reasons"] == [f"the capture thread has not moved for {health.STUCK_S + 1:.0f} s"]


async def test_health_says_when_the_audit_log_cannot_be_written(tmp_path: Path, disk: SimpleNamespace) -> None:
    library = Library(tmp_path)
    (tmp_path / "audit").write_text("no folder")
    async with served(library) as (node, server):
        await ask(node, "/v1/scans")
        await until(lambda: server.audit.trouble)
        _, said = await ask(node, "/healthz")
    assert said["reasons"] == ["the audit log cannot be written: File exists"]


@pytest.mark.parametrize(
    ("left_s", "reasons"),
    [
        (15 * 86400.0, ()),
        (3 * 86400.0, ("the certificate ends in 3 days",)),
        (-1.0, ("the certificate has ended: clients refuse it",)),
    ],
)
def test_health_says_when_the_certificate_ends(
    tmp_path: Path, disk: SimpleNamespace, left_s: float, reasons: tuple[str, ...]
) -> None:
    said = health.examine_health(CaptureStatus("no scanner"), Library(tmp_path), {}, "", "", 1e9 + left_s, 1e9)
    assert said.reasons == reasons


def test_health_says_when_the_axes_cannot_be_read(tmp_path: Path, disk: SimpleNamespace) -> None:
    Library(tmp_path).close()
    (tmp_path / "axes.json").write_text("{")
    said = health.examine_health(CaptureStatus("no scanner"), Library(tmp_path), {})
    why = "axes.json cannot be read, so sweeps are not corrected for an axis: calibrate again"
    assert (said.status, said.reasons) == ("degraded", (why,))


async def test_health_of_a_node_that_stops_is_503(tmp_path: Path, disk: SimpleNamespace) -> None:
    table = Turntable()
    async with served(Library(tmp_path), table) as (node, _):
        table.status = CaptureStatus("stopped")
        status, said = await ask(node, "/healthz")
    assert (status, said["status"], said["reasons"]) == (503, "stopping", [])
