"""A /dev/ttyACM0 that comes and goes, under libumockdev's preload: a fake sysfs round a pseudo terminal."""

from __future__ import annotations

import shutil
import socket
import struct
import threading
from contextlib import suppress
from pathlib import Path

from simulators.usb_descriptors import CDC_IDENTITY, UsbIdentity
from simulators.usb_uevent import announce

_MESSAGE = struct.Struct("<QQQ")
_DONE, _NOT_MINE = 3, (1 << 64) - 100  # "not handled here": the preload then asks the pty itself
_USB = "sys/devices/pci0000:00/usb1/1-2"
_TTY = f"{_USB}/1-2:1.0/tty"


class TtyTestbed:
    """Plugs pseudo terminals in as /dev/ttyACM<n>, with ids and a serial number, under a folder."""

    def __init__(self, root: Path, identity: UsbIdentity = CDC_IDENTITY) -> None:
        self.identity = identity
        self._root = root
        for folder in ("sys/bus/usb/devices", "sys/class/tty", "dev/serial/by-id", "ioctl"):
            (root / folder).mkdir(parents=True, exist_ok=True)
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(root / "ioctl/_default"))
        self._listener.listen(8)
        threading.Thread(target=self._accept, daemon=True).start()

    def plug_in(self, terminal: str, number: int = 0) -> None:
        """Make a pseudo terminal appear as /dev/ttyACM<number>."""
        name, ids = f"ttyACM{number}", self.identity
        self._write(_USB, idVendor=f"{ids.vendor:04x}", idProduct=f"{ids.product:04x}", serial=ids.serial_number,
                    manufacturer=ids.manufacturer, product=ids.model, busnum="1", devnum="3", bNumInterfaces="1",
                    uevent="DEVTYPE=usb_device")  # fmt: skip
        self._write(f"{_USB}/1-2:1.0", interface="CDC", uevent="DEVTYPE=usb_interface")
        self._write(f"{_TTY}/{name}", uevent=f"MAJOR=166\nMINOR={number}\nDEVNAME={name}", dev=f"166:{number}")
        links = {
            f"{_USB}/subsystem": "../../../../bus/usb",
            f"{_USB}/1-2:1.0/subsystem": "../../../../../bus/usb",
            f"{_TTY}/{name}/subsystem": "../../../../../../../class/tty",
            f"{_TTY}/{name}/device": "../../../1-2:1.0",
            f"sys/class/tty/{name}": f"../../{_TTY[4:]}/{name}",
            f"dev/{name}": terminal,
            f"dev/serial/by-id/usb-foveascan_{ids.serial_number}-if00": f"../../{name}",
        }
        for place, target in links.items():
            (self._root / place).symlink_to(target)
        self._links = list(links)
        self._announce("add", name, number)

    def unplug(self, number: int = 0) -> None:
        """Make it vanish."""
        for place in reversed(self._links):
            (self._root / place).unlink()
        shutil.rmtree(self._root / _USB)
        self._announce("remove", f"ttyACM{number}", number)

    def close(self) -> None:
        """Answer no more."""
        self._listener.close()
        (self._root / "ioctl/_default").unlink()

    def _announce(self, action: str, name: str, number: int) -> None:
        properties = {"DEVPATH": f"/{_TTY[4:]}/{name}", "SUBSYSTEM": "tty", "DEVNAME": f"/dev/{name}", "MAJOR": "166"}
        announce(self._root, action, {**properties, "MINOR": f"{number}"})

    def _write(self, folder: str, **texts: str) -> None:
        path = self._root / folder
        path.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (path / name).write_text(text + "\n")

    def _accept(self) -> None:
        with suppress(OSError):  # closed
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=_pass_on, args=(connection,), daemon=True).start()


def _pass_on(connection: socket.socket) -> None:
    """Leave every ioctl to the pty."""
    with suppress(OSError), connection:
        while len(connection.recv(_MESSAGE.size, socket.MSG_WAITALL)) == _MESSAGE.size:
            connection.sendall(_MESSAGE.pack(_DONE, _NOT_MINE, 0))
