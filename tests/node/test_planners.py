"""Processes that plan: they answer as the node itself would, and whatever becomes of one costs nobody a look."""

from __future__ import annotations

import copy
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from multiprocessing import Pipe
from pathlib import Path

import numpy as np
import pytest

from node import planners
from node.bound import AnyUpdate, Bound
from node.classic import build_classic_view
from node.first_view import build_first_view
from node.foveate import Planned, Update
from node.library import About, Library
from node.planners import Planners
from node.planning_process import PlanningProcess, Stop
from node.range_model import RangeModel
from node.sealing import seal
from node.texture_model import TextureModel
from node.tray import Tray
from node.wanted import NO_MODELS, Models, Wanted
from protocol import messages as m
from protocol.errors import LatticeError
from tests.node.scans import make_grid
from tests.node.sealed_places import KEY, open_at
from tests.waiting import PATIENCE_S

CODECS: tuple[m.CodecName, ...] = ("htj2k", "jpeg")
LOOK = m.Look(5, 0.7, 0.5)
ROOT = Path(__file__).parents[2]


def never() -> bool:
    return False


def hurried(look: m.Look) -> Wanted:
    """A look that is planned while others wait."""
    return Wanted(look, CODECS, hurried=True)


class Node:
    """One process over a library of one scan."""

    def __init__(self, folder: Path) -> None:
        self.library = Library(folder)
        self.scan = self.library.open(self.library.resolve("latest"))
        self.planners = Planners(1, folder)

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *how: object) -> None:
        self.planners.close()
        self.library.close()

    def bound(self) -> Bound:
        """A client that has the first view."""
        return Bound(1, self.scan, build_first_view(self.scan, "htj2k", 32768).state, 2)

    def ask(self, look: m.Look = LOOK, superseded: Callable[[], bool] = never) -> Planned | None:
        """What the process makes of a look over the first view."""
        return self.planners.plan(self.bound(), hurried(look), NO_MODELS, superseded)

    def plan(self) -> Update:
        """The same as the node does it."""
        update = self.bound().plan(hurried(LOOK), NO_MODELS, never)
        assert isinstance(update, Update)
        return update.settled()

    @property
    def process(self) -> subprocess.Popen[bytes]:
        process = self.planners._all[0]._process
        assert process is not None
        return process


def wait_for(ask: Callable[[], Planned | None]) -> Planned:
    """The first answer of a process that was not there."""
    until_s = time.monotonic() + PATIENCE_S
    while (planned := ask()) is None:
        assert time.monotonic() < until_s
        time.sleep(0.01)
    return planned


def kept(folder: Path, width: int = 80, height: int = 48) -> Path:
    """A library with a scan in it."""
    with closing(Library(folder)) as library:
        library.add(make_grid(width, height), About(0.0))
    return folder


@pytest.fixture(scope="module")
def the_node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Node]:
    with Node(kept(tmp_path_factory.mktemp("planners"), 156, 96)) as node:
        yield node


@pytest.fixture
def node(the_node: Node, monkeypatch: pytest.MonkeyPatch) -> Node:
    """With its process up, whatever became of it before."""
    monkeypatch.setattr(planners, "RESTART_S", 0.0)
    wait_for(the_node.ask)
    return the_node


def assert_same(planned: Planned | None, update: AnyUpdate) -> None:
    """What a client gets, and what is remembered of it."""
    assert planned is not None and isinstance(update, Update)
    ours, theirs = ([one.refinement(3, 4, 5).to_bytes() for one in each.coded] for each in (update, planned))
    assert ours == theirs
    for name in ("reason", "error_max_mm", "texture_db", "encodes"):
        assert getattr(planned, name) == getattr(update, name)
    for name in ("error", "far", "target_steps", "missed", "first_error"):
        np.testing.assert_array_equal(getattr(planned.state, name), getattr(update.state, name))
    assert planned.state.shapes == update.state.shapes
    assert planned.state.holdings.digest() == update.state.holdings.digest()


def test_a_process_answers_as_the_node_itself(node: Node) -> None:
    scan = node.scan
    models = Models(RangeModel(scan.spec, scan.range_steps, scan.filled), TextureModel(scan.texture))
    for look, knows, quick, in_a_hurry in [
        (LOOK, True, False, True),
        (LOOK, False, False, True),
        (LOOK, True, True, True),
        (LOOK, True, False, False),
        (m.Look(5, 0.2, 0.4, max_bytes=3000, fill=True), True, False, True),
        (m.Look(5, 0.2, 0.4, max_bytes=0), True, False, True),
        (m.Look(5, 0.5, 0.5, parameters=m.LookParameters(m.RangeParameters(1, 1))), True, False, True),
    ]:
        node.planners.forget(node.scan.id)  # its model learns: both begin with a new one
        there, here = (copy.deepcopy(models) if knows else NO_MODELS for _ in range(2))
        bound, wanted = node.bound(), Wanted(look, CODECS, look.max_bytes, quick, in_a_hurry)
        planned = node.planners.plan(bound, wanted, there, never)
        update = bound.plan(wanted, here, never)
        assert isinstance(update, Update)
        assert_same(planned, update.settled())


def test_an_update_is_planned_over_what_the_client_holds(node: Node) -> None:
    bound = node.bound()
    ask = node.planners.plan
    planned = ask(bound, hurried(LOOK), NO_MODELS, never)
    assert planned is not None and len(bound.take(planned, LOOK)) == 2
    assert bound.state is planned.state and bound.next_seq == 4
    again = ask(bound, hurried(LOOK), NO_MODELS, never)
    assert again is not None and not again.coded and again.reason == "complete"


def test_what_does_not_fit_the_scan_is_said(node: Node) -> None:
    died = node.planners.died
    with pytest.raises(LatticeError, match="spacing 8.0 does not divide the 156 columns"):
        node.ask(m.Look(5, 0.5, 0.5, parameters=m.LookParameters(m.RangeParameters(8, 1))))
    assert node.ask() is not None and node.planners.died == died


def test_a_look_that_is_overtaken_is_dropped_and_the_next_planned(node: Node) -> None:
    os.kill(node.process.pid, signal.SIGSTOP)

    def superseded() -> bool:
        os.kill(node.process.pid, signal.SIGCONT)
        return True

    planned = node.ask(superseded=superseded)
    assert planned is not None and planned.reason in ("superseded", "complete")  # it may be done before it hears of it
    assert_same(node.ask(), node.plan())


def test_a_process_that_hears_of_a_newer_look_drops_the_older() -> None:
    ours, theirs = Pipe()
    tray = Tray()
    ours.send(Stop(1))
    stopped = PlanningProcess(theirs, tray)._stopped
    assert stopped(1)() and not stopped(2)()


def test_a_classic_look_is_planned_elsewhere(node: Node) -> None:
    bound = Bound(1, node.scan, build_classic_view(node.scan, "htj2k").state, 2)
    assert node.planners.plan(bound, hurried(LOOK), NO_MODELS, never) is None


def test_a_process_killed_in_mid_look_is_replaced(node: Node) -> None:
    process, died = node.process, node.planners.died
    os.kill(process.pid, signal.SIGSTOP)
    with ThreadPoolExecutor(1) as thread:
        asked = thread.submit(node.ask)
        process.kill()
        assert asked.result(PATIENCE_S) is None  # so the caller plans it
    assert node.planners.died == died + 1
    assert re.fullmatch(
        r"a process that plans looks died \d+ s ago, by signal SIGKILL", node.planners.trouble
    )
    assert_same(wait_for(node.ask), node.plan())
    assert node.planners.running == 1 and node.process is not process


def test_a_process_that_hangs_is_waited_for_no_longer(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planners, "PATIENCE_S", 0.05)
    os.kill(node.process.pid, signal.SIGSTOP)
    assert node.ask() is None
    assert "it did not answer within 0.05 s" in node.planners.trouble


def test_one_that_cannot_be_started_is_done_without(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planners, "PROGRAM", [str(ROOT / "no-such-program")])
    node.process.kill()
    assert node.ask() is None and node.ask() is None
    assert node.planners.running == 0


def test_the_end_waits_for_no_look(tmp_path: Path) -> None:
    with Node(kept(tmp_path)) as node, ThreadPoolExecutor(1) as thread:
        wait_for(node.ask)
        os.kill(node.process.pid, signal.SIGSTOP)
        asked = thread.submit(node.ask)
        node.planners.close()
        assert asked.result(PATIENCE_S) is None
        assert node.planners.running == 0 and not node.planners.died
        assert node.ask() is None and node.planners.running == 0  # and no other is started


def test_signals_to_all_processes_leave_them_to_the_node(node: Node) -> None:
    process = node.process
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        process.send_signal(number)
    assert node.ask() is not None and node.process is process


def test_a_deleted_scan_is_forgotten_by_the_processes_too(node: Node) -> None:
    node.planners.forget(node.scan.id)
    assert not node.planners._parcels and not node.planners._all[0]._has
    maps = Path(f"/proc/{node.process.pid}/maps")
    wait_for(node.ask)
    assert node.scan.id in maps.read_text()
    node.planners.forget(node.scan.id)
    until_s = time.monotonic() + PATIENCE_S
    while node.scan.id in maps.read_text():
        assert time.monotonic() < until_s
        time.sleep(0.01)


def test_a_scan_deleted_before_a_process_has_it_is_planned_by_the_node(tmp_path: Path) -> None:
    with Node(kept(tmp_path)) as node:
        wait_for(node.ask)
        node.planners.forget(node.scan.id)
        node.library.delete(node.scan.id)
        assert node.ask() is None
        assert node.planners.running == 1 and not node.planners.died


@pytest.mark.usefixtures("mounts")
def test_a_sealed_library_is_planned_from_as_any_other(tmp_path: Path) -> None:
    folder = kept(tmp_path / "library")
    seal(folder, KEY, lambda size: None)
    with open_at(folder), Node(folder) as node:
        assert_same(wait_for(node.ask), node.plan())


def test_a_process_ends_with_its_node(tmp_path: Path) -> None:
    program = """if True:
        import sys, time
        from pathlib import Path
        from node.planners import Planners
        planners = Planners(1, Path(sys.argv[1]))
        planners.start()
        print(planners._all[0]._process.pid, flush=True)
        time.sleep(1000)
        """
    with subprocess.Popen([sys.executable, "-c", program, tmp_path], stdout=subprocess.PIPE, cwd=ROOT) as node:
        assert node.stdout is not None
        pid = int(node.stdout.readline())
        node.kill()
    until_s = time.monotonic() + PATIENCE_S
    while Path(f"/proc/{pid}").exists() and "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2]:
        assert time.monotonic() < until_s
        time.sleep(0.01)
