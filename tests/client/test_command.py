from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from aiohttp import web

from client import NodeLost, RequestRefused, discovery
from client.command import _update_line
from client.discovery import NodeAddress
from client.session import _checked_look
from client.update import Tally
from exchange.errors import ExchangeError
from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError, UsageError
from tests.client.commands import greet_and_wait, json_lines, parse, run
from tests.client.scripted_node import Line, greet, serving_in_thread, show_and_answer, synthetic_grid

GRID = synthetic_grid()
NODE = NodeAddress("one", "127.0.0.1", 7345, "id-one", "ready", False)


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


@pytest.mark.parametrize("other", [("--list",), ("--forget", "SIM-0001")])
def test_calibrate_takes_a_scan_with_a_diameter_only(other: tuple[str, ...]) -> None:
    with pytest.raises(UsageError, match="--scan: goes with --diameter"):
        run("calibrate", *other, "--scan", "latest", "--node", "http://127.0.0.1:9")


def test_calibrate_forgets_nobody_without_a_name() -> None:
    with pytest.raises(UsageError, match="--forget: which scanner"):
        run("calibrate", "--forget", " ", "--node", "http://127.0.0.1:9")
