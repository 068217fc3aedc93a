"""The numbers of a node: they count what happens, and name nobody and nothing."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from client import connect
from drivers.scanner import SweepFinished, SweepReport
from node.capture import SweepCounts
from tests.node.entrance import Entrance, entrance

SAID = "a-name-of-somebody"


@pytest.fixture
async def node(tmp_path: Path) -> AsyncIterator[Entrance]:
    async with entrance(tmp_path / "library") as node:
        yield node


async def numbers(node: Entrance, token: str) -> dict[tuple[str, ...], float]:
    """(name, values of its labels) -> value, as Prometheus reads it."""
    async with node.ask("GET", "/metrics", token) as answer:
        assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
        text = await answer.text()
    assert SAID not in text and node.scan not in text and "127.0.0.1" not in text
    families = text_string_to_metric_families(text)
    return {(one.name, *one.labels.values()): one.value for family in families for one in family.samples}


async def test_looks_requests_and_refusals_are_counted(node: Entrance) -> None:
    monitor = node.token("monitor", SAID)
    before = await numbers(node, monitor)
    assert before["foveascan_streams",] == 0
    async with connect(node.url, node.token("view"), node.tls.fingerprint) as session:
        await session.open("latest")
        for at in (0.2, 0.6):
            await session.look(at, 0.5)
        async with node.ask("GET", f"/v1/scans/{node.scan}", "wrong"), node.ask("GET", "/v1/nowhere", monitor):
            pass
        now = await numbers(node, monitor)
    assert now["foveascan_streams",] == 1
    assert now["foveascan_opened_total",] == 1
    assert now["foveascan_updates_total", "complete"] == 2
    assert now["foveascan_encode_seconds_count", "look"] == 2
    assert now["foveascan_encode_seconds_count", "view"] == 1
    assert now["foveascan_encode_wait_seconds_count",] >= 3
    assert now["foveascan_link_bytes_per_second_count",] >= 1
    assert now["foveascan_sent_bytes_total", "stream"] > 500
    assert now["foveascan_sent_bytes_total", "http"] > 1000
    assert now["foveascan_http_requests_total", "GET", "/v1/scans/{scan}", "401"] == 1
    assert now["foveascan_http_requests_total", "GET", "/metrics", "200"] == 1
    assert now["foveascan_refused_total", "wrong token"] == 1
    assert now["foveascan_refused_total", "role"] == 1
    assert now["foveascan_capture_phase", "no scanner"] == 1
    assert (now["foveascan_ready",], now["foveascan_scans",], now["foveascan_audit_failing",]) == (1, 1, 0)
    assert now["foveascan_certificate_end_seconds",] == pytest.approx(node.tls.ends_unix_s)
    assert 0 < now["foveascan_disk_free_bytes",] <= now["foveascan_disk_size_bytes",]
    assert now["process_resident_memory_bytes",] > 1e7


async def test_made_up_methods_and_places_make_no_new_series(node: Entrance) -> None:
    monitor = node.token("monitor", SAID)
    for number, method in enumerate(("PUT", "OPTIONS", "PROPFIND")):
        async with node.ask(method, f"/{SAID}{number}"):
            pass
    now = await numbers(node, monitor)
    assert [key[1:] for key in now if key[0] == "foveascan_http_requests_total"] == [("other", "", "401")]


async def test_a_monitor_sees_health_and_numbers_and_nothing_else(node: Entrance) -> None:
    monitor = node.token("monitor")
    async with node.ask("GET", "/healthz", monitor) as answer:
        assert "reasons" in await answer.json()
    async with node.ask("GET", "/v1/scans", monitor) as answer:
        assert answer.status == 403
    async with node.http.get(f"{node.url}/", headers={"Authorization": f"Bearer {monitor}"}) as answer:
        assert answer.status == 403


async def test_jobs_that_wait_for_a_thread_are_the_queue(node: Entrance) -> None:
    exhibits, release = node.server._exhibits, asyncio.Event()
    await exhibits.picture("latest")  # begun at the node's start
    loop = asyncio.get_running_loop()
    jobs = [
        asyncio.create_task(exhibits.work(lambda: asyncio.run_coroutine_threadsafe(release.wait(), loop).result()))
        for _ in range(3)
    ]
    await asyncio.sleep(0)
    assert (await numbers(node, node.token("monitor")))["foveascan_encode_queue",] == 2  # of one thread
    release.set()
    await asyncio.gather(*jobs)


def test_sweeps_are_counted_with_what_their_line_lost() -> None:
    counts = SweepCounts()
    for _ in range(2):
        counts.take(SweepFinished(SweepReport(requested_columns=3, dropped_bytes=50, dropped_frames=2)))
    assert (counts.requested_columns, counts.dropped_bytes, counts.dropped_frames) == (6, 100, 4)
