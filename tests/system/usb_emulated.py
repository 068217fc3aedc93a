"""What libusb does with an emulated device, as pytest; run by test_usb.py in a process under umockdev's preload."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.usb_port import READ_BYTES, UsbAddress, UsbPort
from protocol.errors import PortLost
from simulators.usb_descriptors import PACKET_BYTES, UsbIdentity
from simulators.usb_testbed import UsbTestbed

ADDRESS = UsbAddress.parse(UsbIdentity().address)


@pytest.fixture
def bed() -> Iterator[UsbTestbed]:
    made = UsbTestbed(Path(os.environ["UMOCKDEV_DIR"]))
    yield made
    made.close()


@pytest.fixture
def port(bed: UsbTestbed) -> Iterator[UsbPort]:
    opened = UsbPort(ADDRESS)
    yield opened
    opened.close()


def read_all(port: UsbPort, size: int) -> bytes:
    got = b""
    while len(got) < size:
        part = port.read(1 << 20, 5)
        assert part, f"{len(got)} of {size} bytes"
        got += part
    return got


def test_bytes_come_and_go(bed: UsbTestbed, port: UsbPort) -> None:
    port.write(b"ping")
    assert bed.read(100, 5) == b"ping"
    bed.write(b"pong")
    assert port.read(100, 5) == b"pong"


@pytest.mark.parametrize("size", [1, PACKET_BYTES - 1, PACKET_BYTES, 4 * PACKET_BYTES, READ_BYTES, READ_BYTES + 1])
def test_short_packets_and_packets_of_length_zero_end_a_read(bed: UsbTestbed, port: UsbPort, size: int) -> None:
    data = os.urandom(size)
    bed.write(data)
    assert read_all(port, size) == data


def test_a_flood_arrives_whole_and_in_order(bed: UsbTestbed, port: UsbPort) -> None:
    data = os.urandom(1 << 20)

    def flood() -> None:
        for _ in range(16):
            bed.write(data)

    thread = threading.Thread(target=flood)
    thread.start()
    assert read_all(port, 16 << 20) == 16 * data
    thread.join(10)


def test_a_stalled_endpoint_is_cleared_and_goes_on(bed: UsbTestbed, port: UsbPort) -> None:
    bed.stalls = 1
    port.write(b"x")
    assert bed.read(10, 5) == b"x"
    bed.stalls = 1
    bed.write(b"after the stall")
    assert read_all(port, 15) == b"after the stall"


def test_unplugging_ends_a_pending_read_at_once(bed: UsbTestbed, port: UsbPort) -> None:
    began_s = time.monotonic()
    threading.Timer(0.1, bed.hang_up).start()
    with pytest.raises(PortLost):
        port.read(100, 30)
    assert time.monotonic() - began_s < 5
    with pytest.raises(PortLost):
        port.write(b"x")


def test_a_device_plugged_in_again_opens_again(bed: UsbTestbed, port: UsbPort) -> None:
    for _ in range(3):
        bed.hang_up()
        with pytest.raises(PortLost):
            port.read(100, 5)
        port.close()
        with pytest.raises(PortLost, match="no such device"):
            open_soon(0.3)
        bed.plug_in()
        port = open_soon(5)
        bed.write(b"here again")
        assert read_all(port, 10) == b"here again"
    port.close()


def open_soon(within_s: float) -> UsbPort:
    """Open as soon as udev has told libusb."""
    until_s = time.monotonic() + within_s
    while True:
        try:
            return UsbPort(ADDRESS)
        except PortLost:
            if time.monotonic() > until_s:
                raise
            time.sleep(0.02)


def test_a_device_opened_twice_is_refused_the_second_time(bed: UsbTestbed, port: UsbPort) -> None:
    with pytest.raises(PortLost, match="another program uses it"):
        UsbPort(ADDRESS)


def test_the_serial_number_chooses(bed: UsbTestbed) -> None:
    UsbPort(UsbAddress(ADDRESS.vendor, ADDRESS.product, "SIM-0001")).close()
    with pytest.raises(PortLost, match="other serial numbers"):
        UsbPort(UsbAddress(ADDRESS.vendor, ADDRESS.product, "SIM-0002"))
