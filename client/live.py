"""A sweep while it runs, as the node shows it: a coarse picture that fills up, how far it is, how it ended."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from protocol import messages as m
from protocol.errors import RemoteWireError
from protocol.grid import BoolArray, ImageArray, StepArray
from protocol.lattice import Channel
from protocol.live import LiveColumns


@dataclass(frozen=True, slots=True, eq=False)
class LiveFrame:
    """A running sweep at one moment. Arrays are copies, in the coarse shapes of the scan to be.

    percent : 0..100, of the sweep that is in.      seconds_left : None while nobody can tell.
    range_steps : (h, w) uint16, 0 = void or not in yet.    range_seen : (w,) columns that are in.
    texture : (ht, wt, 3) uint8 RGB.                        texture_seen : (wt,) columns that are in.
    grid : geometry of the scan to be.
    ended : "" while the sweep runs; then "published", with the id of the scan, or "interrupted", with why.
    """

    sweep: int
    percent: float
    seconds_left: float | None
    range_steps: StepArray
    range_seen: BoolArray
    texture: ImageArray
    texture_seen: BoolArray
    grid: m.ScanInfo
    ended: Literal["", "published", "interrupted"]
    scan: str
    why: str


class Picture:
    """One sweep as it was told so far. Raises RemoteWireError when that makes no sense."""

    def __init__(self, started: m.LiveStarted) -> None:
        self.sweep = started.sweep
        self._grid = started.grid
        shapes = {channel: (s.coarse_width, s.coarse_height) for channel, s in started.grid.shapes().items()}
        self._range: StepArray = np.zeros(shapes[Channel.RANGE], np.uint16)
        self._texture: ImageArray = np.zeros((*shapes[Channel.TEXTURE], 3), np.uint8)
        self._seen = {channel: np.zeros(shape[0], np.bool_) for channel, shape in shapes.items()}
        self._progress = m.LiveProgress(started.sweep, 0.0)
        self.ended: m.LiveEnded | None = None
        self.changes = 0

    def take(self, said: LiveColumns | m.LiveProgress | m.LiveEnded) -> None:
        """Whatever is said of this sweep."""
        if said.sweep != self.sweep:
            raise RemoteWireError(f"live news of sweep {said.sweep} while {self.sweep} is shown")
        self.changes += 1
        match said:
            case LiveColumns():
                self._take_columns(said)
            case m.LiveProgress():
                self._progress = said
            case m.LiveEnded():
                self.ended = said

    def frame(self) -> LiveFrame:
        """The sweep as it stands."""
        ended = self.ended or m.LiveEnded(self.sweep, "interrupted")
        return LiveFrame(
            self.sweep, self._progress.percent, self._progress.seconds_left,
            self._range.T.copy(), self._seen[Channel.RANGE].copy(),
            self._texture.swapaxes(0, 1).copy(), self._seen[Channel.TEXTURE].copy(),
            self._grid, ended.reason if self.ended else "", ended.scan, ended.why,
        )  # fmt: skip

    def _take_columns(self, said: LiveColumns) -> None:
        thinned, columns = self._range if said.channel is Channel.RANGE else self._texture, list(said.columns)
        if said.rows != thinned.shape[1] or max(columns) >= thinned.shape[0]:
            raise RemoteWireError(f"live columns of {said.rows} samples, up to {max(columns)}, in {thinned.shape[:2]}")
        thinned[columns] = said.samples
        self._seen[said.channel][columns] = True


class LiveFeed:
    """What a session hears of running sweeps, and those who wait for it. `watchers` : how many do."""

    def __init__(self) -> None:
        self.watchers = 0
        self._picture: Picture | None = None
        self._changed = asyncio.Event()
        self._ended: tuple[Exception | None] | None = None

    def take(self, said: m.LiveStarted | LiveColumns | m.LiveProgress | m.LiveEnded) -> None:
        """The next live message. Raises RemoteWireError when it makes no sense."""
        if isinstance(said, m.LiveStarted):
            self._picture = Picture(said)
        elif self._picture is not None:  # else it was on its way when the last watcher left
            self._picture.take(said)
        self._tell()

    def forget(self) -> None:
        """Nobody watches any more."""
        self._picture = None

    def end(self, cause: Exception | None) -> None:
        """Nothing more will come; cause None: the session was closed on purpose."""
        self._ended = (cause,)
        self._tell()

    async def frames(self) -> AsyncIterator[LiveFrame]:
        """Frames of the sweep that runs, else of the next, as they change, up to its end. Raises what ends the feed."""
        over = self._picture if self._picture and self._picture.ended else None
        picture, shown = None, -1
        while True:
            if self._picture not in (picture, over) and not (picture and picture.ended):
                picture, shown = self._picture, -1
            if picture is not None and picture.changes > shown:
                shown, frame = picture.changes, picture.frame()
                yield frame
                if frame.ended:
                    return
            elif await self._wait():
                return

    async def _wait(self) -> bool:
        """Wait for news; True when the session was closed."""
        changed = self._changed
        if self._ended is None:
            await changed.wait()
            return False
        if self._ended[0] is not None:
            raise self._ended[0]
        return True

    def _tell(self) -> None:
        self._changed.set()
        self._changed = asyncio.Event()
