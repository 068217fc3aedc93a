"""Ourselves as a user has us: a node as a process of its own, a client on its WebSocket, what the model then holds."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import aiohttp

import foveascan
from client.model import Model
from client.session import Session, connect
from client.update import Update
from tests.bench.scans import BenchScan, Click
from tests.bench.target import Target, Window, crop

FRAME_SHORT, FRAME_LONG = 4, 10  # WebSocket headers of messages up to 64 KiB, and longer ones
LONG_BYTES = 65536


@dataclass(frozen=True)
class Looked:
    """One look, measured at the client: bytes on the wire, quality in the model."""

    size_bytes: int
    node_ms: float
    encodes: int
    range_error_mm: float
    texture_db: float
    reached: bool
    parts: list[dict[str, Any]]


@asynccontextmanager
async def node_with(scans: Iterable[BenchScan]) -> AsyncIterator[tuple[Session, dict[str, str]]]:
    """A session with a running node, and the id of each scan by its key."""
    async with node_at(scans) as (_, _, session, ids):
        yield session, ids


@asynccontextmanager
async def node_at(scans: Iterable[BenchScan]) -> AsyncIterator[tuple[str, int, Session, dict[str, str]]]:
    """The same, and before them where the node is and its process id."""
    with tempfile.TemporaryDirectory(prefix="foveascan-bench-") as folder:
        ids = {scan.key: scan.published(Path(folder)).id for scan in scans}
        arguments = ("serve", "--library", folder, "--listen", "127.0.0.1:0", "--insecure", "--json")
        with foveascan.started(*arguments) as (program, ready):
            async with connect(ready["url"]) as session:
                for scan_id in ids.values():
                    await session.open(scan_id)
                await surveyed(ready["url"])
                yield ready["url"], program.pid, session, ids


async def surveyed(url: str) -> None:
    """Wait until the node has measured the textures of what is open: figures are of a node at rest."""
    async with aiohttp.ClientSession() as http:
        while True:
            async with http.get(f"{url}/v1/node") as response:
                if not (await response.json())["surveying"]:
                    return
            await asyncio.sleep(0.1)


async def look(session: Session, model: Model, scan: BenchScan, click: Click, target: Target, **more: Any) -> Looked:
    """Look once, and hold what the model then shows against the truth."""
    update = await session.look(
        *click, window=target.window, texture_db=target.texture_db, range_mm=target.range_mm, **more
    )
    return looked(update, model, Window.round(scan.grid, click, target))


def looked(update: Update, model: Model, window: Window) -> Looked:
    """What an update cost, and what its window holds now."""
    steps, texels = crop(model.range_steps, window.range), crop(model.texture, window.texture)
    reached = window.range_reached(steps) and window.texture_reached(texels)
    return Looked(
        wire_bytes(update), update.node_ms, update.encodes,
        window.range_error_mm(steps), window.texture_db(texels), reached, [_told(sent) for sent in update.parameters],
    )  # fmt: skip


def wire_bytes(update: Update) -> int:
    """Messages of an update with their WebSocket headers."""
    frames = [FRAME_LONG if sent.payload_bytes > LONG_BYTES - 1024 else FRAME_SHORT for sent in update.parameters]
    return update.bytes_received + sum(frames) + FRAME_SHORT


def _told(sent: Any) -> dict[str, Any]:
    return {
        "channel": sent.channel,
        "p": sent.p,
        "quality": sent.quality,
        "codec": sent.codec,
        "bytes": sent.payload_bytes,
    }
