"""A simulated scanner on a real USB serial port: the kernel's own function for CDC ACM, /dev/ttyACM at the host."""

from __future__ import annotations

import os
import select
import time
import tty

from simulators.carriers import TerminalPort
from simulators.gadget import Gadget
from simulators.usb_descriptors import CDC_IDENTITY, UsbIdentity

_APPEARS_S = 5.0
_LOOK_S = 0.02  # the kernel makes the file, and udev its rights, a few of these later; nothing here is told of it


class TtyGadget(TerminalPort):
    """A serial port on USB; `read` and `write` are its far end.

    controller : which device controller it is plugged in by, as in /sys/class/udc.   rate_bytes_s : speed both ways.
    Needs root. Raises OSError, naming the cure.
    """

    def __init__(
        self, controller: str, identity: UsbIdentity | None = None, rate_bytes_s: float = float("inf")
    ) -> None:
        self.identity = identity or CDC_IDENTITY
        super().__init__(f"serial:{self.identity.address.removeprefix('usb:')}", rate_bytes_s)
        self._gadget = Gadget(controller, self.identity, "acm")
        self._terminal = f"/dev/ttyGS{self._gadget.of_function('port_num')}"
        self.plug_in()

    def plug_in(self) -> None:
        """Show it to the host."""
        self._open()
        self._gadget.plug_in()

    def hang_up(self) -> None:
        """Pull the plug."""
        self._gadget.unplug()
        os.close(self._master)
        self._master = -1

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """As Port.read; a host that resets the device hangs up, and it is opened anew."""
        data = super().read(max_bytes, timeout_s)
        if not data and self._has_hung_up():
            self._reopen()
        return data

    def write(self, data: bytes) -> None:
        """As PtyPort.write; what a host does not take that resets the device is lost."""
        try:
            super().write(data)
        except OSError:
            self._reopen()

    def close(self) -> None:
        """Unplug it for good."""
        super().close()
        self._gadget.remove()

    def _has_hung_up(self) -> bool:
        poll = select.poll()
        poll.register(self._master, 0)
        return bool(poll.poll(0))

    def _reopen(self) -> None:
        os.close(self._master)
        self._open()

    def _open(self) -> None:
        """The far end, which appears soon after the function is made."""
        until_s = time.monotonic() + _APPEARS_S
        while True:
            try:
                self._master = os.open(self._terminal, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                break
            except OSError:
                if time.monotonic() > until_s:
                    raise
                time.sleep(_LOOK_S)
        tty.setraw(self._master)
