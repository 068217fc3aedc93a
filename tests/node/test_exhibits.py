"""Whose turn it is to plan, and when that presses."""

import asyncio
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from node.coarse import FIRST_VIEW_BYTES
from node.exhibits import PRESSING, Exhibits
from node.library import About, Library
from protocol.messages import Profile
from tests.node.scans import make_grid


@pytest.fixture
def exhibits(tmp_path: Path) -> Iterator[Exhibits]:
    with closing(Library(tmp_path)) as library, closing(Exhibits(library, FIRST_VIEW_BYTES, workers=2)) as exhibits:
        yield exhibits


@pytest.mark.parametrize("more", [0, 1, 2 * PRESSING, 5])
async def test_a_turn_presses_while_many_wait_behind_it(exhibits: Exhibits, more: int) -> None:
    begun, pressed = [], []
    go_on = asyncio.Event()

    async def plan(number: int) -> None:
        async with exhibits.turn() as is_pressing:
            begun.append(number)
            pressed.append(is_pressing)
            await go_on.wait()

    plans = [asyncio.create_task(plan(number)) for number in range(4 + more)]
    while len(begun) < 3:
        await asyncio.sleep(0)
    assert begun == [0, 1, 2]  # two threads, and one look that is ready when either is
    go_on.set()
    await asyncio.gather(*plans)
    assert begun == list(range(4 + more))
    assert pressed[3] == (more >= 2 * PRESSING)
    assert not pressed[-1]


async def test_who_gives_up_waiting_is_not_waited_for(exhibits: Exhibits) -> None:
    async def wait() -> None:
        async with exhibits.turn():
            raise AssertionError("nobody gave a turn")

    async with exhibits.turn(), exhibits.turn(), exhibits.turn():
        waiting = [asyncio.create_task(wait()) for _ in range(2 * PRESSING + 1)]
        await asyncio.sleep(0)
        for one in waiting:
            one.cancel()
        ends = await asyncio.gather(*waiting, return_exceptions=True)
        assert all(isinstance(end, asyncio.CancelledError) for end in ends)
    async with exhibits.turn() as is_pressing:
        assert not is_pressing


@pytest.mark.parametrize("profile", ["default", "classic"])
async def test_an_opened_scan_that_comes_again_is_told_of_as_it_came_last(exhibits: Exhibits, profile: Profile) -> None:
    grid = make_grid(40, 24)
    first = exhibits.library.add(grid, About(1e9))
    _, view = await exhibits.open(first.id, "htj2k", profile)
    exhibits.library.add(grid, About(2e9, name="again", note="twice"))
    scan, again = await exhibits.open(first.id, "htj2k", profile)
    assert scan.about == exhibits.library.summary(first.id).about == About(2e9, name="again", note="twice")
    assert (view.info.created, again.info.created) == ("2001-09-09T01:46:40Z", "2033-05-18T03:33:20Z")
    assert again.state is view.state
