"""The USB device of a test: emulated, in a process under umockdev's preload, or a gadget of a real kernel.

The latter where FOVEASCAN_UDC names device controllers that are plugged into this very machine, as in `make nightly`.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from simulators.tty_gadget import TtyGadget
from simulators.usb_descriptors import CDC_IDENTITY, UsbIdentity
from simulators.usb_gadget import UsbGadget
from simulators.usb_preload import is_under_preload
from simulators.usb_testbed import UsbTestbed

CONTROLLERS = os.environ.get("FOVEASCAN_UDC", "").split()
HAS_USB = is_under_preload() or bool(CONTROLLERS)
_TAKEN_UP_S = 30.0

Bed = TypeVar("Bed", UsbGadget, TtyGadget)


def usb_bed(
    identity: UsbIdentity | None = None, rate_bytes_s: float = float("inf"), place: int = 1
) -> UsbTestbed | UsbGadget:
    """A device with bulk endpoints, plugged in. place : several may be, each at another place from 1 on."""
    if CONTROLLERS:
        return taken_up(lambda: UsbGadget(CONTROLLERS[place - 1], identity, rate_bytes_s), identity or UsbIdentity())
    return UsbTestbed(Path(os.environ["UMOCKDEV_DIR"]), identity, rate_bytes_s, place)


def acm_bed(identity: UsbIdentity = CDC_IDENTITY, place: int = 1) -> TtyGadget:
    """A serial port on USB, plugged in."""
    return taken_up(lambda: TtyGadget(CONTROLLERS[place - 1], identity), identity)


def taken_up(plug: Callable[[], Bed], identity: UsbIdentity) -> Bed:
    """A gadget, once kernel and udev have forgotten the one before and know this one."""
    _await(lambda: _configuration(identity) is None)
    bed = plug()
    _await(lambda: _configuration(identity))
    subprocess.run(["udevadm", "settle"], check=True)
    return bed


def _configuration(identity: UsbIdentity) -> str | None:
    """Of the device, "" while it has none; None when it is not there."""
    for serial in Path("/sys/bus/usb/devices").glob("*/serial"):
        with suppress(OSError):  # it goes this very moment
            if serial.read_text().strip() == identity.serial_number:
                return (serial.parent / "bConfigurationValue").read_text().strip()
    return None


def _await(is_so: Callable[[], object]) -> None:
    until_s = time.monotonic() + _TAKEN_UP_S
    while not is_so():
        assert time.monotonic() < until_s, "the kernel does not take notice"
        time.sleep(0.02)
