"""A stream whose client breaks the rules: it is told why and sent away, in whole characters; nobody else notices."""

from __future__ import annotations

import asyncio
import gc
import threading
import time
import weakref
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
from aiohttp import ClientWebSocketResponse, WSMsgType

from node import connection
from node.bound import Bound
from node.library import About, Library
from node.serve import HEARTBEAT_S
from node.texture_search import TextureSearch
from node.wanted import Models, Wanted
from protocol import messages as m
from protocol.codec import TextureCodec
from protocol.errors import CodecError
from protocol.holdings import Holdings
from protocol.lattice import Channel
from protocol.refinement import Refinement
from tests.node.scans import make_grid
from tests.node.served import Client, served


@pytest.fixture
async def node(tmp_path: Path) -> AsyncIterator[Client]:
    library = Library(tmp_path)
    library.add(make_grid(), About(0.0))
    async with served(library) as (client, _):
        yield client


async def opened(node: Client, *codecs: m.CodecName) -> tuple[ClientWebSocketResponse, m.Opened]:
    """A stream with the newest scan open, its first view received and not acknowledged."""
    stream = await node.ws_connect("/v1/stream", protocols=[m.PROTOCOL])
    for said in (m.Hello(m.PROTOCOL, codecs=codecs or ("htj2k",)), m.Open(1, "latest")):
        await stream.send_str(m.encode_message(said))
    answers = [await stream.receive() for _ in range(5)]
    assert [answer.type for answer in answers] == [WSMsgType.TEXT] * 3 + [WSMsgType.BINARY] * 2
    answer = m.decode_message(answers[2].data)
    assert isinstance(answer, m.Opened)
    return stream, answer


def state(answer: m.Opened, next_seq: int) -> m.State:
    """What a client says that holds the first view and waits for next_seq."""
    held = Holdings.coarse(answer.scan.shapes()).channels
    return m.State(
        answer.epoch, next_seq, m.Statement(held[Channel.RANGE].to_runs(), held[Channel.TEXTURE].to_runs())
    )


@pytest.mark.parametrize("next_seq", [3, 0xFFFFFFFF])
async def test_a_client_cannot_wait_for_what_was_never_sent(node: Client, next_seq: int) -> None:
    stream, answer = await opened(node)
    await stream.send_str(m.encode_message(state(answer, next_seq)))
    end = await stream.receive()
    assert (end.type, end.data) == (WSMsgType.CLOSE, 1002)
    assert end.extra == f"state: refinement {next_seq} cannot be next, 2 is"


async def test_a_client_may_state_what_it_holds_at_any_time(node: Client) -> None:
    stream, answer = await opened(node)
    for said in (state(answer, 2), m.Look(7, 0.5, 0.5, max_bytes=0)):
        await stream.send_str(m.encode_message(said))
    updated = m.decode_message((await stream.receive()).data)
    assert isinstance(updated, m.Updated)
    assert (updated.request, updated.next_seq) == (7, 2)
    await stream.close()


async def test_who_clicks_faster_than_the_node_plans_is_answered(
    node: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Bound.plan

    def slowly(self: Bound, wanted: Wanted, models: Models, superseded: Callable[[], bool], *more: Any) -> Any:
        until_s = time.monotonic() + 0.2
        while time.monotonic() < until_s and not superseded():
            time.sleep(0.002)
        return plan(self, wanted, models, superseded, *more)

    monkeypatch.setattr(Bound, "plan", slowly)
    stream, answer = await opened(node)
    await stream.send_str(m.encode_message(state(answer, 2)))
    answered: m.Updated | None = None
    for request in range(2, 1000):
        await asyncio.sleep(0.03)
        await stream.send_str(m.encode_message(m.Look(request, 0.5, 0.5, max_bytes=0)))
        with suppress(TimeoutError):
            said = m.decode_message((await stream.receive(timeout=0.05)).data)
            if isinstance(said, m.Updated) and said.reason != "superseded":
                answered = said
                break
    assert answered is not None
    await stream.close()


@pytest.mark.parametrize(("texture_db", "codec"), [(32, TextureCodec.JPEG), (45, TextureCodec.HTJ2K)])
async def test_a_client_that_likes_jpeg_gets_better_texture_than_that_has(
    node: Client, texture_db: float, codec: TextureCodec
) -> None:
    stream, answer = await opened(node, "jpeg", "htj2k")
    for asked in (state(answer, 2), m.Look(2, 0.75, 0.5, texture_db=texture_db)):
        await stream.send_str(m.encode_message(asked))
    *_, texture = [Refinement.from_bytes((await stream.receive()).data) for _ in Channel]
    assert (texture.channel, texture.codec) == (Channel.TEXTURE, codec)
    ended = m.decode_message((await stream.receive()).data)
    assert isinstance(ended, m.Updated) and ended.texture_db is not None and ended.texture_db >= texture_db
    await stream.close()


@pytest.fixture
def held_up(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Texture is planned once this is set."""
    go_on, search = threading.Event(), TextureSearch.search

    def patiently(self: TextureSearch, aim_bytes: float, limit_bytes: float) -> Any:
        assert go_on.wait(60)
        return search(self, aim_bytes, limit_bytes)

    monkeypatch.setattr(TextureSearch, "search", patiently)
    yield go_on
    go_on.set()


async def said(stream: ClientWebSocketResponse, *messages: m.FromClient) -> None:
    """Say something, and wait until the node has heard it."""
    for message in (*messages, m.Envelope(9)):
        await stream.send_str(m.encode_message(message))
    assert isinstance(m.decode_message((await stream.receive()).data), m.Enveloped)


async def begun(stream: ClientWebSocketResponse, request: int) -> None:
    """Look, and have the range of it."""
    await stream.send_str(m.encode_message(m.Look(request, 0.75, 0.5, texture_db=32)))
    first = Refinement.from_bytes((await stream.receive()).data)
    assert (first.channel, first.seq, first.look) == (Channel.RANGE, 2, request)


async def test_range_is_sent_while_texture_is_planned_and_then_no_look_is_given_up(
    node: Client, held_up: threading.Event
) -> None:
    stream, answer = await opened(node)
    await stream.send_str(m.encode_message(state(answer, 2)))
    await begun(stream, 2)
    await said(stream, m.Cancel(2), m.Look(3, 0.2, 0.5))
    held_up.set()
    texture = Refinement.from_bytes((await stream.receive()).data)
    assert (texture.channel, texture.seq, texture.look) == (Channel.TEXTURE, 3, 2)
    ended = m.decode_message((await stream.receive()).data)
    assert isinstance(ended, m.Updated)
    assert (ended.request, ended.next_seq, ended.reason) == (2, 4, "complete")
    await stream.close()


async def test_a_look_whose_range_a_client_objects_to_is_dropped(node: Client, held_up: threading.Event) -> None:
    stream, answer = await opened(node)
    await stream.send_str(m.encode_message(state(answer, 2)))
    await begun(stream, 2)
    await said(stream, state(answer, 2))
    held_up.set()
    dropped = m.decode_message((await stream.receive()).data)
    assert isinstance(dropped, m.Updated)
    assert (dropped.request, dropped.next_seq, dropped.reason) == (2, 2, "superseded")
    await begun(stream, 3)
    await stream.close()


async def test_an_update_that_cannot_be_ended_costs_no_stream(
    node: Client, held_up: threading.Event, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream, answer = await opened(node)
    await stream.send_str(m.encode_message(state(answer, 2)))
    patiently = TextureSearch.search

    def fail(self: TextureSearch, aim_bytes: float, limit_bytes: float) -> Any:
        patiently(self, aim_bytes, limit_bytes)
        raise CodecError("it fails")

    with monkeypatch.context() as patched:
        patched.setattr(TextureSearch, "search", fail)
        await begun(stream, 2)
        held_up.set()
        told = [m.decode_message((await stream.receive()).data) for _ in range(2)]
    assert [type(one) for one in told] == [m.Resync, m.Refused]
    await stream.send_str(m.encode_message(state(answer, 2)))
    await begun(stream, 3)
    await stream.close()


async def test_a_client_that_says_nothing_is_told_why_it_is_sent_away(
    node: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "HELLO_S", 0.05)
    stream = await node.ws_connect("/v1/stream", protocols=[m.PROTOCOL])
    await stream.receive()
    end = await stream.receive()
    assert (end.type, end.data, end.extra) == (WSMsgType.CLOSE, 1002, "no hello within 0.05 s")


async def test_a_client_that_acknowledges_nothing_is_told_why_it_is_sent_away(
    node: Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "ACK_S", 0.05)
    stream, _ = await opened(node)
    await stream.send_str(m.encode_message(m.Look(7, 0.5, 0.5)))
    end = await stream.receive()
    assert (end.type, end.data, end.extra) == (WSMsgType.CLOSE, 1002, "no ack within 0.05 s")


@pytest.mark.parametrize("letter", ["a", "é", "中", "😀"])
async def test_the_reason_of_a_close_is_whole_characters(node: Client, letter: str) -> None:
    stream, _ = await opened(node)
    await stream.send_str(msgspec.json.encode({"type": 150 * letter}).decode())
    end = await stream.receive()
    assert (end.type, end.data) == (WSMsgType.CLOSE, 1002)
    assert str(end.extra).startswith(f"bad message: Invalid value '{letter}")


async def test_nothing_is_kept_of_a_stream_that_has_ended(tmp_path: Path) -> None:
    async with served(Library(tmp_path)) as (client, server):
        stream = await client.ws_connect("/v1/stream", protocols=[m.PROTOCOL])
        await stream.receive()
        [ours] = [weakref.ref(one._socket) for one in server._connections]
        await stream.send_str("nothing that a client says")
        assert (await stream.receive()).type is WSMsgType.CLOSE
        async with asyncio.timeout(HEARTBEAT_S / 2):  # after as long it would be let go of anyway
            while ours() is not None:
                await asyncio.sleep(0.01)
                gc.collect()
