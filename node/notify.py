"""Telling systemd how we are, by its notification socket: ready, alive, stopping. Silent where nobody asked.

The watchdog is fed by progress, not by a timer: the event loop has to come round to `keep_notified`, the capture thread
has to have shown since that it gets on, and so have the encoding threads, if there is work for them. A node that hangs
is started anew.

Source: sd_notify(3), sd_watchdog_enabled(3).
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Mapping, MutableMapping
from typing import Protocol

from node.capture import Capture

log = logging.getLogger(__name__)

TICK_S = 1.0
STATUS_MAX = 200


class Beating(Protocol):
    """Part of a node that works in threads of its own."""

    @property
    def beat_s(self) -> float:
        """When it last showed that it gets on. [s, time.monotonic]"""


class Notifier:
    """The way to systemd. address : of its socket, "@..." an abstract one; None: nobody listens.

    watchdog_s : how long we may be silent before we are taken for dead; None: for ever.
    """

    def __init__(self, address: str | None = None, watchdog_s: float | None = None) -> None:
        self.watchdog_s = watchdog_s
        self._address = "\0" + address[1:] if address and address.startswith("@") else address
        self._status = ""

    @classmethod
    def from_environment(cls, environ: MutableMapping[str, str]) -> Notifier:
        """As systemd asks by NOTIFY_SOCKET and WATCHDOG_USEC; both are taken out: no child of ours may speak for us."""
        address = environ.pop("NOTIFY_SOCKET", None)
        watchdog_us = environ.pop("WATCHDOG_USEC", "")
        watched = environ.pop("WATCHDOG_PID", str(os.getpid())) == str(os.getpid()) and watchdog_us.isdecimal()
        return cls(address, int(watchdog_us) / 1e6 if watched and int(watchdog_us) else None)

    def ready(self, status: str) -> None:
        """All is up."""
        self._status = status
        self._send("READY=1", f"STATUS={_line(status)}")

    def status(self, status: str) -> None:
        """What `systemctl status` shows; sent when it changes."""
        if status != self._status:
            self._status = status
            self._send(f"STATUS={_line(status)}")

    def alive(self) -> None:
        """Feed the watchdog."""
        self._send("WATCHDOG=1")

    def reloading(self) -> None:
        """Settings are read anew; `ready` ends that."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self) -> None:
        """The end has begun."""
        self._send("STOPPING=1", "STATUS=Stopping")

    def _send(self, *lines: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
                line.setblocking(False)
                line.sendto("\n".join(lines).encode(), self._address)
        except OSError as error:  # whoever is to be told is not worth dying for
            log.warning("cannot tell systemd %s: %s", lines[0], error)


async def keep_notified(
    notifier: Notifier, url: str, capture: Capture | None, parts: Mapping[str, Beating]
) -> None:
    """Until cancelled, say how the node is and, as long as everything moves, that it lives.

    parts : whose progress counts, by what they are called.
    """
    tick_s = min(TICK_S, (notifier.watchdog_s or 4 * TICK_S) / 4)
    while True:
        notifier.status(status_text(url, capture))
        if notifier.watchdog_s is not None:
            if trouble := stuck(parts, notifier.watchdog_s / 2):
                log.error("the watchdog is not fed: %s", trouble)
            else:
                notifier.alive()
        await asyncio.sleep(tick_s)


def status_text(url: str, capture: Capture | None) -> str:
    """One line on what the node does."""
    if capture is None:
        return f"Serving {url}, without a scanner"
    status = capture.status
    doing = f"sweeping, {100 * status.progress:.0f} %" if status.phase == "sweeping" else status.phase
    return f"Serving {url}, scanner: {doing}{': ' + status.why if status.why else ''}"


def stuck(
    parts: Mapping[str, Beating], patience_s: float, clock: Callable[[], float] = time.monotonic
) -> str | None:
    """What does not get on any more, or None."""
    for name, part in parts.items():
        if (silent_s := clock() - part.beat_s) > patience_s:
            return f"{name} has not moved for {silent_s:.0f} s"
    return None


def _line(status: str) -> str:
    """The protocol is one field a line."""
    return " ".join(status.split())[:STATUS_MAX]
