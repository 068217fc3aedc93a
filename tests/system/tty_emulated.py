"""Serial ports that come and go, as pytest; run by test_usb.py in a process under umockdev's preload."""

from __future__ import annotations

import os
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from drivers.discover import Arrivals, find_ports, open_port
from protocol.errors import PortLost
from simulators.tty_testbed import TtyTestbed
from simulators.usb_testbed import UsbTestbed

ADDRESS = "serial:1209:5ca2:SIM-0001"
ROOT = Path(os.environ.get("UMOCKDEV_DIR", "/nowhere"))


@pytest.fixture
def bed() -> Iterator[TtyTestbed]:
    with closing(TtyTestbed(ROOT)) as made:
        yield made


class Plugged:
    """A pseudo terminal that is plugged in as /dev/ttyACM<number>."""

    def __init__(self, bed: TtyTestbed, number: int = 0) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self._bed, self._number = bed, number
        bed.plug_in(os.ttyname(self.slave), number)

    def pull(self) -> None:
        self._bed.unplug(self._number)
        os.close(self.slave)
        os.close(self.master)


def test_a_serial_port_is_found_by_its_ids_and_named_by_id(bed: TtyTestbed) -> None:
    assert find_ports() == []
    plugged = Plugged(bed)
    (found,) = find_ports()
    assert (found.vendor, found.product, found.serial_number) == (0x1209, 0x5CA2, "SIM-0001")
    assert found.address == "/dev/serial/by-id/usb-foveascan_SIM-0001-if00"
    plugged.pull()
    assert find_ports() == []


def test_a_scanner_is_found_again_under_another_name(bed: TtyTestbed) -> None:
    for number in (0, 3):
        plugged = Plugged(bed, number)
        with closing(open_port(ADDRESS)) as port:
            os.write(plugged.master, b"here")
            assert port.read(100, 5) == b"here"
            plugged.pull()
            with pytest.raises(PortLost):
                port.read(100, 5)
        with pytest.raises(PortLost, match="no such serial port is connected$"):
            open_port(ADDRESS)


def test_another_serial_number_is_another_scanner(bed: TtyTestbed) -> None:
    plugged = Plugged(bed)
    with pytest.raises(PortLost, match="1 of this kind with other serial numbers"):
        open_port("serial:1209:5ca2:SIM-0002")
    plugged.pull()


def test_plugging_in_and_out_is_noticed_soon(bed: TtyTestbed) -> None:
    stop, ports = threading.Event(), []
    with closing(Arrivals()) as arrivals:
        assert not arrivals.wait(0.3, stop)
        timer = threading.Timer(0.2, lambda: ports.append(Plugged(bed)))
        timer.start()
        assert arrivals.wait(10, stop)
        timer.join()
        ports[0].pull()
        assert arrivals.wait(10, stop)


def test_bare_usb_devices_are_found_too() -> None:
    with closing(UsbTestbed(ROOT)) as bed:
        until_s = time.monotonic() + 5
        while not (found := find_ports()) and time.monotonic() < until_s:
            time.sleep(0.02)
        assert [port.address for port in found] == ["usb:1209:5ca1:SIM-0001"] and found[0].is_known
        assert bed.identity.address == "usb:1209:5ca1"
