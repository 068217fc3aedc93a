"""Who may do what: every request, each role, and what ends a login."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from pathlib import Path

import aiohttp
import pytest
from aiohttp import web

from client import NodeLost, RequestRefused, connect
from node.access import Access
from node.auth import COOKIE, NOBODY, SUBPROTOCOL, WRONG_TOKENS, Auth
from node.config import Config, Server
from node.endpoints import ENDPOINTS, roles_table
from node.serve import NodeServer
from protocol.messages import PROTOCOL
from protocol.pairing import Role
from tests.node.entrance import Entrance, entrance

ROLES: tuple[Role | None, ...] = (None, "monitor", "view", "operate", "admin")
README = (Path(__file__).parents[2] / "README.md").read_text()


@pytest.fixture
async def node(tmp_path: Path) -> AsyncIterator[Entrance]:
    async with entrance(tmp_path / "library") as node:
        yield node


def routes(node: Entrance) -> list[tuple[str, str]]:
    every = (route for route in node.server._app.router.routes() if route.method != "HEAD" and route.resource)
    return sorted({(route.method, route.resource.canonical) for route in every if route.resource})


async def test_the_table_of_endpoints_is_what_the_node_answers_and_the_readme_says(node: Entrance) -> None:
    assert sorted((one.method, one.canonical) for one in ENDPOINTS.values()) == routes(node)
    assert roles_table() in README, roles_table()


async def test_each_role_may_ask_exactly_what_the_table_says(node: Entrance) -> None:
    tokens = {role: node.token(role) if role else "" for role in ROLES}
    for method, path in routes(node):
        scan = node.scan if method == "GET" else "0" * 32
        place = path.replace("{scan}", scan).replace("{format}", "stl")
        place = re.sub(r"\{\w+\}", "0", place)
        for role in ROLES:
            async with node.ask(method, place, tokens[role]) as answer:
                status = answer.status
                said = await answer.read()
            may = ROLES.index(role) >= ROLES.index(ENDPOINTS[f"{method} {path}"].role)
            if role is None and path == "/":
                assert (status, answer.headers["Location"]) == (303, "/pair")
            elif may:
                own_words = (b"no such code", b"X-Original-URI names nothing")
                assert status not in (401, 403) or any(words in said for words in own_words), (method, path, role)
            else:
                assert status == (401 if role is None else 403), (method, path, role, status)
            assert node.scan.encode() not in said or may
    assert [scan.id for scan in node.library.scans()] == [node.scan]


async def test_what_is_not_there_is_hidden_from_nobody_in_particular(node: Entrance) -> None:
    async with node.ask("GET", "/v1/elsewhere") as answer:
        assert (answer.status, answer.headers["WWW-Authenticate"]) == (401, "Bearer")
    async with node.ask("GET", "/v1/elsewhere", node.token("view")) as answer:
        assert answer.status == 404


async def test_health_tells_strangers_one_word(node: Entrance) -> None:
    async with node.ask("GET", "/healthz") as answer:
        assert await answer.json() == {"status": "ready"}
    async with node.ask("GET", "/healthz", node.token("view")) as answer:
        assert "capture" in await answer.json()


async def test_answers_carry_strict_headers_also_when_they_refuse(node: Entrance) -> None:
    for path in ("/healthz", "/v1/scans", "/pair", "/elsewhere"):
        async with node.ask("GET", path) as answer:
            assert answer.headers["Cache-Control"] == "no-store"
            assert answer.headers["X-Content-Type-Options"] == "nosniff"
            assert answer.headers["Referrer-Policy"] == ("same-origin" if path == "/pair" else "no-referrer")
            assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
            assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
            assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
            assert answer.headers["Server"] == "foveascan"


# Ways to show a token


async def test_a_token_is_taken_as_header_as_subprotocol_and_as_cookie(node: Entrance) -> None:
    token = node.token("view")
    async with node.ask("GET", "/v1/scans", headers={"Cookie": f"{COOKIE}={token}"}) as answer:
        assert answer.status == 200
    async with node.http.ws_connect(f"{node.url}/v1/stream", protocols=[PROTOCOL, SUBPROTOCOL + token]) as stream:
        assert stream.protocol == PROTOCOL
        assert (await stream.receive_json())["type"] == "serverInfo"


@pytest.mark.parametrize("show", ["Bearer {}x", "Bearer", "Basic {}", "Bearer é", "{}"])
async def test_a_token_that_is_wrong_is_none(node: Entrance, show: str) -> None:
    header = show.format(node.token("admin"))
    async with node.ask("GET", "/v1/scans", headers={"Authorization": header}) as answer:
        assert answer.status == 401


async def test_a_stream_of_nobody_is_refused_before_it_begins(node: Entrance) -> None:
    with pytest.raises(aiohttp.WSServerHandshakeError, match="401"):
        await node.http.ws_connect(f"{node.url}/v1/stream", protocols=[PROTOCOL])


async def test_wrong_tokens_are_counted_and_never_written_down(
    node: Entrance, caplog: pytest.LogCaptureFixture
) -> None:
    statuses = []
    for number in range(WRONG_TOKENS + 1):
        async with node.ask("GET", "/v1/scans", f"guess-{number}") as answer:
            statuses.append(answer.status)
    assert statuses == [401] * WRONG_TOKENS + [429]
    assert "wrong or revoked token" in caplog.text
    assert "guess" not in caplog.text
    async with node.ask("GET", "/v1/scans", node.token("view")) as answer:
        assert answer.status == 200  # whoever shares the address is let in all the same


# Browsers


async def test_a_foreign_origin_fails_even_with_a_valid_cookie(node: Entrance) -> None:
    cookie = {"Cookie": f"{COOKIE}={node.token('admin')}"}
    for origin, status in [
        (node.url, 200),
        ("https://evil.example", 403),
        ("null", 403),
        (node.url.replace("https", "http"), 403),
        (node.url + "0", 403),
    ]:
        async with node.ask("GET", "/v1/scans", headers={**cookie, "Origin": origin}) as answer:
            assert answer.status == status, origin
        headers = {**cookie, "Origin": origin}
        if status == 200:
            async with node.http.ws_connect(f"{node.url}/v1/stream", protocols=[PROTOCOL], headers=headers) as stream:
                assert (await stream.receive_json())["type"] == "serverInfo"
        else:
            with pytest.raises(aiohttp.WSServerHandshakeError, match="403"):
                await node.http.ws_connect(f"{node.url}/v1/stream", protocols=[PROTOCOL], headers=headers)


async def test_a_cookie_changes_nothing_without_an_origin(node: Entrance) -> None:
    cookie = {"Cookie": f"{COOKIE}={node.token('admin')}"}
    async with node.ask("DELETE", f"/v1/scans/{node.scan}", headers=cookie) as answer:
        assert answer.status == 403
    async with node.ask("DELETE", f"/v1/scans/{node.scan}", headers={**cookie, "Origin": node.url}) as answer:
        assert answer.status == 204


@pytest.mark.parametrize(
    ("host", "status"),
    [("localhost:1", 200), ("[::1]:1", 200), ("evil.example", 403), ("", 403), ("[::1]@", 403), ("[::1]:x", 403)],
)
async def test_without_login_a_name_that_leads_here_is_not_enough(host: str, status: int) -> None:
    app = web.Application(middlewares=[Auth(None).admit])

    async def hello(request: web.Request) -> web.Response:
        return web.Response()

    app.add_routes([web.get("/", hello)])
    runner = web.AppRunner(app)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    async with aiohttp.ClientSession() as http:
        async with http.get(f"http://127.0.0.1:{runner.addresses[0][1]}", headers={"Host": host}) as answer:
            assert answer.status == status
    await runner.cleanup()


# Revoking


async def test_a_token_revoked_by_another_process_ends_its_stream_and_no_other(node: Entrance) -> None:
    gone, stays = node.token("view", "gone"), node.token("view", "stays")
    async with (
        connect(node.url, gone, node.tls.fingerprint) as session,
        connect(node.url, stays, node.tls.fingerprint) as other,
    ):
        await session.open()
        await other.open()
        Access(node.library.folder / "access").revoke("gone")
        with pytest.raises(NodeLost, match="revoked"):
            async with asyncio.timeout(5):
                await anext(session.published())
        assert (await other.look(0.5, 0.5)).reason == "complete"
    with pytest.raises(RequestRefused, match="join"):
        async with connect(node.url, gone, node.tls.fingerprint):
            pass


async def test_a_token_revoked_over_http_ends_its_stream_at_once(node: Entrance) -> None:
    async with connect(node.url, node.token("view", "gone"), node.tls.fingerprint) as session:
        async with node.ask("DELETE", "/v1/tokens/gone", node.token("admin")) as answer:
            assert answer.status == 204
        with pytest.raises(NodeLost, match="revoked"):
            async with asyncio.timeout(0.4):
                await anext(session.published())


async def test_a_damaged_file_of_tokens_ends_every_stream(node: Entrance) -> None:
    async with connect(node.url, node.token("view"), node.tls.fingerprint) as session:
        (node.library.folder / "access" / "access.json").write_text("?")
        with pytest.raises(NodeLost, match="revoked"):
            async with asyncio.timeout(5):
                await anext(session.published())
    async with node.ask("GET", "/v1/scans", "any") as answer:
        assert answer.status == 503


async def test_a_request_that_is_being_answered_ends_with_its_login(tmp_path: Path) -> None:
    async with entrance(tmp_path / "library") as node:
        auth, begun = Auth(node.access), asyncio.Event()

        async def wait(request: web.Request) -> web.Response:
            begun.set()
            await asyncio.Event().wait()
            return web.Response()

        app = web.Application(middlewares=[auth.admit])
        app.add_routes([web.post("/", wait)])
        runner = web.AppRunner(app)
        await runner.setup()
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        async with aiohttp.ClientSession(headers={"Authorization": f"Bearer {node.token('view')}"}) as http:
            asked = asyncio.create_task(http.post(f"http://127.0.0.1:{runner.addresses[0][1]}/"))
            await begun.wait()
            auth.expel()
            assert not asked.done()
            node.access.revoke("view")
            auth.expel()
            with pytest.raises(aiohttp.ClientError):
                await asked
        await runner.cleanup()


def test_a_node_with_logins_needs_tokens_and_a_certificate() -> None:
    with pytest.raises(ValueError, match="insecure"):
        NodeServer(Config(server=Server()), None, None, None, None)  # type: ignore[arg-type]
    assert NOBODY.role is None
