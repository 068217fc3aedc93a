"""The USB port on a double of pyusb's backend: what each thing that libusb says becomes."""

import threading
from collections.abc import Iterator
from contextlib import closing

import pytest

from drivers.usb_port import READ_BYTES, UsbAddress, UsbPort
from protocol.errors import PortLost
from simulators.usb_descriptors import UsbIdentity
from simulators.usb_double import UsbDouble

ADDRESS = UsbAddress(0x1209, 0x5CA1)


@pytest.fixture
def double() -> UsbDouble:
    return UsbDouble()


@pytest.fixture
def port(double: UsbDouble) -> Iterator[UsbPort]:
    opened = UsbPort(ADDRESS, double)
    yield opened
    opened.close()


@pytest.mark.parametrize("text", ["usb:1209:5ca1", "usb:1209:5ca1:SN 1:2"])
def test_an_address_reads_as_it_is_written(text: str) -> None:
    assert str(UsbAddress.parse(text)) == text


@pytest.mark.parametrize("text", ["usb:", "usb:1209", "usb:12345:1", "usb:x:y", "/dev/ttyACM0", "usb:1:2:"])
def test_what_is_no_address_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not usb:"):
        UsbAddress.parse(text)


def test_bytes_come_and_go(double: UsbDouble, port: UsbPort) -> None:
    port.write(b"ping")
    assert double.read(100, 5) == b"ping"
    double.write(b"pong")
    assert port.read(65536, 5) == b"pong"
    assert port.read(65536, 0.01) == b""


def test_a_read_takes_no_more_than_asked_and_loses_nothing(double: UsbDouble, port: UsbPort) -> None:
    data = bytes(range(256)) * 4096
    double.write(data)
    got = b""
    while len(got) < len(data):
        part = port.read(1000, 5)
        assert 0 < len(part) <= 1000
        got += part
    assert got == data


def test_a_device_that_nobody_reads_has_to_wait(double: UsbDouble, port: UsbPort) -> None:
    written = 0

    def flood() -> None:
        nonlocal written
        for _ in range(200):
            double.write(bytes(READ_BYTES // 4))
            written += 1

    thread = threading.Thread(target=flood)
    thread.start()
    thread.join(0.5)
    assert thread.is_alive()
    total = 0
    while total < 200 * (READ_BYTES // 4):
        total += len(port.read(1 << 20, 5))
    thread.join(5)
    assert not thread.is_alive() and written == 200


def test_a_stalled_endpoint_is_cleared_and_goes_on(double: UsbDouble, port: UsbPort) -> None:
    double.stalls = 2
    double.write(b"after the stall")
    assert port.read(100, 5) == b"after the stall"
    double.stalls = 2
    port.write(b"and back")
    assert double.read(100, 5) == b"and back"


def test_an_endpoint_that_stays_stalled_is_lost(double: UsbDouble, port: UsbPort) -> None:
    double.stalls = 1000
    with pytest.raises(PortLost, match="Pipe error"):
        port.read(100, 5)


def test_unplugging_ends_a_pending_read_and_everything_after_it(double: UsbDouble, port: UsbPort) -> None:
    timer = threading.Timer(0.05, double.hang_up)
    timer.start()
    with pytest.raises(PortLost, match="disconnected"):
        port.read(100, 20)
    for use in (lambda: port.read(100, 5), lambda: port.write(b"x")):
        with pytest.raises(PortLost):
            use()
    port.close()
    with pytest.raises(PortLost, match="no such device is connected"):
        UsbPort(ADDRESS, double)
    double.plug_in()
    UsbPort(ADDRESS, double).close()


def test_cancel_ends_a_pending_read(port: UsbPort) -> None:
    timer = threading.Timer(0.05, port.cancel)
    timer.start()
    assert port.read(100, 60) == b""


def test_close_ends_every_use_and_may_be_repeated(port: UsbPort) -> None:
    for _ in range(2):
        port.close()
        with pytest.raises(PortLost, match="closed"):
            port.read(100, 60)
        with pytest.raises(PortLost, match="closed"):
            port.write(b"x")


def test_a_device_without_permission_names_the_udev_rule(double: UsbDouble) -> None:
    double.is_forbidden = True
    with pytest.raises(PortLost, match=r'no permission.*ATTR{idVendor}=="1209", ATTR{idProduct}=="5ca1"'):
        UsbPort(ADDRESS, double)


def test_a_device_opened_twice_is_refused_the_second_time(double: UsbDouble, port: UsbPort) -> None:
    with pytest.raises(PortLost, match="another program uses it"):
        UsbPort(ADDRESS, double)


@pytest.mark.parametrize("is_serial", [False, True])
def test_the_kernels_driver_lets_go_and_gets_it_back(is_serial: bool) -> None:
    double = UsbDouble()
    double.has_driver, double.is_serial = True, is_serial
    with closing(UsbPort(ADDRESS, double)):
        assert not double.has_driver
    assert double.has_driver


@pytest.mark.parametrize("wanted", [None, "SIM-0007"])
def test_a_device_is_chosen_by_its_serial_number(wanted: str | None) -> None:
    double = UsbDouble(UsbIdentity(serial_number="SIM-0007"))
    UsbPort(UsbAddress(0x1209, 0x5CA1, wanted), double).close()
    with pytest.raises(PortLost, match="1 of this kind with other serial numbers"):
        UsbPort(UsbAddress(0x1209, 0x5CA1, "SIM-0008"), double)


def test_another_kind_of_device_is_not_taken(double: UsbDouble) -> None:
    with pytest.raises(PortLost, match="no such device is connected$"):
        UsbPort(UsbAddress(0x1209, 0x5CA2), double)
