"""A simulated scanner on real USB: bulk endpoints of a gadget by the kernel's FunctionFS, as a carrier's port.

Two threads serve the endpoints, since nothing but a thread can wait for one: what a carrier writes waits for the one
that sends, what the other receives waits for the carrier.
"""

from __future__ import annotations

import os
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

from simulators.gadget import Gadget
from simulators.usb_descriptors import BULK_IN, BULK_OUT, UsbIdentity, bulk_endpoint, bulk_interface
from simulators.usb_pipes import UsbPipes

_RETRY_S = 0.005  # nothing tells when a host takes the device up
_DESCRIPTORS_MAGIC, _STRINGS_MAGIC = 3, 2
SUPER_SPEED_PACKET_BYTES = 1024
_SPEEDS = ((1, 64), (2, 512), (4, SUPER_SPEED_PACKET_BYTES))  # FunctionFS' flag for it, bytes of a packet
_BURST = 15  # packets more, before a host of super speed answers

T = TypeVar("T")


class UsbGadget(UsbPipes):
    """A device with a bulk endpoint each way; `read` and `write` are its end.

    controller : which device controller it is plugged in by, as in /sys/class/udc.   rate_bytes_s : speed towards the
    node.  Needs root. Raises OSError, naming the cure.
    """

    def __init__(
        self, controller: str, identity: UsbIdentity | None = None, rate_bytes_s: float = float("inf")
    ) -> None:
        super().__init__(rate_bytes_s)
        self.identity = identity or UsbIdentity()
        self.name = self.identity.address
        self._is_closed = False
        self._plugged_in = 0  # how often
        self._gadget = Gadget(controller, self.identity, "ffs")
        self._folder = Path(tempfile.mkdtemp(prefix="foveascan-gadget-"))
        subprocess.run(["mount", "-t", "functionfs", self._gadget.name, self._folder], check=True)
        self._control = os.open(self._folder / "ep0", os.O_RDWR)
        for words in (_descriptors(), struct.pack("<IIII", _STRINGS_MAGIC, 16, 0, 0)):
            os.write(self._control, words)
        self._sink, self._source = (os.open(self._folder / name, os.O_RDWR | os.O_NONBLOCK) for name in ("ep1", "ep2"))
        self._threads = [threading.Thread(target=pump, daemon=True) for pump in (self._send, self._receive)]
        self.plug_in()
        for thread in self._threads:
            thread.start()

    def hang_up(self) -> None:
        """Pull the plug; what was on its way is lost."""
        self._gadget.unplug()
        with self._changed:
            self._plugged_in += 1
            self._out.clear()
            self._in.clear()
            self._fetched()

    def plug_in(self) -> None:
        """Put it in again."""
        self._gadget.plug_in()

    def close(self) -> None:
        """Unplug it for good."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self.hang_up()
        for thread in self._threads:
            thread.join()
        for descriptor in (self._sink, self._source, self._control):
            os.close(descriptor)
        subprocess.run(["umount", self._folder], check=True)
        self._folder.rmdir()
        self._gadget.remove()

    # -- the endpoints ---------------------------------------------------------------------------------------------

    def _send(self) -> None:
        """Hand what waits to the host: the last packet of each write is short, or of length zero."""
        while not self._is_closed:
            with self._changed:
                self._changed.wait_for(lambda: self._out or self._is_closed)
                data = self._out.popleft() if self._out else memoryview(b"")
                self._fetched()
            if data:
                self._transfer(lambda: os.read(self._sink, 1), lambda: os.write(self._sink, data))  # noqa: B023
                if len(data) % self._gadget.packet_bytes == 0:
                    self._transfer(None, lambda: os.write(self._sink, b""))

    def _receive(self) -> None:
        """Take what the host sends: packet by packet, since behind a whole one it says nothing of an end."""
        while not self._is_closed:
            size = self._gadget.packet_bytes
            data = self._transfer(lambda: os.write(self._source, b"x"), lambda: os.read(self._source, size))  # noqa: B023
            if data:
                with self._changed:
                    self._in.append(data)
                    self._changed.notify_all()

    def _transfer(self, halt: Callable[[], object] | None, transfer: Callable[[], T]) -> T | None:
        """Transfer once the host has taken the device up, after a halt if one is due; None when the plug was pulled.

        FunctionFS halts an endpoint that is used in the wrong direction.
        """
        plugged_in = self._plugged_in
        while not self._is_closed and plugged_in == self._plugged_in:
            try:
                if halt is not None and self._shall_halt():
                    with suppress(OSError):
                        halt()
                return transfer()
            except BlockingIOError:
                time.sleep(_RETRY_S)
            except OSError:
                break
        return None

    def _shall_halt(self) -> bool:
        with self._changed:
            self.stalls, before = max(self.stalls - 1, 0), self.stalls
            return before > 0


def _descriptors() -> bytes:
    """The interface at every speed, as FunctionFS takes it."""
    flags, counts, bodies = 0, b"", b""
    for flag, packet_bytes in _SPEEDS:
        ends = [bulk_endpoint(address, packet_bytes) for address in (BULK_IN, BULK_OUT)]
        if packet_bytes == SUPER_SPEED_PACKET_BYTES:
            ends = [end + struct.pack("<BBBBH", 6, 0x30, _BURST, 0, 0) for end in ends]
        flags |= flag
        counts += struct.pack("<I", 1 + len(ends) * (2 if len(ends[0]) > 7 else 1))
        bodies += bulk_interface() + b"".join(ends)
    size = 12 + len(counts) + len(bodies)
    return struct.pack("<III", _DESCRIPTORS_MAGIC, size, flags) + counts + bodies
