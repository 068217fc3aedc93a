from __future__ import annotations

import asyncio
import threading
from typing import Any

import numpy as np
import pytest

from client import NodeLost, Session
from client.model import Model
from client.update import Tally, Update
from protocol import messages as m
from protocol.grid import VOID
from protocol.lattice import Channel, Parameters
from protocol.refinement import Refinement
from tests.client.scripted_node import (
    WINDOW,
    Line,
    Planner,
    hear_look,
    session_with,
    show,
    show_and_answer,
    synthetic_grid,
    until_gone,
    updated,
)

GRID = synthetic_grid()
ELSEWHERE = Parameters(2, 8, 5, 2, 2)


# What a look brings


async def test_a_look_makes_its_window_equal_to_the_scan() -> None:
    async with session_with(show_and_answer) as session:
        model = await session.open("latest")
        update = await session.look(0.4, 0.4)
    assert model is session.model
    assert np.array_equal(model.range_steps[16:32, 24:48], GRID.range_steps[16:32, 24:48])
    assert (model.range_steps[18:27, 25:41] == VOID).all()
    assert np.array_equal(model.texture[32:64, 48:96], GRID.texture[32:64, 48:96])
    assert (update.reason, update.error_max_mm, update.texture_db, update.lost) == ("complete", 0.0, 100.0, 0)


async def test_an_update_counts_what_travelled() -> None:
    told: list[str | bytes] = []

    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        look = await hear_look(line)
        for said in (planner.range_fovea(look=look.request), planner.texture_fovea(look=look.request)):
            told.append(said.to_bytes())
            sent.append(said)
            await line.say(said)
        closing = updated(planner, look.request, encodes=2, node_ms=1.5)
        told.append(m.encode_message(closing))
        await line.say(closing)
        await until_gone(line)

    sent: list[Refinement] = []
    async with session_with(script) as session:
        await session.open()
        before = session.stats
        update = await session.look(0.4, 0.4)
        after = session.stats
    assert update.bytes_received == sum(map(len, told)) == after.bytes_received - before.bytes_received
    assert update.payload_bytes == sum(len(said.payload) for said in sent)
    assert update.samples == sum(said.samples for said in sent) == after.samples - before.samples
    assert [(one.channel, one.p, one.quality) for one in update.parameters] == [("range", 1, 1), ("texture", 1, 255)]
    assert [one.parameters for one in update.parameters] == [WINDOW, WINDOW]
    assert (update.encodes, update.node_ms, after.updates) == (2, 1.5, 1)
    assert 0 < update.apply_s < update.elapsed_s


async def test_an_update_names_the_blocks_it_changed() -> None:
    async with session_with(show_and_answer) as session:
        model = await session.open()
        before = model.range_steps.copy()
        update = await session.look(0.4, 0.4)
        rows, columns = np.nonzero(model.range_steps != before)
    changed = np.unique(rows // 8 * 12 + columns // 8)
    assert set(changed) <= set(update.changed["range"])
    assert update.changed["texture"].size and (np.diff(update.changed["texture"]) > 0).all()


async def test_holdings_are_copies_of_what_both_ends_agree_on() -> None:
    async with session_with(show_and_answer) as session:
        model = await session.open()
        await session.look(0.4, 0.4)
        held = session.holdings("range")
        assert (held.level[2:4, 3:6] == 0).all() and (held.rank[2:4, 3:6] == 65534).all()
        held.level[:] = 9
        assert (model.holdings.channels[Channel.RANGE].level[2:4, 3:6] == 0).all()


async def test_refinements_are_applied_outside_the_event_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[int] = []
    apply = Model.apply

    def watched(model: Model, refinement: Refinement) -> Any:
        threads.append(threading.get_ident())
        return apply(model, refinement)

    monkeypatch.setattr(Model, "apply", watched)
    async with session_with(show_and_answer) as session:
        await session.open()
        await session.look(0.4, 0.4)
    assert len(threads) == 4 and threading.get_ident() not in threads


async def test_every_parameter_of_a_look_reaches_the_node() -> None:
    heard: asyncio.Future[m.Look] = asyncio.get_running_loop().create_future()

    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        heard.set_result(await hear_look(line))

    wanted = m.LookParameters(m.RangeParameters(2, 3, None), m.TextureParameters(1.5, 40, "jpeg", 2.0))
    async with session_with(script) as session:
        await session.open()
        look = session.look(
            0.25,
            0.75,
            window=0.1,
            texture_db=35,
            range_mm=0.2,
            max_wait_s=0.5,
            max_bytes=9000,
            fill=True,
            alpha=0.5,
            scale=0.3,
            parameters={
                "range": {"p": 2, "quantum": 3, "s": None},
                "texture": {"p": 1.5, "quality": 40, "codec": "jpeg", "s": 2.0},
            },
        )
        with pytest.raises(NodeLost):
            await look
    assert await heard == m.Look(2, 0.25, 0.75, 0.1, 35.0, 0.2, 0.5, 9000, True, 0.5, 0.3, "default", wanted)


# Acknowledgements and agreement


async def test_first_view_and_update_are_acknowledged_with_the_nodes_own_digest() -> None:
    agreed: list[bool] = []

    async def script(line: Line) -> None:
        planner = Planner(GRID)
        ack = await show(line, planner)
        agreed.append((ack.next_seq, ack.digest) == (2, planner.holdings.digest()))
        look = await hear_look(line)
        await line.say(planner.range_fovea(look=look.request), updated(planner, look.request))
        second = await line.hear()
        assert isinstance(second, m.Ack)
        agreed.append((second.next_seq, second.digest) == (3, planner.holdings.digest()))

    async with session_with(script) as session:
        await session.open()
        await session.look(0.4, 0.4)
        await drained(session)
    assert agreed == [True, True]


async def drained(session: Session) -> None:
    """Wait until the node has ended the stream, so that all it was told is heard."""
    with pytest.raises(NodeLost):
        async for _ in session.published():
            pass


async def test_after_a_lost_refinement_holdings_are_stated_and_the_node_goes_on() -> None:
    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        look = await hear_look(line)
        holdings, content = planner.holdings.copy(), planner.holdings.content
        planner.range_fovea()  # lost
        await line.say(planner.texture_fovea(look=look.request), updated(planner, look.request))
        state = await line.hear()
        assert isinstance(state, m.State)
        stated = state.next_seq, state.holdings.range, state.holdings.texture
        assert stated == (2, *(holdings.channels[channel].to_runs() for channel in Channel))
        planner.holdings, planner.seq = holdings, state.next_seq
        assert content == 0
        look = await hear_look(line)
        fovea = planner.range_fovea(look=look.request), planner.texture_fovea(look=look.request)
        await line.say(*fovea, updated(planner, look.request))
        ack = await line.hear()
        assert isinstance(ack, m.Ack) and ack.digest == planner.holdings.digest()

    async with session_with(script) as session:
        model = await session.open()
        before = model.texture.copy()
        first = await session.look(0.4, 0.4)
        assert first.lost == 2 and first.samples == 0
        assert np.array_equal(model.texture, before)
        second = await session.look(0.4, 0.4)
        assert second.lost == 0 and session.stats.resyncs == 1
        await drained(session)
    assert np.array_equal(model.range_steps[16:32, 24:48], GRID.range_steps[16:32, 24:48])


async def test_a_node_that_sees_another_digest_is_told_the_holdings() -> None:
    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        look = await hear_look(line)
        await line.say(planner.range_fovea(look=look.request), updated(planner, look.request))
        await line.hear()
        look = await hear_look(line)
        await line.say(m.Resync(planner.epoch, "digests differ"))
        state = await line.hear()
        assert isinstance(state, m.State) and state.next_seq == 3
        assert state.holdings.range == planner.holdings.channels[Channel.RANGE].to_runs()
        planner.holdings.content = 0
        await line.say(planner.range_fovea(ELSEWHERE, look=look.request), updated(planner, look.request))
        ack = await line.hear()
        assert isinstance(ack, m.Ack) and ack.digest == planner.holdings.digest()

    async with session_with(script) as session:
        await session.open()
        await session.look(0.4, 0.4)
        await session.look(0.7, 0.7)
        await drained(session)
        assert session.stats.resyncs == 1


# Newer over older


async def test_a_newer_look_supersedes_an_older_one() -> None:
    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        older, newer = await hear_look(line), await hear_look(line)
        await line.say(m.Updated(older.request, planner.seq, "superseded"))
        await line.say(planner.range_fovea(look=newer.request), updated(planner, newer.request))
        ack = await line.hear()
        assert isinstance(ack, m.Ack) and ack.next_seq == 3  # a superseded look is not acknowledged

    async with session_with(script) as session:
        await session.open()
        older, newer = await asyncio.gather(session.look(0.1, 0.1), session.look(0.4, 0.4))
        await drained(session)
    assert (older.reason, older.samples) == ("superseded", 0)
    assert newer.reason == "complete" and newer.samples > 0


async def test_a_superseded_look_may_be_answered_amid_another_update() -> None:
    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        first, second = await hear_look(line), await hear_look(line)
        before = planner.seq
        await line.say(planner.range_fovea(look=first.request))
        await line.say(m.Updated(second.request, before, "superseded"))
        await line.say(planner.texture_fovea(look=first.request), updated(planner, first.request))
        ack = await line.hear()
        assert isinstance(ack, m.Ack) and ack.digest == planner.holdings.digest()

    async with session_with(script) as session:
        await session.open()
        first, second = await asyncio.gather(session.look(0.4, 0.4), session.look(0.1, 0.1))
        await drained(session)
    assert (first.reason, len(first.parameters)) == ("complete", 2)
    assert (second.reason, len(second.parameters)) == ("superseded", 0)


async def test_opening_another_scan_ends_looks_in_the_air() -> None:
    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        await hear_look(line)
        asked = await line.hear()
        assert isinstance(asked, m.Open)
        planner = Planner(GRID, epoch=2)
        await line.say(planner.opened(asked.request), *planner.first_view())
        await until_gone(line)

    async with session_with(script) as session:
        first = await session.open()
        look = asyncio.create_task(session.look(0.4, 0.4))
        await asyncio.sleep(0)
        second = await session.open("other")
        assert (await look).reason == "superseded"
        assert session.model is second is not first


async def test_a_cancelled_look_is_cancelled_at_the_node_and_its_answer_ignored() -> None:
    cancelled = asyncio.Event()
    asked = asyncio.Event()

    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        look = await hear_look(line)
        asked.set()
        assert await line.hear() == m.Cancel(look.request)
        cancelled.set()
        await line.say(planner.range_fovea(look=look.request), updated(planner, look.request))
        assert {type(await line.hear()), type(await line.hear())} == {m.Ack, m.Look}
        await line.say(planner.texture_fovea(look=look.request + 1), updated(planner, look.request + 1))
        await until_gone(line)

    async with session_with(script) as session:
        model = await session.open()
        look = asyncio.create_task(session.look(0.4, 0.4))
        await asked.wait()
        look.cancel()
        with pytest.raises(asyncio.CancelledError):
            await look
        await cancelled.wait()
        assert (await session.look(0.5, 0.5)).samples > 0
        assert np.array_equal(model.range_steps[16:32, 24:48], GRID.range_steps[16:32, 24:48])


async def test_an_answer_to_a_look_cancelled_in_the_same_moment_does_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[asyncio.Task[Update]] = []
    close = Tally.close

    def cancelled(tally: Tally, said: m.Updated, lost: int = 0) -> Update:
        if looks:
            looks.pop().cancel()
        return close(tally, said, lost)

    monkeypatch.setattr(Tally, "close", cancelled)

    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        while True:
            said = await line.hear()
            if isinstance(said, m.Look):
                await line.say(updated(planner, said.request))

    async with session_with(script) as session:
        await session.open()
        looks.append(asyncio.create_task(session.look(0.4, 0.4)))
        with pytest.raises(asyncio.CancelledError):
            await looks[0]
        assert (await session.look(0.4, 0.4)).reason == "complete"
