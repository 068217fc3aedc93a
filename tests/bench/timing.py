"""Ratios of times on a shared, noisy machine: everything that is compared runs in turn, and medians are compared."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

MEGABYTE = 1e6


def medians_s(jobs: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median time of each job [s], the jobs interleaved. Each runs once before, unmeasured."""
    for job in jobs.values():
        job()
    times: dict[str, list[float]] = {name: [] for name in jobs}
    gc.collect()
    for _ in range(repeats):
        for name, job in jobs.items():
            started_s = time.perf_counter()
            job()
            times[name].append(time.perf_counter() - started_s)
    return {name: median(taken) for name, taken in times.items()}
