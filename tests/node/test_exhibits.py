"""Whose turn it is to plan, and when that presses."""

import asyncio
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, closing
from pathlib import Path

import pytest

from node.coarse import FIRST_VIEW_BYTES
from node.exhibits import Exhibits
from node.library import About, Library
from protocol.messages import Profile
from tests.node.scans import make_grid


@pytest.fixture
def exhibits(tmp_path: Path) -> Iterator[Exhibits]:
    with closing(Library(tmp_path)) as library, closing(Exhibits(library, FIRST_VIEW_BYTES, workers=2)) as exhibits:
        yield exhibits


@pytest.mark.parametrize("looks", [1, 2, 3, 9])
async def test_turns_come_in_order_and_a_few_at_once(exhibits: Exhibits, looks: int) -> None:
    begun = []
    go_on = asyncio.Event()

    async def plan(number: int) -> None:
        async with exhibits.turn():
            begun.append(number)
            await go_on.wait()

    plans = [asyncio.create_task(plan(number)) for number in range(looks)]
    while len(begun) < min(looks, 3):
        await asyncio.sleep(0)
    assert begun == [0, 1, 2][:looks]  # two threads, and one look that is ready when either is
    go_on.set()
    await asyncio.gather(*plans)
    assert begun == list(range(looks))


@pytest.mark.parametrize(("workers", "calm"), [(1, 1), (2, 1), (3, 1), (4, 2), (8, 4)])
async def test_a_turn_presses_where_there_are_no_two_threads_for_each_look(
    tmp_path: Path, workers: int, calm: int
) -> None:
    with closing(Library(tmp_path)) as library, closing(Exhibits(library, FIRST_VIEW_BYTES, workers)) as exhibits:
        async with AsyncExitStack() as planning:
            pressed = [await planning.enter_async_context(exhibits.turn()) for _ in range(workers + 1)]
            assert pressed == [False] * calm + [True] * (workers + 1 - calm)
        async with exhibits.turn() as is_pressing:
            assert not is_pressing


async def test_a_turn_presses_while_others_wait_behind_it(exhibits: Exhibits) -> None:
    pressed = []

    async def plan() -> None:
        async with exhibits.turn() as is_pressing:
            pressed.append(is_pressing)

    async with exhibits.turn(), exhibits.turn(), exhibits.turn():
        plans = [asyncio.create_task(plan()) for _ in range(2)]
        await asyncio.sleep(0)
        assert not pressed
    await asyncio.gather(*plans)
    assert pressed == [True, False]  # behind the last one nobody waits


async def test_who_gives_up_waiting_is_not_waited_for(exhibits: Exhibits) -> None:
    async def wait() -> None:
        async with exhibits.turn():
            raise AssertionError("nobody gave a turn")

    async with exhibits.turn(), exhibits.turn(), exhibits.turn():
        waiting = [asyncio.create_task(wait()) for _ in range(3)]
        await asyncio.sleep(0)
        for one in waiting:
            one.cancel()
        ends = await asyncio.gather(*waiting, return_exceptions=True)
        assert all(isinstance(end, asyncio.CancelledError) for end in ends)
    async with exhibits.turn() as is_pressing:
        assert not is_pressing


async def test_what_a_process_does_waits_for_no_columns_and_what_it_does_not_is_done_here_when_they_let(
    exhibits: Exhibits,
) -> None:
    exhibits._way._taken_until_s = time.monotonic() + 60  # columns come fast

    def here() -> str:
        return f"here, in turn: {exhibits._way._one.locked()}"

    def there() -> str:
        return f"there, in turn: {exhibits._way._one.locked()}"

    assert await exhibits.work(here, "look", there) == "there, in turn: False"
    assert await exhibits.work(here, "look", lambda: None) == "here, in turn: True"


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
