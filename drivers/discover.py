"""Which scanners are plugged in, and how a setting finds its port.

A port is named by a device path (best one of /dev/serial/by-id/, which stays the same wherever it is plugged in),
by `serial:VID:PID[:SERIAL]`, by `usb:VID:PID[:SERIAL]`, or by `tcp:HOST:PORT`. Those with ids are looked up whenever
the port is opened, so a scanner is found again under whatever name it comes back.
"""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import usb.backend.libusb1
import usb.core
from serial.tools import list_ports

from drivers.address import parse_ids
from drivers.port import Port
from drivers.serial_port import SerialPort
from drivers.sweep import ScannerConfig
from drivers.tcp_port import TcpPort
from drivers.usb_port import UsbAddress, UsbPort
from protocol.errors import PortLost
from protocol.framing import USB_PAYLOAD_MAX

SCANNER_IDS = ((0x1209, 0x5CA1),)
USB_WINDOW_BYTES = 4 << 20
_BY_ID = Path("/dev/serial/by-id")
_LOOKED_AT = ("/dev/serial/by-id", "/dev/bus/usb", "/dev")
_POLL_S = 0.25
_NETLINK_KOBJECT_UEVENT = 15
_KERNEL_EVENTS, _UDEV_EVENTS = 1, 2
_EVENT_BYTES = 8192


@dataclass(frozen=True, slots=True)
class Found:
    """A port that may lead to a scanner. address : what to open it by.  vendor, product : USB ids, 0 if unknown."""

    address: str
    vendor: int
    product: int
    serial_number: str
    description: str

    @property
    def is_known(self) -> bool:
        """Whether its ids are a scanner's."""
        return (self.vendor, self.product) in SCANNER_IDS


def find_ports() -> list[Found]:
    """Serial ports on USB, and bare USB devices with a scanner's ids; those with known ids first."""
    return sorted([*_serial_ports(), *_usb_devices()], key=lambda found: (not found.is_known, found.address))


def open_port(address: str, baud: int = 3_000_000) -> Port:
    """Open whatever an address names. Raises PortLost, saying what is missing."""
    if address.startswith("usb:"):
        try:
            return UsbPort(UsbAddress.parse(address))
        except ValueError as error:
            raise PortLost(str(error)) from error
    if address.startswith("tcp:"):
        return TcpPort(address)
    if address.startswith("serial:"):
        return SerialPort(_serial_path(address), baud)
    return SerialPort(address, baud)


def config_for(address: str, quiet_s: float = 2.0) -> ScannerConfig:
    """How to talk over the port at an address: USB and TCP take longer frames and run further ahead."""
    if address.startswith(("usb:", "tcp:")):
        return ScannerConfig(quiet_s=quiet_s, payload_max=USB_PAYLOAD_MAX, window_bytes=USB_WINDOW_BYTES)
    return ScannerConfig(quiet_s=quiet_s)


class Arrivals:
    """Tells when something is plugged in or out: woken by udev's events, and without udev by a look every 1/4 s."""

    def __init__(self) -> None:
        self._seen = _fingerprint()
        self._events: socket.socket | None = None
        try:
            self._events = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, _NETLINK_KOBJECT_UEVENT)
            self._events.bind((0, _KERNEL_EVENTS | _UDEV_EVENTS))
            self._events.setblocking(False)
        except (OSError, AttributeError):  # no such socket here, or not allowed: looking does
            self._forget_events()

    def wait(self, timeout_s: float, stop: threading.Event) -> bool:
        """Whether something changed before the time was over or `stop` was set."""
        until_s = time.monotonic() + timeout_s
        while not stop.is_set():
            if (seen := _fingerprint()) != self._seen:
                self._seen = seen
                return True
            left_s = until_s - time.monotonic()
            if left_s <= 0:
                return False
            self._sleep(min(left_s, _POLL_S), stop)
        return False

    def close(self) -> None:
        """Listen no more."""
        self._forget_events()

    def _sleep(self, time_s: float, stop: threading.Event) -> None:
        """Until an event comes, but not for long: `stop` cannot wake it."""
        if self._events is None:
            stop.wait(time_s)
            return
        try:
            if select.select([self._events], [], [], time_s)[0]:
                self._events.recv(_EVENT_BYTES)
        except OSError:
            self._forget_events()

    def _forget_events(self) -> None:
        if self._events is not None:
            self._events.close()
            self._events = None


def _fingerprint() -> tuple[tuple[str, ...], ...]:
    """What stands where ports appear: names of serial ports and USB devices."""
    return tuple(tuple(sorted(_names(folder))) for folder in _LOOKED_AT)


def _names(folder: str) -> list[str]:
    if folder == "/dev/bus/usb":
        return [f"{bus}/{device}" for bus in _listed(folder) for device in _listed(f"{folder}/{bus}")]
    names = _listed(folder)
    return [name for name in names if name.startswith(("ttyACM", "ttyUSB"))] if folder == "/dev" else names


def _listed(folder: str) -> list[str]:
    with suppress(OSError):
        return os.listdir(folder)
    return []


def _serial_ports() -> list[Found]:
    links = {_BY_ID.joinpath(name).resolve(): str(_BY_ID / name) for name in _listed(str(_BY_ID))}
    found = []
    for port in list_ports.comports():
        if port.vid is not None and port.pid is not None:
            path = links.get(Path(port.device).resolve(), port.device)
            said = f"{port.manufacturer or ''} {port.product or ''}".strip() or port.device
            found.append(Found(path, port.vid, port.pid, port.serial_number or "", said))
    return found


def _usb_devices() -> list[Found]:
    """Bare USB devices with a scanner's ids; without libusb, or permission to read names, as much as can be told."""
    backend = usb.backend.libusb1.get_backend()
    if backend is None:
        return []
    found = []
    for vendor, product in SCANNER_IDS:
        with suppress(usb.core.USBError):
            for device in usb.core.find(True, backend=backend, idVendor=vendor, idProduct=product):
                serial = _text(device, "serial_number")
                address = str(UsbAddress(vendor, product, serial or None))
                found.append(Found(address, vendor, product, serial, _text(device, "product") or "USB scanner"))
    return found


def _text(device: Any, name: str) -> str:
    """A name the device has for itself, where it may be read."""
    with suppress(usb.core.USBError, ValueError, NotImplementedError):  # not ours to open, or no such text
        return str(getattr(device, name) or "")
    return ""


def _serial_path(address: str) -> str:
    """The serial port that an address leads to now. Raises PortLost."""
    try:
        vendor, product, serial_number = parse_ids("serial", address)
    except ValueError as error:
        raise PortLost(str(error)) from error
    ports = [port for port in _serial_ports() if (port.vendor, port.product) == (vendor, product)]
    chosen = [port.address for port in ports if serial_number in (None, port.serial_number)]
    if not chosen:
        others = f"; {len(ports)} of this kind with other serial numbers are" if ports else ""
        raise PortLost(f"{address}: no such serial port is connected{others}")
    return chosen[0]
