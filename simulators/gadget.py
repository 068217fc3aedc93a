"""A USB device that this machine pretends to be, by Linux's gadget framework: real packets of a real controller.

Small computers have a device controller (UDC) beside their USB ports, and the kernel's module dummy_hcd makes one that
is plugged into the same machine. `Gadget` is what lies in configfs about such a device; it has one function, which
usb_gadget.py (bulk endpoints) and tty_gadget.py (a serial port) serve.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from simulators.usb_descriptors import UsbIdentity

CONTROLLERS = Path("/sys/class/udc")
_CONFIGFS = Path("/sys/kernel/config/usb_gadget")
_ENGLISH = "0x409"
_MAKE = "modprobe libcomposite && mount -t configfs none /sys/kernel/config"


class Gadget:
    """A device in configfs, plugged in and out by its controller.

    controller : as in /sys/class/udc.   function : of the kernel's, as "acm".  Raises OSError, naming the cure.
    """

    def __init__(self, controller: str, identity: UsbIdentity, function: str) -> None:
        self._controller = controller
        self._folder = _CONFIGFS / f"foveascan-{controller}"
        self._function = self._folder / "functions" / f"{function}.{self.name}"
        self._check()
        self.remove()  # what a simulator left that was killed
        self._make(identity)

    @property
    def name(self) -> str:
        """Of the one function; no other in this machine has it."""
        return self._controller

    @property
    def packet_bytes(self) -> int:
        """Of a bulk endpoint at the speed that was agreed upon."""
        speed = (CONTROLLERS / self._controller / "current_speed").read_text().strip()
        return {"full-speed": 64, "high-speed": 512}.get(speed, 1024)

    def of_function(self, name: str) -> str:
        """What the function says about itself."""
        return (self._function / name).read_text().strip()

    def plug_in(self) -> None:
        """Show it to the host. Raises OSError where the controller is another's."""
        try:
            self._bind(self._controller)
        except OSError as error:
            cure = "another gadget uses it" if error.errno == errno.EBUSY else os.strerror(error.errno or 0)
            raise OSError(error.errno, f"{CONTROLLERS / self._controller}: {cure}") from error

    def unplug(self) -> None:
        """Take it from the host; harmless when repeated."""
        with suppress(OSError):
            self._bind("")

    def remove(self) -> None:
        """Unplug it, and forget it."""
        if not self._folder.exists():
            return
        self.unplug()
        (self._folder / "configs/c.1" / self._function.name).unlink(missing_ok=True)
        for function in (self._folder / "functions").iterdir():
            (self._folder / "configs/c.1" / function.name).unlink(missing_ok=True)
            function.rmdir()
        for folder in ("configs/c.1", f"strings/{_ENGLISH}", ""):
            with suppress(FileNotFoundError):
                (self._folder / folder).rmdir()

    def _check(self) -> None:
        if not _CONFIGFS.is_dir():
            raise FileNotFoundError(errno.ENOENT, f"no gadgets here; as root: {_MAKE}", str(_CONFIGFS))
        if not (CONTROLLERS / self._controller).exists():
            there = ", ".join(sorted(path.name for path in CONTROLLERS.iterdir()))
            cure = f"there is {there}" if there else "as root: modprobe dummy_hcd makes one"
            raise OSError(errno.ENODEV, f"no such device controller; {cure}", self._controller)

    def _make(self, identity: UsbIdentity) -> None:
        texts = {
            "idVendor": f"{identity.vendor:#06x}", "idProduct": f"{identity.product:#06x}", "bcdDevice": "0x0100",
            f"strings/{_ENGLISH}/manufacturer": identity.manufacturer, f"strings/{_ENGLISH}/product": identity.model,
            f"strings/{_ENGLISH}/serialnumber": identity.serial_number, "configs/c.1/MaxPower": "500",
        }  # fmt: skip
        for folder in ("", f"strings/{_ENGLISH}", "configs/c.1", f"functions/{self._function.name}"):
            (self._folder / folder).mkdir()
        for name, text in texts.items():
            (self._folder / name).write_text(text)
        (self._folder / "configs/c.1" / self._function.name).symlink_to(self._function)

    def _bind(self, controller: str) -> None:
        (self._folder / "UDC").write_text(f"{controller}\n")
