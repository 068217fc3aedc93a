"""Whatever is asked of a node is noted, or named here as what needs no note; admins read it over HTTP."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from client import connect
from node.audit import done_trail, read_trail, refused_trail
from node.endpoints import ENDPOINTS
from tests.node.entrance import Entrance, entrance
from tests.node.test_auth import routes
from tests.waiting import until

PRIVATE = ("a secret name", "subject-0815")
NOT_AUDITED = {  # they show, change and delete no scan, or are noted where they are done
    ("GET", "/"), ("GET", "/assets/{name}"), ("GET", "/healthz"), ("GET", "/metrics"), ("GET", "/v1/node"),
    ("GET", "/openapi.json"), ("GET", "/v1/axes"),
    ("GET", "/v1/sweeps"), ("GET", "/v1/audit"), ("GET", "/pair"), ("GET", "/v1/tokens"), ("GET", "/v1/codes"),
    ("GET", "/v1/upkeep"),
    ("GET", "/v1/stream"),  # node.connection
    ("GET", "/v1/scans/{scan}/fovea"),  # leads to what is audited
    ("POST", "/pair"), ("POST", "/v1/pair"), ("POST", "/v1/codes"), ("DELETE", "/v1/tokens/{name}"),  # node.pairing
}  # fmt: skip


@pytest.fixture
async def node(tmp_path: Path) -> AsyncIterator[Entrance]:
    async with entrance(tmp_path / "library") as node:
        yield node


def noted(node: Entrance) -> list[tuple[str, str, str, str]]:
    """What is in the log, oldest first: event, by, whether of the node's scan, what."""
    node.server.audit.close()
    found = [*read_trail(done_trail(node.library.folder, 1 << 26))][::-1]
    return [(one.event, one.by, "scan" if one.scan == node.scan else one.scan, one.what) for one in found]


async def test_every_request_is_audited_or_known_not_to_need_it(node: Entrance) -> None:
    audited = {(one.method, one.canonical) for one in ENDPOINTS.values() if one.event}
    assert sorted([*audited, *NOT_AUDITED]) == routes(node)


async def test_who_did_what_to_a_scan_is_noted(node: Entrance) -> None:
    view, operate = node.token("view"), node.token("operate", "room 2")
    place = f"/v1/scans/{node.scan}"
    for method, path, token, more in [
        ("GET", "/v1/scans", view, {}),
        ("GET", "/v1/scans", view, {}),
        ("GET", "/v1/scans/latest", view, {}),
        ("GET", f"{place}/coarse", view, {}),
        ("GET", "/v1/scans/latest.stl", view, {}),
        ("HEAD", f"{place}/sidecar", view, {}),
        ("PATCH", f"{place}/sidecar", operate, {"json": {"name": PRIVATE[0], "subject": PRIVATE[1]}}),
        ("POST", f"{place}/verify", operate, {}),
        ("DELETE", f"{place}", view, {}),
        ("DELETE", f"{place}", operate, {}),
        ("GET", f"{place}", view, {}),
    ]:
        async with node.ask(method, path, token, **more) as answer:
            await answer.read()
    assert noted(node)[1:] == [
        ("listed", "view", "", ""),
        ("seen", "view", "scan", ""),
        ("exported", "view", "scan", "stl"),
        ("read", "view", "scan", ""),
        ("changed", "room 2", "scan", "name, subject"),
        ("verified", "room 2", "scan", ""),
        ("deleted", "room 2", "scan", ""),
    ]
    [refused] = read_trail(refused_trail(node.library.folder))
    assert (refused.by, refused.role, refused.what) == ("view", "view", "role: DELETE /v1/scans/{scan}")


async def test_a_stream_is_noted_once_for_each_scan_it_opens(node: Entrance) -> None:
    async with connect(node.url, node.token("view"), node.tls.fingerprint) as session:
        await session.open("latest")
        for at in (0.2, 0.4, 0.6):
            await session.look(at, 0.5)
        watching = asyncio.ensure_future(anext(session.live()))
        trail = done_trail(node.library.folder, 1 << 26)
        await until(lambda: any(one.event == "watched" for one in read_trail(trail)))
        watching.cancel()
    assert noted(node)[1:] == [("opened", "view", "scan", ""), ("watched", "view", "", "")]


async def test_who_comes_in_and_goes_is_noted_and_no_secret_with_it(node: Entrance) -> None:
    admin = node.token("admin")
    async with node.ask("POST", "/v1/codes", admin, json={"name": "room 9", "role": "view"}) as answer:
        code = (await answer.json())["code"]
    async with node.ask("POST", "/pair", data={"code": code}, headers={"Origin": node.url}) as answer:
        assert answer.status == 303
        cookie = answer.cookies["__Host-foveascan"].value
    async with node.ask("DELETE", "/v1/tokens/room 9", admin):
        pass
    for path, headers in [
        ("/v1/scans", {"Authorization": "Bearer guess-1"}),
        ("/v1/scans", {"Authorization": f"Bearer {cookie}"}),
        ("/v1/scans", {"Origin": "https://evil.example"}),
    ]:
        async with node.ask("GET", path, headers=headers):
            pass
    async with node.ask("POST", "/pair", data={"code": code}, headers={"Origin": node.url}) as answer:
        assert answer.status == 403
    assert noted(node)[1:] == [
        ("code offered", "admin", "", "room 9: view"),
        ("paired", "room 9", "", ""),
        ("revoked", "admin", "", "room 9"),
    ]
    refused = [*read_trail(refused_trail(node.library.folder))][::-1]
    whys = [one.what.partition(":")[0] for one in refused]
    assert whys == ["wrong token", "no token", "wrong token", "no token", "origin", "code"]
    assert {one.address for one in refused} == {"127.0.0.1"}
    kept = b"".join(path.read_bytes() for path in (node.library.folder / "audit").iterdir())
    for secret in ("guess", cookie, admin, code):
        assert secret.encode() not in kept


async def test_an_admin_reads_the_log(node: Entrance) -> None:
    admin = node.token("admin")
    async with node.ask("GET", f"/v1/scans/{node.scan}/sidecar", admin):
        pass
    await until(lambda: not node.server.audit.waiting)
    async with node.ask("GET", f"/v1/audit?limit=1&scan={node.scan[:8]}&by=admin&since=2026", admin) as answer:
        [one] = await answer.json()
        assert (one["event"], one["by"], one["scan"]) == ("read", "admin", node.scan)
    for query in ("limit=0", "limit=1001", "limit=x", "who=me", "since=yesterday"):
        async with node.ask("GET", f"/v1/audit?{query}", admin) as answer:
            assert answer.status == 400
