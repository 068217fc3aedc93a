"""Every rival by its name: what it sends for a click, verified. Range and texture are chosen each for itself."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path

from node.first_view import FirstView, build_first_view
from tests.bench.cache import Cache
from tests.bench.rivals import draco_range, htj2k_texture, jpeg_texture, jpeg_whole, jpip, range_tiles
from tests.bench.rivals.codestream import RESOLUTIONS
from tests.bench.rivals.offer import Offer, reply, straight
from tests.bench.scans import BenchScan, Click
from tests.bench.target import Target, Window

FIRST_VIEW_BYTES = 32768

Part = Callable[[BenchScan, Window, Cache], Offer]


@lru_cache(maxsize=8)
def our_first_view(scan: BenchScan) -> FirstView:
    """What our clients hold of a scan before any click."""
    with tempfile.TemporaryDirectory(prefix="foveascan-bench-") as folder:
        return build_first_view(scan.published(Path(folder)), "htj2k", FIRST_VIEW_BYTES)


def as_coarse_as_ours(scan: BenchScan) -> dict[str, jpip.Free]:
    """What a JPIP client holds before any click, given the resolutions that our first view has."""
    info = our_first_view(scan).info
    spacings = {"range": info.width / info.coarse_width, "texture": info.texture_width / info.coarse_texture_width}
    return {name: jpip.Free(RESOLUTIONS - round(math.log2(spacing))) for name, spacing in spacings.items()}


def as_large_as_ours(scan: BenchScan) -> dict[str, jpip.Free]:
    """What a JPIP client holds before any click, given the bytes that our first view has."""
    view = our_first_view(scan)
    sizes = {"range": len(view.range.payload) + len(view.range.mask), "texture": len(view.texture.payload)}
    return {channel: jpip.Free(size_bytes=size) for channel, size in sizes.items()}


FIRST_VIEWS = {"coarse": as_coarse_as_ours, "large": as_large_as_ours}


def _jpip(channel: str, first_view: str, scan: BenchScan, window: Window, cache: Cache) -> Offer:
    offer = jpip.range_offer if channel == "range" else jpip.texture_offer
    return offer(scan, window, cache, FIRST_VIEWS[first_view](scan)[channel])


PARTS: Mapping[str, Part] = {
    "draco_full": draco_range.full_offer,
    "draco_tiles": lambda scan, window, _: draco_range.tiles_offer(scan, window),
    "range_tiles": lambda scan, window, _: range_tiles.range_offer(scan, window),
    "jpip_range_coarse": partial(_jpip, "range", "coarse"),
    "jpip_range_large": partial(_jpip, "range", "large"),
    "jpeg_full": jpeg_whole.texture_offer,
    "progressive_jpeg": jpeg_whole.progressive_offer,
    "jpeg_tiles": lambda scan, window, _: jpeg_texture.texture_offer(scan, window),
    "htj2k_tiles": lambda scan, window, _: htj2k_texture.texture_offer(scan, window),
    "jpip_texture_coarse": partial(_jpip, "texture", "coarse"),
    "jpip_texture_large": partial(_jpip, "texture", "large"),
}
SOURCES = {
    "draco_full": "draco_range", "draco_tiles": "draco_range", "range_tiles": "range_tiles",
    "jpip_range_coarse": "jpip", "jpip_range_large": "jpip",
    "jpip_texture_coarse": "jpip", "jpip_texture_large": "jpip",
    "jpeg_full": "jpeg_whole", "progressive_jpeg": "jpeg_whole",
    "jpeg_tiles": "jpeg_texture", "htj2k_tiles": "htj2k_texture",
}  # fmt: skip
RIVALS: Mapping[str, tuple[str, str]] = {
    "full Draco + JPEG": ("draco_full", "jpeg_full"),
    "Draco + JPEG tiles": ("draco_tiles", "jpeg_tiles"),
    "JPEG tile pyramid": ("range_tiles", "jpeg_tiles"),
    "HTJ2K tile pyramid": ("range_tiles", "htj2k_tiles"),
    "JPIP": ("jpip_range_coarse", "jpip_texture_coarse"),
    "JPIP, as large a first view": ("jpip_range_large", "jpip_texture_large"),
    "progressive JPEG": ("range_tiles", "progressive_jpeg"),
}


def bytes_for(rival: str, scan: BenchScan, click: Click, target: Target, cache: Cache) -> Offer:
    """What a rival sends for a click. Raises Unreachable, or Skipped where it cannot run here."""
    range_part, texture_part = RIVALS[rival]
    return reply() + part(range_part, scan, click, target, cache) + part(texture_part, scan, click, target, cache)


def part(name: str, scan: BenchScan, click: Click, target: Target, cache: Cache) -> Offer:
    """One channel of a rival, from the cache where it is known."""

    def make() -> dict[str, object]:
        ready, place = straight(scan, click)
        return asdict(PARTS[name](ready, Window.round(ready.grid, place, target), cache))

    made = cache.value(f"rivals.{SOURCES[name]}", f"{name} {scan.key} {click} {target}{edition(name, scan)}", make)
    return Offer(int(made["size_bytes"]), str(made["how"]))


def edition(name: str, scan: BenchScan) -> str:
    """What a result hangs on beside its own source: our first view, where a rival is given one like it."""
    first_view = FIRST_VIEWS.get(name.rpartition("_")[2])
    return f" {first_view(scan)}" if first_view else ""
