"""A backend for pyusb that has one simulated device and no USB: for machines without umockdev."""

from __future__ import annotations

import errno
import threading
import time
from array import array
from collections import deque
from types import SimpleNamespace
from typing import Any

import usb.backend
import usb.core

from simulators.usb_descriptors import BULK_IN, BULK_OUT, PACKET_BYTES, UsbIdentity

_WAITING_MAX = 64


class UsbDouble(usb.backend.IBackend):  # type: ignore[misc]
    """The device's bulk pipes: `read` and `write` are the device's end, as PtyPort's are.

    is_forbidden, is_taken, has_driver : what opening meets.    is_serial : its bulk endpoints are in the second of two
    interfaces, and the kernel's driver takes both or none, by the first.    stalls : transfers that will be
    refused by a halted endpoint until it is cleared.
    """

    def __init__(self, identity: UsbIdentity | None = None) -> None:
        self.identity = identity or UsbIdentity()
        self.name = self.identity.address
        self.is_forbidden = self.is_taken = self.has_driver = self.is_serial = False
        self.stalls = 0
        self.is_halted = False
        self.is_plugged = True
        self._changed = threading.Condition()
        self._to_node: deque[bytes] = deque()
        self._to_device: deque[bytes] = deque()
        self._is_cancelled = self._is_interrupted = False

    # -- the device's end ----------------------------------------------------------------------------------------

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """What the node wrote."""
        with self._changed:
            self._changed.wait_for(lambda: self._to_device or self._is_cancelled, max(timeout_s, 0.0))
            self._is_cancelled = False
            return self._to_device.popleft() if self._to_device else b""

    def write(self, data: bytes) -> None:
        """Hand data over as packets; waits while nobody reads, until `cancel`."""
        with self._changed:
            self._changed.wait_for(lambda: len(self._to_node) < _WAITING_MAX or self._is_cancelled)
            if data:
                self._to_node.append(data)
            self._changed.notify_all()

    def cancel(self) -> None:
        """Wake who waits in read or write."""
        with self._changed:
            self._is_cancelled = True
            self._changed.notify_all()

    def hang_up(self) -> None:
        """Pull the plug."""
        with self._changed:
            self.is_plugged = False
            self._to_node.clear()
            self._to_device.clear()
            self._changed.notify_all()

    def plug_in(self) -> None:
        """Put the plug in again."""
        with self._changed:
            self.is_plugged = True

    # -- the node's end: pyusb's, and `interrupt` --------------------------------------------------------------------

    def interrupt(self) -> None:
        """End the read that waits, or else the next one."""
        with self._changed:
            self._is_interrupted = True
            self._changed.notify_all()

    def enumerate_devices(self) -> Any:
        """The one device."""
        return iter([self] if self.is_plugged else [])

    def get_parent(self, dev: Any) -> None:
        """It has none."""

    def get_device_descriptor(self, dev: Any) -> SimpleNamespace:
        """As pyusb wants it."""
        ids = self.identity
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0xFF, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=ids.vendor, idProduct=ids.product, bcdDevice=0x100, iManufacturer=1,
            iProduct=2, iSerialNumber=3, bNumConfigurations=1, bus=1, address=2, port_number=1, port_numbers=(1,),
            speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Any, config: int) -> SimpleNamespace:
        """As pyusb wants it."""
        _only(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1 + self.is_serial, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=250, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> SimpleNamespace:
        """As pyusb wants it."""
        _only(alt, config, intf > self.is_serial)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0,
            bNumEndpoints=2 if intf == self.is_serial else 0,
            bInterfaceClass=0xFF, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: Any, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """As pyusb wants it."""
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(BULK_IN, BULK_OUT)[ep], bmAttributes=2,
            wMaxPacketSize=PACKET_BYTES, bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: Any) -> object:
        """A handle."""
        if self.is_forbidden:
            raise usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)
        self._check_plugged()
        return object()

    def close_device(self, dev_handle: object) -> None:
        """Nothing to do."""

    def set_configuration(self, dev_handle: object, config_value: int) -> None:
        """It has one."""

    def get_configuration(self, dev_handle: object) -> int:
        """It has one."""
        return 1

    def claim_interface(self, dev_handle: object, intf: int) -> None:
        """Refused where another program has it."""
        if self.is_taken or self.has_driver:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        self.is_taken = True

    def release_interface(self, dev_handle: object, intf: int) -> None:
        """Let another program have it."""
        self.is_taken = False

    def is_kernel_driver_active(self, dev_handle: object, intf: int) -> bool:
        """Whether the kernel took it for something it knows."""
        return self.has_driver

    def detach_kernel_driver(self, dev_handle: object, intf: int) -> None:
        """The kernel lets go."""
        self.has_driver = False

    def attach_kernel_driver(self, dev_handle: object, intf: int) -> None:
        """The kernel has it again, if it is asked by the first interface."""
        if intf or self.has_driver:
            raise usb.core.USBError("Entity not found", -5, errno.ENOENT)
        self.has_driver = True

    def clear_halt(self, dev_handle: object, ep: int) -> None:
        """The endpoint goes on."""
        self.is_halted = False

    def ctrl_transfer(self, handle: object, kind: int, request: int, value: int, index: int, data: Any, ms: int) -> int:
        """Strings; everything else stalls."""
        text = self.identity.string_descriptor(value & 0xFF) if (kind, request, value >> 8) == (0x80, 6, 3) else None
        if text is None:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        text = text[: len(data)]
        data[: len(text)] = array("B", text)
        return len(text)

    def bulk_write(self, dev_handle: object, ep: int, intf: int, data: Any, timeout: int) -> int:
        """To the device."""
        self._check_halt()
        with self._changed:
            self._check_plugged()
            self._to_device.append(bytes(data))
            self._changed.notify_all()
        return len(data)

    def bulk_read(self, dev_handle: object, ep: int, intf: int, buff: Any, timeout: int) -> int:
        """From the device: ends when the buffer is full or with what one write of the device brought."""
        self._check_halt()
        until_s = time.monotonic() + timeout / 1000
        with self._changed:
            self._changed.wait_for(
                lambda: self._to_node or not self.is_plugged or self._is_interrupted, until_s - time.monotonic()
            )
            self._is_interrupted = False
            self._check_plugged()
            if not self._to_node:
                raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
            data = self._to_node.popleft()
            if len(data) > len(buff):
                self._to_node.appendleft(data[len(buff) :])
                data = data[: len(buff)]
            memoryview(buff)[: len(data)] = data
            self._changed.notify_all()
        return len(data)

    def _check_plugged(self) -> None:
        if not self.is_plugged:
            raise usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)

    def _check_halt(self) -> None:
        if self.stalls:
            self.stalls -= 1
            self.is_halted = True
        if self.is_halted:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)


def _only(*numbers: int) -> None:
    """Raise IndexError beyond the only one of each kind, which ends pyusb's enumeration."""
    if any(numbers):
        raise IndexError(f"there is only one, asked for {numbers}")
