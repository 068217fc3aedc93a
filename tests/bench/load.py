"""`bench load`: hundreds of viewers on one node while its scanner sweeps: waits, errors, memory, who pays for whom."""

from __future__ import annotations

import asyncio
import os
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import msgspec

from client import connect
from foveascan import started
from protocol.errors import FoveascanError
from tests.bench.scans import BenchScan
from tests.bench.viewers import Orders, Report

ROOT = Path(__file__).parents[2]
SWEPT = "nutcracker"  # another object than the one looked at, so another scan
SWEEP_SHARE = 0.6  # of the time, at the scanner's pace: what comes after it is to be seen, too
PLACES = 400
WARM_CLICKS, IDLE_CLICKS = 8, 40
STALL_CLICKERS, STALL_S, STALL_TURNS = 4, 2.0, 7
SAMPLE_S = 0.5
CALM_S = 20.0  # in which a node gives freed memory back once
SETTINGS = """
[capture]
scanner = "{scanner}"
[server]
listen = "127.0.0.1:0"
insecure = true
max_clients = 1024
[limits]
connections = 2048
[library]
folder = "{folder}/library"
spheres = false
[planner]
cold_start_bytes_s = 1e8
[discovery]
enabled = false
[log]
level = "error"
"""


def run(scan: BenchScan, size: str, seconds: float, viewers: int, clickers: int) -> dict[str, Any]:
    """All figures. seconds : of clicking twice a second. Raises FoveascanError where the viewers cannot be run."""
    with tempfile.TemporaryDirectory(prefix="foveascan-load-") as folder:
        scan.published(Path(folder) / "library")
        rate = 1.1 * (2 * scan.grid.range_steps.nbytes + scan.grid.texture.nbytes) / (SWEEP_SHARE * seconds)
        simulate = ["simulate", "--path", f"{folder}/scanner", "--size", size, "--link-rate", f"{rate:.0f}"]
        with started(*simulate, "--specimen", SWEPT, "--json") as (_, scanner):
            (Path(folder) / "node.toml").write_text(SETTINGS.format(scanner=scanner["path"], folder=folder))
            with started("serve", "--config", f"{folder}/node.toml", "--json") as (node, ready):
                return _measure(ready["url"], Watched(node.pid), scan, seconds, viewers, clickers)


def _measure(
    url: str, node: Watched, scan: BenchScan, seconds: float, viewers: int, clickers: int
) -> dict[str, Any]:
    places = scan.clicks(max(int(2 * seconds) * clickers, PLACES))
    view(Orders(url, 1, 1, WARM_CLICKS / 2, places))
    asyncio.run(_surveyed(url))
    with node.watching() as alone:
        idle = view(Orders(url, 1, 1, IDLE_CLICKS / 2, places))
    stalled = _stalled(url, places)
    swept: dict[str, Any] = {}
    sweeping = threading.Thread(target=lambda: swept.update(asyncio.run(_sweep(url))))
    with node.watching() as then:
        sweeping.start()
        busy = view(Orders(url, viewers, clickers, seconds, places))
        sweeping.join()
    memory = {"before": then.own[0], "then": then.own[-1], "most_resident": max(then.resident)}
    memory |= _calm(node, Orders(url, viewers, clickers, CALM_S, places))
    idle_s, busy_s = statistics.median(idle.latencies_s), sorted(busy.latencies_s)
    p99_s = _percentile(busy_s, 99)
    return {
        "viewers": viewers, "clickers": clickers, "seconds": seconds, "clicks": len(busy_s),
        "superseded": busy.superseded, "errors": idle.errors + busy.errors, "sent_mb": busy.size_bytes / 1e6,
        "idle_median_s": idle_s, "busy_median_s": statistics.median(busy_s), "busy_p95_s": _percentile(busy_s, 95),
        "busy_p99_s": p99_s, "p99_to_idle": p99_s / idle_s,
        "cpu": {
            "node_idle_ms_a_click": 1000 * alone.cpu_s / len(idle.latencies_s),
            "node_busy_ms_an_answer": 1000 * then.cpu_s / max(len(busy_s) - busy.superseded, 1),
            "node_cores": then.cpu_s / then.seconds, "viewers_cores": busy.cpu_s / seconds,
            "viewers_late_p99_s": _percentile(sorted(busy.late_s), 99),
        },
        "memory_mb": memory, "sweep": swept, "stalled_reader": stalled,
    }  # fmt: skip


def _percentile(ascending: list[float], percent: int) -> float:
    return ascending[percent * (len(ascending) - 1) // 100]


def _calm(node: Watched, orders: Orders) -> dict[str, float]:
    """The node's memory in two turns of the same clicks when all else is done: as much in both, if it is flat. [MB]"""
    asyncio.run(_surveyed(orders.url))
    medians = {}
    for turn in ("calm", "calm_again"):
        with node.watching() as watching:
            view(orders)
        medians[turn] = statistics.median(watching.own)
    return medians


async def _surveyed(url: str) -> None:
    """Wait until the scan's texture is measured: a node that was started yesterday has done so."""
    async with aiohttp.ClientSession() as http:
        while (await (await http.get(f"{url}/v1/node")).json())["surveying"]:
            await asyncio.sleep(0.2)


def _stalled(url: str, places: list[tuple[float, float]]) -> dict[str, float]:
    """What one reader that stalls costs the others: it is there every other moment, and moments beside each other are
    compared, so that what else the machine does counts for both."""
    seconds = 2 * STALL_TURNS * STALL_S
    report = view(Orders(url, STALL_CLICKERS, STALL_CLICKERS, seconds, places, stall_s=STALL_S))
    moments: list[list[float]] = [[] for _ in range(2 * STALL_TURNS)]
    for clicked_s, latency_s in zip(report.clicked_s, report.latencies_s, strict=True):
        moments[min(int(clicked_s / STALL_S), len(moments) - 1)].append(latency_s)
    medians = [statistics.median(moment) for moment in moments]
    without_s, with_s = medians[::2], medians[1::2]
    return {
        "median_without_s": statistics.median(without_s), "median_with_s": statistics.median(with_s),
        "cost": statistics.median(b / a for a, b in zip(without_s, with_s, strict=True)) - 1,
    }  # fmt: skip


async def _sweep(url: str) -> dict[str, Any]:
    """One sweep from its order to its scan, and what its line lost."""
    began_s = time.monotonic()
    async with connect(url) as session:
        while (await session.scanner())["phase"] != "ready":
            await asyncio.sleep(0.05)
        published = session.published()
        await session.start_sweep()
        scan = await anext(published)
        quality = await session.quality(scan)
    assert quality is not None
    lost = {"requested_columns": quality.requested_columns, "dropped_bytes": quality.dropped_bytes}
    return {"seconds": time.monotonic() - began_s, "holes": quality.holes, **lost}


def view(orders: Orders) -> Report:
    """Run viewers in a process of their own. Raises FoveascanError."""
    import subprocess

    command = [sys.executable, "-m", "tests.bench.viewers"]
    done = subprocess.run(command, input=msgspec.json.encode(orders), capture_output=True, cwd=ROOT)
    if done.returncode:
        raise FoveascanError(f"bench: the viewers failed: {done.stderr.decode(errors='replace').strip()[-500:]}")
    return msgspec.json.decode(done.stdout, type=Report)


@dataclass
class Watching:
    """What a process took in a while.  resident, own : memory at each moment, all of it and what no file backs. [MB]"""

    seconds: float = 0.0
    cpu_s: float = 0.0
    resident: list[float] = field(default_factory=list)
    own: list[float] = field(default_factory=list)


class Watched:
    """A process and those that it has started, whose memory and processor time are looked at."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    @contextmanager
    def watching(self) -> Iterator[Watching]:
        """Look every half second as long as the context lasts; the sums are there behind it."""
        watching, done = Watching(), threading.Event()
        began_s, began_cpu_s = time.monotonic(), self._cpu_s()

        def watch() -> None:
            while not done.wait(SAMPLE_S):
                self._look(watching)

        self._look(watching)
        thread = threading.Thread(target=watch)
        thread.start()
        try:
            yield watching
        finally:
            done.set()
            thread.join()
            self._look(watching)
            watching.seconds, watching.cpu_s = time.monotonic() - began_s, self._cpu_s() - began_cpu_s

    def _look(self, watching: Watching) -> None:
        resident = own = 0
        for folder in self._folders():
            fields = dict(line.split()[:2] for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
            resident += int(fields["Pss:"])  # what processes share counts once
            own += int(fields["Pss_Anon:"]) + int(fields["Pss_Shmem:"])
        watching.resident.append(resident * 1024 / 1e6)
        watching.own.append(own * 1024 / 1e6)

    def _cpu_s(self) -> float:
        ticks = 0
        for folder in self._folders():
            user, system = (folder / "stat").read_text().rpartition(")")[2].split()[11:13]
            ticks += int(user) + int(system)
        return ticks / os.sysconf("SC_CLK_TCK")

    def _folders(self) -> list[Path]:
        listed = Path(f"/proc/{self._pid}/task").glob("*/children")
        children = [child for path in listed for child in path.read_text().split()]
        return [Path(f"/proc/{pid}") for pid in (self._pid, *children)]


def told(record: dict[str, Any]) -> str:
    """The figures for people."""
    memory, stalled, sweep, cpu = (record[name] for name in ("memory_mb", "stalled_reader", "sweep", "cpu"))
    return "\n".join([
        f"{record['viewers']} viewers, {record['clickers']} clicking twice a second for {record['seconds']:g} s: "
        f"{record['clicks']} clicks, {record['superseded']} overtaken by the next, {len(record['errors'])} errors",
        f"click to last byte: {1e3 * record['idle_median_s']:.0f} ms alone, {1e3 * record['busy_median_s']:.0f} ms "
        f"then, 95th percentile {1e3 * record['busy_p95_s']:.0f} ms, 99th {1e3 * record['busy_p99_s']:.0f} ms, "
        f"{record['p99_to_idle']:.1f} times that alone",
        f"processor time of the node: {cpu['node_idle_ms_a_click']:.0f} ms a click alone, "
        f"{cpu['node_busy_ms_an_answer']:.0f} ms an answer then, {cpu['node_cores']:.2f} cores; "
        f"the viewers took {cpu['viewers_cores']:.2f} cores and clicked {1e3 * cpu['viewers_late_p99_s']:.0f} ms late "
        f"(99th percentile)",
        f"memory of the node but for mapped files: {memory['before']:.0f} MB before, {memory['then']:.0f} MB at the "
        f"end; in {CALM_S:g} s more of such clicks without a sweep {memory['calm']:.1f} MB, and in as many again "
        f"{memory['calm_again']:.1f} MB; all of it at most {memory['most_resident']:.0f} MB",
        f"the sweep meanwhile: {sweep['seconds']:.0f} s, {sweep['requested_columns']} columns asked for again, "
        f"{sweep['dropped_bytes']} bytes dropped, {sweep['holes']} holes",
        f"a stalled reader costs the others {100 * stalled['cost']:.0f}%",
        *record["errors"][:5],
    ])  # fmt: skip
