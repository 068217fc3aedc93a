"""The capture thread against a simulated scanner on a pty: plugs are pulled, scanners restarted, disks filled."""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.discover import Arrivals
from drivers.scanner import (
    Scanner,
    ScannerConfig,
    SweepEvent,
    SweepInterrupted,
    SweepProgress,
    SweepReport,
    SweepStarted,
)
from drivers.serial_port import SerialPort
from node import capture, durable
from node.assemble import Assembly
from node.capture import Capture, CaptureStatus
from node.journal import Journals
from node.resume import publish_complete
from node.running_sweep import RunningSweep
from node.scan_quality import ScanQuality, coverage_of
from protocol.errors import LibraryError, PortLost
from protocol.grid import Grid, GridSpec
from protocol.scanner_messages import RangeColumn, SweepRequest, TextureColumn
from simulators.carriers import PtyPort, serve
from simulators.faults import FaultyScanner, parse_faults
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.sweep import Sweep
from simulators.turntable import Turntable

SPEC = GridSpec(width=48, height=30, texture_width=64, texture_height=40, step_mm=0.05, pitch_mm=1.0, theta0_rad=0.3)
FAST_BAUD = 100_000_000
WAIT_S = 20.0


def truth() -> Grid:
    rng = np.random.default_rng(1)
    range_steps = rng.integers(0, 60000, (SPEC.height, SPEC.width)).astype(np.uint16)
    return Grid(SPEC, range_steps, rng.integers(0, 256, (SPEC.texture_height, SPEC.texture_width, 3)).astype(np.uint8))


TRUTH = truth()


def device(turn_s: float = 0.2, home_encoder: int = 0, **kinds: Any) -> SimulatedScanner:
    return SimulatedScanner(Turntable(Specimen("noise", TRUTH), turn_s=turn_s, home_encoder=home_encoder), **kinds)


class Plug:
    """A simulated scanner in a thread of its own, plugged in and pulled out at will."""

    def __init__(self, link: Path) -> None:
        self._link = link
        self._port: PtyPort | None = None

    def plug(self, scanner: SimulatedScanner | FaultyScanner) -> None:
        self._stop = threading.Event()
        self._port = PtyPort(self._link, FAST_BAUD)
        self._thread = threading.Thread(target=serve, args=(scanner, self._port, self._stop))
        self._thread.start()

    def pull(self) -> None:
        if self._port is not None:
            self._stop.set()
            self._port.cancel()
            self._thread.join()
            self._port.close()
            self._port = None


class Node:
    """A capture thread, its journals, and all that it told."""

    def __init__(self, link: Path, folder: Path) -> None:
        self.grids: queue.Queue[Grid] = queue.Queue()
        self.events: queue.Queue[SweepEvent] = queue.Queue()
        self.sweeps = Journals(folder)
        self.deliver: Callable[[Grid], None] = self.grids.put
        self.qualities: list[ScanQuality] = []
        self.capture = Capture(
            lambda: SerialPort(str(link)), ScannerConfig(progress_s=0.02), self.take, self.events.put, self.sweeps,
        )  # fmt: skip

    def take(self, assembly: Assembly) -> None:
        self.deliver(assembly.grid)
        self.qualities.append(assembly.quality)

    def wait_for(self, kind: type[SweepEvent]) -> Any:
        while not isinstance(event := self.events.get(timeout=WAIT_S), kind):
            pass
        return event

    def wait_until(self, phase: str, why: str = "") -> None:
        end_s = time.monotonic() + WAIT_S
        while self.capture.status.phase != phase or why not in self.capture.status.why:
            assert time.monotonic() < end_s, self.capture.status
            time.sleep(0.005)

    def sweep_until_columns(self, share: float = 0.2) -> None:
        self.wait_until("ready")
        assert self.capture.request_sweep()
        while self.wait_for(SweepProgress).share < share:
            pass


@pytest.fixture
def plug(tmp_path: Path) -> Iterator[Plug]:
    plug = Plug(tmp_path / "tty")
    yield plug
    plug.pull()


@pytest.fixture
def node(tmp_path: Path, plug: Plug) -> Iterator[Node]:
    node = Node(tmp_path / "tty", tmp_path / "sweeps")
    node.capture.start()
    yield node
    node.capture.stop()


def is_truth(grid: Grid) -> bool:
    return np.array_equal(grid.range_steps, TRUTH.range_steps) and np.array_equal(grid.texture, TRUTH.texture)


def test_a_sweep_becomes_a_grid_and_its_journal_goes(plug: Plug, node: Node, tmp_path: Path) -> None:
    plug.plug(device())
    node.wait_until("ready")
    for count in (1, 2):
        assert node.capture.request_sweep()
        assert is_truth(node.grids.get(timeout=WAIT_S))
        node.wait_until("ready")
        assert node.capture.status.sweeps == count
    assert list((tmp_path / "sweeps").iterdir()) == []
    assert node.sweeps.interrupted() == []


def test_a_scan_comes_with_its_quality_and_every_sample_as_it_was_measured(plug: Plug, node: Node) -> None:
    bad_line = parse_faults("loss=0.05", 3)[0]
    plug.plug(FaultyScanner(lambda boot_id: device(boot_id=boot_id), bad_line, 3))
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    (quality,) = node.qualities
    assert quality.coverage == coverage_of(TRUTH.range_steps) and (quality.spikes, quality.filled) == (0, 0)
    assert quality.requested_columns > 0 and quality.dropped_bytes > 0


def test_only_one_sweep_is_asked_for_at_a_time(plug: Plug, node: Node) -> None:
    plug.plug(device(turn_s=0.5))
    node.sweep_until_columns()
    assert not node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_a_sweep_asked_for_is_starting_and_older_trouble_forgotten(
    plug: Plug, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    idle, look_up = threading.Semaphore(0), threading.Semaphore(0)

    def watch(scanner: Scanner, listen_s: float) -> None:
        idle.release()
        look_up.acquire(timeout=WAIT_S)

    with monkeypatch.context() as patch:
        patch.setattr(Scanner, "watch", watch)
        patch.setattr(durable, "free_bytes", lambda folder: 0)
        plug.plug(device())
        assert idle.acquire(timeout=WAIT_S)
        assert node.capture.request_sweep() and node.capture.status == CaptureStatus("starting")
        look_up.release()
        assert idle.acquire(timeout=WAIT_S)
        node.wait_until("ready", "the disk is full")
        assert node.capture.request_sweep() and node.capture.status == CaptureStatus("starting")
        assert not node.capture.request_sweep()
    look_up.release()
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_an_idle_scanner_that_is_unplugged_is_noticed_and_found_again(plug: Plug, node: Node) -> None:
    plug.plug(device())
    node.wait_until("ready")
    plug.pull()
    node.wait_until("connecting", "tty")
    plug.plug(device(boot_id=2))
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_a_scanner_that_is_plugged_in_is_met_at_once_however_long_it_was_away(
    plug: Plug, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugged = threading.Event()

    class Told(Arrivals):
        def wait(self, timeout_s: float, stop: threading.Event) -> bool:
            return plugged.wait(timeout_s)

    monkeypatch.setattr(capture, "Arrivals", Told)
    monkeypatch.setattr(capture, "BACKOFF_S", (60.0, 60.0))
    node = Node(tmp_path / "tty", tmp_path / "sweeps")
    node.capture.start()
    node.wait_until("connecting", "tty")
    plug.plug(device())
    plugged.set()
    node.wait_until("ready")
    node.capture.stop()


def test_a_sweep_is_asked_for_as_the_node_is_set(plug: Plug, tmp_path: Path) -> None:
    made: queue.Queue[Assembly] = queue.Queue()
    plug.plug(device())
    request = SweepRequest(passes=2, overlap=64)
    swept = Capture(lambda: SerialPort(str(tmp_path / "tty")), ScannerConfig(), made.put, request=request)
    swept.start()
    while not swept.request_sweep():
        time.sleep(0.01)
    assembly = made.get(timeout=WAIT_S)
    swept.stop()
    assert is_truth(assembly.grid) and assembly.quality.passes == 2 and assembly.quality.noise_mm == 0.0


def test_a_sweep_with_an_overlap_goes_on_with_a_scanner_that_was_restarted(plug: Plug, node: Node) -> None:
    node.capture._sweep_request = SweepRequest(overlap=64)
    sweep_id = cut(plug, node, device(boot_id=2))
    assert node.sweeps.get(sweep_id).header.overlap == 64
    assert node.capture.request_resume(sweep_id)
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_a_scanner_that_is_away_is_not_asked_to_sweep_and_does_not_when_it_comes_back(plug: Plug, node: Node) -> None:
    node.wait_until("connecting", "tty")
    assert not node.capture.request_sweep()
    assert node.capture.status.refusal.startswith("the scanner is not connected: ")
    plug.plug(device())
    node.wait_until("ready")
    assert not node.capture.status.refusal


def test_a_sweep_asked_for_of_a_scanner_that_goes_away_is_forgotten(
    plug: Plug, node: Node, monkeypatch: pytest.MonkeyPatch
) -> None:
    idle, look_up = threading.Event(), threading.Event()

    def watch(scanner: Scanner, listen_s: float) -> None:
        idle.set()
        look_up.wait(WAIT_S)
        raise PortLost("tty: unplugged")

    plug.plug(device())
    with monkeypatch.context() as patch:
        patch.setattr(Scanner, "watch", watch)
        assert idle.wait(WAIT_S)
        assert node.capture.request_sweep()
        look_up.set()
        node.wait_until("connecting", "unplugged")
    node.wait_until("ready")  # not "starting"
    assert node.events.empty()


def test_the_journal_has_the_columns_while_the_sweep_runs(plug: Plug, node: Node, tmp_path: Path) -> None:
    plug.plug(device(turn_s=2.0))
    node.sweep_until_columns(0.3)
    node.wait_for(SweepProgress)
    (path,) = (tmp_path / "sweeps").iterdir()
    assert node.sweeps.interrupted() == []
    copy = tmp_path / "copy" / path.name
    copy.parent.mkdir()
    copy.write_bytes(path.read_bytes())
    (sweep,) = Journals(copy.parent).interrupted()
    assert sweep.held >= 0.2 * sweep.expected


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


def cut(plug: Plug, node: Node, scanner: SimulatedScanner) -> str:
    """A sweep that was interrupted by a pulled plug, and another scanner in its place."""
    plug.plug(device(turn_s=1.0))
    node.sweep_until_columns()
    plug.pull()
    node.wait_for(SweepInterrupted)
    plug.plug(scanner)
    node.wait_until("ready")
    (sweep,) = node.sweeps.interrupted()
    return sweep.id


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


class _Nonsense(SimulatedScanner):
    """A scanner whose header promises an encoder too coarse for its own columns."""

    def _announce(self) -> None:
        if self._sweep is not None:
            self._sweep.header = replace(self._sweep.header, counts_per_turn=8)
        super()._announce()


def test_a_header_that_makes_no_sense_is_told_and_survived(plug: Plug, node: Node) -> None:
    plug.plug(_Nonsense(Turntable(Specimen("noise", TRUTH), turn_s=0.2)))
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert "makes no sense: 8 encoder counts" in node.wait_for(SweepInterrupted).reason
    assert node.sweeps.interrupted() == []
    plug.pull()
    plug.plug(device())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))


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


def test_a_full_disk_refuses_a_sweep_before_it_starts(
    plug: Plug, node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plug.plug(device())
    node.wait_until("ready")
    for free_bytes, words in ((1 << 20, "a sweep needs"), (16 << 20, "this sweep needs")):
        with monkeypatch.context() as patch:
            patch.setattr(durable, "free_bytes", lambda folder, free_bytes=free_bytes: free_bytes)
            assert node.capture.request_sweep()
            node.wait_until("ready", f"{words} ")
        assert f"and {free_bytes} are free" in node.capture.status.why
        assert list((tmp_path / "sweeps").iterdir()) == []
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_complete_sweeps_of_a_crashed_node_are_published(plug: Plug, node: Node, tmp_path: Path) -> None:
    def crash(grid: Grid) -> None:
        raise LibraryError("as good as a crash")

    node.deliver = crash
    plug.plug(device())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    node.wait_for(SweepInterrupted)
    node.capture.stop()
    sweeps, made = Journals(tmp_path / "sweeps"), list[Assembly]()
    (said,) = publish_complete(sweeps, made.append)
    assert said.startswith("published sweep") and is_truth(made[0].grid)
    assert made[0].quality.coverage == coverage_of(TRUTH.range_steps)
    assert sweeps.interrupted() == [] and publish_complete(sweeps, made.append) == []
