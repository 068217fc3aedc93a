"""A USB device that the real libusb talks to, without a kernel's help: the device's side of libumockdev's preload.

A program started with `environment` sees one USB device: sysfs and device nodes are files under `root`, its ioctls
come here over a Unix socket, and plugging shows as a udev event. What a carrier writes goes out as bulk packets: a read
ends when it is full, or with a packet that is not (one of length zero if need be), as on a kernel.

Source: umockdev's ioctl_tree, checked against a kernel's gadget.
"""

from __future__ import annotations

import errno
import os
import shutil
import socket
import struct
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from simulators.usb_descriptors import BULK_IN, BULK_OUT, UsbIdentity
from simulators.usb_pipes import UsbPipes
from simulators.usb_preload import PRELOAD, PreloadClient
from simulators.usb_uevent import announce

BUS_SWITCH_S = 0.00005  # for sys.setswitchinterval: the bus waits for the table's arithmetic no longer
_HOLD_S = 0.01  # how long a reap waits for news: longer holds up writes, shorter spins
_URB = struct.Struct("<BBxxiIxxxxQiiiiIIQ")
_OUTCOME_AT, _OUTCOME = 4, struct.Struct("<iIxxxxQii")  # from its status to its actual length
_TYPE_CONTROL = 2
_SETUP = struct.Struct("<BBHHH")
_CAPABILITIES = 0x1F

_REAP = {0x4008550D, 0x4008550C}
_SUBMIT, _DISCARD, _GET_CAPABILITIES = 0x8038550A, 0x550B, 0x8004551A
_GET_DRIVER, _GET_SPEED = 0x41045508, 0x551F
_CLEAR_HALT = 0x80045515
_CLAIM, _RELEASE = 0x8004550F, 0x80045510
_ACCEPTED = {_CLAIM, _RELEASE, _CLEAR_HALT, 0x80045505, 0x80085504, 0x5514}
_HIGH_SPEED = 3
_SOCKET_PATH_BYTES = 107
_NUMBERS = 16  # devices that one place sees before their numbers meet those of the next


@dataclass(slots=True)
class _Urb:
    """A transfer that the program has handed over: where it lies in its memory, and what became of it."""

    address: int
    kind: int
    flags: int
    buffer: int
    size: int
    data: bytes | memoryview = b""
    data_at: int = 0
    status: int = 0
    actual: int = 0

    def outcome(self) -> bytes:
        """What the program reads of it in its own memory."""
        return _OUTCOME.pack(self.status, self.flags, self.buffer, self.size, self.actual)


@dataclass(slots=True)
class _Plugged:
    """The device from one plugging in to the next pulling out; a program may hold on to it beyond that."""

    number: int
    is_gone: bool = False
    is_halted: bool = False
    claimed_by: object = None
    pending: deque[_Urb] = field(default_factory=deque)
    done: deque[_Urb] = field(default_factory=deque)

    def fail_pending(self) -> None:
        """What a kernel does with the transfers of a device that is gone."""
        while self.pending:
            urb = self.pending.popleft()
            urb.status = -errno.ESHUTDOWN
            self.done.append(urb)


class _Program(PreloadClient):
    """A program that has the device open.

    owes : a transfer outward, whose data are still to be fetched.  has_reaped : whether it asked last for a finished
    one, and was given it; libusb then asks for more before it does anything else.
    """

    owes: _Urb | None = None
    has_reaped = False


class UsbTestbed(UsbPipes):
    """One simulated USB device under a folder, as a carrier's port: `read` and `write` are the device's end.

    rate_bytes_s : speed towards the node.   place : where it is plugged in, 1..7; several beds may share a root.
    Other files under `root` (udev's sockets) are left alone. Raises OSError where its path is too long for sockets.
    """

    def __init__(
        self,
        root: Path,
        identity: UsbIdentity | None = None,
        rate_bytes_s: float = float("inf"),
        place: int = 1,
    ) -> None:
        super().__init__(rate_bytes_s)
        self.identity = identity or UsbIdentity()
        self.name = self.identity.address
        self._root = root
        self._port = f"1-{place}"
        self._plugged = _Plugged(place * _NUMBERS, is_gone=True)
        self._listener: socket.socket | None = None
        if len(os.fsencode(self._ioctls)) > _SOCKET_PATH_BYTES:
            cure = f"a socket's path has at most {_SOCKET_PATH_BYTES} bytes, choose a shorter one"
            raise OSError(errno.ENAMETOOLONG, cure, str(self._ioctls))
        (root / "sys/class").mkdir(parents=True, exist_ok=True)
        self.plug_in()

    @property
    def environment(self) -> dict[str, str]:
        """What the node's environment needs beside its own."""
        return {"LD_PRELOAD": PRELOAD, "UMOCKDEV_DIR": str(self._root)}

    # -- the device's end ----------------------------------------------------------------------------------------

    def hang_up(self) -> None:
        """Pull the plug: every pending transfer ends with ESHUTDOWN."""
        with self._changed:
            self._plugged.is_gone = True
            self._plugged.fail_pending()
            self._out.clear()
            self._in.clear()
            self._fetched()
            self._changed.notify_all()
        announce(self._root, "remove", self._properties())
        self._sysfs_link.unlink()
        shutil.rmtree(self._sysfs)
        self._node.unlink()

    def plug_in(self) -> None:
        """Put the plug in: a device of the next number appears."""
        if self._listener is not None:
            self._listener.close()
            self._ioctls.unlink()
        with self._changed:
            self._plugged = _Plugged(self._plugged.number + 1)
        self._ioctls.parent.mkdir(parents=True, exist_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(self._ioctls))
        self._listener.listen(8)
        threading.Thread(target=self._accept, args=(self._listener, self._plugged), daemon=True).start()
        self._make_sysfs()
        announce(self._root, "add", self._properties())

    def close(self) -> None:
        """Unplug for good."""
        if not self._plugged.is_gone:
            self.hang_up()
        if self._listener is not None:
            self._listener.close()
        self._ioctls.unlink(missing_ok=True)

    # -- sysfs ---------------------------------------------------------------------------------------------------

    @property
    def _device_path(self) -> str:
        return f"/dev/bus/usb/001/{self._plugged.number:03d}"

    @property
    def _sysfs(self) -> Path:
        return self._root / "sys/devices/pci0000:00/usb1" / self._port

    @property
    def _sysfs_link(self) -> Path:
        return self._root / "sys/bus/usb/devices" / self._port

    @property
    def _ioctls(self) -> Path:
        return self._root / f"ioctl{self._device_path}"

    @property
    def _node(self) -> Path:
        return Path(f"{self._root}{self._device_path}")

    def _make_sysfs(self) -> None:
        ids = self.identity
        for folder in (self._sysfs, self._sysfs_link.parent, self._node.parent):
            folder.mkdir(parents=True, exist_ok=True)
        texts = {
            "busnum": "1", "devnum": f"{self._plugged.number}", "speed": "480", "bConfigurationValue": "1",
            "idVendor": f"{ids.vendor:04x}", "idProduct": f"{ids.product:04x}", "serial": ids.serial_number,
            "manufacturer": ids.manufacturer, "product": ids.model, "bNumInterfaces": "1",
            "uevent": "\n".join(f"{key}={value}" for key, value in self._properties().items()),
        }  # fmt: skip
        for name, text in texts.items():
            (self._sysfs / name).write_text(text + "\n")
        (self._sysfs / "descriptors").write_bytes(ids.device_descriptor() + ids.configuration_descriptor())
        (self._sysfs / "subsystem").symlink_to("../../../../bus/usb")
        self._sysfs_link.symlink_to(f"../../../devices/pci0000:00/usb1/{self._port}")
        self._node.touch()

    def _properties(self) -> dict[str, str]:
        """As udev tells them."""
        return {
            "DEVPATH": f"/devices/pci0000:00/usb1/{self._port}", "SUBSYSTEM": "usb", "DEVNAME": self._device_path,
            "DEVTYPE": "usb_device", "DRIVER": "usb", "BUSNUM": "001", "DEVNUM": f"{self._plugged.number:03d}",
            "MAJOR": "189", "MINOR": f"{self._plugged.number - 1}",
        }  # fmt: skip

    # -- the program's ioctls ------------------------------------------------------------------------------------

    def _accept(self, listener: socket.socket, plugged: _Plugged) -> None:
        with suppress(OSError):  # closed
            while True:
                connection, _ = listener.accept()
                threading.Thread(target=self._serve, args=(connection, plugged), daemon=True).start()

    def _serve(self, connection: socket.socket, plugged: _Plugged) -> None:
        """Answer one open device file of the program, until it closes it."""
        client = _Program(connection)
        try:
            for request, address in client.ioctls():
                if client.owes is not None:
                    self._take(client, plugged, client.owes)
                self._answer(client, plugged, request, address)
        except (EOFError, OSError):
            pass
        finally:
            with self._changed:
                if plugged.claimed_by is client:
                    plugged.claimed_by = None
                    plugged.pending.clear()
            connection.close()

    def _answer(self, client: _Program, plugged: _Plugged, request: int, address: int) -> None:
        if request in _REAP:
            self._reap(client, plugged, address)
        elif plugged.is_gone:
            client.fail(errno.ENODEV)
        elif request == _SUBMIT:
            self._submit(client, plugged, address)
        elif request == _DISCARD:
            client.done() if self._discard(plugged, address) else client.fail(errno.EINVAL)
        elif request == _GET_CAPABILITIES:
            client.done([(address, struct.pack("<I", _CAPABILITIES))])
        elif request == _GET_DRIVER:
            client.fail(errno.ENODATA)
        elif request == _GET_SPEED:
            client.done(result=_HIGH_SPEED)
        elif request == _CLAIM and plugged.claimed_by not in (None, client):
            client.fail(errno.EBUSY)
        elif request in _ACCEPTED:
            self._accept_state(client, plugged, request)
            client.done()
        else:
            client.fail(errno.ENOTTY)

    def _accept_state(self, client: _Program, plugged: _Plugged, request: int) -> None:
        """What a request changes about the device."""
        if request == _CLAIM:
            plugged.claimed_by = client
        elif request == _RELEASE:
            plugged.claimed_by = None
        elif request == _CLEAR_HALT:
            with self._changed:
                plugged.is_halted = False
                self._fill()

    def _reap(self, client: _Program, plugged: _Plugged, address: int) -> None:
        """Hand over a finished transfer, or say that there is none yet."""
        with self._changed:
            if not (plugged.done or plugged.is_gone or client.has_reaped):
                self._changed.wait_for(lambda: plugged.done or plugged.is_gone, _HOLD_S)
            urb = plugged.done.popleft() if plugged.done else None
            client.has_reaped = urb is not None
        if urb is None:
            client.fail(errno.ENODEV if plugged.is_gone else errno.EAGAIN)
            return
        outcome: list[tuple[int, bytes | memoryview]] = [(urb.data_at, urb.data)] if len(urb.data) else []
        outcome.append((urb.address + _OUTCOME_AT, urb.outcome()))
        client.done([*outcome, (address, struct.pack("<Q", urb.address))])

    def _submit(self, client: _Program, plugged: _Plugged, address: int) -> None:
        """Take a transfer over. What one outward carries is fetched when the program comes to ask what became of it:
        a read then takes one round, not two, and there are thousands a second."""
        kind, endpoint, _, flags, buffer, size, *_ = _URB.unpack(client.fetch_last(address, _URB.size))
        urb = _Urb(address, kind, flags, buffer, size)
        if kind == _TYPE_CONTROL or endpoint == BULK_OUT:
            client.owes = urb
        elif endpoint == BULK_IN:
            with self._changed:
                plugged.pending.append(urb)
                self._fill()
                if plugged.is_gone:
                    plugged.fail_pending()

    def _take(self, client: _Program, plugged: _Plugged, urb: _Urb) -> None:
        """What goes outward."""
        sent, client.owes = client.fetch(urb.buffer, urb.size), None
        with self._changed:
            if plugged.is_gone:
                urb.status = -errno.ESHUTDOWN
            elif urb.kind == _TYPE_CONTROL:
                self._control(urb, sent)
            elif self._refuses(plugged):
                urb.status = -errno.EPIPE
            else:
                self._in.append(sent)
                urb.actual = urb.size
            plugged.done.append(urb)
            self._changed.notify_all()

    def _control(self, urb: _Urb, sent: bytes) -> None:
        """Strings are told, everything outward is taken, everything else stalls."""
        kind, request, value, _, size = _SETUP.unpack_from(sent)
        text = self.identity.string_descriptor(value & 0xFF) if (kind, request, value >> 8) == (0x80, 6, 3) else None
        if text is not None:
            urb.data, urb.actual, urb.data_at = text[:size], min(len(text), size), urb.buffer + _SETUP.size
        elif kind & 0x80:
            urb.status = -errno.EPIPE
        else:
            urb.actual = size

    def _sent(self) -> None:
        self._fill()

    def _refuses(self, plugged: _Plugged) -> bool:
        """Whether the endpoints are halted, or halt now."""
        if self.stalls:
            self.stalls -= 1
            plugged.is_halted = True
        return plugged.is_halted

    def _fill(self) -> None:
        """Complete pending reads with what waits: each with the rest of one write, or as much as it has room for.

        The first one finds the endpoint halted if it halts now, and those behind it wait until that is cleared.
        """
        plugged = self._plugged
        if plugged.pending and self._out and not plugged.is_halted and self._refuses(plugged):
            urb = plugged.pending.popleft()
            urb.status = -errno.EPIPE
            plugged.done.append(urb)
        while plugged.pending and self._out and not plugged.is_halted:
            urb, data = plugged.pending.popleft(), self._out.popleft()
            urb.data, urb.data_at = data[: urb.size], urb.buffer
            urb.actual = len(urb.data)
            if len(data) > urb.size:
                self._out.appendleft(data[urb.size :])
            plugged.done.append(urb)
        self._fetched()
        if plugged.done:
            self._changed.notify_all()

    def _discard(self, plugged: _Plugged, address: int) -> bool:
        """The program gives a transfer up."""
        with self._changed:
            for urb in plugged.pending:
                if urb.address == address:
                    plugged.pending.remove(urb)
                    urb.status = -errno.ENOENT
                    plugged.done.append(urb)
                    self._changed.notify_all()
                    return True
        return False
