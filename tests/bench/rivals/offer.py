"""What every rival answers: how many bytes it needs for a click, verified by decoding what it would have sent.

Rivals pay REPLY_BYTES for the reply, a void mask where the window has voids, and PIECE_BYTES for each tile's length.
Headers that are constant for a session cost them nothing, nor do fitted Huffman tables, nor the first view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from protocol.codec import encode_mask
from protocol.grid import VOID, Grid
from tests.bench.scans import BenchScan, Click
from tests.bench.target import Window

REPLY_BYTES = 64
PIECE_BYTES = 2


class Unreachable(Exception):
    """A rival cannot deliver the target at any setting."""


@dataclass(frozen=True)
class Offer:
    """What a rival, or a part of one, needs: bytes, and the setting that needs so few."""

    size_bytes: int
    how: str

    def __add__(self, other: Offer) -> Offer:
        return Offer(self.size_bytes + other.size_bytes, f"{self.how} + {other.how}")


def cheapest(offers: list[Offer]) -> Offer:
    """The best of several settings. Raises Unreachable where there is none."""
    if not offers:
        raise Unreachable("no setting reaches the target")
    return min(offers, key=lambda offer: offer.size_bytes)


def reply() -> Offer:
    """The reply that carries everything for one click."""
    return Offer(REPLY_BYTES, "reply")


def void_mask(window: Window) -> Offer:
    """The window's void mask, coded as ours."""
    return Offer(len(encode_mask(window.range_steps == VOID)), "mask")


def straight(scan: BenchScan, click: Click) -> tuple[BenchScan, Click]:
    """The scan as it is, or half a turn on where the click's windows would cross the seam: rivals are not cyclic."""
    width = scan.grid.spec.width
    if width / 4 <= click[0] * width < 3 * width / 4:
        return scan, click
    return turned(scan), ((click[0] + 0.5) % 1, click[1])


def turned(scan: BenchScan) -> BenchScan:
    """A scan half a turn on. One for each scan, so that what is kept by scan is kept."""
    found = _turned.get(scan.key)
    if found is None:
        grid = scan.grid
        half = grid.spec.width // 2, grid.spec.texture_width // 2
        steps, texels = np.roll(grid.range_steps, half[0], axis=1), np.roll(grid.texture, half[1], axis=1)
        found = replace(scan, name=f"{scan.name}-turned", grid=Grid(grid.spec, steps, texels))
        _turned[scan.key] = found
    return found


_turned: dict[str, BenchScan] = {}
