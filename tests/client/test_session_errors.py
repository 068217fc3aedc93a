from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from imagecodecs import deflate_encode

from client import RequestRefused
from client import stream as client_stream
from protocol import messages as m
from protocol.errors import LocalWireError, RemoteWireError
from tests.client.scripted_node import (
    INFO,
    Line,
    Planner,
    greet,
    hear_look,
    session_with,
    show,
    show_and_answer,
    synthetic_grid,
    until_gone,
    updated,
)

GRID = synthetic_grid()
PROTOCOL_ERROR = 1002
DEFLATED = [deflate_encode(bytes(size), raw=True) for size in (2 * 8 * 12 - 2, 2 * 8 * 12 + 2)]


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


@pytest.mark.parametrize("errors", [b"", b"\xff", *DEFLATED], ids=["none", "noise", "few", "many"])
async def test_an_envelope_that_does_not_fit_the_scan_is_refused(errors: bytes) -> None:
    async def script(line: Line) -> None:
        await show(line, Planner(GRID))
        asked = await line.hear()
        assert isinstance(asked, m.Envelope)
        await line.say(m.Enveloped(asked.request, 1, errors))
        await until_gone(line)

    async with session_with(script) as session:
        await session.open()
        with pytest.raises(RemoteWireError, match="enveloped"):
            await session.error_envelope()


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
