"""Watching a sweep while it runs, through the public client."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from client import Session, connect
from client.live import LiveFrame
from client.truth import Truth
from foveascan import started
from tests.system.line import RunningNode, run_line
from tests.waiting import until_ready


@pytest.fixture(scope="module")
def slow_node(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningNode]:
    """A node whose scanner takes a few seconds for a sweep of S."""
    with ExitStack() as stack:
        folder = tmp_path_factory.mktemp("live")
        yield run_line(stack, folder, "--specimen", "sphere", "--size", "S", "--link-rate", "400000")


async def watch(session: Session) -> list[LiveFrame]:
    async with asyncio.timeout(60):
        return [frame async for frame in session.live()]


async def test_viewers_see_a_sweep_grow_late_joiners_included(slow_node: RunningNode) -> None:
    async with connect(slow_node.url) as early, connect(slow_node.url) as late:
        watching = asyncio.create_task(watch(early))
        await early.start_sweep()
        async for frame in late.live():
            if frame.percent >= 30:  # leaves, to join again in the middle of it
                break
        joined_late = await watch(late)
        frames = await watching
        scans = await early.scans()
    percents = [frame.percent for frame in frames]
    assert percents == sorted(percents) and percents[-1] == 100 and len(set(percents)) > 3, percents
    assert any(frame.seconds_left for frame in frames)
    assert {frame.ended for frame in frames[:-1]} == {""}
    assert (frames[-1].ended, frames[-1].scan) == ("published", scans[0]["id"])
    assert joined_late[-1].ended == "published"
    assert np.array_equal(joined_late[-1].range_steps, frames[-1].range_steps)
    assert np.array_equal(joined_late[-1].texture, frames[-1].texture)
    assert_close(frames[-1], slow_node.truth)


def assert_close(frame: LiveFrame, truth: Truth) -> None:
    assert frame.range_seen.all() and frame.texture_seen.all()
    height, width = truth.range_steps.shape
    rows, columns = frame.range_steps.shape
    nearest = truth.range_steps[
        np.ix_((2 * np.arange(rows) + 1) * height // (2 * rows), (2 * np.arange(columns) + 1) * width // (2 * columns))
    ]
    both = (frame.range_steps > 0) & (nearest > 0)
    assert both.sum() > 0.9 * (nearest > 0).sum()
    error_mm = np.abs(frame.range_steps[both].astype(int) - nearest[both]) * truth.step_mm
    assert np.median(error_mm) < 0.5


async def test_an_unplugged_scanner_ends_the_view_as_interrupted(tmp_path: Path) -> None:
    simulate = ["simulate", "--path", str(tmp_path / "tty"), "--specimen", "sphere", "--link-rate", "200000", "--json"]
    serve = ["serve", "--library", str(tmp_path / "library"), "--listen", "127.0.0.1:0", "--insecure", "--json"]
    with started(*simulate) as (scanner, link), started(*serve, "--scanner", link["path"]) as (_, ready):
        async with connect(ready["url"]) as session:
            await until_ready(session)
            watching = asyncio.create_task(watch(session))
            await session.start_sweep()
            async for frame in session.live():
                if frame.percent > 10:
                    break
            scanner.kill()
            frames = await watching
    assert (frames[-1].ended, frames[-1].scan) == ("interrupted", "")
    assert frames[-1].why
    assert 0 < frames[-1].range_seen.sum() < frames[-1].range_seen.size
