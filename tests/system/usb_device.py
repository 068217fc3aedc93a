"""What libusb does with a device, as pytest; run by test_usb.py under umockdev's preload, nightly on a real kernel."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import usb.core

from drivers.usb_backend import PENDING
from drivers.usb_port import READ_BYTES, UsbAddress, UsbPort
from protocol.errors import PortLost
from simulators.pace import CATCH_UP_S
from simulators.usb_descriptors import PACKET_BYTES, UsbIdentity
from simulators.usb_gadget import UsbGadget
from simulators.usb_testbed import UsbTestbed
from tests.permissions import bound_by_permissions
from tests.system.usb_bed import usb_bed

Bed = UsbTestbed | UsbGadget
SOON_S = 30.0
ADDRESS = UsbAddress.parse(UsbIdentity().address)


@pytest.fixture
def bed() -> Iterator[Bed]:
    made = usb_bed()
    yield made
    made.close()


@pytest.fixture
def port(bed: Bed) -> Iterator[UsbPort]:
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


def test_bytes_come_and_go(bed: Bed, port: UsbPort) -> None:
    port.write(b"ping")
    assert bed.read(100, 5) == b"ping"
    bed.write(b"pong")
    assert port.read(100, 5) == b"pong"


@pytest.mark.parametrize("size", [1, PACKET_BYTES - 1, PACKET_BYTES, 4 * PACKET_BYTES, READ_BYTES, READ_BYTES + 1])
def test_short_packets_and_packets_of_length_zero_end_a_read(bed: Bed, port: UsbPort, size: int) -> None:
    data = os.urandom(size)
    bed.write(data)
    assert read_all(port, size) == data


def test_a_flood_arrives_whole_and_in_order(bed: Bed, port: UsbPort) -> None:
    data = os.urandom(1 << 20)

    def flood() -> None:
        for _ in range(16):
            bed.write(data)

    thread = threading.Thread(target=flood)
    thread.start()
    assert read_all(port, 16 << 20) == 16 * data
    thread.join(10)


def test_a_stalled_endpoint_is_cleared_and_goes_on(bed: Bed, port: UsbPort) -> None:
    bed.stalls = 1
    for word in (b"1", b"2"):  # on a kernel the transfer that is pending goes on, and the next finds a halt
        port.write(word)
        assert bed.read(10, 5) == word
    assert bed.stalls == 0
    bed.stalls = 1
    for word in (b"3", b"4"):
        bed.write(word)
        assert read_all(port, 1) == word
    assert bed.stalls == 0


def test_what_comes_before_a_halt_is_not_lost_and_what_comes_after_follows_it(bed: Bed, port: UsbPort) -> None:
    words = [os.urandom(1 + 700 * size) for size in range(12)]
    assert port.read(1, 0) == b""  # reads are pending now, and nobody takes what they bring
    for number, word in enumerate(words):
        bed.stalls += number in (3, 4, 9)
        bed.write(word)
    assert read_all(port, sum(map(len, words))) == b"".join(words)
    assert bed.stalls == 0


def test_many_small_transfers_are_taken_at_once(bed: Bed, port: UsbPort) -> None:
    words = [os.urandom(100) for _ in range(PENDING)]
    assert port.read(1, 0) == b""
    for word in words:
        bed.write(word)
    got, reads = b"", 0
    while len(got) < 100 * PENDING:
        got, reads = got + port.read(1 << 20, 5), reads + 1
    assert got == b"".join(words)
    assert reads < PENDING or isinstance(bed, UsbGadget)  # whose controller sends when it comes round


def test_what_nobody_reads_has_to_wait_and_is_not_lost(bed: Bed, port: UsbPort) -> None:
    data, sent = os.urandom(READ_BYTES - 1), threading.Semaphore(0)  # a whole one and its end would be two reads

    def flood() -> None:
        for _ in range(3 * PENDING):
            bed.write(data)
            sent.release()

    assert port.read(1, 0) == b""
    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    for _ in range(PENDING):  # so many find a place
        assert sent.acquire(timeout=SOON_S)
    for _ in range(3 * PENDING):
        assert read_all(port, len(data)) == data
    thread.join(SOON_S)
    assert not thread.is_alive()


def test_a_port_is_closed_while_reads_are_pending_and_opened_again(bed: Bed) -> None:
    for word in (b"1", b"2"):
        with closing(UsbPort(ADDRESS)) as port:
            assert port.read(1, 0) == b""
            bed.write(word)
            assert read_all(port, 1) == word


def test_cancel_ends_a_pending_read(bed: Bed, port: UsbPort) -> None:
    threading.Timer(0.1, port.cancel).start()
    began_s = time.monotonic()
    assert port.read(100, 30) == b""
    assert time.monotonic() - began_s < 10
    port.cancel()
    assert port.read(100, 30) == b""
    bed.write(b"and then")
    assert read_all(port, 8) == b"and then"


def test_a_paced_device_is_no_faster_than_its_rate() -> None:
    rate_bytes_s, data = 1e6, os.urandom(30_000)
    with closing(usb_bed(rate_bytes_s=rate_bytes_s)) as bed, closing(UsbPort(ADDRESS)) as port:
        began_s = time.monotonic()
        for _ in range(10):
            bed.write(data)
            assert read_all(port, len(data)) == data
        took_s = time.monotonic() - began_s
    assert took_s > 10 * len(data) / rate_bytes_s - CATCH_UP_S


def test_without_permission_the_udev_rule_is_named(bed: Bed) -> None:
    device = usb.core.find(idVendor=ADDRESS.vendor, idProduct=ADDRESS.product)
    node = Path(f"{os.environ.get('UMOCKDEV_DIR', '')}/dev/bus/usb/{device.bus:03d}/{device.address:03d}")
    node.chmod(0)
    with bound_by_permissions(), pytest.raises(PortLost, match=f'no permission.*=="{ADDRESS.vendor:04x}".*rules.d'):
        UsbPort(ADDRESS)
    node.chmod(0o600)
    UsbPort(ADDRESS).close()


def test_unplugging_ends_a_pending_read_at_once(bed: Bed, port: UsbPort) -> None:
    began_s = time.monotonic()
    threading.Timer(0.1, bed.hang_up).start()
    with pytest.raises(PortLost):
        port.read(100, 30)
    assert time.monotonic() - began_s < 5
    with pytest.raises(PortLost):
        port.write(b"x")


def test_a_device_plugged_in_again_opens_again(bed: Bed, port: UsbPort) -> None:
    for _ in range(3):
        bed.hang_up()
        with pytest.raises(PortLost):
            port.read(100, 5)
        port.close()
        until_forgotten()
        bed.plug_in()
        port = open_soon(SOON_S)
        bed.write(b"here again")
        assert read_all(port, 10) == b"here again"
    port.close()


def until_forgotten() -> None:
    """As soon as udev has told libusb that it is gone; before that it cannot be opened either."""
    until_s = time.monotonic() + SOON_S
    while True:
        with pytest.raises(PortLost) as refused:
            UsbPort(ADDRESS)
        if "no such device is connected" in str(refused.value):
            return
        assert time.monotonic() < until_s, refused.value
        time.sleep(0.02)


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


def test_a_device_opened_twice_is_refused_the_second_time(bed: Bed, port: UsbPort) -> None:
    with pytest.raises(PortLost, match="another program uses it"):
        UsbPort(ADDRESS)


def test_the_serial_number_chooses(bed: Bed) -> None:
    UsbPort(UsbAddress(ADDRESS.vendor, ADDRESS.product, "SIM-0001")).close()
    with pytest.raises(PortLost, match="other serial numbers"):
        UsbPort(UsbAddress(ADDRESS.vendor, ADDRESS.product, "SIM-0002"))
