"""What one address, one connection and one stream may take, on real sockets; others are served all the while."""

from __future__ import annotations

import asyncio
import ssl
import time
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from pathlib import Path

import aiohttp
import pytest

from client import connect
from node import gate
from node.config import Config, Limits, Server
from protocol.messages import PROTOCOL
from tests.node.entrance import ANY_PORT, Entrance, entrance
from tests.waiting import until


def untrusting() -> ssl.SSLContext:
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


Line = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@asynccontextmanager
async def line_to(node: Entrance, *, tls: bool = True) -> AsyncIterator[Line]:
    """A bare connection."""
    port = int(node.url.rpartition(":")[2])
    reader, writer = await asyncio.open_connection("127.0.0.1", port, ssl=untrusting() if tls else None, limit=4096)
    try:
        yield reader, writer
    finally:
        writer.transport.abort()


async def answer_on(line: Line, path: str = "/healthz") -> bytes:
    """What comes on a connection for a request, to its end; b"" where it is closed without a word."""
    reader, writer = line
    with suppress(ConnectionError):
        writer.write(f"GET {path} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
        async with asyncio.timeout(10):
            head = await reader.readuntil(b"\r\n\r\n")
            return head + await reader.read(4096)
    return b""


async def end_of(reader: asyncio.StreamReader) -> bytes:
    """All that comes until the other end closes."""
    with suppress(ConnectionError):
        async with asyncio.timeout(15):
            return await reader.read()
    return b""


async def test_other_limits_hold_at_once(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(requests_s_per_address=1)) as node:

        async def statuses() -> set[int]:
            said = set()
            for _ in range(40):
                async with node.ask("GET", "/healthz") as answer:
                    said.add(answer.status)
            return said

        assert 429 in await statuses()
        node.server.use(Config(server=ANY_PORT))
        assert await statuses() == {200}
        node.server.use(Config(server=ANY_PORT, limits=Limits(connections_per_address=1)))
        async with line_to(node) as surplus:  # beside the one that has asked so far, and stays
            assert b"too many connections" in await answer_on(surplus)
        assert await statuses() == {200}


@pytest.mark.parametrize("said", [b"", b"GET /healthz HT", b"GET /healthz HTTP/1.1\r\nHost: x\r\nA: b"])
async def test_a_head_that_does_not_come_ends_the_connection(tmp_path: Path, said: bytes) -> None:
    async with entrance(tmp_path, limits=Limits(head_s=1)) as node, line_to(node) as (reader, writer):
        writer.write(said)
        assert await end_of(reader) == b""
        async with node.ask("GET", "/healthz") as answer:
            assert answer.status == 200


async def test_a_handshake_that_does_not_come_ends_the_connection(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(head_s=1)) as node, line_to(node, tls=False) as (reader, _):
        assert await end_of(reader) == b""
        assert node.server._gate.connections == 0


async def test_a_body_that_does_not_come_is_told_so(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(body_s=1)) as node, line_to(node) as (reader, writer):
        writer.write(b"POST /v1/pair HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\n{")
        assert (await end_of(reader)).startswith(b"HTTP/1.1 408 ")


async def test_idle_connections_are_closed(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(keep_s=1)) as node, line_to(node) as line:
        assert b" 200 OK" in await answer_on(line)
        assert await end_of(line[0]) == b""


async def test_one_address_has_so_many_connections_and_is_told(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(connections_per_address=3)) as node, AsyncExitStack() as stack:
        lines = [await stack.enter_async_context(line_to(node)) for _ in range(3)]
        for line in lines:
            assert b" 200 OK" in await answer_on(line)
        async with line_to(node) as surplus:
            told = await answer_on(surplus)
            assert told.startswith(b"HTTP/1.1 503 ") and b"Retry-After: 5" in told and b"too many connections" in told
            assert await end_of(surplus[0]) == b""
        for _ in range(gate.SURPLUS):
            await stack.enter_async_context(line_to(node, tls=False))
        async with line_to(node, tls=False) as refused:
            assert await end_of(refused[0]) == b""
        assert node.server._gate.turned_away == 1
        await stack.aclose()
        await until(lambda: not node.server._gate.connections)
        async with line_to(node) as line:
            assert b" 200 OK" in await answer_on(line)


async def test_all_together_have_so_many_connections(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(connections=32)) as node, AsyncExitStack() as stack:
        for _ in range(32 - gate.SURPLUS):
            await stack.enter_async_context(line_to(node, tls=False))
        async with line_to(node) as surplus:
            assert (await answer_on(surplus)).startswith(b"HTTP/1.1 503 ")


class Clock:
    """The node's, of which a second passes when a test says so."""

    now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s


async def test_one_address_asks_so_often_and_others_do_not_notice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(gate, "time", clock := Clock())
    settings = Server(listen="127.0.0.1:0", trusted_proxies=("127.0.0.1",))
    async with entrance(tmp_path, settings, Limits(requests_s_per_address=1)) as node:
        greedy, other = {"X-Forwarded-For": "10.0.0.1"}, {"X-Forwarded-For": "10.0.0.2"}
        statuses = []
        for _ in range(4):
            async with node.ask("GET", "/healthz", headers=greedy) as answer:
                statuses.append(answer.status)
                wait = answer.headers.get("Retry-After")
        assert (statuses, wait) == ([200, 200, 429, 429], "1")
        async with node.ask("GET", "/healthz", headers=other) as answer:
            assert answer.status == 200
        clock.now_s += 1.0
        async with node.ask("GET", "/healthz", headers=greedy) as answer:
            assert answer.status == 200


async def test_one_address_has_so_many_requests_in_work(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(requests_per_address=1)) as node:
        async with line_to(node) as (_, writer):
            writer.write(b"POST /v1/pair HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\n{")
            async with asyncio.timeout(10):
                while True:
                    async with node.ask("GET", "/healthz") as answer:
                        if answer.status == 429:
                            assert answer.headers["Retry-After"] == "1"
                            break
        async with asyncio.timeout(10):
            while True:
                async with node.ask("GET", "/healthz") as answer:
                    if answer.status == 200:
                        break


async def test_one_address_has_so_many_streams(tmp_path: Path) -> None:
    settings = Server(listen="127.0.0.1:0", trusted_proxies=("127.0.0.1",))
    async with entrance(tmp_path, settings, Limits(streams_per_address=2)) as node, AsyncExitStack() as stack:
        headers = {"Authorization": f"Bearer {node.token('view')}"}

        def stream(address: str) -> aiohttp.client._WSRequestContextManager:
            forwarded = headers | {"X-Forwarded-For": address}
            return node.http.ws_connect(f"{node.url}/v1/stream", protocols=[PROTOCOL], headers=forwarded)

        first = await stream("10.0.0.1")
        await stack.enter_async_context(stream("10.0.0.1"))
        with pytest.raises(aiohttp.WSServerHandshakeError, match="429"):
            await stream("10.0.0.1")
        await stack.enter_async_context(stream("10.0.0.2"))
        await first.close()
        async with asyncio.timeout(10):
            while True:
                with suppress(aiohttp.WSServerHandshakeError):
                    await stack.enter_async_context(stream("10.0.0.1"))
                    break


@pytest.mark.parametrize("kind", ["text", "ping"])
async def test_a_stream_that_says_too_much_is_read_no_faster_and_others_notice_nothing(
    tmp_path: Path, kind: str
) -> None:
    async with entrance(tmp_path, limits=Limits(messages_s=5)) as node:
        headers = {"Authorization": f"Bearer {node.token('view')}"}
        async with (
            node.http.ws_connect(f"{node.url}/v1/stream", protocols=[PROTOCOL], headers=headers) as stream,
            connect(node.url, node.token("view", "other"), node.tls.fingerprint) as session,
        ):
            await stream.send_str('{"type":"hello","protocol":"foveascan.v1"}')
            began_s = time.monotonic()
            for _ in range(20):
                await (stream.ping() if kind == "ping" else stream.send_str('{"type":"cancel","request":1}'))
            await stream.send_str('{"type":"open","request":1,"scan":"none such"}')
            await session.open()
            assert (await session.look(0.5, 0.5)).reason == "complete"
            while "refused" not in (said := await stream.receive()).data:
                assert said.type is aiohttp.WSMsgType.TEXT
            assert time.monotonic() - began_s > 1.5  # of 22 messages 10 are read at once, then five a second


async def test_a_client_that_clicks_as_fast_as_it_can_notices_nothing(tmp_path: Path) -> None:
    async with (
        entrance(tmp_path) as node,
        connect(node.url, node.token("view"), node.tls.fingerprint) as session,
    ):
        await session.open()
        answered = [await session.look(at / 200, 0.5) for at in range(200)]
    assert [update.request for update in answered] == list(range(answered[0].request, answered[0].request + 200))


async def test_who_does_not_read_the_answer_is_cut_off(tmp_path: Path) -> None:
    async with entrance(tmp_path, limits=Limits(stall_s=1)) as node, line_to(node) as (reader, writer):
        head = f"Host: x\r\nAuthorization: Bearer {node.token('view')}\r\n\r\n"
        writer.transport.pause_reading()  # type: ignore[attr-defined]
        for _ in range(300):
            writer.write(f"GET /v1/scans/{node.scan}.stl HTTP/1.1\r\n{head}".encode())
        await until(lambda: not node.server._gate.connections)
        async with node.ask("GET", "/healthz") as answer:
            assert answer.status == 200


async def test_a_target_that_is_no_url_ends_the_connection_and_no_more(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async with entrance(tmp_path / "library") as node:
        async with line_to(node) as (reader, writer):
            writer.write(b"GET http://[::1]@/ HTTP/1.1\r\nHost: x\r\n\r\n")
            assert await reader.read() == b""
        async with node.ask("GET", "/healthz") as answer:
            assert answer.status == 200
    assert [record.getMessage() for record in caplog.records if record.levelname == "ERROR"] == []
    assert "its target is no URL" in caplog.text


async def test_what_is_no_http_is_told_so_and_nothing_of_us(tmp_path: Path) -> None:
    async with entrance(tmp_path / "library") as node, line_to(node) as (reader, writer):
        writer.write(b"GET /v1/scans HTTP/1.1\r\nHost: x\r\nA\x00B: y\r\n\r\n")
        said = (await reader.read()).decode()
    assert said.partition(" ")[2].startswith("400 ")
    assert said.endswith('{"code":"bad request","message":"that is no HTTP"}')
    assert "Server: foveascan\r\n" in said and "Content-Type: application/json" in said
