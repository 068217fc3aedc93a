"""How the node is, over HTTP: for a monitor, and in numbers for Prometheus.

    GET /healthz    one word for anybody, the reasons for whoever has a login
    GET /metrics    (monitor) node.metrics
    GET /v1/upkeep  (admin) what who looks after the node wants to know
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Callable

from aiohttp import web

from node.audit import Audit
from node.auth import LOGIN
from node.bodies import Certificate, Disk, HealthSaid, Rules, Upkeep
from node.capture import Capture, CaptureStatus, SweepCounts
from node.config import Retention
from node.endpoints import route
from node.exhibits import Exhibits
from node.gate import Gate
from node.health import Health, examine_health
from node.metrics import MEDIA_TYPE, Metrics, Now
from node.notify import Beating
from node.rest import said
from node.tls import Tls


class HealthRoutes:
    """The routes above. streams : how many there are.  is_stopping : whether the node is."""

    def __init__(
        self,
        metrics: Metrics,
        exhibits: Exhibits,
        capture: Capture | None,
        tls: Tls | None,
        audit: Audit,
        gate: Gate,
        streams: Callable[[], int],
        is_stopping: Callable[[], bool],
        version: str,
        retention: Callable[[], Retention],
    ) -> None:
        self._metrics = metrics
        self._exhibits = exhibits
        self._capture = capture
        self._tls = tls
        self._audit = audit
        self._gate = gate
        self._streams = streams
        self._is_stopping = is_stopping
        self._version = version
        self._retention = retention
        self._started_unix_s = time.time()
        metrics.show(self._now)

    def routes(self) -> list[web.RouteDef]:
        """What to add to the application."""
        return [
            route("GET /healthz", self._health),
            route("GET /metrics", self._show),
            route("GET /v1/upkeep", self._upkeep),
        ]

    async def _health(self, request: web.Request) -> web.Response:
        health = await asyncio.to_thread(self._examine)
        status = 503 if health.status == "stopping" else 200
        if request[LOGIN].role is None:
            return said(HealthSaid(health.status), status)
        return said(HealthSaid(health.status, health.reasons, self._status()), status)

    async def _show(self, request: web.Request) -> web.Response:
        body = await asyncio.to_thread(self._metrics.exposition)
        return web.Response(body=body, headers={"Content-Type": MEDIA_TYPE})

    async def _upkeep(self, request: web.Request) -> web.Response:
        health, now = await asyncio.to_thread(lambda: (self._examine(), self._now()))
        tls, rules = self._tls, self._retention()
        upkeep = Upkeep(
            self._version, self._started_unix_s, health.status, health.reasons, self._status(),
            Disk(now.free_bytes, now.size_bytes),
            Certificate(tls.fingerprint, tls.ends_unix_s, tls.is_own) if tls else None,
            Rules(rules.max_age_days, rules.max_gb), now.scans, now.interrupted, now.streams,
        )  # fmt: skip
        return said(upkeep)

    def _status(self) -> CaptureStatus:
        return self._capture.status if self._capture else CaptureStatus("no scanner")

    def _examine(self) -> Health:
        if self._is_stopping() or self._status().phase == "stopped":
            return Health("stopping")
        parts: dict[str, Beating] = {"the encoding threads": self._exhibits}
        if self._capture is not None:
            parts["the capture thread"] = self._capture
        ends_s = self._tls.ends_unix_s if self._tls else None
        library, now_s = self._exhibits.library, time.time()
        planning = self._exhibits.planners.trouble
        return examine_health(self._status(), library, parts, self._audit.trouble, planning, ends_s, now_s)

    def _now(self) -> Now:
        library, status = self._exhibits.library, self._status()
        disk = os.statvfs(library.folder)
        return Now(
            is_ready=self._examine().status in ("ready", "capturing"),
            phase=status.phase,
            sweeps=status.sweeps,
            counts=self._capture.counts if self._capture else SweepCounts(),
            streams=self._streams(),
            connections=self._gate.connections,
            turned_away=self._gate.turned_away,
            queued=self._exhibits.queued,
            planners=self._exhibits.planners.running,
            planners_died=self._exhibits.planners.died,
            scans=len(library.scans()),
            interrupted=len(library.sweeps.interrupted()),
            free_bytes=disk.f_bavail * disk.f_frsize,
            size_bytes=disk.f_blocks * disk.f_frsize,
            audit_waiting=self._audit.waiting,
            audit_fails=bool(self._audit.trouble),
            certificate_end_unix_s=self._tls.ends_unix_s if self._tls else None,
        )
