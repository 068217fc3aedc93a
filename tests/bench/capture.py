"""`bench capture`: what a sweep costs the node, and whether looking clients cost the sweep anything.

Scanner, node, clients and driver are processes of their own, and so is the emulated USB, which is neither's. What it
does inside the node, as umockdev's preload, counts as the node's; only that it sleeps for 0 s at every ioctl, which the
kernel takes for its timer's slack of 50 us and which no real USB does, is taken out. Durations are the scanner's own:
from the first column to the last. Compared are sweeps of one run, taken in turn; a figure is a median.

Processor time tells more than the clock on a machine that others use, too: it is given as a share of a core, of the
node and of the scanner's process each, and for the node also as the share that the full speed of the link would take.
Whether a node slows a sweep shows best in how long it kept the scanner waiting: for credit, or to fetch what it sends.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import IO, Any

from foveascan import started
from protocol.errors import ConfigError
from simulators.carriers import PORTION_BYTES
from simulators.command import USB_PORTION_BYTES
from tests.bench.timing import MEGABYTE

SERIAL_BYTES_S, USB_BYTES_S = 300_000, 35_000_000
CLIENTS = 16
WORKER = [sys.executable, "-m", "tests.bench.capture_worker"]
ROOT = Path(__file__).parents[2]
DRIVER_BYTES, PACED_BYTES = 256_000_000, 64_000_000
SWEEP_LASTS = 3  # repetitions of anything else: so many times less often is a sweep repeated
AWAY_S = 0.6
PASSES = 4  # of M over USB: long enough to be measured
UNPACED = float("inf")
POLL_S = 0.1
OFF_AXIS = ("0.8", "-0.5", "0.005", "-0.004")
SETTLED_S = 1.0
BEGIN_S, WINDOW_S, UNPACED_WINDOW_S = 0.5, 2.0, 1.0  # of a sweep; in between the node is asked nothing
UNPACED_PASSES = 8
READS = {"64 KiB": 59_300, "256 KiB": USB_PORTION_BYTES}  # what a device sends at once, to fill so much with a column
PR_SET_TIMERSLACK = 29  # heirs have it too
KEY = b"a key that nothing else is sealed with"


@dataclass
class Line:
    """A scanner and a node that run: what the scanner says of its sweeps, and what the node is known by."""

    url: str
    pid: int
    said: IO[str]
    sweeps: list[dict[str, Any]] = field(default_factory=list)


def run(repeats: int) -> dict[str, Any]:
    """Everything, each a third as often as `repeats` says. Raises ConfigError where USB cannot be emulated."""
    from simulators.usb_preload import PRELOAD, is_available

    if not is_available():
        raise ConfigError(f"bench: no {PRELOAD} here: apt-get install umockdev libusb-1.0-0")
    ctypes.CDLL(None).prctl(PR_SET_TIMERSLACK, 1)
    repeats = max(1, repeats // SWEEP_LASTS)
    return {
        "repeats": repeats,
        "clients": CLIENTS,
        "serial": sweeps("pty", "S", SERIAL_BYTES_S, 1, repeats),
        "usb": sweeps("usb", "M", USB_BYTES_S, PASSES, repeats),
        "unpaced": {reads: unpaced(repeats, portion) for reads, portion in READS.items()},
        "sealed": sealed(repeats),
        "driver": {str(portion): driver(portion, repeats) for portion in (1 << 16, 1 << 18)},
        "driver_paced": driver(1 << 16, repeats, USB_BYTES_S, PACED_BYTES),
        "recovery_s": recovery(repeats),
        "assembly": assembly(repeats),
        "assembly_off_axis": assembly(repeats, *OFF_AXIS),
    }


def sweeps(link: str, size: str, rate_bytes_s: float, passes: int, repeats: int) -> dict[str, Any]:
    """Sweeps at the full speed of a link, by turns alone and while clients look as fast as they can."""
    with line(link, size, rate_bytes_s, passes) as running:
        sweep(running)  # the first scan, for the clients to look at; unmeasured
        alone, beside, updates = [], [], 0
        for _ in range(repeats):
            alone.append(sweep(running))
            with looking(running.url) as told:
                beside.append(sweep(running))
            updates += told[-1]["updates"]
    return {
        "size": size, "bytes": alone[0]["bytes"], "rate_aimed_at": rate_bytes_s, "updates": updates,
        "alone": _medians(alone), "beside_clients": _medians(beside),
        "slower": median(sweep["seconds"] for sweep in beside) / median(sweep["seconds"] for sweep in alone) - 1,
        "lost_columns": sum(sweep["lost_columns"] for sweep in alone + beside),
    }  # fmt: skip


def unpaced(repeats: int, portion_bytes: int) -> dict[str, float]:
    """The whole way of a column, from USB to journal and assembler, as fast as scanner and node can."""
    with line("usb", "M", UNPACED, UNPACED_PASSES, portion_bytes) as running:
        sweep(running, UNPACED_WINDOW_S)  # the scanner then has its columns at hand
        swept = [sweep(running, UNPACED_WINDOW_S) for _ in range(repeats)]
    return {**_medians(swept), "lost_columns": sum(sweep["lost_columns"] for sweep in swept)}


def sealed(repeats: int) -> dict[str, Any]:
    """Sweeps at the full speed of USB into a sealed library; or why there can be none here."""
    from protocol.errors import LibraryError

    try:
        with line("usb", "M", USB_BYTES_S, PASSES, is_sealed=True) as running:
            sweep(running)
            swept = [sweep(running) for _ in range(repeats)]
    except LibraryError as problem:
        return {"why_not": str(problem)}
    lost = sum(sweep["lost_columns"] for sweep in swept)
    return {**_medians(swept), "rate_aimed_at": USB_BYTES_S, "lost_columns": lost}


def sweep(running: Line, window_s: float = WINDOW_S) -> dict[str, Any]:
    """One sweep: what the scanner said of it, and what the node took for it."""
    core, lost = asyncio.run(_sweep(running, window_s))
    said = json.loads(running.said.readline())
    mb_s = said["bytes"] / MEGABYTE / said["seconds"]
    return {
        "seconds": said["seconds"],
        "bytes": said["bytes"],
        "mb_s": mb_s,
        "core": core,
        "cpu_s_per_mb": core / mb_s,
        "scanner_core": said["cpu_s"] / said["seconds"],
        "waiting": said["stood_s"] / said["seconds"],
        "lost_columns": lost,
    }


async def _sweep(running: Line, window_s: float) -> tuple[float, int]:
    """The node's share of a core while columns came, and how many it had to ask for again."""
    from client import connect
    from tests.bench.ours import surveyed

    async with connect(running.url) as session:
        published = session.published()
        while (await session.scanner())["phase"] != "ready":
            await asyncio.sleep(POLL_S)
        await surveyed(running.url)  # what the node does with the scan before is no part of this sweep
        await asyncio.sleep(SETTLED_S)
        await session.start_sweep()
        await asyncio.sleep(BEGIN_S)
        first = time.monotonic(), _cpu_s(running.pid)
        await asyncio.sleep(window_s)
        last = time.monotonic(), _cpu_s(running.pid)
        assert (await session.scanner())["phase"] == "sweeping"
        quality = await session.quality(await anext(published))
    assert quality is not None
    return (last[1] - first[1]) / (last[0] - first[0]), quality.requested_columns


def driver(
    portion_bytes: int, repeats: int, rate_bytes_s: float = UNPACED, size_bytes: int = DRIVER_BYTES
) -> dict[str, float]:
    """The USB driver alone on the real libusb: MB/s, and its share of a core, the emulation's work included."""
    from simulators.usb_testbed import UsbTestbed

    data = bytes(portion_bytes)
    rates, shares = [], []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory(prefix="fs-") as folder, ExitStack() as stack:
            bed = stack.enter_context(closing(UsbTestbed(Path(folder), rate_bytes_s=rate_bytes_s)))
            with worker("read", bed.name, str(size_bytes), environment=bed.environment) as said:
                bed.read(1 << 16, 30)
                sending = threading.Thread(target=_flood, args=(bed, data, size_bytes))
                sending.start()
                told = json.loads(said.readline())
                sending.join()
        rates.append(size_bytes / MEGABYTE / told["seconds"])
        shares.append(told["cpu_s"] / told["seconds"])
    return {"mb_s": median(rates), "core": median(shares)}


def _flood(bed: Any, data: bytes, size_bytes: int) -> None:
    for _ in range(size_bytes // len(data) + 2):
        bed.write(data)


def recovery(repeats: int) -> float:
    """From the plug's coming back to the first column that is sent again. [s]"""
    from protocol.framing import USB_PAYLOAD_MAX
    from protocol.scanner_messages import Hello, RangeColumn, TextureColumn
    from simulators.carriers import serve
    from simulators.faults import FaultyScanner, parse_faults, split_frames
    from simulators.scanner import SimulatedScanner
    from simulators.specimen import make_specimen
    from simulators.turntable import Turntable
    from simulators.usb_testbed import UsbTestbed

    class Noting(UsbTestbed):
        plugged_s: float | None = None

        def plug_in(self) -> None:
            super().plug_in()
            self.plugged_s = time.monotonic()

    class Returning(FaultyScanner):
        columns_s: float | None = None
        is_greeted = False

        def receive_data(self, data: bytes, now_s: float) -> None:
            is_back = bed.plugged_s is not None and bed.plugged_s > began_s
            self.is_greeted |= is_back and any(frame[3] == Hello.TYPE for frame in split_frames(data))
            super().receive_data(data, now_s)

        def data_to_send(self, max_bytes: int) -> bytes:
            data = super().data_to_send(max_bytes)
            if self.is_greeted and self.columns_s is None and any(frame[3] in COLUMNS for frame in split_frames(data)):
                self.columns_s = time.monotonic()
            return data

    COLUMNS = (RangeColumn.TYPE, TextureColumn.TYPE)
    specimen, took = make_specimen("head", "S"), []
    for seed in range(repeats):
        faults = parse_faults(f"unplug={AWAY_S}")[0]
        with tempfile.TemporaryDirectory(prefix="fs-") as folder, ExitStack() as stack:
            began_s = float("inf")
            bed = stack.enter_context(closing(Noting(Path(folder, "usb"), rate_bytes_s=1e6)))
            scanner = Returning(
                lambda boot: SimulatedScanner(Turntable(specimen), boot_id=boot, payload_max=USB_PAYLOAD_MAX),
                faults,
                seed,
            )
            stop = threading.Event()
            thread = threading.Thread(target=serve, args=(scanner, bed, stop))
            thread.start()
            stack.callback(thread.join)
            stack.callback(bed.cancel)
            stack.callback(stop.set)
            _, ready = stack.enter_context(_node(folder, bed.name, bed.environment, 1))
            began_s = time.monotonic()
            asyncio.run(_published(ready["url"]))
        assert scanner.columns_s is not None and bed.plugged_s is not None
        took.append(scanner.columns_s - bed.plugged_s)
    return median(took)


async def _published(url: str) -> None:
    from client import connect

    async with connect(url) as session:
        published = session.published()
        while (await session.scanner())["phase"] != "ready":
            await asyncio.sleep(POLL_S)
        await session.start_sweep()
        await anext(published)


def assembly(repeats: int, *axis: str) -> dict[str, float]:
    """A grid of L, its quality and repairs, after its last column: seconds, and memory as a multiple of its arrays.

    axis : lateral, radial, lean, side of one that it is corrected for.
    """
    told = []
    for _ in range(repeats):
        with worker("assemble", *axis) as said:
            told.append(json.loads(said.readline()))
    return {
        "seconds": median(one["seconds"] for one in told),
        "cpu_s": median(one["cpu_s"] for one in told),
        "times_arrays": median(one["peak_bytes"] / one["arrays_bytes"] for one in told),
    }


@contextmanager
def line(
    link: str, size: str, rate_bytes_s: float, passes: int, portion_bytes: int | None = None, is_sealed: bool = False
) -> Iterator[Line]:
    """A scanner whose table waits for nothing but its line, and a node.

    Raises LibraryError where its library shall be sealed and this machine cannot do that.
    """
    path, at_once = ("usb", USB_PORTION_BYTES) if link == "usb" else ("tty", PORTION_BYTES)
    with tempfile.TemporaryDirectory(prefix="fs-") as folder, ExitStack() as stack:
        arguments = (link, f"{folder}/{path}", size, str(rate_bytes_s), "0.05", str(portion_bytes or at_once))
        said = stack.enter_context(worker("device", *arguments))
        scanner = json.loads(said.readline())
        if is_sealed:
            stack.enter_context(_sealed_library(Path(folder, "library")))
        process, ready = stack.enter_context(_node(folder, scanner["address"], scanner["environment"], passes))
        yield Line(ready["url"], process.pid, said)


def _sealed_library(folder: Path) -> AbstractContextManager[Path]:
    from node.sealed import make_sealed, opened, sealed_folder

    make_sealed(sealed_folder(folder), KEY)
    return opened(sealed_folder(folder), folder, KEY)


@contextmanager
def looking(url: str) -> Iterator[list[dict[str, Any]]]:
    """Clients at work; when they are stopped, what they did is the last in the list."""
    told: list[dict[str, Any]] = []
    with worker("look", url, str(CLIENTS)) as said:
        told.append(json.loads(said.readline()))
        time.sleep(SETTLED_S)
        yield told
    told.append(json.loads(said.readline()))


@contextmanager
def worker(*arguments: str, environment: dict[str, str] | None = None) -> Iterator[IO[str]]:
    """A process of tests/bench/capture_worker.py; its output, which can be read to its end after it was ended."""
    process = subprocess.Popen(
        [*WORKER, *arguments], stdout=subprocess.PIPE, text=True, cwd=ROOT, env={**os.environ, **(environment or {})}
    )
    assert process.stdout is not None
    try:
        yield process.stdout
    finally:
        process.terminate()
        process.wait(60)


def _node(folder: str, scanner: str, environment: dict[str, str], passes: int) -> Any:
    config = Path(folder, "node.toml")
    config.write_text(f"[capture]\npasses = {passes}\n[discovery]\nenabled = false\n")
    serve = ["serve", "--config", str(config), "--scanner", scanner, "--library", f"{folder}/library"]
    return started(*serve, "--listen", "127.0.0.1:0", "--insecure", "--json", environment=environment)


def _cpu_s(pid: int) -> float:
    """CPU that a process has had, all threads together. [s]"""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _medians(swept: list[dict[str, Any]]) -> dict[str, float]:
    names = ("seconds", "mb_s", "core", "cpu_s_per_mb", "scanner_core", "waiting")
    return {name: median(one[name] for one in swept) for name in names}


def told(record: dict[str, Any]) -> str:
    """The figures as text."""
    lines = [f"medians of {record['repeats']}; {record['clients']} clients looking as fast as they can"]
    for name in ("serial", "usb"):
        found, alone, beside = record[name], record[name]["alone"], record[name]["beside_clients"]
        rate = found["rate_aimed_at"] / MEGABYTE
        lines += [
            f"{name}, {found['size']}: {alone['mb_s']:.2f} MB/s of {rate:.2f}; {_shares(alone)};"
            f" at {rate:.2f} MB/s {_percent(alone['cpu_s_per_mb'] * rate)} of a core",
            f"{name} beside clients: {beside['mb_s']:.2f} MB/s, {100 * found['slower']:+.1f} % in time"
            f" ({found['updates']} updates); {_percent(beside['waiting'])} of it the scanner waited for the node,"
            f" alone {_percent(alone['waiting'])}; {found['lost_columns']} columns lost",
        ]
    for reads, free in record["unpaced"].items():
        what = f"USB unpaced, whole capture, reads of {reads}"
        lines.append(f"{what}: {free['mb_s']:.0f} MB/s; {_shares(free)}; {free['lost_columns']} lost")
    lines.append(_sealed_in_words(record["sealed"]))
    for portion, found in record["driver"].items():
        share = f"{_percent(found['core'])} of a core"
        lines.append(f"USB driver alone, unpaced, writes of {portion} bytes: {found['mb_s']:.0f} MB/s, {share}")
    paced = record["driver_paced"]
    lines.append(f"USB driver alone, paced: {paced['mb_s']:.0f} MB/s, {_percent(paced['core'])} of a core")
    lines.append(f"first column after the plug is back: {record['recovery_s']:.2f} s")
    for name, what in (("assembly", ""), ("assembly_off_axis", ", corrected for an axis that leans off centre")):
        grid = record[name]
        took = f"{grid['seconds']:.2f} s, {grid['cpu_s']:.2f} s of processor time"
        lines.append(f"a grid of L after its last column{what}: {took}, {grid['times_arrays']:.2f} times its arrays")
    return "\n".join(lines)


def _shares(found: dict[str, float]) -> str:
    return f"node {_percent(found['core'])}, scanner {_percent(found['scanner_core'])} of a core"


def _sealed_in_words(found: dict[str, Any]) -> str:
    if "why_not" in found:
        return f"usb into a sealed library: not measured: {found['why_not']}"
    return (
        f"usb into a sealed library, M: {found['mb_s']:.2f} MB/s of {found['rate_aimed_at'] / MEGABYTE:.2f};"
        f" {_shares(found)}, without gocryptfs's; {_percent(found['waiting'])} of it the scanner waited for the node;"
        f" {found['lost_columns']} columns lost"
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"
