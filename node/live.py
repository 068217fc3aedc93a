"""A sweep while it runs, for whoever watches: a thinned picture that the capture thread fills and streams copy from.

The picture has the coarse shapes of the scan to be, so a viewer draws both with the same mesh. Each of its columns is
one column of the scanner, taken as it is at the rows' centres: the first to come that stands within one column of the
cell's centre. No viewer makes the capture thread wait, and a slow or late one costs nothing: columns carry the number
of their last change, and a stream remembers up to which number it has sent.
"""

from __future__ import annotations

import math
import threading
import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from drivers.scanner import SweepEvent, SweepInterrupted, SweepProgress, SweepStarted
from node.coarse import (
    BYTES_PER_RANGE_CELL,
    BYTES_PER_TEXEL,
    FIRST_VIEW_BYTES,
    RANGE_SPACING_MIN,
    TEXTURE_SPACING_MIN,
    coarse_shape,
)
from node.resampling import Encoder
from protocol import messages as m
from protocol.grid import GridSpec, ImageArray, IntArray, StepArray
from protocol.lattice import Channel
from protocol.live import LiveColumns
from protocol.scanner_messages import Column, RangeColumn, SweepHeader, TextureColumn

TELL_S = 0.1
COLUMNS_BYTES_MAX = 16384  # of one message: a click waits for no more than this

LiveSaid = m.LiveStarted | m.LiveProgress | m.LiveEnded | LiveColumns


class Live:
    """The running sweep's picture, and what each stream still lacks of it. Safe to use from several threads.

    tell : called in the capture thread, at most every TELL_S while columns come, when there is something new to send.
    """

    def __init__(
        self,
        tell: Callable[[], object],
        first_view_bytes: int = FIRST_VIEW_BYTES,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._tell = tell
        self._first_view_bytes = first_view_bytes
        self._clock = clock
        self._lock = threading.Lock()
        self._picture: _Picture | None = None
        self._sweeps = 0
        self._told_s = -math.inf

    # -- in the capture thread -------------------------------------------------------------------------------------

    def watch(self, event: SweepEvent) -> None:
        """Take in what happens in a sweep. Exactly one end, this or `published`, follows each start."""
        match event:
            case SweepStarted(header):
                self._start(header)
            case RangeColumn() | TextureColumn():
                self._take(event)
            case SweepProgress(share):
                self._progress(share)
            case SweepInterrupted(reason):
                self._end("interrupted", why=reason)

    def published(self, scan_id: str) -> None:
        """The sweep is a scan now."""
        self._progress(1.0)
        self._end("published", scan=scan_id)

    def _start(self, header: SweepHeader) -> None:
        self._sweeps += 1
        self._picture = _Picture(self._sweeps, header, self._first_view_bytes)
        self._tell_now()

    def _take(self, column: Column) -> None:
        picture = self._picture
        cell = picture.cell_of(column) if picture else None
        if picture is None or cell is None:
            return
        with self._lock:
            picture.take(cell, column)
        if self._clock() >= self._told_s + TELL_S:
            self._tell_now()

    def _progress(self, share: float) -> None:
        if self._picture is not None:
            self._picture.progress(share, self._clock())
            self._tell_now()

    def _end(self, reason: Literal["published", "interrupted"], scan: str = "", why: str = "") -> None:
        picture, self._picture = self._picture, None
        if picture is not None:
            picture.ended = m.LiveEnded(picture.sweep, reason, scan, why[: m.REASON_MAX])
            self._tell_now()

    def _tell_now(self) -> None:
        self._told_s = self._clock()
        self._tell()

    # -- for streams -----------------------------------------------------------------------------------------------

    def next(self, place: Place) -> list[LiveSaid]:
        """What to send next to a stream that is at `place`, which moves on; nothing: it has all there is."""
        with self._lock:
            if place.picture is None:
                place.picture = self._picture
                return [] if place.picture is None else [place.picture.started]
            return place.picture.next(place)


@dataclass(slots=True, eq=False)
class Place:
    """How far a stream has followed. sent : number of the last change sent, for each channel."""

    picture: _Picture | None = None
    sent: dict[Channel, int] = field(default_factory=lambda: dict.fromkeys(Channel, 0))
    progress: m.LiveProgress | None = None

    def leave(self) -> None:
        """Be nowhere: what runs next, or runs now, is followed from its beginning."""
        self.picture, self.sent, self.progress = None, dict.fromkeys(Channel, 0), None


class _Picture:
    """One sweep, thinned. `_progress` and `ended` are replaced whole, so setting them needs no lock."""

    def __init__(self, sweep: int, header: SweepHeader, first_view_bytes: int) -> None:
        s, self.sweep = header.spec, sweep
        self._began: tuple[float, float] | None = None
        cells_max, texels_max = first_view_bytes // BYTES_PER_RANGE_CELL, first_view_bytes // BYTES_PER_TEXEL
        cells = coarse_shape(s.height, s.width, RANGE_SPACING_MIN, cells_max)
        texels = coarse_shape(s.texture_height, s.texture_width, TEXTURE_SPACING_MIN, texels_max)
        thinned_range, thinned_texture = np.zeros(cells[::-1], np.uint16), np.zeros((*texels[::-1], 3), np.uint8)
        encoder = Encoder(header.counts_per_turn, header.encoder_start, header.direction)
        self._tracks = {
            Channel.RANGE: _Track(encoder, s.width, s.height, thinned_range),
            Channel.TEXTURE: _Track(encoder, s.texture_width, s.texture_height, thinned_texture),
        }
        self._track_of = {RangeColumn: self._tracks[Channel.RANGE], TextureColumn: self._tracks[Channel.TEXTURE]}
        self.started = m.LiveStarted(sweep, _grid(s, cells, texels))
        self._progress = m.LiveProgress(sweep, 0.0)
        self.ended: m.LiveEnded | None = None

    def cell_of(self, column: Column) -> int | None:
        """The cell that a column shows, or None where the picture has no use for it."""
        return self._track_of[type(column)].cell_of(column)

    def take(self, cell: int, column: Column) -> None:
        """Show a column, or a piece of one."""
        self._track_of[type(column)].take(cell, column)

    def progress(self, share: float, now_s: float) -> None:
        """So much of the sweep is in. How fast the rest comes is judged since then: some may have been kept before."""
        self._began = self._began or (share, now_s)
        share_0, began_s = self._began
        left_s = round((1 - share) * (now_s - began_s) / (share - share_0), 1) if share > share_0 else None
        percent = math.floor(1000 * share) / 10  # never more than is there
        self._progress = m.LiveProgress(self.sweep, percent, left_s)

    def next(self, place: Place) -> list[LiveSaid]:
        """As Live.next: what is new in each channel, then how far the sweep is; once there is nothing, the end."""
        said: list[LiveSaid] = []
        for channel, track in self._tracks.items():
            columns, place.sent[channel] = track.changed_since(place.sent[channel])
            if columns.size:
                said.append(LiveColumns(channel, self.sweep, *track.packed(columns)))
        if place.progress is not self._progress:
            place.progress = self._progress
            said.append(self._progress)
        if not said and self.ended is not None:
            place.leave()
            said.append(self.ended)
        return said


class _Track:
    """One channel of a picture. thinned : (columns, rows) or (columns, rows, 3), as it travels."""

    def __init__(self, encoder: Encoder, width: int, height: int, thinned: StepArray | ImageArray) -> None:
        self._encoder = encoder
        self._width = width
        self._thinned = thinned
        self._cells, rows = thinned.shape[:2]
        self._rows = (2 * np.arange(rows) + 1) * height // (2 * rows)
        self._sorted: list[int] = self._rows.tolist()  # a list is searched in no time, and several thousand times
        self._shown: dict[int, tuple[int, int]] = {}
        self._change = np.zeros(self._cells, np.int64)
        self._changes = 0

    def cell_of(self, column: Column) -> int | None:
        counts = self._encoder.counts_per_turn
        along = self._encoder.tick(column.encoder) % counts * self._cells  # in cells, of `counts` parts each
        cell = along // counts
        off_centre = abs(2 * (along - cell * counts) - counts)
        if off_centre * self._width > 2 * counts * self._cells:  # more than one column of the scanner
            return None
        name = (column.pass_index, column.column)
        return cell if self._shown.get(cell, name) == name else None

    def take(self, cell: int, column: Column) -> None:
        first, last = (bisect_left(self._sorted, row) for row in (column.row0, column.row0 + column.rows))
        self._shown[cell] = (column.pass_index, column.column)
        self._thinned[cell, first:last] = column.samples[self._rows[first:last] - column.row0]
        self._changes += 1
        self._change[cell] = self._changes

    def changed_since(self, sent: int) -> tuple[IntArray, int]:
        """Columns changed after `sent`, oldest first, as many as fit a message; and the last change among them."""
        columns = np.flatnonzero(self._change > sent)
        columns = columns[np.argsort(self._change[columns])][: max(1, COLUMNS_BYTES_MAX // self._thinned[0].nbytes)]
        return columns, int(self._change[columns[-1]]) if columns.size else sent

    def packed(self, columns: IntArray) -> tuple[tuple[int, ...], int, bytes]:
        """Columns as LiveColumns has them: their numbers, rows and samples."""
        picked = self._thinned[columns]
        return tuple(columns.tolist()), picked.shape[1], picked.astype(picked.dtype.newbyteorder("<")).tobytes()


def _grid(spec: GridSpec, cells: tuple[int, int], texels: tuple[int, int]) -> m.ScanInfo:
    """The scan to be: geometry of the sweep, and the (rows, columns) it is thinned to."""
    return m.ScanInfo(
        "", spec.width, spec.height, spec.texture_width, spec.texture_height, cells[1], cells[0], texels[1], texels[0],
        spec.step_mm, spec.pitch_mm, spec.z_max_mm, spec.theta0_rad,
    )  # fmt: skip
