"""What `bench capture` runs in processes of their own, so that each one's time and memory can be told from the others'.

    device LINK PATH SIZE BYTES_S TURN_S PORTION
                                            a simulated scanner; prints a line for each sweep: seconds, columns' bytes,
                                            processor time, how long the node kept it waiting
    bus PATH CABLE                          the emulated USB that a device is plugged into, CABLE the number of an open
                                            socket; prints the device's address and what a node's environment needs
    look URL CLIENTS                        clients that look as fast as they can, until SIGTERM; prints their updates
    read ADDRESS BYTES                      the USB driver alone, under umockdev's preload; prints seconds and CPU
    assemble [LATERAL RADIAL LEAN SIDE]     a grid of L from its columns, corrected for an axis that is there; prints
                                            seconds, processor time and memory
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np

PORTION_BYTES_MAX = 1 << 19
FOR_EVER_S = 3600.0
NICE = 19  # clients stand for other machines: they may have what is left of this one


def say(**record: Any) -> None:
    """One line for whoever started this."""
    print(json.dumps(record), flush=True)


class Cable:
    """A scanner's end of a cable to a bus in a process of its own, as a carrier's port: the two share no interpreter,
    as a scanner shares none with the USB that it is plugged into.

    rate_bytes_s : speed towards the node.  waited_s : for the node to fetch what was sent.
    """

    def __init__(self, path: str, rate_bytes_s: float) -> None:
        from simulators.pace import Pace

        self.waited_s = 0.0
        self._pace = Pace(rate_bytes_s)
        self._end, far_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)  # what is written stays one piece
        self._end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, PORTION_BYTES_MAX)
        command = [sys.executable, "-m", "tests.bench.capture_worker", "bus", path, str(far_end.fileno())]
        with far_end:
            self._bus = subprocess.Popen(command, pass_fds=[far_end.fileno()])

    def read(self, max_bytes: int, timeout_s: float) -> bytes:
        """What the node wrote."""
        ready, _, _ = select.select([self._end], [], [], timeout_s)
        return self._end.recv(max_bytes) if ready else b""

    def write(self, data: bytes) -> None:
        """Send `data` as one piece, at the pace of the line. Raises BrokenPipeError once the cable is cut."""
        if not data:
            return
        try:
            self._end.send(data, socket.MSG_DONTWAIT)
        except BlockingIOError:
            began_s = time.monotonic()
            self._end.send(data)
            self.waited_s += time.monotonic() - began_s
        self._pace.wait(len(data))

    def hang_up(self) -> None:
        """Pull the plug. This one has no faults."""
        raise NotImplementedError

    def plug_in(self) -> None:
        """Put it in again."""
        raise NotImplementedError

    def cancel(self) -> None:
        """Cut it: whoever reads or writes wakes."""
        self._end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Unplug for good."""
        self._bus.terminate()
        self._bus.wait()
        self._end.close()


def bus(path: str, cable: str) -> None:
    """Carry what comes by a cable to whoever reads the emulated USB, and back, until the cable is cut."""
    from simulators.usb_testbed import UsbTestbed

    def back() -> None:
        while True:
            if data := bed.read(PORTION_BYTES_MAX, FOR_EVER_S):
                end.send(data)

    portion = memoryview(bytearray(PORTION_BYTES_MAX))

    with socket.socket(fileno=int(cable)) as end, closing(UsbTestbed(Path(path))) as bed:
        say(address=bed.name, environment=bed.environment)
        threading.Thread(target=back, daemon=True).start()
        while size := end.recv_into(portion):
            bed.write(bytes(portion[:size]))


def device(link: str, path: str, size: str, rate_bytes_s: str, turn_s: str, portion: str) -> None:
    """A scanner that says how long each of its sweeps took. portion : bytes that it sends at once."""
    from protocol.framing import SERIAL_PAYLOAD_MAX, USB_PAYLOAD_MAX
    from protocol.scanner_messages import State
    from simulators.carriers import PtyPort, serve
    from simulators.command import BITS_PER_BYTE
    from simulators.scanner import SimulatedScanner
    from simulators.specimen import make_specimen
    from simulators.turntable import Turntable

    class Timed(SimulatedScanner):
        _began: tuple[float, float, int, float] | None = None
        _stands_since_s: float | None = None
        _stood_s = 0.0

        def data_to_send(self, max_bytes: int) -> bytes:
            data = super().data_to_send(max_bytes)
            now_s = time.monotonic()
            waited_s = port.waited_s if isinstance(port, Cable) else 0.0
            if self.state is State.SWEEPING and self._began is None:
                self._began = now_s, time.process_time(), self._link.sent_bytes, waited_s
                self._stood_s = 0.0
            elif self.state is State.HOLDING and self._began is not None:
                began_s, cpu_s, sent, waited_0_s = self._began
                spent = {"cpu_s": time.process_time() - cpu_s, "stood_s": self._stood_s + waited_s - waited_0_s}
                say(seconds=now_s - began_s, bytes=self._link.sent_bytes - sent, **spent)
                self._began = None
            if self._stands_since_s is not None:
                self._stood_s += now_s - self._stands_since_s
            self._stands_since_s = now_s if self._is_starved() else None
            return data

    is_usb = link == "usb"
    table = Turntable(make_specimen("head", size), turn_s=float(turn_s))
    scanner = Timed(table, payload_max=USB_PAYLOAD_MAX if is_usb else SERIAL_PAYLOAD_MAX)
    stop = threading.Event()
    port: Cable | PtyPort
    if is_usb:
        port = Cable(path, float(rate_bytes_s))
    else:
        port = PtyPort(Path(path), BITS_PER_BYTE * round(float(rate_bytes_s)))
        say(address=port.name, environment={})

    def end(*_: object) -> None:
        stop.set()
        port.cancel()

    signal.signal(signal.SIGTERM, end)
    with closing(port), suppress(BrokenPipeError):
        serve(scanner, port, stop, int(portion))


def look(url: str, clients: str) -> None:
    """Clients that are never content."""
    os.nice(NICE)
    updates = asyncio.run(_look(url, int(clients)))
    say(updates=updates)


async def _look(url: str, clients: int) -> int:
    """Foveae over HTTP: as much work for the node as a look on a stream, and hardly any for who asks."""
    import aiohttp

    stop = asyncio.Event()
    asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, stop.set)
    updates = 0

    async def one(number: int, http: aiohttp.ClientSession, scan: str) -> None:
        nonlocal updates
        rng = random.Random(number)
        while True:
            place = {"u": f"{rng.random():.6f}", "v": f"{rng.random():.6f}"}
            async with http.get(f"{url}/v1/scans/{scan}/fovea", params=place) as response:
                response.raise_for_status()
                await response.read()
            updates += 1

    async with aiohttp.ClientSession() as http:
        async with http.get(f"{url}/v1/scans/latest") as response:
            scan = (await response.json())["id"]
        tasks = [asyncio.create_task(one(number, http, scan)) for number in range(clients)]
        while not updates:
            await asyncio.sleep(0.1)
            for task in tasks:
                if task.done():
                    task.result()
        say(looking=clients)
        await stop.wait()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return updates


def read(address: str, size_bytes: str) -> None:
    """Everything that a device sends, thrown away."""
    from drivers.usb_port import UsbAddress, UsbPort

    with closing(UsbPort(UsbAddress.parse(address))) as port:
        port.write(b"go")
        left, began_s, cpu_s = int(size_bytes), 0.0, 0.0
        while left > 0:
            data = port.read(1 << 20 if began_s else 1, 5)
            if not began_s:
                began_s, cpu_s, left = time.monotonic(), time.process_time(), left + 1  # from the first byte on
            left -= len(data)
        say(seconds=time.monotonic() - began_s, cpu_s=time.process_time() - cpu_s)


def assemble(*axis: str) -> None:
    """A sweep at L whose last column has just come; memory is what it took beyond the program itself.

    axis : lateral, radial, lean, side; to be corrected for.
    """
    from exchange.formats import SIZES
    from node.assemble import Assembler
    from node.axis import Axis
    from node.resampling import Encoder
    from protocol.grid import GridSpec

    width, height, texture_width, texture_height = SIZES["L"]
    spec = GridSpec(width, height, texture_width, texture_height, 0.01, 0.1)
    Assembler(GridSpec(8, 8, 8, 8, 0.01, 0.1), Encoder(64))
    before = _peak_bytes()
    counts = 2 * texture_width
    assembler = Assembler(spec, Encoder(counts))
    wave = 200 * np.sin(np.arange(height) / 99)
    for column in range(width):
        shape = 5000 + wave + 300 * np.sin(2 * np.pi * column / width)
        assembler.add_range_column(4 * column + 2, 0, shape.astype(np.uint16))
    texels = np.random.default_rng(7).integers(0, 256, (texture_height, 3), np.uint8)
    for column in range(texture_width):
        assembler.add_texture_column(2 * column + 1, 0, np.roll(texels, column, axis=0))
    began_s, began_cpu_s = time.perf_counter(), time.process_time()
    grid = assembler.assembly(axis=Axis(*map(float, axis)) if axis else None).grid
    took_s, cpu_s = time.perf_counter() - began_s, time.process_time() - began_cpu_s
    arrays = grid.range_steps.nbytes + grid.texture.nbytes
    say(seconds=took_s, cpu_s=cpu_s, arrays_bytes=arrays, peak_bytes=_peak_bytes() - before)


def _peak_bytes() -> int:
    """The most that this process has had; ru_maxrss would begin with what its parent has."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmHWM:")[1].split()[0])


JOBS: dict[str, Callable[..., None]] = {"device": device, "bus": bus, "look": look, "read": read, "assemble": assemble}

if __name__ == "__main__":
    JOBS[sys.argv[1]](*sys.argv[2:])
