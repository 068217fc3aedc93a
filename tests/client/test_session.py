from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from aiohttp import web

from client import NodeLost, RequestRefused, Session, connect
from client import stream as client_stream
from client.discovery import NodeAddress
from client.model import Model
from client.update import Tally, Update
from protocol import messages as m
from protocol.errors import FoveascanError, LocalWireError, RemoteWireError
from protocol.grid import VOID
from protocol.lattice import Channel, Parameters
from protocol.refinement import Refinement
from tests.client.scripted_node import (
    INFO,
    WINDOW,
    Line,
    Planner,
    Script,
    greet,
    serving,
    show,
    show_and_answer,
    synthetic_grid,
    updated,
)

GRID = synthetic_grid()
ELSEWHERE = Parameters(2, 8, 5, 2, 2)
PROTOCOL_ERROR = 1002


@asynccontextmanager
async def session_with(script: Script, *routes: web.RouteDef) -> AsyncIterator[Session]:
    async with serving(script, *routes) as url, connect(url) as session:
        yield session


async def hear_look(line: Line) -> m.Look:
    look = await line.hear()
    assert isinstance(look, m.Look)
    return look


async def until_gone(line: Line) -> None:
    await line.gone()


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


# What the caller gets wrong


BAD_LOOKS: dict[str, dict[str, Any]] = {
    "u of 1": {"u": 1.0},
    "negative v": {"v": -0.01},
    "NaN": {"u": float("nan")},
    "text": {"u": "0.5"},
    "window of nothing": {"window": 0},
    "window beyond the area": {"window": 1.1},
    "no time": {"max_wait_s": 0},
    "negative bytes": {"max_bytes": -1},
    "half a byte": {"max_bytes": 1.5},
    "unknown profile": {"profile": "other"},
    "spacing that is none": {"parameters": {"range": {"p": 3}}},
    "quality off the scale": {"parameters": {"texture": {"quality": 256}}},
    "parameters of another kind": {"parameters": 7},
}


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no time", "max_wait_s: expected float >= 0.05"),
        ("spacing that is none", "parameters.range.p: Invalid enum value 3"),
    ],
)
async def test_a_look_out_of_bounds_is_named_as_the_caller_wrote_it(name: str, said: str) -> None:
    async with session_with(show_and_answer) as session:
        await session.open()
        with pytest.raises(LocalWireError) as refused:
            await session.look(**{"u": 0.5, "v": 0.5, **BAD_LOOKS[name]})
        assert str(refused.value) == f"look: {said}"


@pytest.mark.parametrize("change", BAD_LOOKS.values(), ids=BAD_LOOKS)
async def test_a_look_out_of_bounds_is_refused_before_it_is_sent(change: dict[str, Any]) -> None:
    async with session_with(show_and_answer) as session:
        await session.open()
        before = session.stats.bytes_sent
        with pytest.raises(LocalWireError, match="look:"):
            await session.look(**{"u": 0.5, "v": 0.5, **change})
        assert session.stats.bytes_sent == before
        assert (await session.look(0.4, 0.4)).reason == "complete"


async def test_looking_before_opening_says_what_to_do() -> None:
    async with session_with(show_and_answer) as session:
        with pytest.raises(LocalWireError, match=r"session\.open"):
            await session.look(0.5, 0.5)
        with pytest.raises(LocalWireError, match=r"session\.open"):
            session.holdings("range")


async def test_a_refused_look_names_code_and_reason_and_the_session_goes_on() -> None:
    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        look = await hear_look(line)
        await line.say(m.Refused(look.request, "bad request", "spacing 8 does not divide the 90 columns"))
        look = await hear_look(line)
        await line.say(updated(planner, look.request))
        await until_gone(line)

    async with session_with(script) as session:
        await session.open()
        with pytest.raises(RequestRefused, match="spacing 8 does not divide") as refusal:
            await session.look(0.5, 0.5)
        assert refusal.value.code == "bad request"
        assert (await session.look(0.5, 0.5)).reason == "complete"


async def test_an_unknown_scan_is_refused() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        asked = await line.hear()
        assert isinstance(asked, m.Open) and asked.scan == "nope"
        await line.say(m.Refused(asked.request, "not found", "no scan 'nope'"))
        await until_gone(line)

    async with session_with(script) as session:
        with pytest.raises(RequestRefused, match="no scan 'nope'") as refusal:
            await session.open("nope")
        assert refusal.value.code == "not found" and session.model is None


# What the node gets wrong


async def say_text(line: Line, text: str) -> None:
    await line.socket.send_str(text)


async def say_bytes(line: Line, data: bytes) -> None:
    await line.socket.send_bytes(data)


async def say_out_of_order(line: Line, *said: m.Message) -> None:
    for message in said:
        await line.socket.send_str(m.encode_message(message))


def sound_fovea() -> bytes:
    planner = Planner(GRID)
    planner.first_view()
    return planner.range_fovea(look=2).to_bytes()


def altered_fovea(**changes: Any) -> bytes:
    planner = Planner(GRID)
    planner.first_view()
    return replace(planner.range_fovea(look=2), **changes).to_bytes()


VIOLATIONS: dict[str, Callable[[Line], Awaitable[None]]] = {
    "no JSON": lambda line: say_text(line, "hello"),
    "unknown type": lambda line: say_text(line, '{"type":"surprise"}'),
    "missing field": lambda line: say_text(line, '{"type":"updated","request":2}'),
    "value out of bounds": lambda line: say_text(line, '{"type":"resync","epoch":70000,"reason":""}'),
    "empty binary": lambda line: say_bytes(line, b""),
    "garbage binary": lambda line: say_bytes(line, bytes(range(256))),
    "refinement cut short": lambda line: say_bytes(line, sound_fovea()[:-1]),
    "refinement with a flipped bit": lambda line: say_bytes(line, sound_fovea()[:-9] + b"\x55" + sound_fovea()[-8:]),
    "refinement of another epoch": lambda line: say_bytes(line, altered_fovea(epoch=9)),
    "refinement out of its turn": lambda line: say_bytes(line, altered_fovea(seq=1)),
    "payload that does not decode": lambda line: say_bytes(line, altered_fovea(payload=b"nonsense")),
    "a second greeting": lambda line: say_out_of_order(line, INFO),
    "a client's message": lambda line: say_out_of_order(line, m.Cancel(1)),
    "an answer nobody asked for": lambda line: say_out_of_order(line, m.Updated(99, 2, "complete")),
    "a scan nobody opened": lambda line: say_out_of_order(line, Planner(GRID).opened(99)),
    "fewer refinements than arrived": lambda line: say_out_of_order(line, m.Updated(2, 1, "complete")),
    "a scan without sense": lambda line: say_out_of_order(
        line, m.Opened(1, 2, m.ScanInfo("x", 96, 64, 9, 9, 97, 8, 9, 9, 0.01, 0.5, 0, 0))
    ),
}


@pytest.mark.parametrize("violate", VIOLATIONS.values(), ids=VIOLATIONS)
async def test_a_violation_by_the_node_ends_the_session_and_says_so_to_both(
    violate: Callable[[Line], Awaitable[None]],
) -> None:
    closed: asyncio.Future[int | None] = asyncio.get_running_loop().create_future()

    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        await hear_look(line)
        await violate(line)
        closed.set_result(await line.gone())

    async with session_with(script) as session:
        model = await session.open()
        before = model.range_steps.copy()
        with pytest.raises(RemoteWireError) as violation:
            await session.look(0.4, 0.4)
        assert await closed == PROTOCOL_ERROR
        assert np.array_equal(model.range_steps, before)
        with pytest.raises(RemoteWireError) as again:
            await session.look(0.4, 0.4)
        assert again.value is violation.value


async def test_a_message_beyond_the_limit_ends_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_stream, "MESSAGE_MAX_BYTES", 1 << 16)

    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        await hear_look(line)
        await say_bytes(line, bytes(1 << 17))
        await until_gone(line)

    async with session_with(script) as session:
        await session.open()
        with pytest.raises(RemoteWireError, match="WebSocket"):
            await session.look(0.4, 0.4)


async def test_refinements_before_a_scan_is_open_end_the_session() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await line.hear()
        await say_bytes(line, sound_fovea())
        await until_gone(line)

    async with session_with(script) as session:
        with pytest.raises(RemoteWireError, match="before one is open"):
            await session.open()


async def test_a_node_that_never_agrees_is_left() -> None:
    async def script(line: Line) -> None:
        planner = Planner(GRID)
        await show(line, planner)
        for _ in range(9):
            await line.say(m.Resync(planner.epoch, "never content"))
        await until_gone(line)

    async with session_with(script) as session:
        await session.open()
        with pytest.raises(RemoteWireError, match="no agreement"):
            async for _ in session.published():
                pass


# Coming and going


async def test_a_lost_connection_ends_looks_news_and_later_calls() -> None:
    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        await hear_look(line)
        assert line.socket._req is not None
        line.socket._req.transport.abort()  # type: ignore[union-attr]

    async with session_with(script) as session:
        await session.open()
        news = session.published()
        with pytest.raises(NodeLost, match="connect again"):
            await session.look(0.4, 0.4)
        with pytest.raises(NodeLost):
            await anext(news)
        with pytest.raises(NodeLost):
            await anext(session.published())
        with pytest.raises(NodeLost):
            await session.open()


async def test_a_goodbye_is_passed_on_with_its_reason() -> None:
    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        await hear_look(line)
        await line.say(m.Goodbye("the node is stopping"))
        await until_gone(line)

    async with session_with(script) as session:
        await session.open()
        with pytest.raises(NodeLost, match="the node is stopping"):
            await session.look(0.4, 0.4)


async def test_closing_the_session_ends_looks_in_the_air() -> None:
    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        await until_gone(line)

    async with session_with(script) as session:
        await session.open()
        look = asyncio.create_task(session.look(0.4, 0.4))
        news = session.published()
        await asyncio.sleep(0)
    with pytest.raises(NodeLost, match="closed"):
        await look
    with pytest.raises(StopAsyncIteration):
        await anext(news)


async def test_news_of_scans_reaches_everyone_who_listens() -> None:
    told = asyncio.Event()

    async def script(line: Line) -> None:
        await greet(line)
        await told.wait()
        await line.say(m.Published("one"), m.Published("two"))
        await until_gone(line)

    async with session_with(script) as session:
        first, second = session.published(), session.published()
        told.set()
        assert [await anext(first), await anext(first), await anext(second)] == ["one", "two", "one"]


async def test_news_that_nobody_reads_is_not_kept_for_ever() -> None:
    read = asyncio.Event()

    async def script(line: Line) -> None:
        await greet(line)
        await line.say(*(m.Published(str(n)) for n in range(256)))
        await read.wait()
        await line.say(m.Published("256"))
        await until_gone(line)

    async with session_with(script) as session:
        reader, sleeper = session.published(), session.published()
        assert [await anext(reader) for _ in range(256)] == [str(n) for n in range(256)]
        read.set()
        assert await anext(reader) == "256"
        assert [await anext(sleeper) for _ in range(256)] == [str(n) for n in range(256)]
        with pytest.raises(FoveascanError, match="left unread"):
            await anext(sleeper)


async def test_a_client_may_connect_to_what_discovery_found() -> None:
    async with serving(show_and_answer) as url:
        host, port = url.removeprefix("http://").split(":")
        async with connect(NodeAddress("scripted", host, int(port), "", "ready", False)) as session:
            assert session.node == INFO
            assert (await session.open()).info.id == "synthetic"


async def test_a_token_is_presented_with_the_stream_and_in_http() -> None:
    heard: list[str | None] = []

    async def script(line: Line) -> None:
        heard.append(line.authorization)
        await greet(line)
        await until_gone(line)

    async def scans(request: web.Request) -> web.Response:
        heard.append(request.headers.get("Authorization"))
        return web.json_response([])

    async with serving(script, web.get("/v1/scans", scans)) as url, connect(url, token="secret") as session:
        assert await session.scans() == []
    assert heard == ["Bearer secret", "Bearer secret"]


# Nobody there, or nobody who lets us in


async def test_nobody_listening_is_one_error_with_its_cure() -> None:
    with pytest.raises(NodeLost, match="connection refused.*foveascan serve"):
        async with connect("http://127.0.0.1:9"):
            pass


@pytest.mark.parametrize("url", ["", "nonsense", "ftp://127.0.0.1:9", "http://", "http://127.0.0.1:99999"])
async def test_what_is_no_url_is_named(url: str) -> None:
    with pytest.raises(NodeLost, match="https://HOST:PORT"):
        async with connect(url):
            pass


async def test_a_web_server_of_another_kind_is_named() -> None:
    async with serving(greet) as url:  # type: ignore[arg-type]
        with pytest.raises(NodeLost, match="HTTP 404"):
            async with connect(f"{url}/elsewhere"):
                pass


async def test_a_node_behind_a_login_is_a_refusal() -> None:
    async def refuse(request: web.Request) -> web.Response:
        return web.Response(status=401)

    app_route = web.get("/locked/v1/stream", refuse)
    async with serving(show_and_answer, app_route) as url:
        with pytest.raises(RequestRefused, match="token"):
            async with connect(f"{url}/locked"):
                pass


@pytest.mark.parametrize(
    ("answer", "error", "told"),
    [
        ('{"code": "service unavailable", "message": "64 are there"}', RequestRefused, "busy.*64 are there"),
        ("sorry", NodeLost, "HTTP 503: it is no foveascan node"),
    ],
)
async def test_a_node_without_a_place_tells_why(answer: str, error: type[Exception], told: str) -> None:
    async def refuse(request: web.Request) -> web.Response:
        return web.Response(status=503, text=answer)

    async with serving(show_and_answer, web.get("/full/v1/stream", refuse)) as url:
        with pytest.raises(error, match=told):
            async with connect(f"{url}/full"):
                pass


async def test_why_a_node_closed_the_stream_is_told() -> None:
    async def script(line: Line) -> None:
        await greet(line)
        await line.socket.close(code=1002, message=b"no ack within 60 s")

    async with serving(script) as url, connect(url) as session:
        with pytest.raises(NodeLost, match=r"the node closed the stream \(1002\): no ack within 60 s"):
            await session.open()


async def test_a_hello_that_is_refused_names_the_reason() -> None:
    async def script(line: Line) -> None:
        await line.say(INFO)
        await line.hear()
        await line.say(m.Refused(0, "forbidden", "this node needs a token"))

    async with serving(script) as url:
        with pytest.raises(RequestRefused, match="needs a token"):
            async with connect(url):
                pass


async def test_another_version_of_the_protocol_is_named() -> None:
    async def script(line: Line) -> None:
        await line.say(replace_protocol("foveascan.v9"))
        assert await line.gone() == PROTOCOL_ERROR

    async with serving(script) as url:
        with pytest.raises(RemoteWireError, match="foveascan.v9"):
            async with connect(url):
                pass


def replace_protocol(protocol: str) -> m.ServerInfo:
    return m.ServerInfo(protocol, INFO.id, INFO.name, INFO.version)


async def test_a_node_that_says_nothing_is_not_waited_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client_stream, "HANDSHAKE_S", 0.2)

    async with serving(until_gone) as url:
        with pytest.raises(NodeLost, match="does not answer"):
            async with connect(url):
                pass


# HTTP beside the stream


async def test_scans_and_sweeps_are_asked_for_over_http() -> None:
    async def scans(request: web.Request) -> web.Response:
        return web.json_response([{"id": "b"}, {"id": "a"}])

    async def sweep(request: web.Request) -> web.Response:
        return web.json_response({"phase": "sweeping", "progress": 0.0}, status=202)

    async def node(request: web.Request) -> web.Response:
        return web.json_response({"id": "0123", "capture": {"phase": "sweeping", "progress": 0.5}})

    routes = web.get("/v1/scans", scans), web.post("/v1/sweeps", sweep), web.get("/v1/node", node)
    async with session_with(show_and_answer, *routes) as session:
        assert [scan["id"] for scan in await session.scans()] == ["b", "a"]
        assert (await session.start_sweep())["phase"] == "sweeping"
        assert (await session.scanner())["progress"] == 0.5


@pytest.mark.parametrize(
    ("status", "body", "error", "match"),
    [
        (409, b'{"code":"conflict","message":"a sweep is running already"}', RequestRefused, "running already"),
        (500, b"{}", RequestRefused, "HTTP 500"),
        (200, b"<html>", RemoteWireError, "JSON"),
        (200, b"[" + b" " * (5 << 20) + b"]", RemoteWireError, "more than"),
    ],
    ids=["refused", "failed", "no JSON", "too long"],
)
async def test_a_bad_http_reply_is_one_of_our_errors(
    status: int, body: bytes, error: type[Exception], match: str
) -> None:
    async def sweep(request: web.Request) -> web.Response:
        return web.Response(status=status, body=body)

    async with session_with(show_and_answer, web.post("/v1/sweeps", sweep)) as session:
        with pytest.raises(error, match=match):
            await session.start_sweep()
