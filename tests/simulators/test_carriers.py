import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.scanner import Scanner, SweepFinished
from drivers.serial_port import SerialPort
from protocol.errors import PortLost
from protocol.grid import Grid, GridSpec
from protocol.scanner_messages import RangeColumn, SweepRequest, TextureColumn
from simulators.carriers import MemoryPort, PtyPort, serve
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable

W, H, WT, HT = 32, 200, 64, 100


def scanner(turn_s: float = 0.05) -> SimulatedScanner:
    rng = np.random.default_rng(5)
    steps, texture = rng.integers(0, 60000, (H, W)), rng.integers(0, 256, (HT, WT, 3))
    grid = Grid(GridSpec(W, H, WT, HT, 0.01, 1.0), steps.astype(np.uint16), texture.astype(np.uint8))
    return SimulatedScanner(Turntable(Specimen("noise", grid), turn_s=turn_s))


def assert_sweeps_the_truth(driver: Scanner, device: SimulatedScanner) -> None:
    truth = device._table.specimen.grid
    range_steps, texture = np.zeros_like(truth.range_steps), np.zeros_like(truth.texture)
    for event in driver.sweep(SweepRequest()):
        if isinstance(event, RangeColumn):
            range_steps[event.row0 : event.row0 + event.rows, event.column] = event.samples
        elif isinstance(event, TextureColumn):
            texture[event.row0 : event.row0 + event.rows, event.column] = event.samples
    assert isinstance(event, SweepFinished), event
    np.testing.assert_array_equal(range_steps, truth.range_steps)
    np.testing.assert_array_equal(texture, truth.texture)


class Served:
    """A scanner served on a pty by a thread."""

    def __init__(self, path: Path, baud: int = 20_000_000) -> None:
        self.device, self.port, self.stop = scanner(), PtyPort(path, baud), threading.Event()
        self.thread = threading.Thread(target=serve, args=(self.device, self.port, self.stop))
        self.thread.start()

    def end(self) -> None:
        self.stop.set()
        self.port.cancel()
        self.thread.join(10)
        assert not self.thread.is_alive()
        self.port.close()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    here = Served(tmp_path / "scanner")
    yield here
    if here.thread.is_alive():
        here.end()


def test_a_sweep_through_memory_takes_the_time_the_rate_allows() -> None:
    device = scanner()
    port = MemoryPort(device, rate_bytes_s=50_000)
    driver = Scanner(port, clock=port.clock)
    driver.hello()
    assert_sweeps_the_truth(driver, device)
    assert port.clock() == pytest.approx((W * H * 2 + WT * HT * 3) / 50_000, rel=0.35)


def test_memory_time_passes_only_while_somebody_reads() -> None:
    port = MemoryPort(scanner())
    port.write(b"noise")
    assert port.clock() == 0.0
    assert port.read(100, 2.5) == b""
    assert port.clock() == pytest.approx(2.5)
    port.cancel()
    assert port.read(100, 2.5) == b""
    assert port.clock() == pytest.approx(2.5)


def test_memory_reads_are_bounded_and_an_unplugged_port_is_lost() -> None:
    device = scanner()
    port = MemoryPort(device)
    driver = Scanner(port, clock=port.clock)
    driver.hello()
    port._arrived = b"0123456789"
    assert port.read(4, 1.0) + port.read(100, 1.0) == b"0123456789"
    port.unplug()
    with pytest.raises(PortLost):
        port.read(1, 0.0)
    with pytest.raises(PortLost):
        port.write(b"x")


def test_sweeps_through_a_pty_bring_the_truth(served: Served) -> None:
    driver = Scanner(SerialPort(served.port.name))
    assert driver.hello() == served.device.info
    for _ in range(2):
        assert_sweeps_the_truth(driver, served.device)
    driver.close()


def test_a_pty_can_be_closed_and_opened_again_mid_sweep(served: Served) -> None:
    first = Scanner(SerialPort(served.port.name))
    first.hello()
    events = first.sweep(SweepRequest())
    while not isinstance(next(events), TextureColumn):
        pass
    first.close()
    again = Scanner(SerialPort(served.port.name))
    again.hello()
    assert_sweeps_the_truth(again, served.device)
    again.close()


def test_a_pty_is_no_faster_than_its_baud_rate(tmp_path: Path) -> None:
    port, data = PtyPort(tmp_path / "line", baud=1_000_000), bytes(20_000)
    reader = SerialPort(port.name)
    received: list[bytes] = []
    thread = threading.Thread(target=lambda: received.extend(iter(lambda: reader.read(65536, 1.0), b"")))
    thread.start()
    began_s = time.monotonic()
    for start in range(0, len(data), 2000):
        port.write(data[start : start + 2000])
    took_s = time.monotonic() - began_s
    thread.join(10)
    assert b"".join(received) == data
    assert took_s >= 0.9 * len(data) / 100_000  # ten bits a byte, less one catch-up
    reader.close()
    port.close()


def test_hanging_up_loses_the_nodes_port_and_takes_the_link_away(served: Served) -> None:
    node_end = SerialPort(served.port.name)
    served.end()
    assert not os.path.lexists(served.port.name)
    with pytest.raises(PortLost):
        while True:
            node_end.read(100, 60.0)
    node_end.close()


def test_serving_ends_though_nobody_reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    here = Served(tmp_path / "scanner")
    monkeypatch.setattr(here.device, "data_to_send", bytes)  # a scanner that chatters at a deaf node
    here.end()


def test_a_link_that_cannot_be_made_is_named_itself(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError) as refused:
        PtyPort(tmp_path / "nowhere" / "scanner")
    assert refused.value.filename == str(tmp_path / "nowhere" / "scanner")


def test_a_link_left_behind_is_replaced_and_anything_else_is_not(tmp_path: Path) -> None:
    stale, file = tmp_path / "stale", tmp_path / "file"
    stale.symlink_to(tmp_path / "gone")
    port = PtyPort(stale)
    assert os.readlink(stale).startswith("/dev/")
    newer = PtyPort(stale)
    port.close()
    assert os.path.lexists(stale)  # it is the newer one's by now
    newer.close()
    assert not os.path.lexists(stale)
    file.write_text("mine")
    with pytest.raises(FileExistsError):
        PtyPort(file)
    assert file.read_text() == "mine"
