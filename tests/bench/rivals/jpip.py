"""JPEG 2000 by precincts, as a JPIP server would answer a window request: which packets, in how many bytes.

A message of the JPP stream carries a run of one precinct's packets; its header is counted byte by byte (bin id, offset
and length as variable-length numbers), and packets that say nothing are not sent where nothing follows them. The main
header is free. So is a first view: the resolutions as coarse as ours, or else as many bytes of them as ours may take.
The number of layers is the lowest that reaches the target; of several ways to cut and to layer the image the best one
counts, click by click.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.region import Region
from tests.bench.cache import Cache
from tests.bench.rivals.codestream import EMPTY, CodeStream, Layout, make
from tests.bench.rivals.jpeg_texture import least
from tests.bench.rivals.offer import Offer, cheapest, void_mask
from tests.bench.rivals.range_tiles import filled_range
from tests.bench.scans import BenchScan
from tests.bench.target import Window, crop

CUTS = (((64,) * 7, 32), ((128,) * 7, 64), ((64, 64, 32, 32, 32, 32, 32), 32), ((64, 32, 32, 16, 16, 16, 16), 32))
TEXTURE_DB = ((36.0, 39.0, 42.0, 45.0, 48.0, 51.0), (37.5, 39.0, 40.5, 42.0, 43.5, 45.0, 46.5, 48.0, 49.5))
RANGE_DB = (tuple(np.arange(55, 95, 3.0).tolist()), tuple(np.arange(56.5, 95, 3.0).tolist()))
MARGINS = (0, 2)  # samples of each resolution round the window whose precincts are sent as well, where 0 does not do

Reached = Callable[[Any], bool]


@dataclass(frozen=True)
class Free:
    """What a client holds of a channel before any click.

    resolutions : of 7, whole ones.  size_bytes : whole resolutions within it, coarsest first, the last one by layers.
    """

    resolutions: int = 7
    size_bytes: int = 1 << 30


def texture_offer(scan: BenchScan, window: Window, cache: Cache, free: Free) -> Offer:
    """The cheapest packets that show the window at the target's PSNR."""
    layouts = [Layout(*cut, layers) for cut in CUTS for layers in TEXTURE_DB]
    streams = (texture_stream(scan, layout, cache) for layout in layouts)
    return cheapest([o for s in streams for o in offers_of(s, window.texture, window.texture_reached, free)])


def range_offer(scan: BenchScan, window: Window, cache: Cache, free: Free) -> Offer:
    """The cheapest packets that show the window within the target's error, with its void mask."""

    def reached(values: Any) -> bool:
        return window.range_reached(np.maximum(values, 1).astype(np.uint16))

    layouts = [Layout(*cut, layers) for cut in CUTS for layers in RANGE_DB]
    streams = (range_stream(scan, layout, cache) for layout in layouts)
    return cheapest([o for s in streams for o in offers_of(s, window.range, reached, free)]) + void_mask(window)


@lru_cache(maxsize=16)
def texture_stream(scan: BenchScan, layout: Layout, cache: Cache) -> CodeStream:
    """A scan's texture as one code stream."""
    return make(np.ascontiguousarray(scan.grid.texture), layout, cache, f"{scan.key} texture")


@lru_cache(maxsize=16)
def range_stream(scan: BenchScan, layout: Layout, cache: Cache) -> CodeStream:
    """A scan's range, voids filled, as one code stream."""
    return make(filled_range(scan).astype(np.uint16), layout, cache, f"{scan.key} range")


def offers_of(stream: CodeStream, region: Region, reached: Reached, free: Free) -> Iterator[Offer]:
    """The fewest layers that reach the target, with as little margin as does."""
    for margin in MARGINS:
        bins = precincts_over(stream, region, margin)

        def enough(layers: int, bins: list[list[int]] = bins) -> bool:
            wanted = packets_of(stream, bins, layers) | first_view(stream, layers, free)
            return reached(crop(stream.decode(wanted), region))

        layers = least(enough, 1, stream.layers)
        if layers is not None:
            cut = stream.layout
            how = f"{layers} of {stream.layers} layers, precincts of {cut.precincts}, blocks of {cut.block}"
            size = message_bytes(stream, packets_of(stream, bins, layers), first_view(stream, layers, free))
            yield Offer(size, f"JPEG 2000, {how}, margin {margin}")
            return


def precincts_over(stream: CodeStream, region: Region, margin: int) -> list[list[int]]:
    """Precincts of each resolution beneath a region."""
    chosen = []
    for resolution, (across, down) in enumerate(stream.precincts):
        side = stream.side(resolution)
        slack = margin << (len(stream.precincts) - 1 - resolution)
        left, right = (region.left - slack) // side, (region.left + region.width - 1 + slack) // side
        top, bottom = (region.top - slack) // side, (region.top + region.height - 1 + slack) // side
        columns, rows = range(max(left, 0), min(right, across - 1) + 1), range(max(top, 0), min(bottom, down - 1) + 1)
        chosen.append([row * across + column for row in rows for column in columns])
    return chosen


def packets_of(stream: CodeStream, bins: list[list[int]], layers: int) -> NDArray[np.bool_]:
    """Which packets carry the first layers of some precincts."""
    wanted = np.zeros(stream.grid, np.bool_)
    for resolution, precincts in enumerate(bins):
        for component in range(stream.components):
            start = stream.number(0, resolution, component, 0)
            wanted[:layers, [start + precinct for precinct in precincts]] = True
    return wanted


def first_view(stream: CodeStream, layers: int, free: Free) -> NDArray[np.bool_]:
    """The packets a client has before any click."""
    wanted = np.zeros(stream.grid, np.bool_)
    left = free.size_bytes
    for resolution, (across, down) in enumerate(stream.precincts[: free.resolutions]):
        start = stream.number(0, resolution, 0, 0)
        run = slice(start, start + across * down * stream.components)
        for layer in range(layers):
            left -= int(stream.sizes[layer, run].sum())
            if left < 0:
                return wanted
            wanted[layer, run] = True
    return wanted


def message_bytes(stream: CodeStream, wanted: NDArray[np.bool_], held: NDArray[np.bool_]) -> int:
    """JPP stream messages for the packets that are wanted and not held, a message for each precinct."""
    new = wanted & ~held
    # What says nothing is not sent where nothing follows it.
    speaks = np.logical_or.accumulate((new & (stream.sizes > len(EMPTY)))[::-1], axis=0)[::-1]
    lengths = (stream.sizes * (new & speaks)).sum(axis=0)
    offsets = (stream.sizes * held).sum(axis=0)
    sent = np.flatnonzero(lengths)
    headers = sum(
        _header_bytes(*each) for each in zip(sent.tolist(), offsets[sent].tolist(), lengths[sent].tolist(), strict=True)
    )
    return int(lengths.sum()) + headers


def _header_bytes(bin_id: int, offset: int, length: int) -> int:
    """Message header without class and code stream: the id has 4 bits in its first byte, 7 in each further one."""
    id_bytes = 1 if bin_id < 16 else 1 + _sevens(bin_id >> 4)
    return id_bytes + _sevens(offset) + _sevens(length)


def _sevens(number: int) -> int:
    return max(-(-number.bit_length() // 7), 1)
