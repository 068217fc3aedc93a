from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from node.capture import Capture, CaptureStatus
from node.notify import Notifier, keep_notified, status_text, stuck


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
    notifier.stopping()
    assert systemd.heard() == [
        "READY=1\nSTATUS=up", "STATUS=two lines", "WATCHDOG=1", "STOPPING=1\nSTATUS=Stopping",
    ]  # fmt: skip


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


def test_a_capture_thread_that_stands_still_is_stuck() -> None:
    assert stuck(None, 5.0) is None
    assert stuck(capture(beat_s=100.0), 5.0, lambda: 105.0) is None
    assert stuck(capture(beat_s=100.0), 5.0, lambda: 106.0) == "the capture thread has not moved for 6 s"


async def keep_until(systemd: Systemd, watched: Capture | None, count: int) -> list[str]:
    """What systemd hears until it has heard `count` times."""
    notifier = Notifier(systemd.address, watchdog_s=0.02)
    keeping = asyncio.create_task(keep_notified(notifier, "U", watched))
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
