"""Hostility on each port: so many mutated messages, while somebody well-behaved is served; memory before and after.

HTTP, WebSocket and serial meet the real daemon in a process of its own; USB meets its port and its capture thread here,
on a double of libusb.
"""

from __future__ import annotations

import asyncio
import base64
import os
import random
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from client import connect
from drivers.scanner import ScannerConfig
from drivers.usb_port import UsbAddress, UsbPort
from foveascan import started
from node.capture import Capture
from node.library import About, Library
from protocol import messages as m
from protocol.framing import USB_PAYLOAD_MAX, Frame, FrameReader, encode_frame
from protocol.scanner_messages import DeviceInfo, Hello, encode_message
from simulators.carriers import PtyPort, ServedPort
from simulators.usb_double import UsbDouble
from tests.exchange.grids import vase
from tests.fuzz.mutation import mutant
from tests.fuzz.parsers import SAID
from tests.protocol.test_scanner_messages import TABLE

PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
ATTACKERS = 8
EACH = 16  # messages of one attacker's connection, unless the node has had enough before
ANSWER_S = 5.0
WARM_UP = 20
FRAMES_AT_ONCE = 20
SETTINGS = """
[server]
listen = "127.0.0.1:0"
insecure = true
max_clients = 1024
[limits]
connections = 1024
messages_s = 100000.0
requests_s_per_address = 100000.0
[library]
folder = "{folder}/library"
spheres = false
[discovery]
enabled = false
[log]
level = "error"
"""
PATHS = (
    "/", "/healthz", "/v1/node", "/v1/scans", "/v1/scans/latest", "/v1/scans/latest/coarse", "/v1/scans/latest.stl",
    "/v1/scans/latest/fovea?u=0.5&v=0.5", "/v1/scans/latest/sidecar", "/v1/sweeps", "/pair", "/v1/tokens", "/v1/auth",
    "/v1/stream", "/assets/x.js", "/v1/scans/0/fovea/00000000/2.0.0.1.1.0.0.1/-", "/metrics",
)  # fmt: skip


class Hostility:
    """How much of it there was. pid : whose memory counts.  failures : what went wrong for who behaved well."""

    def __init__(self, count: int, first: int, pid: int) -> None:
        self.count = count
        self.first = first
        self.pid = pid
        self.sent = 0
        self.served = 0
        self.failures: list[str] = []
        self.start_mb = 0.0
        self._began_s = time.monotonic()

    @property
    def is_done(self) -> bool:
        """Whether all were sent."""
        return self.sent >= self.count

    def add(self, sent: int) -> None:
        """So many more."""
        self.sent += sent

    def begin(self) -> None:
        """Everything works, and nobody was hostile yet."""
        self.start_mb = self.memory_mb()
        self._began_s = time.monotonic()

    def memory_mb(self) -> float:
        """Resident memory of the node."""
        return int(Path(f"/proc/{self.pid}/statm").read_text().split()[1]) * PAGE_BYTES / 1e6

    def record(self, port: str) -> dict[str, Any]:
        """The figures."""
        return {
            "port": port, "messages": self.sent, "seconds": time.monotonic() - self._began_s, "served": self.served,
            "failures": self.failures[:20], "grown_mb": self.memory_mb() - self.start_mb,
        }  # fmt: skip


def attack(port: str, count: int, first: int) -> dict[str, Any]:
    """So many messages to a port of PORTS, and what came of it. first : seeds the mutants."""
    with tempfile.TemporaryDirectory(prefix="foveascan-fuzz-") as folder:
        if port == "usb":
            return _attack_usb(count, first)
        library = Library(Path(folder) / "library")
        library.add(vase(), About(1.0))
        library.close()
        (Path(folder) / "node.toml").write_text(SETTINGS.format(folder=folder))
        serve = ["serve", "--config", f"{folder}/node.toml", "--json"]
        if port != "serial":
            with started(*serve) as (node, ready):
                hostility = Hostility(count, first, node.pid)
                asyncio.run(_attack_network(ready["url"], ATTACKS[port], hostility))
                return _ended(hostility, port, node.poll())
        line = PtyPort(Path(folder) / "scanner", baud=12_000_000)
        with started(*serve, "--scanner", line.name) as (node, ready):
            hostility = Hostility(count, first, node.pid)
            asyncio.run(_warm_up(ready["url"], hostility))
            with _lying_scanner(line, hostility):
                asyncio.run(_behave_until_done(ready["url"], hostility))
            return _ended(hostility, port, node.poll())


def _ended(hostility: Hostility, port: str, status: int | None) -> dict[str, Any]:
    if status is not None:
        hostility.failures.append(f"the node ended with status {status}")
        return {"port": port, "messages": hostility.sent, "served": hostility.served, "failures": hostility.failures}
    return hostility.record(port)


# -- who behaves -------------------------------------------------------------------------------------------------------


async def _behave(url: str) -> None:
    """Open the scan, look, leave."""
    async with asyncio.timeout(60), connect(url) as session:
        await session.open()
        await session.look(random.random(), 0.5)
        await session.scans()


async def _warm_up(url: str, hostility: Hostility) -> None:
    """What the node keeps for everybody is there before its memory is looked at."""
    for _ in range(WARM_UP):
        await _behave(url)
    hostility.begin()


async def _behave_until_done(url: str, hostility: Hostility) -> None:
    """Behave well, again and again."""
    while not hostility.is_done or not hostility.served:
        try:
            await _behave(url)
            hostility.served += 1
        except Exception as error:  # whatever it is, it is what is looked for here
            hostility.failures.append(f"{type(error).__name__}: {error}")
            await asyncio.sleep(0.2)
            if len(hostility.failures) > 50:
                return


# -- the network -------------------------------------------------------------------------------------------------------

Exchange = Callable[[asyncio.StreamReader, asyncio.StreamWriter, random.Random], Awaitable[int]]


async def _attack_network(url: str, exchange: Exchange, hostility: Hostility) -> None:
    await _warm_up(url, hostility)
    attackers = [_attacker(url, exchange, hostility, number) for number in range(ATTACKERS)]
    await asyncio.gather(_behave_until_done(url, hostility), *attackers)


async def _attacker(url: str, exchange: Exchange, hostility: Hostility, number: int) -> None:
    host, _, port = url.removeprefix("http://").rpartition(":")
    draw = random.Random(f"{hostility.first} {number}")
    while not hostility.is_done:
        try:
            reader, writer = await asyncio.open_connection(host, int(port))
        except OSError as error:
            hostility.failures.append(f"cannot connect: {error}")
            return
        sent = 1
        with suppress(OSError, TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            sent = await exchange(reader, writer, draw)
        writer.transport.abort()
        hostility.add(sent)


async def _http(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, draw: random.Random) -> int:
    """Requests one behind the other, until the node hangs up."""
    for sent in range(1, EACH + 1):
        method = draw.choice(("GET", "POST", "PATCH", "DELETE", "HEAD", "OPTIONS"))
        body = mutant(BODIES, draw) if method in ("POST", "PATCH") else b""
        if method == "DELETE":  # the scan is for who behaves
            path = "/v1/sweeps/0"
        else:
            path = draw.choice(PATHS)
        length = f"Content-Length: {len(body)}\r\n" if body else ""
        head = f"{method} {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{length}Origin: http://127.0.0.1\r\n\r\n".encode()
        writer.write(mutant((head + body, head), draw) if draw.random() < 0.8 else head + body)
        await writer.drain()
        async with asyncio.timeout(0.02):  # an unfinished request earns no answer: go on, the next completes it
            if not await reader.read(65536):
                return sent
    return sent


BODIES = (
    b'{"name":"x"}', b'{"name":"x","role":"view"}', b'{"nonce":"00","proof":"11"}', b"code=ABCD-EFGH-IJKL-MNOP",
    b"PK\x03\x04",
)  # fmt: skip


async def _websocket(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, draw: random.Random) -> int:
    """A stream that is greeted as it should be, then mutated messages in mutated frames."""
    key = base64.b64encode(draw.randbytes(16)).decode()
    writer.write(
        f"GET /v1/stream HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n"
        f"Sec-WebSocket-Protocol: {m.PROTOCOL}\r\n\r\n".encode()
    )
    async with asyncio.timeout(ANSWER_S):
        await reader.readuntil(b"\r\n\r\n")
    if draw.random() < 0.8:
        writer.write(_frame(m.encode_message(SAID[0]).encode(), draw, 1))
        writer.write(_frame(m.encode_message(SAID[1]).encode(), draw, 1))
    seeds = [m.encode_message(said).encode() for said in SAID[:9]]
    for sent in range(1, EACH + 1):
        message = mutant(seeds, draw) if draw.random() < 0.6 else draw.choice(seeds)
        frame = _frame(message, draw, draw.choice((1, 1, 1, 1, 2, 0, 8, 9, 10, 3)))
        writer.write(mutant((frame,), draw) if draw.random() < 0.2 else frame)
        await writer.drain()
        with suppress(TimeoutError):
            async with asyncio.timeout(0.002):
                if not await reader.read(65536):
                    return sent
    return sent


def _frame(payload: bytes, draw: random.Random, opcode: int) -> bytes:
    """As clients send it: masked."""
    mask = draw.randbytes(4)
    size = len(payload)
    length = bytes([0x80 | size]) if size < 126 else bytes([0x80 | 126]) + size.to_bytes(2, "big")
    masked = bytes(byte ^ mask[n % 4] for n, byte in enumerate(payload))
    return bytes([0x80 | opcode]) + length + mask + masked


ATTACKS: dict[str, Exchange] = {"http": _http, "websocket": _websocket}

# -- the scanner -------------------------------------------------------------------------------------------------------


class _lying_scanner:  # noqa: N801  # reads as what it is: with _lying_scanner(...)
    """A device in a thread of its own that greets as it should and lies ever after."""

    def __init__(self, port: ServedPort, hostility: Hostility, payload_max: int = 1024) -> None:
        self._port = port
        self._hostility = hostility
        self._draw = random.Random(hostility.first)
        self._reader = FrameReader(payload_max)
        self._session = 1
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *of: object) -> None:
        self._ended.set()
        self._port.cancel()
        self._thread.join(10)

    def _run(self) -> None:
        seeds = [(message.TYPE, encode_message(message)) for message, _ in TABLE]
        while not self._ended.is_set() and not self._hostility.is_done:
            self._listen()
            frames = []
            for _ in range(FRAMES_AT_ONCE):
                kind, payload = self._draw.choice(seeds)
                payload = mutant((payload,), self._draw)[:1000]
                frame = encode_frame(kind, payload, seq=self._draw.randrange(64), session=self._session)
                frames.append(mutant((frame,), self._draw) if self._draw.random() < 0.3 else frame)
            self._port.write(b"".join(frames))
            self._hostility.add(FRAMES_AT_ONCE)

    def _listen(self) -> None:
        """Answer a greeting, three times of four."""
        self._reader.receive_data(self._port.read(65536, 0.0))
        while (event := self._reader.next_event()) is not None:
            if isinstance(event, Frame) and event.type == Hello.TYPE:
                self._session = event.session
                if self._draw.random() < 0.75:
                    said = encode_message(DeviceInfo("A7", 5, 1000, 100))
                    self._port.write(encode_frame(DeviceInfo.TYPE, said, seq=0, session=event.session))


def _attack_usb(count: int, first: int) -> dict[str, Any]:
    double = UsbDouble()
    hostility = Hostility(count, first, os.getpid())
    address = UsbAddress.parse(double.identity.address)
    config = ScannerConfig(payload_max=USB_PAYLOAD_MAX)
    capture = Capture(lambda: UsbPort(address, double), config, lambda assembly: None)
    capture.start()
    hostility.begin()
    try:
        with _lying_scanner(double, hostility, USB_PAYLOAD_MAX):
            while not hostility.is_done or not hostility.served:
                time.sleep(0.2)
                capture.request_sweep()
                hostility.served += 1
                if capture.status.phase == "stopped" or time.monotonic() - capture.beat_s > 30:
                    hostility.failures.append("the capture thread does not get on")
                    break
    finally:
        capture.stop()
    return hostility.record("usb")


PORTS = (*ATTACKS, "serial", "usb")
