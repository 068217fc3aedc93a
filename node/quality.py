"""Searching a texture quality in few encodes: aim by what is expected, correct by what is measured."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from node.coded import Coded
from node.texture_model import MSE_MIN, Expected

MARGIN = 0.98  # of the squared error allowed: what is aimed at
MARGIN_CYLINDER = 0.99  # the same where errors are not weighed by area, and so are what anybody measures
OVERSHOOT_DB = 0.45  # a result so little above the target is not worth another encode: a step of quality is 0.35 dB
FILL = 0.88  # of the bytes aimed at: range takes what is left, so only less than this is worth one more encode
HIGHER = 0.5  # by how much a quality is raised at least that was expected to do and did not
TRIES = 2  # tries spent on saving or filling bytes; only to reach the target or to fit are there more
TRIES_MAX = 8
TRIES_MAX_LIMITED = 3


class Superseded(Exception):
    """A newer look has come: what is planned is not wanted any more."""


class Encodes:
    """Counts the images coded for an update. superseded : asked before each; when true, Superseded is raised."""

    def __init__(self, superseded: Callable[[], bool]) -> None:
        self._superseded = superseded
        self.count = 0

    def add(self) -> None:
        """One more is about to be coded."""
        if self._superseded():
            raise Superseded
        self.count += 1


@dataclass(frozen=True, slots=True, eq=False)
class Point:
    """One try that fitted: what a quality left and took."""

    quality: float
    mse: float
    coded: Coded


class QualitySearch:
    """Looks for the lowest quality whose squared error is at most target_mse, within a limit.

    aim_bytes, limit_bytes : payload to aim at, and the most it may be.
    expected : what qualities take and reach, by the scan's model.  lowest, highest : the codec's qualities.
    grain : by how much these can differ.  margin : of target_mse, what is aimed at.
    """

    def __init__(
        self,
        target_mse: float,
        aim_bytes: float,
        limit_bytes: float,
        expected: Expected,
        lowest: int,
        highest: int,
        tries: int = TRIES,
        grain: float = 1.0,
        margin: float = MARGIN,
    ) -> None:
        self._tries, self._margin = tries, margin
        self._target = target_mse
        self._aim_bytes, self._limit = aim_bytes, limit_bytes
        self._expected = expected
        self._lowest, self._highest, self._grain = float(lowest), float(highest), grain
        self._points: list[Point] = []
        self._tried: set[float] = set()
        self.limited = False
        self._next: float | None = None
        self._aim(1.0, 1.0)

    def next_quality(self) -> float | None:
        """What to try now; None when the search is over."""
        most = TRIES_MAX_LIMITED if self.limited and not self._points else TRIES_MAX
        if self._next is None or self._next in self._tried or len(self._tried) >= most:
            return None
        self._tried.add(self._next)
        return self._next

    def fits(self, coded: Coded) -> bool:
        """Whether a try is within the bytes there are."""
        return len(coded.payload) <= self._limit

    def measured(self, point: Point) -> None:
        """A try fitted and was measured."""
        self._points.append(point)
        reached = point.mse <= self._target
        spared = 10 * math.log10(self._target / max(point.mse, 1e-9)) if reached else 0.0
        filled = len(point.coded.payload) >= FILL * self._aim_bytes
        done = spared <= OVERSHOOT_DB if reached else filled and self.limited
        if done or ((reached or self.limited) and len(self._tried) >= self._tries):
            self._next = None
            return
        worse = max(point.mse, MSE_MIN) / self._expected.mse(point.quality)  # a plain texture leaves no error at all
        self._aim(worse, len(point.coded.payload) / self._expected.size_bytes(point.quality))
        if self._next in self._tried:
            self._next = None if reached or self.limited else self._above(point.quality)

    def at_least(self, quality: float) -> None:
        """Less than this leaves blocks as they are that spoil the result."""
        if self._next is not None:
            self._lowest = max(self._lowest, min(quality, self._highest))
            self._next = max(self._next, self._lowest)

    def missed_all(self, quality: float, needed: float) -> None:
        """A try would be adopted nowhere, and what is held is too poor: at least `needed` would be."""
        self._next = max(needed, quality + 1) if max(needed, quality + 1) <= self._highest else None

    def too_large(self, quality: float, payload_bytes: int) -> None:
        """A try took more than there is; nothing at or above its quality fits."""
        self._highest = quality - self._grain
        self.limited = True
        self._aim(1.0, payload_bytes / self._expected.size_bytes(quality))
        if self._highest < self._lowest:
            self._next = None

    def best(self) -> Point | None:
        """The cheapest try that reached the target, else the one that came nearest; None when none fitted."""
        reached = [point for point in self._points if point.mse <= self._target]
        if reached:
            return min(reached, key=lambda point: point.coded.wire_bytes)
        return min(self._points, key=lambda point: point.mse, default=None)

    def _above(self, quality: float) -> float:
        """What to try after a quality that is too low: half way to the lowest that is not, where one is known."""
        enough = min((point.quality for point in self._points if point.mse <= self._target), default=None)
        if enough is None:
            return min(quality + max(self._grain, HIGHER), self._highest)
        return floored((quality + enough) / 2, self._grain)

    def _aim(self, worse: float, larger: float) -> None:
        """Choose the next quality, given how far the expectation was off: factors on squared error and bytes."""
        wanted = ceiled(self._expected.quality_for_mse(self._margin * self._target / worse), self._grain)
        affordable = wanted
        if math.isfinite(self._aim_bytes):
            affordable = floored(self._expected.quality_for_bytes(self._aim_bytes / larger), self._grain)
        self.limited |= affordable < wanted
        self._next = min(max(min(wanted, affordable), self._lowest), self._highest)


def ceiled(quality: float, grain: float) -> float:
    """The next quality that there is, upward."""
    return math.ceil(quality / grain) * grain


def floored(quality: float, grain: float) -> float:
    """The same downward."""
    return math.floor(quality / grain) * grain
