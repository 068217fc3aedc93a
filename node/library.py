"""The scans of a node, each a folder on disk that appears whole or not at all and never changes its samples.

Scans are ordered by `sequence`, which only grows: a clock that was wrong once reorders nothing. Whatever else lies in
the library's folder is reported and left alone. Listing reads the small files only; samples are mapped when a scan is
opened, and what is derived from them (first view, filled range, pyramid) is rebuilt then: nothing derived can disagree
with its scan. node.scan_folder, node.sidecar, node.journal and node.library_folder say what lies where.
"""

from __future__ import annotations

import math
import os
import secrets
import shutil
import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from msgspec import structs

from node import archive
from node.axes import Axes
from node.coarse import FIRST_VIEW_BYTES, Coarse, build_coarse, build_pyramid, fill_voids
from node.durable import disk_error, sync_folder
from node.journal import Journals
from node.library_folder import OWN, SWEEPS, TRASH, UNFINISHED, check_format, take, tidy
from node.scan_folder import (
    FORMAT,
    About,
    Problem,
    Record,
    content_id,
    read_grid,
    read_record,
    read_sound_grid,
    write_record,
    write_scan,
)
from node.sealed import has_died
from node.sidecar import FILE as SIDECAR_FILE
from node.sidecar import Changes, Sidecar, change_sidecar, read_sidecar
from protocol.errors import LibraryError
from protocol.grid import GEOMETRIES, Geometry, Grid, GridSpec, ImageArray, RepairArray, StepArray

__all__ = ["About", "Library", "Problem", "Scan", "ScanSummary", "content_id", "survey", "verify"]

OPEN_MAX = 4
LATEST = "latest"  # stands for the id of the newest scan
PREFIX_MIN = 6  # as few digits of an id stand for it


@dataclass(frozen=True, slots=True)
class ScanSummary:
    """A scan as a list shows it; its name is the one it was given last, and so are subject and body site."""

    id: str
    sequence: int
    spec: GridSpec
    about: About
    subject: str = ""
    body_site: str = ""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Scan:
    """A published scan: immutable, every array read-only, its samples mapped from disk.

    range_steps : (H, W) uint16, 0 = void.  filled : the same with voids taken from the nearest measured sample.
    texture : (Ht, Wt, 3) uint8 RGB.        pyramid : the texture at spacings 1, 2, 4, ... up to the first view's.
    repairs : (n, 3) int32, as Grid.repairs.
    """

    id: str
    spec: GridSpec
    about: About
    range_steps: StepArray
    texture: ImageArray
    coarse: Coarse
    filled: StepArray
    pyramid: tuple[ImageArray, ...]
    repairs: RepairArray

    def __repr__(self) -> str:
        return f"Scan({self.id})"  # nobody wants to read its samples

    @property
    def grid(self) -> Grid:
        """Its samples, without what is derived from them."""
        return Grid(self.spec, self.range_steps, self.texture, self.repairs)


@dataclass(frozen=True, slots=True, eq=False)
class _Derived:
    """What is computed from a grid once, before anybody sees it; `smaller` is the pyramid without its first level."""

    coarse: Coarse
    filled: StepArray
    smaller: tuple[ImageArray, ...]


class Library:
    """The scans in one folder, which is made if it is missing. Safe to use from several threads of one process.

    first_view_bytes : how large the first views may be.  open_max : opened scans kept ready, at least 1.
    sweeps : the journals kept here.  axes : those of the scanners.  found : what the start made good after a crash.
    Raises LibraryError when the folder cannot be used: another process has it, or a newer version wrote it.
    """

    def __init__(self, folder: Path, first_view_bytes: int = FIRST_VIEW_BYTES, open_max: int = OPEN_MAX) -> None:
        self.folder = folder
        self._first_view_bytes = first_view_bytes
        self._open_max = open_max
        self._work = threading.Lock()  # held while something is written or prepared
        self._lock = threading.Lock()  # held for a moment, to look up or exchange what follows
        self._opened: OrderedDict[str, Scan] = OrderedDict()
        self._held = take(folder)
        try:
            self.found = tidy(folder)
            self.sweeps = Journals(folder / SWEEPS)
            self.axes = Axes(folder)
            self._known, problems = survey(folder)
        except OSError as error:
            raise disk_error(f"the library {folder} cannot be used", error) from error
        self.found += self.sweeps.found
        self._problems = (*problems, *self.sweeps.problems)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What lies in the folder and is no sound scan."""
        return self._problems

    def close(self) -> None:
        """Let another process have the folder. Scans that are open stay readable."""
        self._held.release()

    def scans(self) -> list[ScanSummary]:
        """Every scan, newest first."""
        return sorted(self._known.values(), key=lambda summary: (summary.sequence, summary.id), reverse=True)

    def summary(self, scan_id: str) -> ScanSummary:
        """A scan as the list shows it. Raises LibraryError when unknown."""
        summary = self._known.get(scan_id)
        if summary is None:
            short = f" ({PREFIX_MIN} digits of an id at least)" if len(scan_id) < PREFIX_MIN else ""
            raise LibraryError(f"no scan {scan_id[:40]!r} in this library{short}")
        return summary

    def resolve(self, scan_id: str, geometries: Sequence[Geometry] = GEOMETRIES) -> str:
        """The id that "latest" stands for, or the beginning of just one id; any other is returned as it is.

        geometries : those that "latest" may have.  Raises LibraryError when there is no scan, or several begin so.
        """
        if scan_id == LATEST:
            found = next((scan for scan in self.scans() if scan.spec.geometry in geometries), None)
            if found is None:
                raise LibraryError("there is no scan yet: start a sweep")
            return found.id
        if scan_id in self._known or len(scan_id) < PREFIX_MIN:
            return scan_id
        begin_so = [known for known in self._known if known.startswith(scan_id)]
        if len(begin_so) > 1:
            raise LibraryError(f"{len(begin_so)} scans begin with {scan_id!r}: give more of the id")
        return begin_so[0] if begin_so else scan_id

    def open(self, scan_id: str) -> Scan:
        """A scan with its samples mapped and checked against its id. Raises LibraryError when unknown or damaged."""
        scan = self._ready(scan_id)
        if scan is not None:
            return scan
        with self._work:
            return self._ready(scan_id) or self._open(scan_id)

    def add(self, grid: Grid, about: About) -> Scan:
        """Keep a grid, safe on disk before this returns. The same content again is the same scan, now the newest; where
        it comes as a file, what is known of it stays: when it was made, its sweep, the scans it was made of.

        What clients need is derived while the disk is busy. Raises LibraryError when it cannot be written; then
        nothing of it is left.
        """
        with self._work, ThreadPoolExecutor(1, "derive") as beside:
            derived = beside.submit(_derive, grid, self._first_view_bytes)
            summary = self._write(grid, about)
            scan = self._ready(summary.id)
            if scan is None:
                kept = read_grid(self.folder / summary.id, grid.spec)
                scan = _scan(summary, kept, derived.result())
            return self._keep(replace(scan, about=summary.about))

    def delete(self, scan_id: str) -> None:
        """Delete a scan and what was said of it. Whoever has it open keeps it. Raises LibraryError."""
        with self._work:
            self.summary(scan_id)
            trash = self.folder / f"{TRASH}{scan_id}-{secrets.token_hex(4)}"
            try:
                os.rename(self.folder / scan_id, trash)
                sync_folder(self.folder)
                self._forget(scan_id)
                shutil.rmtree(trash)
            except OSError as error:
                raise disk_error(f"cannot delete scan {scan_id}", error) from error

    def sidecar(self, scan_id: str) -> Sidecar:
        """What is said of a scan. Until somebody renames it, its name is the one it came with.

        Raises LibraryError when the scan is unknown or that is damaged.
        """
        return _called(read_sidecar(self.folder / scan_id), self.summary(scan_id))

    def annotate(self, scan_id: str, changes: Changes, by: str, revision: int | None = None) -> Sidecar:
        """Change what is said of a scan, durable before this returns. by : who does it.

        revision : the one the changes are meant for, or None.  Raises ValueError, Conflict, LibraryError.
        """
        with self._work:
            summary = self.summary(scan_id)
            sidecar = change_sidecar(self.folder / scan_id, changes, by, time.time(), revision)
            self._know(_named(summary, sidecar))
            return _called(sidecar, summary)

    def rename(self, scan_id: str, name: str, by: str) -> Sidecar:
        """Call a scan something else. Raises ValueError, LibraryError."""
        return self.annotate(scan_id, Changes(name=name), by)

    def verify(self) -> Iterator[tuple[str, Problem | None]]:
        """Check every sample of every scan: yields (id, what is wrong or None)."""
        return verify(self.folder, [summary.id for summary in self.scans()])

    def restore(self, path: Path) -> archive.Restored:
        """Take in the scans of a backup: all of them, or none. Those that are here already keep what they have.

        Raises LibraryError for whatever is not a sound backup, OSError when it cannot be opened.
        """
        with self._work:
            restored = archive.restore(path, self.folder)
            known, problems = survey(self.folder)
            with self._lock:
                self._known, self._problems = known, (*problems, *self.sweeps.problems)
            return restored

    def _write(self, grid: Grid, about: About) -> ScanSummary:
        scan_id = content_id(grid)
        sequence = 1 + max((summary.sequence for summary in self._known.values()), default=0)
        if scan_id in self._known:
            about = _come_again(self._known[scan_id].about, about)
        record = Record(FORMAT, scan_id, sequence, grid.spec, about, len(grid.repairs))
        try:
            if scan_id in self._known:
                write_record(self.folder / scan_id, record)
            else:
                write_scan(self.folder, record, grid)
        except OSError as error:
            raise disk_error(f"cannot keep scan {scan_id}", error) from error
        return self._know(_summary(self.folder / scan_id, record)[0])

    def _know(self, summary: ScanSummary) -> ScanSummary:
        with self._lock:
            self._known = {**self._known, summary.id: summary}
        return summary

    def _forget(self, scan_id: str) -> None:
        with self._lock:
            self._known = {key: summary for key, summary in self._known.items() if key != scan_id}
            self._opened.pop(scan_id, None)

    def _ready(self, scan_id: str) -> Scan | None:
        """An opened scan, marked as used last."""
        with self._lock:
            if scan_id in self._opened:
                self._opened.move_to_end(scan_id)
            return self._opened.get(scan_id)

    def _open(self, scan_id: str) -> Scan:
        summary = self.summary(scan_id)
        try:
            grid = read_sound_grid(self.folder / scan_id, summary.spec)
        except LibraryError as error:
            if has_died(error):
                raise
            self._forget(scan_id)
            self._problems = (*self._problems, Problem(scan_id, str(error)))
            raise LibraryError(f"scan {scan_id} is damaged: {error}") from error
        return self._keep(_scan(summary, grid, _derive(grid, self._first_view_bytes)))

    def _keep(self, scan: Scan) -> Scan:
        """Have this scan ready, and let go of the one used longest ago when there are too many."""
        with self._lock:
            self._opened[scan.id] = scan
            self._opened.move_to_end(scan.id)
            if len(self._opened) > self._open_max:
                self._opened.popitem(last=False)
        return scan


def survey(folder: Path) -> tuple[dict[str, ScanSummary], tuple[Problem, ...]]:
    """What a library holds, by its small files alone; needs no lock. Raises LibraryError."""
    check_format(folder)
    known: dict[str, ScanSummary] = {}
    problems: list[Problem] = []
    try:
        names = sorted(set(os.listdir(folder)) - OWN)
    except OSError as error:
        raise disk_error(f"the library {folder} cannot be used", error) from error
    for name in names:
        if name.startswith(UNFINISHED):
            problems.append(Problem(name, "unfinished: written or deleted at this moment, or not by this program"))
            continue
        try:
            known[name], trouble = _summary(folder / name, read_record(folder / name))
            problems += trouble
        except LibraryError as error:
            problems.append(Problem(name, str(error)))
    return known, tuple(problems)


def verify(folder: Path, scan_ids: list[str]) -> Iterator[tuple[str, Problem | None]]:
    """Check every sample of some scans, and what is said of them; needs no lock. Yields (id, what is wrong or None).

    Raises LibraryError when they cannot be looked at, since what had opened a sealed library has died.
    """
    for scan_id in scan_ids:
        try:
            read_sound_grid(folder / scan_id, read_record(folder / scan_id).spec)
            read_sidecar(folder / scan_id)
            yield scan_id, None
        except LibraryError as error:
            if has_died(error):
                raise
            yield scan_id, Problem(scan_id, str(error))


def _summary(folder: Path, record: Record) -> tuple[ScanSummary, list[Problem]]:
    """A scan for the list, under the name it was given last, and what is wrong with the sidecar that would tell."""
    summary = ScanSummary(record.id, record.sequence, record.spec, record.about)
    try:
        return _named(summary, read_sidecar(folder)), []
    except LibraryError as error:
        return summary, [Problem(f"{record.id}/{SIDECAR_FILE}", str(error))]


def _named(summary: ScanSummary, sidecar: Sidecar) -> ScanSummary:
    about = summary.about if sidecar.name is None else replace(summary.about, name=sidecar.name)
    return replace(summary, about=about, subject=sidecar.subject, body_site=sidecar.body_site)


def _called(sidecar: Sidecar, summary: ScanSummary) -> Sidecar:
    """A form that shows no name where there is one would save none."""
    return sidecar if sidecar.name is not None else structs.replace(sidecar, name=summary.about.name)


def _derive(grid: Grid, first_view_bytes: int) -> _Derived:
    coarse = build_coarse(grid, first_view_bytes)
    smaller = build_pyramid(grid.texture, math.floor(min(coarse.texture_spacing)))[1:]
    return _Derived(coarse, fill_voids(grid.range_steps), smaller)


def _scan(summary: ScanSummary, grid: Grid, derived: _Derived) -> Scan:
    """grid : mapped from disk."""
    pyramid = (grid.texture, *derived.smaller)
    return Scan(
        summary.id, grid.spec, summary.about, grid.range_steps, grid.texture, derived.coarse, derived.filled, pyramid,
        grid.repairs,
    )  # fmt: skip


def _come_again(known: About, about: About) -> About:
    """What is to be said of a scan that comes a second time: a file knows less of where it came from than we do."""
    if about.source != "import":
        return about
    return replace(known, name=about.name or known.name, note=about.note or known.note)
