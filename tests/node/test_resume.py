"""Sweeps that were cut, by the plug, the node's end or a disk: which go on, and which become a scan."""

import asyncio
import shutil
from collections.abc import Callable
from contextlib import AsyncExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.scanner import SweepInterrupted, SweepReport, SweepStarted
from node import config, derive
from node.assemble import Assembly
from node.audit import done_trail, read_trail
from node.capture import Manner
from node.daemon import start_node
from node.journal import Journals
from node.library import content_id
from node.resume import cut_lately, publish_complete
from node.running_sweep import RunningSweep
from protocol.errors import LibraryError, PortLost
from protocol.grid import Grid
from protocol.scanner_messages import RangeColumn, SweepRequest, TextureColumn
from simulators.sweep import Sweep
from tests.node.capturing import SPEC, WAIT_S, Node, Plug, cut, device, is_truth


def test_a_sweep_with_an_overlap_goes_on_with_a_scanner_that_was_restarted(plug: Plug, node: Node) -> None:
    node.capture.sweep_like(Manner(SweepRequest(overlap=64)))
    sweep_id = cut(plug, node, device(boot_id=2))
    assert node.sweeps.get(sweep_id).header.overlap == 64
    assert node.capture.request_resume(sweep_id)
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_a_sweep_cut_by_a_pulled_plug_goes_on_when_the_scanner_is_back(plug: Plug, node: Node) -> None:
    scanner = device(turn_s=1.0)
    plug.plug(scanner)
    node.sweep_until_columns()
    plug.pull()
    interrupted = node.wait_for(SweepInterrupted)
    assert "tty" in interrupted.reason
    node.wait_until("connecting")
    (sweep,) = node.sweeps.interrupted()
    assert 0 < sweep.held < sweep.expected and not sweep.is_complete
    plug.plug(scanner)
    node.wait_for(SweepStarted)
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    assert node.sweeps.interrupted() == []


def test_watchers_of_a_resumed_sweep_see_all_of_it(plug: Plug, node: Node) -> None:
    scanner = device(turn_s=1.0)
    plug.plug(scanner)
    node.sweep_until_columns()
    plug.pull()
    node.wait_for(SweepInterrupted)
    plug.plug(scanner)
    node.wait_for(SweepStarted)
    node.grids.get(timeout=WAIT_S)
    columns = [event for event in list(node.events.queue) if isinstance(event, RangeColumn | TextureColumn)]
    assert len(columns) == SPEC.width + SPEC.texture_width


def test_a_restarted_scanner_does_not_go_on_by_itself_and_the_next_sweep_succeeds(plug: Plug, node: Node) -> None:
    sweep_id = cut(plug, node, device(boot_id=2))
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    assert [sweep.id for sweep in node.sweeps.interrupted()] == [sweep_id]


def test_a_restarted_scanner_with_the_same_calibration_goes_on_when_asked(plug: Plug, node: Node) -> None:
    sweep_id = cut(plug, node, device(boot_id=2, home_encoder=12345))
    assert node.capture.request_resume(sweep_id)
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    assert node.sweeps.interrupted() == []


@pytest.mark.parametrize(
    ("kinds", "why"),
    [({"boot_id": 2, "calibration": 77}, "calibrated anew"), ({"serial_number": "SIM-2"}, "begun by scanner SIM-0001")],
)
def test_a_scanner_that_is_not_the_same_is_refused(plug: Plug, node: Node, kinds: dict[str, Any], why: str) -> None:
    sweep_id = cut(plug, node, device(**kinds))
    before = node.sweeps.get(sweep_id)
    assert node.capture.request_resume(sweep_id)
    node.wait_until("ready", why)
    after = node.sweeps.get(sweep_id)
    assert (after.held, after.is_complete) == (before.held, False)
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_a_sweep_goes_on_by_itself_within_half_a_minute_and_no_later(plug: Plug, node: Node) -> None:
    sweep = node.sweeps.get(cut(plug, node, device(boot_id=2)))
    for later_s, goes_on in ((0.0, True), (29.0, True), (31.0, False), (-1.0, False)):
        found = cut_lately([sweep], sweep.info, sweep.ended_unix_s + later_s)
        assert (found is not None) == goes_on, later_s
    assert cut_lately([sweep], replace(sweep.info, boot_id=2), sweep.ended_unix_s) is None


def test_an_unknown_sweep_cannot_be_resumed(plug: Plug, node: Node) -> None:
    with pytest.raises(LibraryError, match="no interrupted sweep"):
        node.capture.request_resume("0" * 16)


def test_a_stopped_sweep_is_kept_and_does_not_go_on_by_itself(plug: Plug, node: Node, tmp_path: Path) -> None:
    plug.plug(device(turn_s=2.0))
    node.sweep_until_columns()
    node.capture.stop()
    (sweep,) = node.sweeps.interrupted()
    assert 0 < sweep.held < sweep.expected and sweep.why == "stopped"
    again = Node(tmp_path / "tty", tmp_path / "sweeps")
    again.capture.start()
    again.wait_until("ready")
    assert again.capture.request_resume(sweep.id)
    assert is_truth(again.grids.get(timeout=WAIT_S))
    again.capture.stop()


def test_a_grid_that_is_not_taken_stays_and_is_published_later(plug: Plug, node: Node) -> None:
    def full(grid: Grid) -> None:
        raise LibraryError("the disk is full")

    node.deliver = full
    plug.plug(device())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert node.wait_for(SweepInterrupted).reason == "the disk is full"
    node.wait_until("ready", "the disk is full")
    (sweep,) = node.sweeps.interrupted()
    assert sweep.is_complete and node.capture.status.sweeps == 0
    assert publish_complete(node.sweeps, node.take) == [f"could not publish sweep {sweep.id}: the disk is full"]
    node.deliver = node.grids.put
    assert node.capture.request_resume(sweep.id)
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    assert node.sweeps.interrupted() == []


def test_columns_that_the_scanner_counted_otherwise_never_become_a_scan(
    plug: Plug, node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    end = Sweep.end
    monkeypatch.setattr(Sweep, "end", lambda sweep: replace(end(sweep), digest=1))
    plug.plug(device())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert "not those the scanner counted" in node.wait_for(SweepInterrupted).reason
    node.wait_until("ready", "counted")
    (sweep,) = node.sweeps.interrupted()
    assert sweep.held == sweep.expected and not sweep.is_complete and "counted" in sweep.why
    assert node.capture.request_resume(sweep.id)
    node.wait_until("ready", "does not confirm them")
    node.capture.stop()
    again = Journals(tmp_path / "sweeps")
    assert publish_complete(again, node.take) == [] and node.grids.empty()
    assert [kept.id for kept in again.interrupted()] == [sweep.id]


def test_a_whole_sweep_whose_count_had_not_come_is_counted_when_it_goes_on(
    plug: Plug, node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = RunningSweep.finish

    def cut(running: RunningSweep, deliver: Callable[[Assembly], None], report: SweepReport) -> None:
        monkeypatch.setattr(RunningSweep, "finish", finish)
        raise PortLost("tty: unplugged")

    monkeypatch.setattr(RunningSweep, "finish", cut)
    plug.plug(device())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert node.wait_for(SweepInterrupted).reason == "tty: unplugged"
    assert is_truth(node.grids.get(timeout=WAIT_S))


def crashed(plug: Plug, node: Node) -> Grid:
    """A node that ends before the grid of its sweep, which is returned, is taken."""
    refused: list[Grid] = []

    def crash(grid: Grid) -> None:
        refused.append(grid)
        raise LibraryError("as good as a crash")

    node.deliver = crash
    plug.plug(device())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    node.wait_for(SweepInterrupted)
    node.capture.stop()
    (not_taken,) = refused
    return not_taken


def test_complete_sweeps_of_a_crashed_node_are_published_as_they_would_have_been(
    plug: Plug, node: Node, tmp_path: Path
) -> None:
    not_taken = crashed(plug, node)
    sweeps, made = Journals(tmp_path / "sweeps"), list[Assembly]()
    (said,) = publish_complete(sweeps, made.append)
    assert said.startswith("published sweep") and is_truth(made[0].grid)
    assert content_id(made[0].grid) == content_id(not_taken)
    assert sweeps.interrupted() == [] and publish_complete(sweeps, made.append) == []


async def test_a_complete_sweep_of_a_crashed_node_is_told_of_as_any_when_the_node_starts(
    plug: Plug, node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    crashed(plug, node)
    asked: asyncio.Queue[Grid] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    monkeypatch.setattr(derive, "closes", lambda grid: loop.call_soon_threadsafe(asked.put_nowait, grid) and False)
    shutil.move(tmp_path / "sweeps", tmp_path / "library" / "sweeps")
    folder = config.Library(str(tmp_path / "library"))
    settings = config.Config(
        server=config.Server(listen="127.0.0.1:0", insecure=True), library=folder, discovery=config.Discovery(False)
    )
    async with AsyncExitStack() as stack:
        started = await start_node(settings, stack)
        assert is_truth(await asyncio.wait_for(asked.get(), WAIT_S))  # whether it is to be a sphere, too
        scan = started.exhibits.library.scans()[0].id
    told = list(read_trail(done_trail(tmp_path / "library", 1 << 20), scan=scan))
    assert [entry.event for entry in told] == ["scanned"]
