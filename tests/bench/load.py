"""`bench load`: hundreds of viewers on one node while its scanner sweeps: waits, errors, memory, who pays for whom."""

from __future__ import annotations

import asyncio
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from client import connect
from foveascan import started
from protocol.errors import FoveascanError
from tests.bench.scans import BenchScan
from tests.bench.viewers import Orders, Report

ROOT = Path(__file__).parents[2]
SWEPT = "nutcracker"  # another object than the one looked at, so another scan
PLACES = 400
IDLE_CLICKS = 40
STALL_CLICKERS, STALL_S, STALL_ROUNDS = 4, 6.0, 3
SAMPLE_S = 0.5
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
        rate = 2.2 * scan.grid.range_steps.nbytes / seconds + 1.1 * scan.grid.texture.nbytes / seconds
        simulate = ["simulate", "--path", f"{folder}/scanner", "--size", size, "--link-rate", f"{rate:.0f}"]
        with started(*simulate, "--specimen", SWEPT, "--json") as (_, scanner):
            (Path(folder) / "node.toml").write_text(SETTINGS.format(scanner=scanner["path"], folder=folder))
            with started("serve", "--config", f"{folder}/node.toml", "--json") as (node, ready):
                return _measure(ready["url"], node.pid, scan, seconds, viewers, clickers)


def _measure(url: str, pid: int, scan: BenchScan, seconds: float, viewers: int, clickers: int) -> dict[str, Any]:
    places = scan.clicks(PLACES)
    idle = view(Orders(url, 1, 1, IDLE_CLICKS / 2, places))
    stalled = _stalled(url, places)
    swept: dict[str, Any] = {}
    sweeping = threading.Thread(target=lambda: swept.update(asyncio.run(_sweep(url))))
    with _watched(pid) as memory:
        sweeping.start()
        busy = view(Orders(url, viewers, clickers, seconds, places))
        sweeping.join()
    idle_s, busy_s = statistics.median(idle.latencies_s), sorted(busy.latencies_s)
    p99_s = busy_s[int(0.99 * (len(busy_s) - 1))]
    warm, end = memory[len(memory) // 3], memory[-1]
    return {
        "viewers": viewers, "clickers": clickers, "seconds": seconds, "clicks": len(busy_s),
        "superseded": busy.superseded, "errors": idle.errors + busy.errors, "sent_mb": busy.size_bytes / 1e6,
        "idle_median_s": idle_s, "busy_median_s": statistics.median(busy_s), "busy_p99_s": p99_s,
        "p99_to_idle": p99_s / idle_s, "memory_mb": {"warm": warm, "end": end, "most": max(memory)},
        "sweep": swept, "stalled_reader": stalled,
    }  # fmt: skip


def _stalled(url: str, places: list[tuple[float, float]]) -> dict[str, float]:
    """What one reader that stalls costs the others: medians without and with it, in turns."""
    medians: dict[int, list[float]] = {0: [], 1: []}
    for turn in range(STALL_ROUNDS):
        for stalled in medians:
            orders = Orders(url, STALL_CLICKERS, STALL_CLICKERS, STALL_S, places, stalled=stalled, seed=turn)
            medians[stalled].append(statistics.median(view(orders).latencies_s))
    without_s, with_s = (statistics.median(medians[stalled]) for stalled in (0, 1))
    return {"median_without_s": without_s, "median_with_s": with_s, "cost": with_s / without_s - 1}


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


@contextmanager
def _watched(pid: int) -> Iterator[list[float]]:
    """A process's resident memory, every half second. [MB]"""
    samples = [_memory_mb(pid)]
    done = threading.Event()

    def watch() -> None:
        while not done.wait(SAMPLE_S):
            samples.append(_memory_mb(pid))

    watching = threading.Thread(target=watch)
    watching.start()
    try:
        yield samples
    finally:
        done.set()
        watching.join()


def _memory_mb(pid: int) -> float:
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def told(record: dict[str, Any]) -> str:
    """The figures for people."""
    memory, stalled, sweep = record["memory_mb"], record["stalled_reader"], record["sweep"]
    return "\n".join([
        f"{record['viewers']} viewers, {record['clickers']} clicking twice a second for {record['seconds']:g} s: "
        f"{record['clicks']} clicks, {record['superseded']} overtaken by the next, {len(record['errors'])} errors",
        f"click to last byte: {1e3 * record['idle_median_s']:.0f} ms alone, {1e3 * record['busy_median_s']:.0f} ms "
        f"then, 99th percentile {1e3 * record['busy_p99_s']:.0f} ms, {record['p99_to_idle']:.1f} times",
        f"memory of the node: {memory['warm']:.0f} MB after a third of the time, {memory['end']:.0f} MB at the end, "
        f"{memory['most']:.0f} MB at most",
        f"the sweep meanwhile: {sweep['seconds']:.0f} s, {sweep['requested_columns']} columns asked for again, "
        f"{sweep['dropped_bytes']} bytes dropped, {sweep['holes']} holes",
        f"a stalled reader costs the others {100 * stalled['cost']:.0f}%",
        *record["errors"][:5],
    ])  # fmt: skip
