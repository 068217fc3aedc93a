from __future__ import annotations

import asyncio

import pytest
from aiohttp import web

from client import NodeLost, RequestRefused, connect
from client import stream as client_stream
from client.discovery import NodeAddress
from protocol import messages as m
from protocol.errors import FoveascanError, RemoteWireError
from tests.client.scripted_node import (
    INFO,
    Line,
    Planner,
    greet,
    hear_look,
    serving,
    session_with,
    show,
    show_and_answer,
    synthetic_grid,
    until_gone,
)

GRID = synthetic_grid()
PROTOCOL_ERROR = 1002


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
        await line.say(m.Published("one", 3), m.Published("two", made_from=("one",)))
        await until_gone(line)

    async with session_with(script) as session:
        first, second = session.published(), session.published()
        told.set()
        swept, made = await anext(first), await anext(first)
        assert [swept, made, await anext(second)] == ["one", "two", "one"]
        assert [(news.sweep, news.made_from) for news in (swept, made)] == [(3, ()), (0, ("one",))]


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


async def test_who_speaks_to_a_node_that_has_just_gone_hears_why(monkeypatch: pytest.MonkeyPatch) -> None:
    said = asyncio.Event()

    async def script(line: Line) -> None:
        await greet(line)
        await said.wait()
        await line.say(m.Goodbye("the node is stopping"))
        await until_gone(line)

    async def refused(stream: client_stream.Stream, message: m.FromClient) -> None:
        said.set()
        raise NodeLost("cannot write to closing transport")

    async with session_with(script) as session:
        monkeypatch.setattr(client_stream.Stream, "send", refused)
        with pytest.raises(NodeLost, match="the node is stopping"):
            await anext(session.live())


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


@pytest.mark.parametrize(
    "url", ["", "nonsense", "ftp://127.0.0.1:9", "http://", "http://127.0.0.1:99999", "http://[::1]@"]
)
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
        return web.json_response({"phase": "sweeping", "progress": 0.0, "sweeps": 0, "why": "", "sweep": 1}, status=202)

    async def node(request: web.Request) -> web.Response:
        capture = {"phase": "sweeping", "progress": 0.5, "sweeps": 0, "why": ""}
        return web.json_response({"id": "0123", "capture": capture})

    routes = web.get("/v1/scans", scans), web.post("/v1/sweeps", sweep), web.get("/v1/node", node)
    async with session_with(show_and_answer, *routes) as session:
        assert [scan["id"] for scan in await session.scans()] == ["b", "a"]
        assert (await session.start_sweep())["phase"] == "sweeping"
        assert (await session.scanner())["progress"] == 0.5


@pytest.mark.parametrize("said", [[], 1, {}, {"phase": "ready"}, {"capture": []}, {"capture": {"phase": 1}}, [{}, 1]])
async def test_an_answer_of_another_kind_is_one_of_our_errors(said: object) -> None:
    async def answer(request: web.Request) -> web.Response:
        return web.json_response(said)

    routes = web.get("/v1/scans", answer), web.post("/v1/sweeps", answer), web.get("/v1/node", answer)
    async with session_with(show_and_answer, *routes) as session:
        for asking in (session.scanner, session.start_sweep):
            with pytest.raises(RemoteWireError, match="scanner|sweep"):
                await asking()
        if said != []:
            with pytest.raises(RemoteWireError, match="lists its scans"):
                await session.scans()


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
