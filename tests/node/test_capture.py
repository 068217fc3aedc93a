"""The capture thread against a simulated scanner on a pty: plugs are pulled, scanners restarted, disks filled."""

import queue
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drivers.discover import Arrivals
from drivers.scanner import Scanner, ScannerConfig, SweepInterrupted, SweepProgress
from drivers.serial_port import SerialPort
from node import capture, durable
from node.assemble import Assembly
from node.capture import Capture, CaptureStatus, Manner
from node.journal import Journals
from node.repair import repair
from node.scan_quality import coverage_of
from protocol.errors import PortLost
from protocol.grid import Grid
from protocol.scanner_messages import SweepRequest
from simulators.faults import FaultyScanner, parse_faults
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable
from tests.node.capturing import TRUTH, WAIT_S, Node, Plug, device, is_truth
from tests.node.round_bodies import KNOWN


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


def test_grids_are_corrected_for_the_axis_of_their_scanner_as_it_is_set(plug: Plug, node: Node) -> None:
    axis = KNOWN.estimate.axis
    node.axes.keep(replace(KNOWN, settings=1))
    plug.plug(device(calibration=1))
    node.wait_until("ready")
    assert node.capture.request_sweep()
    grid = node.grids.get(timeout=WAIT_S)
    wanted = repair(Grid(TRUTH.spec, TRUTH.range_steps.copy(), TRUTH.texture.copy()), 0.0, axis).grid
    assert np.array_equal(grid.range_steps, wanted.range_steps) and np.array_equal(grid.texture, wanted.texture)
    assert np.array_equal(grid.repairs, wanted.repairs) and not is_truth(grid)
    node.wait_until("ready")
    plug.pull()
    node.wait_until("connecting")
    plug.plug(device(calibration=2))
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    first, later = node.qualities
    assert first.axis == axis and not first.axis_trouble
    assert later.axis is None and "its settings changed since: calibrate again" in later.complaints[0]


def test_who_hears_of_a_scan_may_ask_for_the_next_one_at_once(plug: Plug, node: Node) -> None:
    asked: queue.Queue[tuple[int, int]] = queue.Queue()
    keep = node.deliver
    grids: list[Grid] = []

    def ask_again(grid: Grid) -> None:
        keep(grid)
        grids.append(grid)
        if len(grids) == 1:
            asked.put((node.capture.request_sweep(), node.capture.request_sweep()))

    node.deliver = ask_again
    plug.plug(device())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert asked.get(timeout=WAIT_S) == (2, 0)  # the second one, and no third
    for _ in range(2):
        assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    assert node.capture.status.sweeps == 2


def test_a_scan_comes_with_its_quality_and_what_was_measured_where_it_was_repaired(plug: Plug, node: Node) -> None:
    bad_line = parse_faults("loss=0.05", 3)[0]
    plug.plug(FaultyScanner(lambda boot_id: device(boot_id=boot_id), bad_line, 3))
    node.wait_until("ready")
    assert node.capture.request_sweep()
    grid = node.grids.get(timeout=WAIT_S)
    assert is_truth(grid) and grid.repairs.size
    node.wait_until("ready")
    (quality,) = node.qualities
    assert quality.spikes == np.count_nonzero(grid.repairs[:, 2]) and quality.filled == grid.filled.sum()
    assert quality.coverage == pytest.approx(coverage_of(TRUTH.range_steps) - quality.spikes / TRUTH.range_steps.size)
    assert quality.requested_columns > 0 and quality.dropped_bytes > 0


def test_a_node_that_is_to_repair_nothing_keeps_every_sample(plug: Plug, tmp_path: Path) -> None:
    made: queue.Queue[Assembly] = queue.Queue()
    plug.plug(device())
    swept = Capture(lambda: SerialPort(str(tmp_path / "tty")), ScannerConfig(), made.put, manner=Manner(repairs=False))
    swept.start()
    while not swept.request_sweep():
        time.sleep(0.01)
    assembly = made.get(timeout=WAIT_S)
    swept.stop()
    assert np.array_equal(assembly.grid.range_steps, TRUTH.range_steps) and not assembly.grid.repairs.size
    assert (assembly.quality.spikes, assembly.quality.filled) == (0, 0)


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
    swept = Capture(lambda: SerialPort(str(tmp_path / "tty")), ScannerConfig(), made.put, manner=Manner(request))
    swept.start()
    while not swept.request_sweep():
        time.sleep(0.01)
    assembly = made.get(timeout=WAIT_S)
    swept.stop()
    assert is_truth(assembly.grid) and assembly.quality.passes == 2 and assembly.quality.noise_mm == 0.0


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
