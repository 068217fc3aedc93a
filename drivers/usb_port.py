"""A scanner as a bare USB device, as a Port: bulk transfers by pyusb and libusb, the same frames as on serial.

Reads are pending all the time (drivers/usb_backend.py), so that the device never waits for the node's program to come
round; where that is late, the device has to wait. Packet boundaries mean nothing: frames say where they end.
"""

from __future__ import annotations

import errno
import threading
import time
from array import array
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any

import usb.backend.libusb1
import usb.core
import usb.util

from drivers.address import parse_ids
from drivers.usb_backend import ReadingAhead
from protocol.errors import PortLost

READ_BYTES = 262_144
_LOOK_S = 0.1  # how long a read may go on where something else took the word that it was cancelled
_WRITE_MS = 2000
_STALLS_MAX = 5  # in a row
_RULE = (
    'SUBSYSTEM=="usb", ATTR{{idVendor}}=="{:04x}", ATTR{{idProduct}}=="{:04x}", MODE="0660", GROUP="foveascan"'
    " in /etc/udev/rules.d/70-foveascan.rules"
)
_GONE = (usb.core.USBError, NotImplementedError, ValueError)  # the latter two: what pyusb says of a device half gone


@dataclass(frozen=True, slots=True)
class UsbAddress:
    """Which device: vendor and product id, and a serial number where there may be several."""

    vendor: int
    product: int
    serial_number: str | None = None

    @classmethod
    def parse(cls, text: str) -> UsbAddress:
        """From "usb:VID:PID" or "usb:VID:PID:SERIAL", ids in hexadecimal. Raises ValueError."""
        return cls(*parse_ids("usb", text))

    def __str__(self) -> str:
        tail = f":{self.serial_number}" if self.serial_number else ""
        return f"usb:{self.vendor:04x}:{self.product:04x}{tail}"


class UsbPort:
    """An open USB device; nobody else can use its interface meanwhile.

    backend : pyusb's with `interrupt`, another one for tests; by default drivers.usb_backend's.
    Raises PortLost when there is no such device, no permission, or somebody else uses it, naming the cure.
    """

    def __init__(self, address: UsbAddress, backend: Any = None) -> None:
        self._address = address
        self._buffer = array("B", bytes(READ_BYTES))
        self._left = b""
        self._cancelled = threading.Event()
        self._is_closed = False
        self._lost: str | None = None
        self._detached: list[int] = []
        self._backend = backend or _libusb(address)
        self._device = _find(address, self._backend)
        try:
            with self._translated("open"):
                self._interface, self._source, self._sink = self._claim()
        except PortLost:
            self._let_go()
            raise

    @property
    def name(self) -> str:
        """The address it was opened by."""
        return str(self._address)

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read."""
        until_s = time.monotonic() + timeout_s
        while not self._left:
            self._check()
            was_cancelled, left_s = self._cancelled.is_set(), until_s - time.monotonic()
            self._left = self._receive(0.0 if was_cancelled else min(left_s, _LOOK_S))
            if was_cancelled or left_s <= 0:
                self._cancelled.clear()
                break
        data, self._left = self._left[:max_bytes], self._left[max_bytes:]
        return data

    def write(self, data: bytes) -> None:
        """As Port.write; a device that takes nothing for two seconds is lost."""
        self._check()
        with self._translated("write"):
            rest, stalls = memoryview(data), 0
            while rest:
                try:
                    rest = rest[self._sink.write(rest, _WRITE_MS) :]
                except usb.core.USBError as error:
                    stalls += 1
                    if error.errno != errno.EPIPE or stalls > _STALLS_MAX:
                        raise
                    self._sink.clear_halt()

    def cancel(self) -> None:
        """As Port.cancel."""
        self._cancelled.set()
        self._backend.interrupt()

    def close(self) -> None:
        """As Port.close."""
        if self._is_closed:
            return
        self._is_closed = True
        with suppress(*_GONE):
            usb.util.release_interface(self._device, self._interface)
        self._let_go()

    def _let_go(self) -> None:
        """Give the device back to whoever had it."""
        for interface in self._detached:
            with suppress(*_GONE):  # the driver may have taken it along with the one before
                self._device.attach_kernel_driver(interface)
        with suppress(*_GONE):
            usb.util.dispose_resources(self._device)

    def _receive(self, timeout_s: float) -> bytes:
        """What has come, or comes in time; a stalled endpoint is cleared, so often. Raises PortLost."""
        stalls, timeout_ms = 0, max(1, round(1000 * timeout_s))  # 0 would be for ever
        with self._translated("read"):
            while True:
                try:
                    return bytes(memoryview(self._buffer)[: self._source.read(self._buffer, timeout_ms)])
                except usb.core.USBTimeoutError:
                    return b""
                except usb.core.USBError as error:
                    stalls += 1
                    if error.errno != errno.EPIPE or stalls > _STALLS_MAX:
                        raise
                    self._source.clear_halt()

    def _check(self) -> None:
        if self._is_closed or self._lost:
            raise PortLost(f"{self._address}: {self._lost or 'the port is closed'}")

    @contextmanager
    def _translated(self, doing: str) -> Iterator[None]:
        """Turn what libusb says into PortLost, for good."""
        try:
            yield
        except _GONE as error:
            self._lost = self._lost or f"{doing} failed: {_in_words(error, self._address)}"
            raise PortLost(f"{self._address}: {self._lost}") from error

    def _claim(self) -> tuple[int, Any, Any]:
        """The first interface with bulk endpoints both ways, claimed: its number, and the endpoints in and out."""
        try:
            configuration = self._device.get_active_configuration()
        except usb.core.USBError:
            self._device.set_configuration()
            configuration = self._device.get_active_configuration()
        for interface in configuration:
            ends = [_bulk(interface, direction) for direction in (usb.util.ENDPOINT_IN, usb.util.ENDPOINT_OUT)]
            if all(ends):
                number = interface.bInterfaceNumber
                self._detach(configuration, number)
                usb.util.claim_interface(self._device, number)
                return number, *ends
        raise ValueError("it has no interface with bulk endpoints both ways, so it is no scanner of this kind")

    def _detach(self, configuration: Any, interface: int) -> None:
        """Have the kernel's own driver let go of an interface, if it has one; it gets it back at the end.

        With it go interfaces that the same driver has beside it: a serial port's has two, and comes back by the first.
        """
        with suppress(NotImplementedError):  # a system whose kernel takes no interface has nothing to let go
            driven = [number for number in _numbers(configuration) if self._device.is_kernel_driver_active(number)]
            if interface in driven:
                self._device.detach_kernel_driver(interface)
                self._detached = [number for number in driven if not self._device.is_kernel_driver_active(number)]


def _libusb(address: UsbAddress) -> ReadingAhead:
    """The machine's. Raises PortLost."""
    backend = usb.backend.libusb1.get_backend()
    if backend is None:
        raise PortLost(f"{address}: no USB here: libusb is not installed (libusb-1.0-0), or the machine has no bus")
    return ReadingAhead(backend)


def _find(address: UsbAddress, backend: Any) -> Any:
    """The device at an address. Raises PortLost."""
    try:
        found = list(usb.core.find(True, backend=backend, idVendor=address.vendor, idProduct=address.product))
        chosen = [device for device in found if _has_serial(device, address.serial_number)]
    except _GONE as error:
        raise PortLost(f"{address}: {_in_words(error, address)}") from error
    if not chosen:
        others = f"; {len(found)} of this kind with other serial numbers are" if found else ""
        raise PortLost(f"{address}: no such device is connected{others}")
    return chosen[0]


def _has_serial(device: Any, wanted: str | None) -> bool:
    return wanted is None or device.serial_number == wanted


def _numbers(configuration: Any) -> list[int]:
    """Of its interfaces, each once whatever settings it has."""
    return sorted({interface.bInterfaceNumber for interface in configuration})


def _bulk(interface: Any, direction: int) -> Any:
    """The first bulk endpoint of an interface in one direction, or None."""
    return usb.util.find_descriptor(
        interface,
        custom_match=lambda end: (
            usb.util.endpoint_direction(end.bEndpointAddress) == direction
            and usb.util.endpoint_type(end.bmAttributes) == usb.util.ENDPOINT_TYPE_BULK
        ),
    )


def _in_words(error: Exception, address: UsbAddress) -> str:
    """What libusb said, with its cure where there is one."""
    number = getattr(error, "errno", None)
    if number == errno.EACCES or "langid" in str(error):  # pyusb's words for strings it may not read
        return f"no permission; add the udev rule {_RULE.format(address.vendor, address.product)} and plug it in again"
    if number == errno.EBUSY:
        return "another program uses it"
    return str(error)
