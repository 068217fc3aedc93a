"""A whole line: simulated scanner and real daemon as processes of their own, and the truth they are held against."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiohttp

from client import connect
from client.truth import Truth
from foveascan import started
from tests.waiting import until_ready

SHARED_DATA = Path(__file__).parents[3] / "shared" / "data"
SWEEP_S = 60


@dataclass(frozen=True)
class RunningNode:
    """A node that has swept its specimen once."""

    url: str
    truth: Truth
    process: Any
    folder: Path


def sweep(url: str) -> str:
    """Have a node sweep once; the scan's id."""

    async def once() -> str:
        async with connect(url) as session:
            published = session.published()
            await until_ready(session)
            await session.start_sweep()
            async with asyncio.timeout(SWEEP_S):
                return await anext(published)

    return asyncio.run(once())


def run_line(stack: ExitStack, folder: Path, *simulate: str) -> RunningNode:
    """Simulated scanner and node, swept once, until the stack ends."""
    truth = folder / "truth.npz"
    link = ["simulate", "--path", str(folder / "scanner"), "--truth", str(truth), "--json", *simulate]
    _, scanner = stack.enter_context(started(*link))
    serve = ["serve", "--scanner", scanner["path"], "--library", str(folder / "library"), "--listen", "127.0.0.1:0"]
    beside = scanner.get("environment", {})  # of a node that shall see emulated USB
    process, ready = stack.enter_context(started(*serve, "--insecure", "--json", environment=beside))
    sweep(ready["url"])
    return RunningNode(ready["url"], Truth.read(truth), process, folder)


async def surveyed(url: str) -> None:
    """Returns once the node has measured the textures of what is open: until then it guesses."""
    async with aiohttp.ClientSession() as http:
        while (await (await http.get(f"{url}/v1/node")).json())["surveying"]:
            await asyncio.sleep(0.05)
