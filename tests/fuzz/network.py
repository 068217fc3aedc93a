"""Who attacks a node over the network: requests and messages that are nearly right, on many connections."""

from __future__ import annotations

import asyncio
import base64
import random
import ssl
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import Protocol

import aiohttp

from node.auth import COOKIE, SUBPROTOCOL
from node.shared import BODIES_KEPT
from protocol import messages as m
from tests.fuzz.mutation import mutant
from tests.fuzz.parsers import SAID

EACH = 16  # messages of one connection, unless the node has had enough before
ANSWER_S = 5.0
STREAM_HEAD_S = 0.002
HEAD_S = 0.02
METHODS = ("GET", "GET", "POST", "PATCH", "DELETE", "HEAD", "OPTIONS")
PATHS = (
    "/", "/healthz", "/metrics", "/pair", "/assets/x.js", "/openapi.json", "/v1/auth", "/v1/node", "/v1/tokens",
    "/v1/tokens/somebody", "/v1/codes", "/v1/pair", "/v1/audit?limit=3&since=2026&scan=6&by=x&refused=1", "/v1/stream",
    "/v1/scans", "/v1/scans/latest", "/v1/scans/latest/coarse?codec=jpeg", "/v1/scans/latest/picture",
    "/v1/scans/latest.stl", "/v1/scans/latest.npz", "/v1/scans/latest/fovea?u=0.5&v=0.5&max_bytes=900",
    "/v1/scans/0/fovea/00000000/2.0.0.1.1.0.0.1/-", "/v1/scans/latest/sidecar", "/v1/scans/latest/verify",
    "/v1/scans/latest/derive", "/v1/sweeps", "/v1/sweeps/0.npz", "/v1/sweeps/0/resume", "/v1/sweeps/0",
    "/v1/axes", "/v1/axes/0",
)  # fmt: skip
BODIES = (
    b'{"name":"x"}', b'{"name":"x","role":"view"}', b"code=ABCD-EFGH-IJKL-MNOP", b"PK\x03\x04",
    b'{"nonce":"' + b"01" * 16 + b'","proof":"' + b"ab" * 32 + b'"}', b'{"geometry":"sphere","caps":true}',
    b'{"scan":"latest","diameterMm":80}', b'{"pins":[{"u":0.5,"v":0.5,"label":"x"}],"notes":"y"}',
)  # fmt: skip


class Campaign(Protocol):
    """What an attacker needs to know of it."""

    failures: list[str]

    @property
    def is_done(self) -> bool:
        """Whether it is over."""

    def add(self, sent: int) -> None:
        """So many more."""


Exchange = Callable[[asyncio.StreamReader, asyncio.StreamWriter], AsyncIterator[None]]


async def ask_everything(url: str, token: str) -> None:
    """Everything that attackers ask, once and soundly, so that what it leads to is no growth later."""
    headers = {"Authorization": f"Bearer {token}"} if token else {}
    asked = [("GET", path, b"") for path in PATHS if path != "/v1/stream"]
    asked += [(method, path, body) for method in ("POST", "PATCH") for path in PATHS for body in BODIES]
    async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(ssl=False), headers=headers) as http:
        for method, path, body in asked:
            async with http.request(method, url + path, data=body, allow_redirects=False) as answer:
                await answer.read()
        for place in range(BODIES_KEPT):  # what is kept of foveae is full then
            async with http.get(f"{url}/v1/scans/latest/fovea?u={place / BODIES_KEPT}&v=0.5") as answer:
                await answer.read()


async def attack_http(url: str, token: str, draw: random.Random, campaign: Campaign) -> None:
    """Requests one behind the other, until the node hangs up. token : of a login, mutated with all else."""

    async def requests(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> AsyncIterator[None]:
        for _ in range(EACH):
            writer.write(_request(url, token, draw))
            yield
            await writer.drain()
            with suppress(TimeoutError):  # an unfinished request earns no answer: go on, the next completes it
                async with asyncio.timeout(HEAD_S):
                    answer = await reader.read(65536)
                    if b"HTTP/1.1 500" in answer:
                        campaign.failures.append(f"a request failed in the node: {answer[-300:]!r}")
                    if not answer:
                        return

    await _attack(url, requests, campaign)


def _request(url: str, token: str, draw: random.Random) -> bytes:
    method, path = draw.choice(METHODS), draw.choice(PATHS)
    if method == "DELETE":  # the scan and the login are for who behaves
        path = draw.choice(("/v1/sweeps/0", "/v1/tokens/nobody", "/v1/scans/0"))
    body = draw.choice(BODIES) if method in ("POST", "PATCH") else b""
    host = url.partition("://")[2]
    head = f"{method} {path} HTTP/1.1\r\nHost: {host}\r\nOrigin: {url}\r\n"
    if token:
        head += draw.choice((f"Authorization: Bearer {token}\r\n", f"Cookie: a=b; {COOKIE}={token}\r\n", ""))
    head += draw.choice(("", 'If-Match: "1"\r\n', "X-Original-URI: /v1/scans/0/coarse\r\n"))
    length = f"Content-Length: {len(body)}\r\n" if body else ""
    whole = f"{head}{length}\r\n".encode() + body
    return mutant((whole,), draw) if draw.random() < 0.8 else whole


async def attack_stream(url: str, token: str, draw: random.Random, campaign: Campaign) -> None:
    """A stream that is greeted as it should be, then mutated messages in mutated frames."""
    seeds = [m.encode_message(said).encode() for said in SAID[:9]]

    async def messages(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> AsyncIterator[None]:
        writer.write(_upgrade(url, token, draw))
        async with asyncio.timeout(ANSWER_S):
            await reader.readuntil(b"\r\n\r\n")
        if draw.random() < 0.8:
            for said in SAID[:2]:
                writer.write(_frame(m.encode_message(said).encode(), draw, 1))
        for _ in range(EACH):
            message = mutant(seeds, draw) if draw.random() < 0.6 else draw.choice(seeds)
            frame = _frame(message, draw, draw.choice((1, 1, 1, 1, 2, 0, 8, 9, 10, 3)))
            writer.write(mutant((frame,), draw) if draw.random() < 0.2 else frame)
            yield
            await writer.drain()
            with suppress(TimeoutError):
                async with asyncio.timeout(STREAM_HEAD_S):
                    if not await reader.read(65536):
                        return

    await _attack(url, messages, campaign)


def _upgrade(url: str, token: str, draw: random.Random) -> bytes:
    key = base64.b64encode(draw.randbytes(16)).decode()
    login = f", {SUBPROTOCOL}{token}" if token else ""
    return (
        f"GET /v1/stream HTTP/1.1\r\nHost: {url.partition('://')[2]}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n"
        f"Sec-WebSocket-Protocol: {m.PROTOCOL}{login}\r\n\r\n"
    ).encode()


def _frame(payload: bytes, draw: random.Random, opcode: int) -> bytes:
    """As clients send it: masked."""
    mask = draw.randbytes(4)
    size = len(payload)
    length = bytes([0x80 | size]) if size < 126 else bytes([0x80 | 126]) + size.to_bytes(2, "big")
    masked = bytes(byte ^ mask[n % 4] for n, byte in enumerate(payload))
    return bytes([0x80 | opcode]) + length + mask + masked


async def _attack(url: str, exchange: Exchange, campaign: Campaign) -> None:
    """Connection after connection, until the campaign is over."""
    scheme, _, place = url.partition("://")
    host, _, port = place.rpartition(":")
    anyone = ssl.create_default_context()
    anyone.check_hostname, anyone.verify_mode = False, ssl.CERT_NONE
    while not campaign.is_done:
        try:
            async with asyncio.timeout(60):
                reader, writer = await asyncio.open_connection(
                    host, int(port), ssl=anyone if scheme == "https" else None
                )
        except (OSError, TimeoutError) as error:
            campaign.failures.append(f"cannot connect: {error or 'no answer'}")
            return
        with suppress(OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            async for _ in exchange(reader, writer):
                campaign.add(1)
        writer.transport.abort()
