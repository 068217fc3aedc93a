"""What a node has done and how it is, in numbers for Prometheus. No label names a person, a scan or an address.

Counters and histograms are counted where things happen; whatever can be asked for is asked at each scrape.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Histogram, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from node.capture import SweepCounts

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
ENCODE_S = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
LINK_BYTES_S = tuple(unit * scale for scale in (10**4, 10**5, 10**6, 10**7, 10**8) for unit in (1, 3))
METHODS = frozenset({"GET", "HEAD", "POST", "PATCH", "DELETE"})
PHASES = ("no scanner", "connecting", "ready", "starting", "sweeping", "stopped")


@dataclass(frozen=True, slots=True)
class Now:
    """How a node is at this moment. phase, is_stuck : of the capture thread.  certificate_end_unix_s : None: none."""

    is_ready: bool
    phase: str
    sweeps: int
    counts: SweepCounts
    streams: int
    connections: int
    turned_away: int
    queued: int
    planners: int
    planners_died: int
    scans: int
    interrupted: int
    free_bytes: int
    size_bytes: int
    audit_waiting: int
    audit_fails: bool
    certificate_end_unix_s: float | None


class Metrics:
    """The numbers of one node. For one event loop, except `exposition`."""

    def __init__(self) -> None:
        self._registry = registry = CollectorRegistry()
        ProcessCollector(registry=registry)
        self._encoding = Histogram(
            "foveascan_encode_seconds", "Planning and encoding one answer, after its wait for a thread", ["of"],
            buckets=ENCODE_S, registry=registry,
        )  # fmt: skip
        self._waited = Histogram(
            "foveascan_encode_wait_seconds", "Waiting for an encoding thread", buckets=ENCODE_S, registry=registry
        )
        self._hurried = Counter(
            "foveascan_hurried_looks", "Looks planned in a hurry, since others were in work", registry=registry
        )
        self._updates = Counter("foveascan_updates", "Looks answered on streams", ["reason"], registry=registry)
        self._opened = Counter("foveascan_opened", "Scans opened on streams", registry=registry)
        self._sent = Counter("foveascan_sent_bytes", "Bytes sent, before TLS", ["by"], registry=registry)
        self._bandwidth = Histogram(
            "foveascan_link_bytes_per_second", "Bandwidth to a client, as its acknowledgements tell",
            buckets=LINK_BYTES_S, registry=registry,
        )  # fmt: skip
        self._requests = Counter(
            "foveascan_http_requests", "Requests over HTTP", ["method", "route", "status"], registry=registry
        )
        self._refused = Counter(
            "foveascan_refused", "Whoever was not let in, or not to something", ["why"], registry=registry
        )
        for by in ("stream", "http"):
            self._sent.labels(by)

    def show(self, now: Callable[[], Now]) -> None:
        """Add what is asked for at each scrape."""
        self._registry.register(_Asked(now))

    def encoded(self, of: str, waited_s: float, took_s: float) -> None:
        """A job of an encoding thread is done. of : "look", "fovea", "view", "picture" or "other"."""
        self._waited.observe(waited_s)
        self._encoding.labels(of).observe(took_s)

    def hurried(self) -> None:
        """A look was planned in a hurry."""
        self._hurried.inc()

    def updated(self, reason: str) -> None:
        """A look was answered."""
        self._updates.labels(reason).inc()

    def opened(self) -> None:
        """A stream opened a scan."""
        self._opened.inc()

    def sent(self, size_bytes: int) -> None:
        """So much went out on a stream."""
        self._sent.labels("stream").inc(size_bytes)

    def measured(self, bytes_s: float) -> None:
        """A client acknowledged an update."""
        self._bandwidth.observe(bytes_s)

    def answered(self, method: str, route: str, status: int, size_bytes: int) -> None:
        """A request got its answer. route : as the router has it, so that nobody can make up another."""
        self._requests.labels(method if method in METHODS else "other", route, str(status)).inc()
        self._sent.labels("http").inc(size_bytes)

    def refused(self, why: str) -> None:
        """Somebody was turned away."""
        self._refused.labels(why).inc()

    def exposition(self) -> bytes:
        """All of it, as Prometheus reads it. Asks the disk, so it may take its time."""
        return generate_latest(self._registry)


class _Asked(Collector):
    def __init__(self, now: Callable[[], Now]) -> None:
        self._now = now

    def describe(self) -> Iterable[Metric]:
        return ()  # else the registry would ask for everything when this is added

    def collect(self) -> Iterator[Metric]:
        now = self._now()
        c = now.counts
        text = "What the scanner does: one of these is 1"
        phase = GaugeMetricFamily("foveascan_capture_phase", text, labels=["phase"])
        for name in PHASES:
            phase.add_metric([name], now.phase == name)
        yield phase
        columns = CounterMetricFamily("foveascan_columns", "Pieces of columns received", labels=["channel"])
        columns.add_metric(["range"], c.range_columns)
        columns.add_metric(["texture"], c.texture_columns)
        yield columns
        sweeps = CounterMetricFamily("foveascan_sweeps", "Sweeps that ended", labels=["end"])
        sweeps.add_metric(["scan"], now.sweeps)
        sweeps.add_metric(["interrupted"], c.interrupted)
        yield sweeps
        for name, text, count in (
            ("rerequested_columns", "Columns asked for again", c.requested_columns),
            ("dropped_frames", "Stretches of the scanner's line that were no sound frame", c.dropped_frames),
            ("dropped_bytes", "Bytes of these", c.dropped_bytes),
            ("planning_processes_died", "Processes that planned looks, and died", now.planners_died),
            ("connections_closed", "Connections closed because there were too many", now.turned_away),
        ):
            yield CounterMetricFamily(f"foveascan_{name}", text, value=count)
        for name, text, value in (
            ("ready", "1: all is well, as /healthz says", now.is_ready),
            ("streams", "Clients with a stream", now.streams),
            ("connections", "Connections, streams among them", now.connections),
            ("encode_queue", "Jobs that wait for an encoding thread", now.queued),
            ("planning_processes", "Processes that plan looks where several wait", now.planners),
            ("scans", "Scans in the library", now.scans),
            ("interrupted_sweeps", "Interrupted sweeps in the library", now.interrupted),
            ("disk_free_bytes", "Free where the library is", now.free_bytes),
            ("disk_size_bytes", "Size of the disk where the library is", now.size_bytes),
            ("audit_waiting", "Entries of the audit log that are not written yet", now.audit_waiting),
            ("audit_failing", "1: the audit log cannot be written", now.audit_fails),
        ):
            yield GaugeMetricFamily(f"foveascan_{name}", text, value=value)
        if now.certificate_end_unix_s is not None:
            text = "When the certificate ends, in seconds since 1970"
            yield GaugeMetricFamily("foveascan_certificate_end_seconds", text, value=now.certificate_end_unix_s)
