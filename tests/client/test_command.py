from __future__ import annotations

import argparse
import asyncio
import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiohttp import web

from client import NodeLost, RequestRefused, command, discovery, scan_command
from client.command import _update_line
from client.discovery import NodeAddress
from client.session import _checked_look
from client.update import Tally
from exchange.errors import ExchangeError
from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError, ScannerFault, UsageError
from tests.client.scripted_node import Line, greet, serving_in_thread, show_and_answer, synthetic_grid

GRID = synthetic_grid()
NODE = NodeAddress("one", "127.0.0.1", 7345, "id-one", "ready", False)


def parse(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    command.add_subcommands(parser.add_subparsers(required=True))
    return parser.parse_args(arguments)


def run(*arguments: str) -> int:
    """A subcommand as `foveascan` runs it."""
    args = parse(*arguments)
    status: int = args.run(args)
    return status


def json_lines(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> list[NodeAddress]:
    """What discovery finds."""
    found: list[NodeAddress] = []

    async def discover(timeout_s: float, name: str | None = None) -> list[NodeAddress]:
        return [node for node in found if name in (None, node.name)]

    monkeypatch.setattr(discovery, "discover", discover)
    return found


def test_discover_prints_every_node(nodes: list[NodeAddress], capsys: pytest.CaptureFixture[str]) -> None:
    nodes.append(NODE)
    assert run("discover") == 0
    assert capsys.readouterr().out == "http://127.0.0.1:7345  one  ready\n"
    assert run("discover", "--json") == 0
    url = "http://127.0.0.1:7345"
    assert json_lines(capsys.readouterr().out) == [
        {"name": "one", "id": "id-one", "state": "ready", "url": url, "tls": False, "fingerprint": ""}
    ]


def test_discover_without_a_node_names_the_cure(nodes: list[NodeAddress]) -> None:
    with pytest.raises(NodeLost, match="within 0.5 s; start one with `foveascan serve`"):
        run("discover", "--timeout", "0.5")


def test_look_prints_the_scan_and_each_update_and_writes_the_model(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving_in_thread(show_and_answer) as url:
        target = tmp_path / "model.npz"
        assert run("look", "--node", url, "--at", "0.4,0.4", "--json", "-o", str(target)) == 0
    scan, update = json_lines(capsys.readouterr().out)
    assert (scan["scan"], scan["range"], scan["texture"]) == ("synthetic", [64, 96], [128, 256])
    assert scan["first_view_bytes"] > 0
    assert (update["u"], update["v"], update["reason"], update["texture_db"]) == (0.4, 0.4, "complete", 100.0)
    with np.load(target) as file:
        assert np.array_equal(file["depth_u16"][16:32, 24:48], GRID.range_steps[16:32, 24:48])


def test_look_is_readable_without_json(capsys: pytest.CaptureFixture[str]) -> None:
    with serving_in_thread(show_and_answer) as url:
        run("look", "--node", url)
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith("scan synthetic: 96 x 64, first view ")
    assert second.startswith("(0.5, 0.5): complete, ") and second.endswith("range within 0 mm, texture 100.0 dB")


def test_look_finds_the_only_node(nodes: list[NodeAddress], capsys: pytest.CaptureFixture[str]) -> None:
    with serving_in_thread(show_and_answer) as url:
        nodes.append(NodeAddress("one", "127.0.0.1", int(url.rpartition(":")[2]), "", "ready", False))
        assert run("look", "--json") == 0
    assert len(json_lines(capsys.readouterr().out)) == 2


def test_look_asks_which_of_several_nodes(nodes: list[NodeAddress]) -> None:
    nodes += [NODE, NodeAddress("two", "127.0.0.2", 1, "", "ready", False)]
    with pytest.raises(NodeLost, match="--node http://127.0.0.1:7345 or http://127.0.0.2:1"):
        run("look")


def test_look_refuses_a_format_it_cannot_write_before_it_connects() -> None:
    with pytest.raises(ExchangeError, match=r"model\.xyz: cannot tell its format; end it in \.glb, "):
        run("look", "--node", "http://127.0.0.1:9", "-o", "model.xyz")


def test_look_passes_a_refusal_on() -> None:
    async def refuse(line: Line) -> None:
        await greet(line)
        asked = await line.hear()
        assert isinstance(asked, m.Open) and asked.scan == "nope"
        await line.say(m.Refused(asked.request, "not found", "no scan 'nope'"))
        await line.gone()

    with serving_in_thread(refuse) as url, pytest.raises(RequestRefused, match="no scan 'nope'"):
        run("look", "--node", url, "--scan", "nope")


def test_a_complete_look_does_not_promise_its_largest_error() -> None:
    blank = Tally(1).close(m.Updated(1, 2, "complete", error_max_mm=1.22))
    assert "range 99% within 0.1 mm, all within 1.22 mm" in _update_line(0.5, 0.5, blank, 0.1)
    cut = replace(blank, reason="byte limit")
    assert cut.reason in (line := _update_line(0.5, 0.5, cut, 0.1)) and "99%" not in line


def test_look_checks_where_to_write_before_it_connects(tmp_path: Path) -> None:
    target = tmp_path / "none" / "model.glb"
    for arguments in (("look", "-o", str(target)), ("export", str(target))):
        with pytest.raises(FileNotFoundError) as refused:
            run(*arguments, "--node", "http://127.0.0.1:9")
        assert refused.value.filename == str(target)


BOUNDS = {
    "--window": ("window", ["0", "-1", "1.01", "2"], ["0.001", "1"]),
    "--texture-db": ("texture_db", ["9.9", "101"], ["10", "100"]),
    "--range-mm": ("range_mm", ["-0.1", "1001"], ["0", "1000"]),
    "--max-wait": ("max_wait_s", ["0", "31"], ["0.05", "30"]),
    "--max-bytes": ("max_bytes", ["-1", "1.5", str((1 << 40) + 1)], ["0", str(1 << 40)]),
}


@pytest.mark.parametrize("option", BOUNDS)
def test_a_look_out_of_bounds_is_wrong_usage_where_a_stream_would_refuse_it(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    field, wrong, right = BOUNDS[option]
    for text in wrong:
        with pytest.raises(SystemExit) as end:
            parse("look", f"{option}={text}")
        assert end.value.code == 2 and f"{option}: expected" in capsys.readouterr().err
        with pytest.raises(LocalWireError):
            _checked_look(replace_field(field, float(text)))
    for text in right:
        value = getattr(parse("look", f"{option}={text}"), option[2:].replace("-", "_"))
        assert getattr(_checked_look(replace_field(field, value)), field) == value


def replace_field(field: str, value: float) -> m.Look:
    return m.Look(1, 0.5, 0.5, **{field: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "arguments",
    [("--at", "0.5"), ("--at", "1,0"), ("--at", "0,nan"), ("--at", "a,b"), ("--timeout", "0"), ("--max-wait", "inf")],
)
def test_arguments_without_sense_are_wrong_usage(
    arguments: tuple[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        run("look", *arguments)
    assert end.value.code == 2 and arguments[0] in capsys.readouterr().err


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


@pytest.mark.parametrize(
    "command", [("discover",), ("look",), ("scan",), ("scans",), ("export", "x.glb"), ("import", "x.npz")]
)
@pytest.mark.parametrize("timeout", ["0", "-1", "nan", "inf", "3601", "soon"])
def test_every_command_checks_how_long_to_search(
    command: tuple[str, ...], timeout: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as end:
        run(*command, "--timeout", timeout)
    assert end.value.code == 2 and "--timeout: expected" in capsys.readouterr().err


def listing(scans: Any) -> web.RouteDef:
    async def answer(request: web.Request) -> web.Response:
        return web.json_response(scans)

    return web.get("/v1/scans", answer)


SCAN = {
    "id": "65c920f10da19d5aa6d707ea911682d3", "created": 0, "source": "sweep", "name": "red \x1b[31m",
    "width": 360, "height": 100, "textureWidth": 1024, "textureHeight": 256,
}  # fmt: skip


def test_scans_lists_whole_ids(capsys: pytest.CaptureFixture[str]) -> None:
    scans = [SCAN, {**SCAN, "created": 1e300, "name": ""}]
    with serving_in_thread(greet_and_wait, listing(scans)) as url:
        assert run("scans", "--node", url) == 0
        first, second = capsys.readouterr().out.splitlines()
        assert run("scans", "--node", url, "--json") == 0
    assert first.startswith(f"{SCAN['id']}  19") and first.endswith(r"360 x 100 + 1024 x 256  red \x1b[31m")
    assert second.endswith("at no known time  360 x 100 + 1024 x 256")
    assert json_lines(capsys.readouterr().out) == scans


def test_a_node_without_scans_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    with serving_in_thread(greet_and_wait, listing([])) as url:
        assert run("scans", "--node", url) == 0
    assert capsys.readouterr().out == "no scans\n"


@pytest.mark.parametrize("said", [{}, [1], [{**SCAN, "id": 5}], [{"id": "x"}]])
def test_what_is_no_list_of_scans_is_refused(said: Any) -> None:
    with serving_in_thread(greet_and_wait, listing(said)) as url, pytest.raises(RemoteWireError, match="scans"):
        run("scans", "--node", url)


async def greet_and_wait(line: Line) -> None:
    await greet(line)
    await line.gone()


@pytest.mark.parametrize("other", [("--list",), ("--forget", "SIM-0001")])
def test_calibrate_takes_a_scan_with_a_diameter_only(other: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match="--scan: goes with --diameter"):
        run("calibrate", *other, "--scan", "latest", "--node", "http://127.0.0.1:9")


def test_calibrate_forgets_nobody_without_a_name() -> None:
    with pytest.raises(UsageError, match="--forget: which scanner"):
        run("calibrate", "--forget", " ", "--node", "http://127.0.0.1:9")
