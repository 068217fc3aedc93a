"""libusb as pyusb has it, but for reads from bulk endpoints: several are kept pending, by libusb's asynchronous calls.

A read that is begun when somebody wants it lets the device wait until then. Here the kernel always has a place for what
the device sends, nobody needs a thread for that, and where packets end a transfer early, as many transfers as have
ended are taken at once.
"""

from __future__ import annotations

import ctypes
import errno
import threading
import time
from collections import deque
from contextlib import suppress
from typing import Any

import usb.core

PENDING = 16  # reads; together they hold a tenth of a second at full speed, and a quarter of what a kernel lends to all
_WITHDRAWN_S = 2.0  # a kernel takes no longer to give a read up
_BULK = 2
_RUNNING = -1  # instead of the length of what came, which libusb writes last
_COMPLETED = 0
_PIPE = -9
_ERROR_OF = {1: -1, 2: -7, 3: -10, 4: _PIPE, 5: -4, 6: -8}  # libusb's error for what became of a transfer
_ERRNO_OF = {
    -1: errno.EIO, -3: errno.EACCES, -4: errno.ENODEV, -7: errno.ETIMEDOUT, -8: errno.EOVERFLOW, _PIPE: errno.EPIPE,
    -10: errno.EINTR, -11: errno.ENOMEM,
}  # fmt: skip


class _Transfer(ctypes.Structure):
    """libusb_transfer. `callback` stays NULL: libusb then calls nobody, and whoever waits looks at `actual_length`."""

    _fields_ = [
        ("device", ctypes.c_void_p), ("flags", ctypes.c_uint8), ("endpoint", ctypes.c_ubyte), ("type", ctypes.c_ubyte),
        ("timeout_ms", ctypes.c_uint), ("status", ctypes.c_int), ("length", ctypes.c_int),
        ("actual_length", ctypes.c_int), ("callback", ctypes.c_void_p), ("user_data", ctypes.c_void_p),
        ("buffer", ctypes.c_void_p), ("iso_packets", ctypes.c_int),
    ]  # fmt: skip


class _Time(ctypes.Structure):
    """timeval."""

    _fields_ = [("seconds", ctypes.c_long), ("microseconds", ctypes.c_long)]


_P, _INT = ctypes.c_void_p, ctypes.c_int
_PROTOTYPES: dict[str, tuple[Any, ...]] = {  # what it returns, what it takes
    "alloc_transfer": (_P, _INT), "free_transfer": (None, _P), "submit_transfer": (_INT, _P),
    "cancel_transfer": (_INT, _P), "handle_events_timeout_completed": (_INT, _P, _P, _P),
    "interrupt_event_handler": (None, _P), "strerror": (ctypes.c_char_p, _INT),
}  # fmt: skip


class ReadingAhead:
    """pyusb's backend for libusb 1.0, wrapped: everything but reading is left to it. For one device and one thread.

    `interrupt` may be called from another thread.
    """

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self._libusb = {
            name: ctypes.CFUNCTYPE(*types)(("libusb_" + name, backend.lib)) for name, types in _PROTOTYPES.items()
        }
        self._interrupted = threading.Event()
        self._queues: dict[int, _Queue] = {}

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def interrupt(self) -> None:
        """Have the read that waits, or else the next one, end as if its time were over."""
        self._interrupted.set()
        self._libusb["interrupt_event_handler"](self._backend.ctx)

    def bulk_read(self, handle: Any, endpoint: int, interface: int, buffer: Any, timeout_ms: int) -> int:
        """What has come, as much as there is room for; else what comes first. Raises USBTimeoutError, USBError.

        buffer : as large as it was at the first time, which is how much a read asks for.
        """
        if endpoint not in self._queues:
            self._queues[endpoint] = _Queue(self._libusb, self._backend.ctx, handle.handle, endpoint, len(buffer))
        queue, until_s, view = self._queues[endpoint], time.monotonic() + timeout_ms / 1000, memoryview(buffer)
        while not (size := queue.take(view)):
            left_s = until_s - time.monotonic()
            if left_s <= 0 or self._interrupted.is_set():
                self._interrupted.clear()
                raise usb.core.USBTimeoutError(*_said(self._libusb, -7))
            queue.wait(left_s)
        return size

    def clear_halt(self, handle: Any, endpoint: int) -> None:
        """As pyusb's; nothing may be pending meanwhile."""
        if endpoint in self._queues:
            self._queues[endpoint].withdraw()
        self._backend.clear_halt(handle, endpoint)

    def release_interface(self, handle: Any, interface: int) -> None:
        """As pyusb's; what has come and was not read is lost."""
        for queue in self._queues.values():
            queue.close()
        self._queues.clear()
        self._backend.release_interface(handle, interface)


class _Read:
    """A read of a size, and the memory it goes to."""

    def __init__(self, transfer: int, device: Any, endpoint: int, size: int) -> None:
        self.address = transfer
        self.memory = ctypes.create_string_buffer(size)
        self.view = memoryview(self.memory).cast("B")
        self.transfer = _Transfer.from_address(transfer)
        self.transfer.device, self.transfer.endpoint, self.transfer.type = device, endpoint, _BULK
        self.transfer.buffer, self.transfer.length = ctypes.addressof(self.memory), size

    @property
    def is_done(self) -> bool:
        """Whether it has ended, however."""
        return bool(self.transfer.actual_length != _RUNNING)


class _Queue:
    """The reads of one endpoint, in the order in which they were begun, which is the order in which they end."""

    def __init__(self, libusb: dict[str, Any], context: Any, device: Any, endpoint: int, size: int) -> None:
        self._libusb = libusb
        self._context = context
        transfers = [libusb["alloc_transfer"](0) for _ in range(PENDING)]
        self._idle = [_Read(transfer, device, endpoint, size) for transfer in transfers]
        self._pending: deque[_Read] = deque()
        self._left = b""  # of reads that were withdrawn

    def take(self, into: memoryview) -> int:
        """What has come, put `into`, as many reads as fit whole: where a read ends, most often a frame does. 0 when
        there is nothing. Raises USBError once all before it is taken."""
        size = min(len(self._left), len(into))
        into[:size], self._left = self._left[:size], self._left[size:]
        self._submit()
        while self._pending and self._pending[0].is_done:
            read = self._pending[0]
            end = size + read.transfer.actual_length
            if end > len(into):
                break
            into[size:end] = read.view[: end - size]
            size = end
            if read.transfer.status != _COMPLETED:
                read.transfer.actual_length = 0
                if size:
                    break
                raise self._error(_ERROR_OF.get(read.transfer.status, -1))
            self._idle.append(self._pending.popleft())
            self._submit()
        return size

    def wait(self, timeout_s: float) -> None:
        """Until something happens, most likely to the first read. Raises USBError.

        What another thread had happen meanwhile, for a port of its own, is seen only once the time is over.
        """
        time_ = _Time(int(timeout_s), int(timeout_s % 1 * 1e6))
        code = self._libusb["handle_events_timeout_completed"](self._context, ctypes.byref(time_), None)
        if code < 0 and code != -10:
            raise self._error(code)

    def withdraw(self) -> None:
        """Give up what is pending; what had come stays to be taken."""
        for read in self._pending:
            self._libusb["cancel_transfer"](read.address)
        until_s = time.monotonic() + _WITHDRAWN_S
        while self._is_running() and (left_s := until_s - time.monotonic()) > 0:
            self.wait(left_s)
        if self._is_running():
            raise self._error(-1)
        self._left += b"".join(read.view[: read.transfer.actual_length] for read in self._pending)
        self._idle += self._pending
        self._pending.clear()

    def close(self) -> None:
        """Withdraw and free all; what a kernel does not give up is left to it, since it may still write there."""
        with suppress(usb.core.USBError):
            self.withdraw()
        _LENT.extend(self._pending)
        for read in self._idle:
            self._libusb["free_transfer"](read.address)

    def _is_running(self) -> bool:
        return not all(read.is_done for read in self._pending)

    def _submit(self) -> None:
        """Begin every read that can be. A kernel that has no memory for so many, or has lost the device, is told of
        when nothing is pending any more. Raises USBError then."""
        while self._idle:
            self._idle[-1].transfer.actual_length = _RUNNING
            code = self._libusb["submit_transfer"](self._idle[-1].address)
            if code and not self._pending:
                raise self._error(code)
            if code:
                break
            self._pending.append(self._idle.pop())

    def _error(self, code: int) -> usb.core.USBError:
        return usb.core.USBError(*_said(self._libusb, code))


_LENT: list[_Read] = []


def _said(libusb: dict[str, Any], code: int) -> tuple[str, int, int]:
    """An error of libusb as pyusb's exceptions take it."""
    return libusb["strerror"](code).decode(), code, _ERRNO_OF.get(code, errno.EIO)
