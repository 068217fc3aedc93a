"""Pairing with a node, knowing it again, and taking nobody else for it."""

from __future__ import annotations

import asyncio
import datetime as dt
import ssl
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, closing
from pathlib import Path

import pytest

from client import NodeAddress, NodeLost, NodeNotTrusted, RequestRefused, connect, credentials, pair
from client.credentials import Credential, credentials_path, find_credential, keep_credential, read_credentials
from client.login import logged_in
from client.transfer import fetch_scan
from node.config import Server
from node.library import Library
from node.tls import FILE, RENEW_BEFORE, VALID, Tls, renew_own
from protocol.errors import AccessError, LocalWireError, RemoteWireError
from tests.node.entrance import Entrance, entrance
from tests.node.served import served


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))


@pytest.fixture
async def node(tmp_path: Path) -> AsyncIterator[Entrance]:
    async with entrance(tmp_path / "library") as node:
        yield node


@asynccontextmanager
async def somebody_in_between(folder: Path, url: str) -> AsyncIterator[tuple[str, list[bytes]]]:
    """A relay with a certificate of its own before a node; its URL, and what it could read of what was sent."""
    folder.mkdir()
    heard: list[bytes] = []
    anyone = ssl.create_default_context()
    anyone.check_hostname, anyone.verify_mode = False, ssl.CERT_NONE
    port = int(url.rpartition(":")[2])

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, into: list[bytes]) -> None:
        while data := await reader.read(65536):
            into.append(data)
            writer.write(data)
        writer.close()

    relays: list[asyncio.Task[None]] = []

    def begin(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        relays.append(asyncio.create_task(relay(reader, writer)))

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        back, forth = await asyncio.open_connection("127.0.0.1", port, ssl=anyone)
        try:
            await asyncio.gather(pump(reader, forth, heard), pump(back, writer, []))
        except OSError:
            pass
        finally:
            for end in (writer, forth):
                end.close()
            await asyncio.gather(writer.wait_closed(), forth.wait_closed(), return_exceptions=True)

    tls = Tls(Server(), folder, "relay")
    server = await asyncio.start_server(begin, "127.0.0.1", 0, ssl=tls.context)
    try:
        yield f"https://127.0.0.1:{server.sockets[0].getsockname()[1]}", heard
    finally:
        server.close()
        for task in relays:
            task.cancel()
        await asyncio.gather(*relays, return_exceptions=True)


async def test_pairing_once_is_enough_to_connect_from_then_on(node: Entrance) -> None:
    credential = await pair(node.url, node.offer("laptop", "operate"))
    assert (credential.name, credential.role, credential.node) == ("laptop", "operate", "n1")
    async with connect(node.url) as session:
        assert session.node.login
        await session.open()
    moved = NodeAddress("node", "127.0.0.1", int(node.url.rpartition(":")[2]), "n1", "ready", True)
    keep_credential(Credential("n1", "https://elsewhere", "laptop", "operate", credential.token, credential.key))
    async with connect(moved) as session:
        assert await session.scans()


async def test_files_travel_with_the_same_login(node: Entrance, tmp_path: Path) -> None:
    await pair(node.url, node.offer())
    assert await fetch_scan(node.url, node.scan, tmp_path / "scan.npz", moved=lambda done, total: None) > 1000


async def test_what_is_kept_is_private(node: Entrance) -> None:
    await pair(node.url, node.offer())
    assert credentials_path().stat().st_mode & 0o077 == 0
    assert credentials_path().parent.stat().st_mode & 0o077 == 0


async def test_somebody_in_between_gets_neither_code_nor_token(node: Entrance, tmp_path: Path) -> None:
    code = node.offer()
    async with somebody_in_between(tmp_path / "relay", node.url) as (url, heard):
        with pytest.raises(RequestRefused, match="in between"):
            await pair(url, code)
    assert heard and code.encode() not in b"".join(heard) and code.replace("-", "").encode() not in b"".join(heard)
    assert read_credentials() == () and node.access.tokens() == ()
    await pair(node.url, code)  # it is as good as before


async def test_a_paired_client_tells_somebody_in_between_nothing(node: Entrance, tmp_path: Path) -> None:
    credential = await pair(node.url, node.offer())
    async with somebody_in_between(tmp_path / "relay", node.url) as (url, heard):
        keep_credential(Credential("n1", url, "laptop", "view", credential.token, credential.key))
        with pytest.raises(NodeNotTrusted, match="another certificate"):
            async with connect(url):
                pass
        with pytest.raises(NodeNotTrusted, match="another certificate"):
            await fetch_scan(url, "latest", tmp_path / "scan.npz", moved=lambda done, total: None)
    assert heard == []


async def test_a_wrong_fingerprint_stops_before_any_request(node: Entrance, tmp_path: Path) -> None:
    async with somebody_in_between(tmp_path / "relay", node.url) as (url, heard):
        with pytest.raises(NodeNotTrusted, match="another certificate"):
            async with connect(url, token=node.token("view"), fingerprint=node.tls.fingerprint):
                pass
        assert heard == []


async def test_a_node_that_nobody_vouches_for_must_be_paired_with_first(node: Entrance) -> None:
    with pytest.raises(NodeNotTrusted, match="foveascan join CODE"):
        async with connect(node.url, token=node.token("view")):
            pass


async def test_a_renewed_certificate_is_still_the_same_node(node: Entrance) -> None:
    await pair(node.url, node.offer())
    before, soon = node.tls.fingerprint, dt.datetime.now(dt.UTC) + VALID - RENEW_BEFORE
    folder = node.library.folder / "access"
    renew_own(folder, "n1", "127.0.0.1", soon)
    node.tls.context.load_cert_chain(folder / FILE)
    async with connect(node.url) as session:
        await session.open()
    with pytest.raises(NodeNotTrusted):
        async with connect(node.url, fingerprint=before):
            pass


async def test_somebody_who_does_not_know_the_code_cannot_hand_out_tokens(
    node: Entrance, monkeypatch: pytest.MonkeyPatch
) -> None:
    proofs = iter(["11" * 32, "00" * 32])  # what is answered, and what would be right
    monkeypatch.setattr("protocol.pairing.node_proof", lambda *said: next(proofs))
    with pytest.raises(NodeNotTrusted, match="does not know the code"):
        await pair(node.url, node.offer())
    assert read_credentials() == ()


async def test_a_bad_answer_is_no_pairing(node: Entrance, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("protocol.pairing.node_proof", lambda *said: "short")
    with pytest.raises(RemoteWireError, match="bad answer"):
        await pair(node.url, node.offer())


@pytest.mark.parametrize("url", ["http://127.0.0.1:1", "https://", "nonsense"])
async def test_only_tls_can_be_paired_over(url: str) -> None:
    with pytest.raises(NodeLost, match="https://HOST:PORT"):
        await pair(url, "AAAA-AAAA-AAAA-AAAA")


async def test_nobody_there_is_told_apart() -> None:
    with pytest.raises(NodeLost, match="no node with TLS"):
        await pair("https://127.0.0.1:9", "AAAA-AAAA-AAAA-AAAA")


async def test_a_token_is_never_sent_in_the_clear_to_another_machine() -> None:
    with pytest.raises(NodeNotTrusted, match="in the clear"):
        async with logged_in("http://192.0.2.1:7345", "secret"):
            pass


@pytest.mark.parametrize("text", ["", "ab", "zz" * 32])
async def test_a_fingerprint_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(LocalWireError, match="64 hex digits"):
        async with logged_in("https://127.0.0.1:1", "token", text):
            pass


# What is kept


def credential(node: str, url: str = "https://a:1") -> Credential:
    return Credential(node, url, "laptop", "view", "secret", "ab" * 32)


def test_the_latest_of_a_node_counts() -> None:
    for one in (credential("1"), credential("2", "https://b:1"), credential("1", "https://c:1")):
        keep_credential(one)
    assert [one.url for one in read_credentials()] == ["https://b:1", "https://c:1"]
    assert find_credential("https://anywhere", "1") == credential("1", "https://c:1")
    assert find_credential("https://b:1") == credential("2", "https://b:1")
    assert find_credential("https://a:1") is None and find_credential("https://b:1", "3") is None


def test_of_too_many_the_oldest_is_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(credentials, "CREDENTIALS_MAX", 2)
    for node in "123":
        keep_credential(credential(node))
    assert [one.node for one in read_credentials()] == ["2", "3"]


def test_a_damaged_file_is_named() -> None:
    keep_credential(credential("1"))
    credentials_path().write_text("{")
    with pytest.raises(AccessError, match="nodes.json"):
        find_credential("https://a:1")


async def test_who_names_the_other_of_http_and_https_is_told(node: Entrance, tmp_path: Path) -> None:
    plain, grid = node.url.replace("https", "http"), tmp_path / "scan.npz"
    with pytest.raises(NodeLost, match=f"if it serves TLS, it is {node.url}"):
        await fetch_scan(plain, "latest", grid, moved=lambda done, total: None)
    with pytest.raises(NodeLost, match=f"if it serves TLS, it is {node.url}"):
        async with connect(plain):
            pass
    with closing(Library(tmp_path / "other")) as library:
        async with served(library) as (client, _):
            url = f"https://127.0.0.1:{client.port}"
            with pytest.raises(NodeLost, match=f"does not serve TLS; .* is http://127.0.0.1:{client.port}"):
                await fetch_scan(url, "latest", grid, moved=lambda done, total: None)
            with pytest.raises(NodeLost, match="does not serve TLS"):
                async with connect(url):
                    pass
