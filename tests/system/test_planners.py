"""Many clients of a real daemon, whose looks are planned in processes: these may be killed, and end with the node."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from contextlib import suppress
from pathlib import Path

import aiohttp

from client import NodeLost, connect
from foveascan import started
from node.library import About, Library
from tests.node.scans import make_grid
from tests.waiting import PATIENCE_S, until

CLIENTS = 6
STOP_S = 30.0


def children(pid: int) -> set[int]:
    """The processes that one has started and that run."""
    found = Path(f"/proc/{pid}/task/{pid}/children").parent.parent.glob("*/children")
    return {int(child) for path in found for child in path.read_text().split()}


def is_there(pid: int) -> bool:
    with suppress(FileNotFoundError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


async def click(url: str, number: int, done: list[int]) -> None:
    """Look here and there until the node goes; every look is answered in full."""
    draw = random.Random(number)
    with suppress(NodeLost):
        async with connect(url) as session:
            await session.open("latest")
            while True:
                update = await session.look(draw.random(), draw.uniform(0.2, 0.8), window=0.02)
                assert update.reason == "complete"
                done[number] += 1


async def planning_processes(http: aiohttp.ClientSession, url: str) -> tuple[float, float]:
    """How many there are and how many have died, as /metrics says."""
    text = await (await http.get(f"{url}/metrics")).text()
    said = dict(line.rsplit(" ", 1) for line in text.splitlines() if not line.startswith("#"))
    return float(said["foveascan_planning_processes"]), float(said["foveascan_planning_processes_died_total"])


async def test_processes_that_are_killed_cost_no_client_a_look_and_all_end_with_the_node(tmp_path: Path) -> None:
    library = Library(tmp_path / "library")
    library.add(make_grid(320, 192), About(0.0))
    library.close()
    serve = ["serve", "--library", str(tmp_path / "library"), "--listen", "127.0.0.1:0", "--insecure", "--json"]
    with started(*serve) as (node, ready):
        done = [0] * CLIENTS
        async with asyncio.TaskGroup() as clients, aiohttp.ClientSession() as http:
            clicking = [clients.create_task(click(ready["url"], number, done)) for number in range(CLIENTS)]
            await until(lambda: min(done) >= 2 and len(children(node.pid)) == 2)
            first = children(node.pid)
            for child in first:
                os.kill(child, signal.SIGKILL)
            so_far = list(done)
            await until(lambda: len(children(node.pid) - first) == 2)
            await until(lambda: all(now > before + 2 for now, before in zip(done, so_far, strict=True)))
            async with asyncio.timeout(PATIENCE_S):
                while await planning_processes(http, ready["url"]) != (2, 2):
                    await asyncio.sleep(0.01)
            health = await (await http.get(f"{ready['url']}/healthz")).json()
            assert health["status"] == "degraded" and "by signal SIGKILL" in health["reasons"][0]
            assert not any(task.done() for task in clicking)
            last = children(node.pid)
            node.terminate()
            assert await asyncio.to_thread(node.wait, STOP_S) == 0
        await until(lambda: not any(map(is_there, last)))
