"""Rivals that keep what they were sent: a tile client and a JPIP client over a session of clicks.

A tile client keeps one level and tile size for the session, the best in hindsight. At each click it asks for the tiles
it misses, at the poorest quality that makes the window good together with those it has; where no quality of the missing
ones does, for all of the window's tiles anew. A JPIP client is sent only packets that it does not hold.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tests.bench.cache import Cache
from tests.bench.rivals import htj2k_texture, jpip, range_tiles
from tests.bench.rivals.codestream import CodeStream, Layout
from tests.bench.rivals.jpeg_texture import CHROMA, Q_MAX, Q_MIN, data_bytes, decode_stack, encode_stack, least
from tests.bench.rivals.offer import PIECE_BYTES, REPLY_BYTES, Unreachable, void_mask
from tests.bench.rivals.pyramid import Level, Rect, enlarged, promising, texture_level, tiles_over
from tests.bench.scans import BenchScan, Click
from tests.bench.target import Target, Window, crop

TILES = (32, 64, 128)
HTJ2K_MIN, HTJ2K_MAX = 16, 72
JPIP_CUTS = (jpip.CUTS[0], jpip.CUTS[2])

Images = list[np.ndarray]
Coder = Callable[[Images, int], tuple[Images, int]]  # tiles, setting (rising quality) -> decoded tiles, bytes
Windows = list[Window]
Shapes = tuple[tuple[int, ...], tuple[int, ...]]  # of the full image, of the level's


@dataclass(frozen=True)
class TileClient:
    """One way of keeping tiles.

    image : the level.  show : a window's samples from the level's.  reached : whether they are good.
    lowest, highest : the coder's settings.
    """

    image: np.ndarray
    tile: int
    coder: Coder
    show: Callable[[np.ndarray, Rect, Window], np.ndarray]
    reached: Callable[[Window, np.ndarray], bool]
    rect: Callable[[Window], Rect]
    lowest: int
    highest: int

    def session(self, windows: Windows) -> list[int] | None:
        """Bytes of each click; None where a window cannot be made good."""
        canvas, held = np.zeros_like(self.image), set[tuple[int, int]]()
        sizes = []
        for window in windows:
            size = self._click(window, canvas, held)
            if size is None:
                return None
            sizes.append(size)
        return sizes

    def _click(self, window: Window, canvas: np.ndarray, held: set[tuple[int, int]]) -> int | None:
        rect = self.rect(window)
        places = list(self._places(rect))
        missing = [place for place in places if place not in held]
        for asked in (missing, places):
            found = self._least(window, rect.of(canvas), asked)
            if found is not None:
                size, made = found
                rect.of(canvas)[:] = made
                held.update(asked)
                return size
        return None

    def _least(self, window: Window, had: np.ndarray, asked: list[tuple[int, int]]) -> tuple[int, np.ndarray] | None:
        """The poorest setting of the tiles asked for that makes the window good: bytes, and the tiles then held."""
        rect = self.rect(window)
        tiles = [self._at(rect.of(self.image), rect, place) for place in asked]
        tried: dict[int, tuple[int, np.ndarray]] = {}

        def good(setting: int) -> bool:
            made, size = had.copy(), 0
            if tiles:
                decoded, size = self.coder(tiles, setting)
                for place, tile in zip(asked, decoded, strict=True):
                    self._at(made, rect, place)[:] = tile
            tried[setting] = size, made
            return self.reached(window, self.show(made, rect, window))

        setting = least(good, self.lowest, self.highest)
        return None if setting is None else tried[setting]

    def _at(self, image: np.ndarray, rect: Rect, place: tuple[int, int]) -> np.ndarray:
        top, left = place[0] * self.tile - rect.top, place[1] * self.tile - rect.left
        return image[top : top + self.tile, left : left + self.tile]

    def _places(self, rect: Rect) -> Iterator[tuple[int, int]]:
        for top in range(rect.top, rect.bottom, self.tile):
            for left in range(rect.left, rect.right, self.tile):
                yield top // self.tile, left // self.tile


def texture_sessions(scan: BenchScan, windows: Windows, codec: str) -> list[int]:
    """Bytes of each click, texture as tiles, at the best level, tile size (and chroma) in hindsight."""
    coders = [partial(_jpeg, chroma) for chroma in CHROMA] if codec == "jpeg" else [_htj2k]
    bounds = (Q_MIN, Q_MAX) if codec == "jpeg" else (HTJ2K_MIN, HTJ2K_MAX)
    found = []
    for level in _levels_for_all(scan, windows):
        image = texture_level(scan, level.spacing, level.shrink)
        shapes = scan.grid.texture.shape, image.shape
        for tile in TILES:
            rect = partial(_texture_rect, shapes, tile)
            for coder in coders:
                show = partial(_show_texture, shapes, level.enlarge)
                client = TileClient(image, tile, coder, show, Window.texture_reached, rect, *bounds)
                found.append(client.session(windows))
    return _best(found)


def range_session(scan: BenchScan, windows: Windows) -> list[int]:
    """Bytes of each click, range as tiles with void masks, at the best level, tile size and codec in hindsight."""
    step_mm = scan.grid.spec.step_mm
    largest = 3 * windows[0].target.range_mm / step_mm
    quanta = sorted({max(int(largest / 1.05**k), 1) for k in range(200)}, reverse=True)
    found = []
    for level in (1, 2, 4, 8):
        image = range_tiles.range_level(scan, level, "point")
        for tile in TILES:
            rect = partial(_range_rect, scan.grid.range_steps.shape, image.shape, tile)
            for codec in ("HTJ2K", "JPEG XL"):
                coder = partial(_range_coder, codec, quanta)
                show = partial(_show_range, level)
                client = TileClient(image, tile, coder, show, Window.range_reached, rect, 0, len(quanta) - 1)
                found.append(client.session(windows))
    masks = [void_mask(window).size_bytes for window in windows]
    return [size + mask for size, mask in zip(_best(found), masks, strict=True)]


def jpip_session(scan: BenchScan, windows: Windows, cache: Cache, free: dict[str, jpip.Free]) -> list[int]:
    """Bytes of each click for a JPIP client, both channels, at the best cut and layering in hindsight."""
    textures = [
        _jpip_channel(jpip.texture_stream(scan, Layout(*cut, layers), cache), windows, "texture", free["texture"])
        for cut in JPIP_CUTS
        for layers in jpip.TEXTURE_DB
    ]
    ranges = [
        _jpip_channel(jpip.range_stream(scan, Layout(*cut, layers), cache), windows, "range", free["range"])
        for cut in JPIP_CUTS
        for layers in jpip.RANGE_DB
    ]
    masks = [void_mask(window).size_bytes for window in windows]
    return [sum(parts) for parts in zip(_best(textures), _best(ranges), masks, strict=True)]


def with_replies(*channels: list[int]) -> list[int]:
    """Bytes of each click, both channels in one reply."""
    return [REPLY_BYTES + sum(parts) for parts in zip(*channels, strict=True)]


def windows_of(scan: BenchScan, clicks: list[Click], target: Target) -> Windows:
    """The windows of a session."""
    return [Window.round(scan.grid, click, target) for click in clicks]


def _jpip_channel(stream: CodeStream, windows: Windows, channel: str, free: jpip.Free) -> list[int] | None:
    held = jpip.first_view(stream, -(-stream.layers // 2), free)  # about the quality that windows will need
    sizes = []
    for window in windows:
        bins = jpip.precincts_over(stream, window.texture if channel == "texture" else window.range, 0)

        def good(
            layers: int, had: NDArray[np.bool_] = held, bins: list[list[int]] = bins, window: Window = window
        ) -> bool:
            made = stream.decode(had | jpip.packets_of(stream, bins, layers))
            if channel == "texture":
                return window.texture_reached(crop(made, window.texture))
            return window.range_reached(np.maximum(crop(made, window.range), 1).astype(np.uint16))

        layers = least(good, 1, stream.layers)
        if layers is None:
            return None
        wanted = jpip.packets_of(stream, bins, layers)
        sizes.append(jpip.message_bytes(stream, wanted, held))
        held = held | wanted
    return sizes


def _levels_for_all(scan: BenchScan, windows: Windows) -> list[Level]:
    """Levels that can reach the target in every window."""
    sets = [{level.spacing: level for level in promising(scan, window, window.target.texture_db)} for window in windows]
    return [level for spacing, level in sets[0].items() if all(spacing in others for others in sets)]


def _best(found: list[list[int] | None]) -> list[int]:
    sessions = [sizes for sizes in found if sizes is not None]
    if not sessions:
        raise Unreachable("no setting reaches the target in every window of the session")
    return min(sessions, key=sum)


def _jpeg(chroma: str, tiles: Images, q: int) -> tuple[Images, int]:
    side = max(max(tile.shape[:2]) for tile in tiles)
    side = -(-side // 16) * 16
    padded = [np.pad(t, ((0, side - t.shape[0]), (0, side - t.shape[1]), (0, 0)), "edge") for t in tiles]
    files = encode_stack(np.stack(padded), chroma, q)
    decoded = decode_stack(files, side)
    return [made[: t.shape[0], : t.shape[1]] for made, t in zip(decoded, tiles, strict=True)], data_bytes(files)


def _htj2k(tiles: Images, quality: int) -> tuple[Images, int]:
    coded = [htj2k_texture.code(tile, quality) for tile in tiles]
    return [decoded for decoded, _ in coded], sum(size for _, size in coded)


def _range_coder(codec: str, quanta: list[int], tiles: Images, setting: int) -> tuple[Images, int]:
    quantum = quanta[setting]
    values = [np.ascontiguousarray(np.floor(tile / quantum + 0.5).astype(np.uint16)) for tile in tiles]
    size = sum(range_tiles.CODECS[codec](value) + PIECE_BYTES for value in values)
    return [(value * np.float32(quantum)).astype(np.float32) for value in values], size


def _texture_rect(shapes: Shapes, tile: int, window: Window) -> Rect:
    return tiles_over(window.texture, *shapes, tile)


def _range_rect(full: tuple[int, ...], level: tuple[int, ...], tile: int, window: Window) -> Rect:
    return tiles_over(window.range, full, level, tile)


def _show_texture(shapes: Shapes, kernel: str, received: np.ndarray, rect: Rect, window: Window) -> np.ndarray:
    return enlarged(received, rect, window.texture, shapes, kernel)


def _show_range(level: float, received: np.ndarray, rect: Rect, window: Window) -> np.ndarray:
    return range_tiles.shown(received, rect, window, level, "point", "linear")
