"""Hostility on each port: so many mutated messages, while somebody well-behaved is served; memory before and after.

Each port is that of the real daemon, in a process of its own: HTTP and the stream, without and with TLS and logins, a
pseudo terminal, and USB, where the real libusb meets a device emulated under umockdev. On the scanner's ports an honest
scanner comes after the lying one, and a sweep with it has to become a scan.
"""

from __future__ import annotations

import asyncio
import os
import random
import tempfile
import time
from collections.abc import Awaitable, Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any, NamedTuple

from client import RequestRefused, connect
from client.session import Session
from client.trust import look_at_certificate
from foveascan import started
from node.access import Access, access_folder
from node.library import About, Library
from protocol import pairing
from protocol.errors import FoveascanError
from protocol.framing import SERIAL_PAYLOAD_MAX, USB_PAYLOAD_MAX
from simulators.carriers import PtyPort
from simulators.usb_preload import PRELOAD, is_available
from simulators.usb_testbed import UsbTestbed
from tests.exchange.grids import vase
from tests.fuzz.lying_scanner import HonestScanner, LyingScanner
from tests.fuzz.network import ask_everything, attack_http, attack_stream

PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
ATTACKERS = 8
WARM_UP = 5
FAILURES_MAX = 50
SWEEP_S = 60.0  # until an honest scanner is found again, and its sweep a scan
SETTINGS = """
[server]
listen = "127.0.0.1:0"
insecure = {insecure}
max_clients = 1024
[limits]
connections = 1024
connections_per_address = 1024
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
WITH_LOGINS = ("https", "wss")
PORTS = ("http", *WITH_LOGINS, "websocket", "serial", "usb")


class Target(NamedTuple):
    """A running node. token : a login that may look and sweep, fingerprint : of its certificate; "" without TLS."""

    url: str
    token: str = ""
    fingerprint: str = ""

    def connect(self) -> Any:
        """As `client.connect`."""
        return connect(self.url, self.token or None, self.fingerprint or None)


class Hostility:
    """How much of it there was. pid : whose memory counts.  failures : what went wrong for who behaved well."""

    def __init__(self, count: int, first: int, pid: int) -> None:
        self.count = count
        self.first = first
        self.pid = pid
        self.sent = 0
        self.served = 0
        self.failures: list[str] = []
        self._start_mb = self._peak_mb = 0.0
        self._began_s = time.monotonic()

    @property
    def is_done(self) -> bool:
        """Whether all were sent, or too much has gone wrong already."""
        return self.sent >= self.count or len(self.failures) > FAILURES_MAX

    def add(self, sent: int) -> None:
        """So many more."""
        self.sent += sent

    def begin(self) -> None:
        """Everything works, and nobody was hostile yet."""
        self._start_mb = self._peak_mb = self._memory_mb()
        self._began_s = time.monotonic()

    def look(self) -> None:
        """See how much memory is taken now."""
        with suppress(OSError):  # it has ended, which `record` tells
            self._peak_mb = max(self._peak_mb, self._memory_mb())

    def _memory_mb(self) -> float:
        """Resident memory of the node."""
        return int(Path(f"/proc/{self.pid}/statm").read_text().split()[1]) * PAGE_BYTES / 1e6

    def record(self, port: str, status: int | None) -> dict[str, Any]:
        """The figures. status : with which the node has ended, if it has."""
        if status is not None:
            self.failures.append(f"the node ended with status {status}")
        return {
            "port": port, "messages": self.sent, "seconds": time.monotonic() - self._began_s, "served": self.served,
            "failures": self.failures[:20], "grown_mb": self._peak_mb - self._start_mb,
        }  # fmt: skip


def attack(port: str, count: int, first: int) -> dict[str, Any]:
    """So many messages to a port of PORTS, and what came of it. first : seeds the mutants. Raises FoveascanError."""
    if port == "usb" and not is_available():
        raise FoveascanError(f"no {PRELOAD} here; as root: apt-get install umockdev libusb-1.0-0")
    with tempfile.TemporaryDirectory(prefix="fs-fuzz-") as name, ExitStack() as stack:  # short: see folder of umockdev
        folder = Path(name)
        token = _prepare(folder, "false" if port in WITH_LOGINS else "true")
        serve = ["serve", "--config", f"{folder}/node.toml", "--json"]
        if port in ("serial", "usb"):
            line: PtyPort | UsbTestbed
            line = PtyPort(folder / "tty", 12_000_000) if port == "serial" else UsbTestbed(folder)
            stack.enter_context(closing(line))
            environment = line.environment if isinstance(line, UsbTestbed) else {}
            node, ready = stack.enter_context(started(*serve, "--scanner", line.name, environment=environment))
            hostility = Hostility(count, first, node.pid)
            payload_max = SERIAL_PAYLOAD_MAX if port == "serial" else USB_PAYLOAD_MAX
            asyncio.run(_attack_scanner(Target(ready["url"]), line, payload_max, hostility))
        else:
            node, ready = stack.enter_context(started(*serve))
            hostility = Hostility(count, first, node.pid)
            asyncio.run(_attack_network(ready["url"], token if port in WITH_LOGINS else "", port, hostility))
        return hostility.record(port, node.poll())


def _prepare(folder: Path, insecure: str) -> str:
    """A library with a scan, settings, and a login: its token."""
    with closing(Library(folder / "library")) as library:
        library.add(vase(), About(1.0))
    (folder / "node.toml").write_text(SETTINGS.format(folder=folder, insecure=insecure))
    access = Access(access_folder(folder / "library"))
    key = pairing.key_of(pairing.parse_code(access.offer("view", "somebody", time.time())))
    made = access.redeem(lambda other: other == key, time.time())
    assert made is not None
    return made[0]


# -- who behaves -------------------------------------------------------------------------------------------------------

Visit = Callable[[Session], Awaitable[object]]


async def _behave(target: Target) -> None:
    """Open the scan, look, leave."""
    async with asyncio.timeout(60), target.connect() as session:
        await session.open()
        await session.look(random.random(), 0.5)
        await session.scans()


async def _behave_and_sweep(target: Target) -> None:
    """The same, and have the scanner sweep if it can."""
    await _behave(target)
    async with asyncio.timeout(60), target.connect() as session:
        with suppress(RequestRefused):  # it is not ready, which is no wonder
            await session.start_sweep()


async def _warm_up(target: Target, hostility: Hostility) -> None:
    """What the node keeps for everybody, and for as many as there will be, is there before its memory is looked at."""
    for _ in range(WARM_UP):
        await asyncio.gather(*(_behave(target) for _ in range(ATTACKERS)))
    await ask_everything(target.url, target.token)
    hostility.begin()


async def _behave_until_done(
    target: Target, hostility: Hostility, behave: Callable[[Target], Awaitable[None]] = _behave
) -> None:
    """Behave well, again and again."""
    while not hostility.is_done or not hostility.served:
        try:
            await behave(target)
            hostility.served += 1
        except Exception as error:  # whatever it is, it is what is looked for here
            hostility.failures.append(f"{type(error).__name__}: {error}")
            await asyncio.sleep(0.2)
            if hostility.is_done:
                return
        hostility.look()


# -- the attacks -------------------------------------------------------------------------------------------------------


async def _attack_network(url: str, token: str, port: str, hostility: Hostility) -> None:
    fingerprint = ""
    if token:
        host, _, number = url.removeprefix("https://").rpartition(":")
        fingerprint = pairing.fingerprint((await look_at_certificate(host, int(number)))[0])
    target = Target(url, token, fingerprint)
    await _warm_up(target, hostility)
    exchange = attack_stream if port in ("websocket", "wss") else attack_http
    attackers = [exchange(url, token, random.Random(f"{hostility.first} {n}"), hostility) for n in range(ATTACKERS)]
    await asyncio.gather(_behave_until_done(target, hostility), *attackers)


async def _attack_scanner(
    target: Target, line: PtyPort | UsbTestbed, payload_max: int, hostility: Hostility
) -> None:
    await _warm_up(target, hostility)
    with LyingScanner(line, hostility, payload_max):
        await _behave_until_done(target, hostility, _behave_and_sweep)
    hostility.look()  # what the honest sweep below takes, its picture say, is no growth
    line.hang_up()
    line.plug_in()
    with HonestScanner(line, payload_max):
        try:
            async with asyncio.timeout(SWEEP_S), target.connect() as session:
                await _sweep(session)
        except Exception as error:
            hostility.failures.append(f"with an honest scanner: {type(error).__name__}: {error}")


async def _sweep(session: Session) -> None:
    """Sweep as soon as the scanner is ready, until there is a scan more."""
    before = len(await session.scans())
    while len(await session.scans()) == before:
        with suppress(RequestRefused):  # not ready yet, or sweeping
            await session.start_sweep()
        await asyncio.sleep(0.2)
