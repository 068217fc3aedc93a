from __future__ import annotations

import hashlib
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from client.trust import look_at_certificate
from node import pairing as routes
from node.auth import COOKIE
from protocol import pairing
from tests.node.entrance import Entrance, entrance

NONCE = "01" * 16


@pytest.fixture
async def node(tmp_path: Path) -> AsyncIterator[Entrance]:
    async with entrance(tmp_path / "library") as node:
        yield node


def proof(code: str, seen: str) -> dict[str, str]:
    return {"nonce": NONCE, "proof": pairing.client_proof(pairing.key_of(pairing.parse_code(code)), seen, NONCE)}


async def pair(node: Entrance, body: object) -> tuple[int, dict[str, str]]:
    async with node.ask("POST", "/v1/pair", json=body) as answer:
        return answer.status, await answer.json()


async def test_a_proof_over_the_certificate_that_is_shown_gives_a_token(node: Entrance) -> None:
    certificate, _ = await look_at_certificate("127.0.0.1", int(node.url.rpartition(":")[2]))
    seen = hashlib.sha256(certificate).hexdigest()
    code = node.offer("room 2", "operate")
    status, paired = await pair(node, proof(code, seen))
    key = pairing.key_of(pairing.parse_code(code))
    assert (status, paired["name"], paired["role"], paired["node"]) == (200, "room 2", "operate", "n1")
    assert paired["proof"] == pairing.node_proof(key, seen, NONCE, paired["token"], "operate")
    async with node.ask("GET", "/v1/scans", paired["token"]) as answer:
        assert answer.status == 200


async def test_a_proof_over_another_certificate_is_worth_nothing(node: Entrance) -> None:
    status, refused = await pair(node, proof(node.offer(), "ab" * 32))
    assert (status, "in between" in refused["message"]) == (403, True)
    assert node.access.tokens() == ()


async def test_a_replayed_proof_fails(node: Entrance) -> None:
    body = proof(node.offer(), node.tls.fingerprint)
    assert (await pair(node, body))[0] == 200
    assert (await pair(node, body))[0] == 403
    assert len(node.access.tokens()) == 1


async def test_guessing_locks_the_address_and_is_logged(node: Entrance, caplog: pytest.LogCaptureFixture) -> None:
    code = node.offer()
    wrong = proof("AAAA-AAAA-AAAA-AAAA", node.tls.fingerprint)
    statuses = [(await pair(node, wrong))[0] for _ in range(routes.ADDRESS_FAILURES + 1)]
    assert statuses == [403] * routes.ADDRESS_FAILURES + [429]
    assert (await pair(node, proof(code, node.tls.fingerprint)))[0] == 429
    assert "wrong code from 127.0.0.1" in caplog.text
    assert code not in caplog.text


async def test_guessing_from_many_places_voids_the_codes(node: Entrance, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(routes, "CODE_FAILURES", 3)
    code = node.offer()
    for _ in range(3):
        await pair(node, proof("AAAA-AAAA-AAAA-AAAA", node.tls.fingerprint))
    assert (await pair(node, proof(code, node.tls.fingerprint)))[0] == 403
    assert node.access.tokens() == ()


@pytest.mark.parametrize("body", [None, [], {}, {"nonce": NONCE, "proof": ""}, {"nonce": "x" * 5000}])
async def test_what_is_no_proof_is_refused(node: Entrance, body: object) -> None:
    assert (await pair(node, body))[0] in (400, 413)


# Browsers


async def test_the_page_shows_the_fingerprint_and_runs_no_script(node: Entrance) -> None:
    async with node.ask("GET", "/pair") as answer:
        page = await answer.text()
    assert pairing.fingerprint_text(node.tls.fingerprint) in page
    assert "&lt;node &amp; co&gt;" in page and "<node & co>" not in page
    assert "script-src" not in answer.headers["Content-Security-Policy"] and "<script" not in page


async def test_a_code_typed_in_the_page_becomes_a_cookie_no_script_can_read(node: Entrance) -> None:
    form = {"code": node.offer("tablet").lower()}
    async with node.ask("POST", "/pair", data=form, headers={"Origin": node.url}) as answer:
        assert (answer.status, answer.headers["Location"]) == (303, "/")
        cookie = answer.headers["Set-Cookie"]
    name, _, rest = cookie.partition("=")
    attributes = {part.strip().lower() for part in rest.split(";")[1:]}
    assert name == COOKIE and name.startswith("__Host-")
    assert {"httponly", "secure", "samesite=strict", "path=/"} <= attributes
    assert not any(part.startswith("domain") for part in attributes)
    async with node.ask("GET", "/v1/scans", headers={"Cookie": cookie.partition(";")[0]}) as answer:
        assert answer.status == 200


async def test_a_wrong_code_shows_the_page_again_and_counts(node: Entrance) -> None:
    statuses = []
    for code in ["<b>", *["AAAA-AAAA-AAAA-AAAA"] * (routes.ADDRESS_FAILURES + 1)]:
        async with node.ask("POST", "/pair", data={"code": code}, headers={"Origin": node.url}) as answer:
            statuses.append(answer.status)
            page = await answer.text()
            assert 'role="alert"' in page and "<b>" not in page and "Set-Cookie" not in answer.headers
    assert statuses == [400, *[403] * routes.ADDRESS_FAILURES, 429]
    async with node.ask("GET", answer.url.path) as answer:  # as a browser does that loads it anew
        assert answer.status == 200 and 'role="alert"' not in await answer.text()


async def test_a_form_that_is_none_shows_the_page_again(node: Entrance) -> None:
    body = b'--x\r\nContent-Disposition: form-data; name="code"\r\n\r\n' + node.offer().encode() + b"\r\n--x"
    for kind in ("multipart/form-data; boundary=x", "application/json"):
        headers = {"Origin": node.url, "Content-Type": kind}
        async with node.ask("POST", "/pair", data=body, headers=headers) as answer:
            assert answer.status == 400 and 'role="alert"' in await answer.text()
    assert node.access.tokens() == ()


async def test_another_sites_page_cannot_pair_a_browser(node: Entrance) -> None:
    origin = {"Origin": "https://evil.example"}
    async with node.ask("POST", "/pair", data={"code": node.offer()}, headers=origin) as answer:
        assert answer.status == 403
    assert node.access.tokens() == ()


# Looking after it


async def test_an_admin_offers_lists_and_revokes(node: Entrance) -> None:
    admin = node.token("admin")
    async with node.ask("POST", "/v1/codes", admin, json={"name": "tablet", "role": "operate"}) as answer:
        offered = await answer.json()
        assert (answer.status, offered["fingerprint"]) == (201, node.tls.fingerprint)
    assert (await pair(node, proof(offered["code"], node.tls.fingerprint)))[0] == 200
    async with node.ask("GET", "/v1/tokens", admin) as answer:
        listed = await answer.json()
    assert [(one["name"], one["role"]) for one in listed] == [("admin", "admin"), ("tablet", "operate")]
    assert all(one.keys() == {"name", "role", "created", "lastUsed", "own"} for one in listed)
    assert [one["own"] for one in listed] == [True, False]
    assert abs(listed[1]["created"] - time.time()) < 60
    async with node.ask("POST", "/v1/codes", admin, json={"name": "tablet"}) as answer:
        assert answer.status == 409
    for status in (204, 404):
        async with node.ask("DELETE", "/v1/tokens/tablet", admin) as answer:
            assert answer.status == status


async def test_who_revokes_himself_hears_that_it_is_done(node: Entrance) -> None:
    admin = node.token("admin")
    async with node.ask("DELETE", "/v1/tokens/admin", admin) as answer:
        assert answer.status == 204
    async with node.ask("GET", "/v1/tokens", admin) as answer:
        assert answer.status == 401


async def test_codes_that_wait_are_listed_without_the_code_and_can_be_ended(node: Entrance) -> None:
    admin = node.token("admin")
    wanted = {"name": "room 2", "role": "operate", "minutes": 30}
    async with node.ask("POST", "/v1/codes", admin, json=wanted) as answer:
        offered = await answer.json()
    assert 29 * 60 < offered["expires"] - time.time() <= 30 * 60
    async with node.ask("GET", "/v1/codes", admin) as answer:
        listed = await answer.json()
        assert listed == [{"name": "room 2", "role": "operate", "expires": offered["expires"]}]
        assert offered["code"] not in await answer.text()
    async with node.ask("DELETE", "/v1/tokens/room%202", admin) as answer:
        assert answer.status == 204
    async with node.ask("GET", "/v1/codes", admin) as answer:
        assert await answer.json() == []


@pytest.mark.parametrize("minutes", [0, 61, -1, "ten", None])
async def test_a_code_is_valid_for_minutes(node: Entrance, minutes: object) -> None:
    wanted = {"name": "room 2", "minutes": minutes}
    async with node.ask("POST", "/v1/codes", node.token("admin"), json=wanted) as answer:
        assert (answer.status, "minutes" in await answer.text()) == (400, True)
