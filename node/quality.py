"""Searching a texture quality in few encodes: aim by what has been measured, never repeat a try."""

from __future__ import annotations

import math
from dataclasses import dataclass

from node.coded import Coded

FIRST_QUALITY = 40
DB_PER_QUALITY = 0.35  # what a step of quality is worth near the qualities in use, until two measurements tell
BYTES_PER_DOUBLING = 8  # steps of quality that double the bytes
MARGIN_DB = 0.1  # aimed above the target, so that the next try reaches it
OVERSHOOT_DB = 0.4  # a result so little above the target is not worth another encode
TRIES = 3  # tries spent on saving bytes; only to reach the target are there more
TRIES_MAX = 8


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """One try: what a quality gave."""

    quality: int
    db: float
    coded: Coded


class QualitySearch:
    """Looks for the lowest quality whose result has at least target_db, or the highest that is not too large."""

    def __init__(self, target_db: float, lowest: int, highest: int) -> None:
        self._target = target_db
        self._lowest, self._highest = lowest, highest
        self._points: list[Point] = []
        self._tried: set[int] = set()
        self._next: int | None = min(max(FIRST_QUALITY, lowest), highest)

    def next_quality(self) -> int | None:
        """What to try now; None when the search is over."""
        if self._next is None or self._next in self._tried or len(self._tried) >= TRIES_MAX:
            return None
        self._tried.add(self._next)
        return self._next

    def measured(self, point: Point) -> None:
        """A try fitted and was measured."""
        self._points.append(point)
        reached = point.db >= self._target
        if reached and (point.db - self._target <= OVERSHOOT_DB or len(self._tried) >= TRIES):
            self._next = None
            return
        step = (self._target + MARGIN_DB - point.db) / self._slope()
        self._next = self._bounded(point.quality + (math.ceil(step) if step > 0 else -math.floor(-step)))

    def too_large(self, quality: int, ratio: float) -> None:
        """A try took `ratio` times the bytes there are; nothing at or above its quality fits."""
        self._highest = quality - 1
        if self._highest < self._lowest:
            self._next = None
            return
        self._next = self._bounded(quality - max(math.ceil(BYTES_PER_DOUBLING * math.log2(max(ratio, 1))), 1))

    def best(self) -> Point | None:
        """The cheapest try that reached the target, else the one that came nearest; None when none fitted."""
        reached = [point for point in self._points if point.db >= self._target]
        if reached:
            return min(reached, key=lambda point: point.coded.wire_bytes)
        return max(self._points, key=lambda point: point.db, default=None)

    def _slope(self) -> float:
        """Decibels a step of quality, from the last two tries."""
        if len(self._points) < 2:
            return DB_PER_QUALITY
        a, b = self._points[-2:]
        slope = (b.db - a.db) / (b.quality - a.quality)
        return min(max(slope, DB_PER_QUALITY / 4), DB_PER_QUALITY * 4)

    def _bounded(self, quality: int) -> int:
        return min(max(quality, self._lowest), self._highest)
