"""The commands that sweep, and go on with what was cut: what they wait for, and what they say."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import pytest
from aiohttp import web

from client import scan_command
from protocol import messages as m
from protocol.errors import RemoteWireError, ScannerFault, UsageError
from tests.client.commands import greet_and_wait, json_lines, run
from tests.client.scripted_node import Line, greet, serving_in_thread


class Turntable:
    """A node's HTTP side while it sweeps. phases : what GET /v1/node says, one after the other, the last for ever."""

    def __init__(self, *phases: dict[str, Any]) -> None:
        self.phases = [{"progress": 0.0, "sweeps": 0, "why": "", **phase} for phase in phases]
        self.swept = threading.Event()
        quality = {"coverage": 0.5, "noiseMm": 0.025, "holes": 3, "complaints": ["something moved\x1b"], "later": 1}
        self.described: dict[str, object] = {"id": "fresh", "quality": quality}

    def routes(self) -> tuple[web.RouteDef, ...]:
        return (
            web.get("/v1/node", self.node),
            web.post("/v1/sweeps", self.sweep),
            web.get("/v1/scans/fresh", self.scan),
        )

    async def scan(self, request: web.Request) -> web.Response:
        return web.json_response(self.described)

    async def node(self, request: web.Request) -> web.Response:
        phase = self.phases.pop(0) if len(self.phases) > 1 else self.phases[0]
        if phase["sweeps"]:
            self.swept.set()
        return web.json_response({"capture": phase})

    async def sweep(self, request: web.Request) -> web.Response:
        return web.json_response({**self.phases[0], "sweep": 1}, status=202)

    async def announce(self, line: Line) -> None:
        """The script of the stream."""
        await greet(line)
        await asyncio.to_thread(self.swept.wait, 10)
        await line.say(m.Published("brought"), m.Published("round", made_from=("old",)))
        await line.say(m.Published("fresh", 1))
        await line.gone()


def test_scan_sweeps_once_and_prints_the_new_scan(capsys: pytest.CaptureFixture[str]) -> None:
    sweeping = {"phase": "sweeping", "progress": 0.5}
    table = Turntable({"phase": "connecting"}, {"phase": "ready"}, sweeping, {"phase": "ready", "sweeps": 1})
    with serving_in_thread(table.announce, *table.routes()) as url:
        assert run("scan", "--node", url, "--json") == 0
    (said,) = json_lines(capsys.readouterr().out)
    assert said["scan"] == "fresh" and said["quality"]["coverage"] == 0.5 and said["quality"]["complaints"]


def test_scan_says_in_words_what_the_scan_is_worth(capsys: pytest.CaptureFixture[str]) -> None:
    table = Turntable({"phase": "ready"}, {"phase": "ready", "sweeps": 1})
    with serving_in_thread(table.announce, *table.routes()) as url:
        assert run("scan", "--node", url) == 0
    assert capsys.readouterr().out.splitlines() == [
        "scan fresh", "coverage 50.0 %, noise 0.025 mm, 3 void cells in holes", "something moved\\x1b",
    ]  # fmt: skip


@pytest.mark.parametrize("quality", [None, "absent"])
def test_a_scan_of_which_no_quality_is_known_is_a_scan(
    quality: object, capsys: pytest.CaptureFixture[str]
) -> None:
    table = Turntable({"phase": "ready"}, {"phase": "ready", "sweeps": 1})
    table.described = {} if quality else {"quality": None}
    with serving_in_thread(table.announce, *table.routes()) as url:
        assert run("scan", "--node", url, "--json") == 0
    assert json_lines(capsys.readouterr().out) == [{"scan": "fresh", "quality": None}]


def test_a_quality_that_makes_no_sense_is_refused() -> None:
    table = Turntable({"phase": "ready"}, {"phase": "ready", "sweeps": 1})
    table.described = {"quality": {"coverage": 2}}
    with serving_in_thread(table.announce, *table.routes()) as url, pytest.raises(RemoteWireError, match="coverage"):
        run("scan", "--node", url)


def test_a_sweep_that_fails_says_why() -> None:
    table = Turntable({"phase": "ready"}, {"phase": "ready", "why": "sweep interrupted: the port is gone"})
    with serving_in_thread(greet_and_wait, *table.routes()) as url, pytest.raises(ScannerFault, match="port is gone"):
        run("scan", "--node", url)


def test_a_sweep_that_is_cut_is_waited_for(capsys: pytest.CaptureFixture[str]) -> None:
    away = {"phase": "connecting", "why": "the line is empty"}
    back = {"phase": "ready"}, {"phase": "sweeping"}, {"phase": "ready", "sweeps": 1}
    table = Turntable({"phase": "ready"}, {"phase": "sweeping"}, away, away, *back)
    with serving_in_thread(table.announce, *table.routes()) as url:
        assert run("scan", "--node", url, "--json") == 0
    said, told = capsys.readouterr()
    assert [one["scan"] for one in json_lines(said)] == ["fresh"]
    assert told == "foveascan: the line is empty: waiting for the scanner to come back\n"


@pytest.mark.parametrize("phase", ["connecting", "ready"])
def test_a_sweep_that_does_not_go_on_is_not_waited_for_endlessly(phase: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan_command, "AWAY_S", 0.5 if phase == "connecting" else 1e9)
    monkeypatch.setattr(scan_command, "BACK_S", 0.5)
    away = {"phase": "connecting", "why": "the line is empty"}
    table = Turntable({"phase": "ready"}, away, {"phase": phase, "why": away["why"] if phase == "connecting" else ""})
    with serving_in_thread(greet_and_wait, *table.routes()) as url, pytest.raises(ScannerFault, match="line is empty"):
        run("scan", "--node", url)


def test_trouble_of_an_earlier_sweep_is_not_taken_for_this_one_s(capsys: pytest.CaptureFixture[str]) -> None:
    old = {"phase": "ready", "why": "sweep interrupted: the port is gone"}
    table = Turntable(old, {"phase": "starting"}, {"phase": "sweeping"}, {"phase": "ready", "sweeps": 1})
    with serving_in_thread(table.announce, *table.routes()) as url:
        assert run("scan", "--node", url, "--json") == 0
    assert [said["scan"] for said in json_lines(capsys.readouterr().out)] == ["fresh"]


CUT = {
    "id": "5d7a7f19215321eb", "started": 0, "ended": 0, "why": "unplugged\x1b", "held": 35, "expected": 100,
    "complete": False, "damagedBytes": 0, "sizeBytes": 9, "scanner": "SIM-1", "width": 360, "height": 100,
    "textureWidth": 1024, "textureHeight": 256,
}  # fmt: skip
OLDER = {**CUT, "id": "5d7a7f0000000000"}


def cut_sweeps(*lists: list[dict[str, Any]], started: Any = None) -> tuple[web.RouteDef, ...]:
    """What a node says of its cut sweeps, one answer after the other, the last for ever; and of going on with one."""
    waiting = list(lists)

    async def listed(request: web.Request) -> web.Response:
        return web.json_response(waiting.pop(0) if len(waiting) > 1 else waiting[0])

    async def resumed(request: web.Request) -> web.Response:
        assert request.match_info["sweep"] == CUT["id"]
        return web.json_response(started, status=202)

    async def deleted(request: web.Request) -> web.Response:
        return web.Response(status=204 if request.match_info["sweep"] == CUT["id"] else 404)

    return (
        web.get("/v1/sweeps", listed),
        web.post("/v1/sweeps/{sweep}/resume", resumed),
        web.delete("/v1/sweeps/{sweep}", deleted),
    )


def test_a_sweep_that_fails_names_what_is_kept_of_it() -> None:
    table = Turntable({"phase": "ready"}, {"phase": "ready", "why": "the disk is full"})
    routes = (*table.routes(), *cut_sweeps([OLDER], [OLDER, CUT]))
    kept = "the disk is full; 35 % of it is kept: foveascan sweeps --resume 5d7a7f19215321eb"
    with serving_in_thread(greet_and_wait, *routes) as url, pytest.raises(ScannerFault, match=kept):
        run("scan", "--node", url)


def test_a_sweep_that_did_not_begin_takes_no_other_for_its_own() -> None:
    table = Turntable({"phase": "ready"}, {"phase": "ready", "why": "the disk is full"})
    routes = (*table.routes(), *cut_sweeps([OLDER]))
    with serving_in_thread(greet_and_wait, *routes) as url, pytest.raises(ScannerFault, match="the disk is full$"):
        run("scan", "--node", url)


def test_sweeps_that_were_cut_are_listed_newest_first(capsys: pytest.CaptureFixture[str]) -> None:
    with serving_in_thread(greet_and_wait, *cut_sweeps([OLDER, CUT])) as url:
        assert run("sweeps", "--node", url) == 0
        first, second = capsys.readouterr().out.splitlines()
        assert run("sweeps", "--node", url, "--json") == 0
    assert first.startswith(f"{CUT['id']}  19") and second.startswith(str(OLDER["id"]))
    assert first.endswith(r"  35 % of 360 x 100 + 1024 x 256  SIM-1  unplugged\x1b")
    assert [said["held"] for said in json_lines(capsys.readouterr().out)] == [35, 35]
    with serving_in_thread(greet_and_wait, *cut_sweeps([])) as url:
        assert run("sweeps", "--node", url) == 0
    assert capsys.readouterr().out == "no sweep was cut\n"


@pytest.mark.parametrize("given", ["latest", CUT["id"], "5d7a7f1"])
def test_a_cut_sweep_is_gone_on_with(given: str, capsys: pytest.CaptureFixture[str]) -> None:
    table = Turntable({"phase": "ready"}, {"phase": "sweeping"}, {"phase": "ready", "sweeps": 1})
    routes = (*table.routes(), *cut_sweeps([OLDER, CUT], started={**CUT, "sweep": 1}))
    with serving_in_thread(table.announce, *routes) as url:
        assert run("sweeps", "--resume", given, "--node", url, "--json") == 0
    assert [said["scan"] for said in json_lines(capsys.readouterr().out)] == ["fresh"]


@pytest.mark.parametrize(
    ("given", "why"), [("5d7a7f", "several begin with '5d7a7f'"), ("5d7a", "no sweep '5d7a'"), ("x", "no sweep 'x'")]
)
def test_a_cut_sweep_that_is_not_the_only_one_meant_is_refused(given: str, why: str) -> None:
    with serving_in_thread(greet_and_wait, *cut_sweeps([OLDER, CUT])) as url, pytest.raises(UsageError, match=why):
        run("sweeps", "--resume", given, "--node", url)


def test_a_cut_sweep_is_deleted_by_its_whole_id(capsys: pytest.CaptureFixture[str]) -> None:
    with serving_in_thread(greet_and_wait, *cut_sweeps([OLDER, CUT])) as url:
        assert run("sweeps", "--delete", str(CUT["id"]), "--node", url) == 0
        with pytest.raises(RemoteWireError):
            run("sweeps", "--delete", "latest", "--node", url)
    assert capsys.readouterr().out == f"sweep {CUT['id']} deleted\n"


@pytest.mark.parametrize("options", [("--fetch", "latest"), ("-o", "x.npz"), ("--fetch", "latest", "-o", "x.glb")])
def test_what_there_is_of_a_sweep_is_fetched_as_npz_only(options: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match=r"\.npz|--fetch ID and -o FILE"):
        run("sweeps", *options, "--node", "http://127.0.0.1:1")


@pytest.mark.parametrize("said", [{}, [{**CUT, "held": "x"}], [{"id": "x"}]])
def test_what_is_no_list_of_sweeps_is_refused(said: Any) -> None:
    with serving_in_thread(greet_and_wait, *cut_sweeps(said)) as url, pytest.raises(RemoteWireError, match="sweeps"):
        run("sweeps", "--node", url)


def test_a_node_without_a_scanner_is_named() -> None:
    table = Turntable({"phase": "no scanner"})
    with serving_in_thread(greet_and_wait, *table.routes()) as url, pytest.raises(ScannerFault, match="--scanner"):
        run("scan", "--node", url)
