"""Which pieces of a sweep have arrived, which are missing, and whether the whole is what the scanner sent."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from protocol.grid import BoolArray, IntArray
from protocol.scanner_messages import RUNS_MAX, Channel, Column, ColumnRun, SweepHeader

_MARGIN = 2  # a column this far behind the newest one of its channel is not merely late


class _Track:
    """The columns of one channel and pass: `held` (W * pieces) bytes of 0 or 1, column after column."""

    def __init__(self, columns: int, rows: int, piece_rows: int) -> None:
        self.columns, self.rows, self.piece_rows = columns, rows, piece_rows
        self.pieces = -(-rows // piece_rows)
        self.held = bytearray(columns * self.pieces)
        self.newest = -1
        self.asked = np.zeros(columns, np.bool_)
        self.gone = np.zeros(columns, np.bool_)

    def piece_of(self, column: Column) -> int | None:
        """Index into `held`, or None where such a piece does not exist in this sweep."""
        row0 = column.row0
        piece, beside = divmod(row0, self.piece_rows)
        if beside or column.column >= self.columns or column.rows != min(self.piece_rows, self.rows - row0):
            return None
        return column.column * self.pieces + piece

    def missing(self) -> BoolArray:
        """(W,) columns with at least one piece missing."""
        held = np.frombuffer(self.held, np.uint8).reshape(self.columns, self.pieces)
        lacking: BoolArray = held.min(axis=1) == 0
        return lacking


class Ledger:
    """Keeps account of one sweep's column messages."""

    def __init__(self, header: SweepHeader) -> None:
        self._sweep = header.sweep
        self._tracks = {
            (channel, pass_index): _Track(columns, *header.shape(channel)[1:])
            for channel in (Channel.RANGE, Channel.TEXTURE)
            for pass_index, columns in enumerate(header.columns_in(channel))
        }
        self.expected = sum(len(track.held) for track in self._tracks.values())
        self.held = 0
        self.duplicates = 0
        self.strays = 0
        self.digest = 0

    def take(self, column: Column) -> bool:
        """Whether this piece belongs to the sweep and is new; counts it either way."""
        track = self._tracks.get((column.CHANNEL, column.pass_index))
        piece = track.piece_of(column) if track is not None and column.sweep == self._sweep else None
        if track is None or piece is None:
            self.strays += 1
            return False
        if track.held[piece]:
            self.duplicates += 1
            return False
        track.held[piece] = 1
        if column.column > track.newest:
            track.newest = column.column
        self.held += 1
        self.digest = (self.digest + column.checksum) % 2**32
        return True

    def missing(self) -> tuple[ColumnRun, ...]:
        """The first columns still missing that the scanner may still hold, as many as one request carries."""
        return self._runs(lambda track: track.missing() & ~track.gone)

    def first(self) -> tuple[ColumnRun, ...]:
        """The first column of the sweep, for a request that shall bring nothing but the scanner's count."""
        channel, pass_index = next(iter(self._tracks))
        return (ColumnRun(channel, pass_index, 0, 1),)

    def left_behind(self) -> tuple[ColumnRun, ...]:
        """Columns the table has passed, that are missing and were not asked for in this way before."""
        runs = self._runs(lambda track: _behind(track) & track.missing() & ~track.gone & ~track.asked)
        for run in runs:
            self._tracks[run.channel, run.pass_index].asked[run.first : run.first + run.count] = True
        return runs

    def give_up(self, runs: tuple[ColumnRun, ...]) -> None:
        """The scanner holds these columns no longer."""
        for run in runs:
            track = self._tracks.get((run.channel, run.pass_index))
            if track is not None:
                track.gone[run.first : run.first + run.count] = True

    def lost_columns(self) -> int:
        """Missing columns that can come no more."""
        return sum(int((track.missing() & track.gone).sum()) for track in self._tracks.values())

    def _runs(self, choose: Callable[[_Track], BoolArray]) -> tuple[ColumnRun, ...]:
        """Runs of the chosen columns of every channel and pass, at most RUNS_MAX of them."""
        runs: list[ColumnRun] = []
        for (channel, pass_index), track in self._tracks.items():
            room = RUNS_MAX - len(runs)
            runs += (ColumnRun(channel, pass_index, a, b - a) for a, b in _spans(choose(track))[:room])
        return tuple(runs)


def _behind(track: _Track) -> BoolArray:
    """(W,) columns the newest one has left well behind."""
    return np.arange(track.columns) < track.newest - _MARGIN


def _spans(mask: BoolArray) -> list[tuple[int, int]]:
    """First and one-past-last index of every run of True in mask (n,)."""
    edges: IntArray = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
