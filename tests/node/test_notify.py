from __future__ import annotations

import asyncio
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from drivers.port import Port
from drivers.scanner import ScannerConfig
from node.capture import Capture, CaptureStatus
from node.coarse import FIRST_VIEW_BYTES
from node.exhibits import Exhibits
from node.library import Library
from node.notify import Beating, Notifier, keep_notified, status_text, stuck
from protocol.errors import PortLost


class Systemd:
    """The other end of a notification socket."""

    def __init__(self, address: str) -> None:
        self.address = address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("\0" + address[1:] if address.startswith("@") else address)
        self._socket.setblocking(False)

    def heard(self) -> list[str]:
        said = []
        while True:
            try:
                said.append(self._socket.recv(4096).decode())
            except BlockingIOError:
                return said

    def close(self) -> None:
        self._socket.close()


@pytest.fixture(params=["file", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Systemd]:
    address = str(tmp_path / "notify") if request.param == "file" else f"@foveascan-test-{os.getpid()}"
    listener = Systemd(address)
    yield listener
    listener.close()


def capture(beat_s: float = 0.0, status: CaptureStatus | None = None) -> Capture:
    return cast(Capture, SimpleNamespace(beat_s=beat_s, status=status or CaptureStatus("ready")))


def test_what_is_said_and_how(systemd: Systemd) -> None:
    notifier = Notifier.from_environment({"NOTIFY_SOCKET": systemd.address})
    notifier.ready("up")
    notifier.status("up")
    notifier.status("two\nlines")
    notifier.alive()
    before_us = time.monotonic_ns() // 1000
    notifier.reloading()
    notifier.stopping()
    *said, reloading, stopping = systemd.heard()
    assert said == ["READY=1\nSTATUS=up", "STATUS=two lines", "WATCHDOG=1"]
    assert stopping == "STOPPING=1\nSTATUS=Stopping"
    kind, _, when_us = reloading.partition("\nMONOTONIC_USEC=")
    assert kind == "RELOADING=1" and before_us <= int(when_us) <= time.monotonic_ns() // 1000


@pytest.mark.parametrize(
    ("environ", "watchdog_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "60000000"}, 60.0),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "-1"}, None),
        ({"WATCHDOG_USEC": "1500000", "WATCHDOG_PID": str(os.getpid())}, 1.5),
        ({"WATCHDOG_USEC": "1500000", "WATCHDOG_PID": "1"}, None),
    ],
)
def test_the_environment_is_read_and_left_to_nobody_else(environ: dict[str, str], watchdog_s: float | None) -> None:
    environ = {"HOME": "/", "NOTIFY_SOCKET": "/nowhere", **environ}
    assert Notifier.from_environment(environ).watchdog_s == watchdog_s
    assert environ == {"HOME": "/"}


def test_nobody_listening_harms_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Notifier().ready("up")
    assert not caplog.records
    Notifier(str(tmp_path / "nowhere")).ready("up")
    assert "cannot tell systemd READY=1" in caplog.text


@pytest.mark.parametrize(
    ("status", "text"),
    [
        (None, "Serving U, without a scanner"),
        (CaptureStatus("ready"), "Serving U, scanner: ready"),
        (CaptureStatus("sweeping", 0.416), "Serving U, scanner: sweeping, 42 %"),
        (CaptureStatus("connecting", why="no such port"), "Serving U, scanner: connecting: no such port"),
    ],
)
def test_status_is_one_line_for_people(status: CaptureStatus | None, text: str) -> None:
    assert status_text("U", capture(status=status) if status else None) == text


def test_a_part_that_stands_still_is_stuck() -> None:
    assert stuck({}, 5.0) is None
    parts = {"one": capture(beat_s=105.0), "the capture thread": capture(beat_s=100.0)}
    assert stuck(parts, 5.0, lambda: 105.0) is None
    assert stuck(parts, 5.0, lambda: 106.0) == "the capture thread has not moved for 6 s"


async def keep_until(systemd: Systemd, watched: Capture | None, count: int) -> list[str]:
    """What systemd hears until it has heard `count` times."""
    notifier = Notifier(systemd.address, watchdog_s=0.02)
    parts = {"the capture thread": watched} if watched else {}
    keeping = asyncio.create_task(keep_notified(notifier, "U", watched, parts))
    said: list[str] = []
    while len(said) < count:
        await asyncio.sleep(0.005)
        said += systemd.heard()
    keeping.cancel()
    return said


async def test_the_watchdog_is_fed_again_and_again(systemd: Systemd) -> None:
    assert (await keep_until(systemd, None, 4))[:3] == ["STATUS=Serving U, without a scanner", *["WATCHDOG=1"] * 2]


async def test_a_stuck_capture_thread_starves_the_watchdog(systemd: Systemd, caplog: pytest.LogCaptureFixture) -> None:
    still = capture(beat_s=-1e9)
    said = await keep_until(systemd, still, 1)
    while "not fed" not in caplog.text:
        await asyncio.sleep(0.005)
    assert said == ["STATUS=Serving U, scanner: ready"]
    assert not any("WATCHDOG" in one for one in systemd.heard())


class Starving:
    """A watchdog that waits 0.2 s, and what it is told."""

    def __init__(self, systemd: Systemd, parts: dict[str, Beating]) -> None:
        self._systemd = systemd
        notifier = Notifier(systemd.address, watchdog_s=0.2)
        self._telling = asyncio.create_task(keep_notified(notifier, "U", None, parts))

    async def is_fed(self) -> bool:
        """Whether anything comes while it would wait, after what came so far."""
        self._systemd.heard()
        await asyncio.sleep(0.25)
        return "WATCHDOG=1" in self._systemd.heard()

    def end(self) -> None:
        self._telling.cancel()


async def test_a_capture_thread_that_hangs_in_a_port_starves_the_watchdog_until_it_goes_on(systemd: Systemd) -> None:
    go_on, hangs = threading.Event(), threading.Event()

    def open_port() -> Port:
        hangs.set()
        go_on.wait()
        raise PortLost("gone")

    capture = Capture(open_port, ScannerConfig(), lambda assembly: None)
    capture.start()
    watchdog = Starving(systemd, {"the capture thread": capture})
    try:
        assert await asyncio.to_thread(hangs.wait, 10)
        while await watchdog.is_fed():
            pass
        assert not await watchdog.is_fed()
        go_on.set()
        while not await watchdog.is_fed():
            pass
    finally:
        watchdog.end()
        go_on.set()
        await asyncio.to_thread(capture.stop)


async def test_encoding_threads_that_hang_starve_the_watchdog_until_one_goes_on(
    systemd: Systemd, tmp_path: Path
) -> None:
    go_on = threading.Event()
    with closing(Library(tmp_path)) as library, closing(Exhibits(library, FIRST_VIEW_BYTES, workers=2)) as exhibits:
        watchdog = Starving(systemd, {"the encoding threads": exhibits})
        try:
            assert await watchdog.is_fed()  # nothing to do is no standstill
            jobs = [asyncio.create_task(exhibits.work(go_on.wait)) for _ in range(2)]
            while await watchdog.is_fed():
                pass
            assert not await watchdog.is_fed()
            go_on.set()
            await asyncio.gather(*jobs)
            while not await watchdog.is_fed():
                pass
        finally:
            go_on.set()
            watchdog.end()


async def test_an_event_loop_that_hangs_starves_the_watchdog(systemd: Systemd) -> None:
    watchdog = Starving(systemd, {})
    assert await watchdog.is_fed()
    systemd.heard()
    time.sleep(0.5)
    assert systemd.heard() == []
    assert await watchdog.is_fed()
    watchdog.end()
