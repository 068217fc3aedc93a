import os
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers import serial_port
from drivers.serial_port import SerialPort
from protocol.errors import PortLost


class Line:
    def __init__(self, far: int, port: SerialPort) -> None:
        self.far, self.port = far, port

    def hang_up(self) -> None:
        far, self.far = self.far, -1
        if far >= 0:
            os.close(far)


@pytest.fixture
def line() -> Iterator[Line]:
    """A pty, whose far end is `far`, opened as a serial port."""
    far, near = os.openpty()
    tty.setraw(near)
    port = SerialPort(os.ttyname(near))
    os.close(near)
    ends = Line(far, port)
    yield ends
    ends.hang_up()
    port.close()


def read_all(port: SerialPort, size_bytes: int) -> bytes:
    data = b""
    while len(data) < size_bytes:
        data += port.read(65536, 5.0)
    return data


def test_bytes_pass_unchanged_both_ways(line: Line) -> None:
    every_byte = bytes(range(256)) * 8
    os.write(line.far, every_byte)
    assert read_all(line.port, len(every_byte)) == every_byte
    line.port.write(every_byte)
    received = b""
    while len(received) < len(every_byte):
        received += os.read(line.far, 4096)
    assert received == every_byte


def test_a_read_takes_no_more_than_asked_for(line: Line) -> None:
    os.write(line.far, b"0123456789")
    assert line.port.read(4, 5.0) == b"0123"
    assert read_all(line.port, 6) == b"456789"


def test_a_quiet_line_is_an_empty_read_after_the_time_asked_for(line: Line) -> None:
    began_s = time.monotonic()
    assert line.port.read(100, 0.05) == b""
    assert time.monotonic() - began_s >= 0.05


def test_cancel_ends_a_waiting_read_and_the_port_goes_on(line: Line) -> None:
    threading.Timer(0.05, line.port.cancel).start()
    assert line.port.read(100, 60.0) == b""
    os.write(line.far, b"on")
    assert read_all(line.port, 2) == b"on"


def test_an_unplugged_line_is_lost_and_stays_lost(line: Line) -> None:
    line.hang_up()
    for _ in range(3):
        with pytest.raises(PortLost, match=line.port.name):
            line.port.read(100, 60.0)
    with pytest.raises(PortLost):
        line.port.write(b"x")


def test_a_write_to_an_unplugged_line_is_lost(line: Line) -> None:
    line.hang_up()
    with pytest.raises(PortLost):
        line.port.write(b"x")


def test_a_line_unplugged_while_reading_is_lost(line: Line) -> None:
    threading.Timer(0.05, line.hang_up).start()
    with pytest.raises(PortLost):
        line.port.read(100, 60.0)


def test_a_vanished_terminal_that_reads_as_empty_for_ever_is_lost(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    os.write(line.far, b"x")  # ready
    monkeypatch.setattr(os, "read", lambda *_: b"")
    with pytest.raises(PortLost):
        line.port.read(100, 60.0)


def test_a_line_that_takes_nothing_is_lost(line: Line, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_port, "_WRITE_TIMEOUT_S", 0.05)
    with pytest.raises(PortLost, match="write"):
        line.port.write(bytes(1_000_000))


def test_a_port_opened_twice_is_refused(line: Line) -> None:
    with pytest.raises(PortLost, match="cannot open: another program has it open; end that"):
        SerialPort(line.port.name)


def test_what_cannot_be_opened_says_which_path(tmp_path: Path) -> None:
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(PortLost, match=str(path)):
            SerialPort(str(path))
    with pytest.raises(PortLost, match="cannot open: no such file; plug the scanner in, or correct the path$"):
        SerialPort(str(tmp_path / "missing"))


def test_closing_twice_and_using_a_closed_port(line: Line) -> None:
    line.port.close()
    line.port.close()
    line.port.cancel()
    with pytest.raises(PortLost, match="closed"):
        line.port.read(1, 0.0)


def test_closing_an_unplugged_port_is_harmless(line: Line) -> None:
    line.hang_up()
    line.port.close()


@pytest.mark.usefixtures("many_open_files")
def test_a_line_opened_late_by_a_node_with_many_clients_works() -> None:
    far, near = os.openpty()
    tty.setraw(near)
    port = SerialPort(os.ttyname(near))
    ends = Line(far, port)
    try:
        os.write(far, b"ping")
        assert read_all(port, 4) == b"ping"
        port.write(b"pong")
        assert os.read(far, 10) == b"pong"
    finally:
        os.close(near)
        ends.hang_up()
        port.close()
