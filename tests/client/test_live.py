from __future__ import annotations

import asyncio

import numpy as np
import pytest

from client import NodeLost, connect
from client.live import LiveFrame
from client.session import Session
from protocol import messages as m
from protocol.errors import RemoteWireError
from protocol.lattice import Channel
from protocol.live import LiveColumns
from tests.client.scripted_node import Line, greet, serving

GRID = m.ScanInfo("", 96, 64, 256, 128, 12, 8, 32, 16, 0.01, 0.5, 32.0, 0.0)
STARTED = m.LiveStarted(7, GRID)
PUBLISHED = m.LiveEnded(7, "published", "ab12")


def range_columns(*columns: int, sweep: int = 7, rows: int = 8) -> LiveColumns:
    steps = np.array([np.arange(rows) + 100 * column + 1 for column in columns], "<u2")
    return LiveColumns(Channel.RANGE, sweep, columns, rows, steps.tobytes())


def texture_columns(*columns: int) -> LiveColumns:
    return LiveColumns(Channel.TEXTURE, 7, columns, 16, bytes(range(48)) * len(columns))


async def hear_watch(line: Line, live: bool = True) -> None:
    assert await line.hear() == m.Watch(live)


async def frames_of(session: Session) -> list[LiveFrame]:
    return [frame async for frame in session.live()]


async def test_a_sweep_is_shown_up_to_its_end() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await hear_watch(line)
        await line.say(STARTED, range_columns(3, 4), texture_columns(31), m.LiveProgress(7, 12.5, 3.0), PUBLISHED)
        await hear_watch(line, live=False)
        await line.gone()

    async with serving(script) as url, connect(url) as session:
        *_, last = await frames_of(session)
        await session.close()
    assert (last.sweep, last.percent, last.seconds_left, last.grid) == (7, 12.5, 3.0, GRID)
    assert (last.ended, last.scan, last.why) == ("published", "ab12", "")
    assert last.range_steps.shape == (8, 12) and last.texture.shape == (16, 32, 3)
    assert np.array_equal(last.range_steps[:, 3], np.arange(8) + 301)
    assert np.array_equal(last.texture[:, 31].ravel(), np.arange(48))
    assert list(np.flatnonzero(last.range_seen)) == [3, 4]
    assert list(np.flatnonzero(last.texture_seen)) == [31]
    assert last.range_steps[:, 5:].max() == 0


async def test_frames_follow_the_news_and_are_copies() -> None:
    go_on = asyncio.Event()

    async def script(line: Line) -> None:
        await greet(line)
        await hear_watch(line)
        await line.say(STARTED, range_columns(3))
        await go_on.wait()
        await line.say(range_columns(4), PUBLISHED)
        await line.gone()

    async with serving(script) as url, connect(url) as session:
        frames = []
        async for frame in session.live():
            frames.append(frame)
            frame.range_steps[:] = 9
            if frame.range_seen[3]:
                go_on.set()
    assert [frame.ended for frame in frames[:-1]] == [""] * (len(frames) - 1)
    assert list(np.flatnonzero(frames[-1].range_seen)) == [3, 4]
    assert frames[-2].range_seen.sum() == 1


async def test_several_watchers_cost_the_link_one_view_and_the_last_one_ends_it() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await hear_watch(line)
        await line.say(STARTED, range_columns(1), PUBLISHED)
        await hear_watch(line, live=False)
        await hear_watch(line)
        await line.say(m.LiveStarted(8, GRID), m.LiveEnded(8, "interrupted", why="stopped"))
        await line.gone()

    async with serving(script) as url, connect(url) as session:
        first, second = await asyncio.gather(frames_of(session), frames_of(session))
        assert first[-1].scan == second[-1].scan == "ab12"
        assert (await frames_of(session))[-1].why == "stopped"


async def test_what_was_on_its_way_to_a_watcher_who_left_is_ignored() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await hear_watch(line)
        await line.say(STARTED)
        await hear_watch(line, live=False)
        await line.say(range_columns(1), m.LiveProgress(7, 50.0))
        await hear_watch(line)
        await line.say(STARTED, range_columns(2), PUBLISHED)
        await line.gone()

    async with serving(script) as url, connect(url) as session:
        live = session.live()
        await anext(live)
        await live.aclose()
        assert list(np.flatnonzero((await frames_of(session))[-1].range_seen)) == [2]


@pytest.mark.parametrize(
    "nonsense",
    [
        range_columns(1, sweep=8),
        range_columns(12),
        range_columns(1, rows=7),
        texture_columns(32),
        m.LiveProgress(6, 1.0),
    ],
    ids=repr,
)
async def test_nonsense_ends_the_session(nonsense: LiveColumns | m.LiveProgress) -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await hear_watch(line)
        await line.say(STARTED, nonsense)
        await line.gone()

    async with serving(script) as url, connect(url) as session:
        with pytest.raises(RemoteWireError):
            await frames_of(session)


async def test_a_lost_node_ends_the_view() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await hear_watch(line)
        await line.say(STARTED, m.Goodbye("the node is stopping"))

    async with serving(script) as url, connect(url) as session:
        with pytest.raises(NodeLost, match="stopping"):
            await frames_of(session)
        with pytest.raises(NodeLost):
            await frames_of(session)


async def test_closing_the_session_ends_the_view_quietly() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await hear_watch(line)
        await line.gone()

    async with serving(script) as url, connect(url) as session:
        watching = asyncio.create_task(frames_of(session))
        await asyncio.sleep(0)
        await session.close()
        assert await watching == []
