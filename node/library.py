"""The scans of a node, each a folder on disk that appears whole or not at all and never changes its samples.

    <library>/<scan id>/range.npy      (H, W) uint16 steps, little-endian, 0 = void
                        texture.npy    (Ht, Wt, 3) uint8 RGB
                        scan.json      format, id, sequence, geometry, where it came from

The id is the hash of geometry and samples, so it also tells whether a file has rotted. Scans are ordered by `sequence`,
which only grows: a clock that was wrong once reorders nothing. Whatever else lies in the folder is reported and left
alone. Listing reads the small files only; samples are mapped when a scan is opened, and what is derived from them
(first view, filled range, pyramid) is rebuilt then: nothing derived can disagree with its scan.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
import shutil
import tempfile
import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np

from node.coarse import FIRST_VIEW_BYTES, Coarse, build_coarse, build_pyramid, fill_voids
from protocol.errors import LibraryError
from protocol.grid import Grid, GridSpec, ImageArray, StepArray

FORMAT = 1
RECORD_BYTES_MAX = 65536
ARRAY_HEADER_BYTES_MAX = 4096
TEXT_MAX = 200
OPEN_MAX = 4
INCOMING = ".incoming-"
RANGE_FILE, TEXTURE_FILE, RECORD_FILE = "range.npy", "texture.npy", "scan.json"


@dataclass(frozen=True, slots=True)
class About:
    """Where a scan came from. Nothing of the patient: this is listed freely.

    created_unix_s : the node's clock, for people; it orders nothing.  source : "sweep", "import", ...
    name : what to call it, at most 200 characters.  Raises ValueError when out of bounds.
    """

    created_unix_s: float
    source: str = "sweep"
    name: str = ""

    def __post_init__(self) -> None:
        if not math.isfinite(self.created_unix_s):
            raise ValueError(f"created_unix_s must be finite, got {self.created_unix_s}")
        for text in (self.source, self.name):
            if len(text) > TEXT_MAX:
                raise ValueError(f"a text of {len(text)} characters, at most {TEXT_MAX} are kept")


@dataclass(frozen=True, slots=True)
class ScanSummary:
    """A scan as a list shows it."""

    id: str
    sequence: int
    spec: GridSpec
    about: About


@dataclass(frozen=True, slots=True)
class Problem:
    """Something in the library's folder that is no sound scan: its name there, and what is wrong."""

    name: str
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """A published scan: immutable, every array read-only, its samples mapped from disk.

    range_steps : (H, W) uint16, 0 = void.  filled : the same with voids taken from the nearest measured sample.
    texture : (Ht, Wt, 3) uint8 RGB.        pyramid : the texture at spacings 1, 2, 4, ... up to the first view's.
    """

    id: str
    spec: GridSpec
    about: About
    range_steps: StepArray
    texture: ImageArray
    coarse: Coarse
    filled: StepArray
    pyramid: tuple[ImageArray, ...]


class _Version(msgspec.Struct, frozen=True):
    """The one field of scan.json that every version has."""

    format: int


class _Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """scan.json."""

    format: int
    id: str
    sequence: int
    spec: GridSpec
    about: About


class Library:
    """The scans in one folder, which is made if it is missing. Safe to use from several threads of one process.

    first_view_bytes : how large the first views may be.  open_max : opened scans kept ready, at least 1.
    Raises LibraryError when the folder cannot be used.
    """

    def __init__(self, folder: Path, first_view_bytes: int = FIRST_VIEW_BYTES, open_max: int = OPEN_MAX) -> None:
        self._folder = folder
        self._first_view_bytes = first_view_bytes
        self._open_max = open_max
        self._work = threading.Lock()  # held while a scan is written or prepared
        self._lock = threading.Lock()  # held for a moment, to look up or exchange what follows
        self._opened: OrderedDict[str, Scan] = OrderedDict()
        self._known, self._problems = _survey(folder)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """What lies in the folder and is no sound scan."""
        return self._problems

    def scans(self) -> list[ScanSummary]:
        """Every scan, newest first."""
        return sorted(self._known.values(), key=lambda summary: (summary.sequence, summary.id), reverse=True)

    def open(self, scan_id: str) -> Scan:
        """A scan with its samples mapped and checked against its id. Raises LibraryError when unknown or damaged."""
        scan = self._ready(scan_id)
        if scan is not None:
            return scan
        with self._work:
            return self._ready(scan_id) or self._open(scan_id)

    def add(self, grid: Grid, about: About) -> Scan:
        """Keep a grid, safe on disk before this returns. The same content again is the same scan, now the newest.

        Raises LibraryError when it cannot be written; then nothing of it is left.
        """
        scan_id = content_id(grid)
        with self._work:
            sequence = 1 + max((summary.sequence for summary in self._known.values()), default=0)
            record = _Record(FORMAT, scan_id, sequence, grid.spec, about)
            try:
                if scan_id in self._known:
                    _write_record(self._folder / scan_id, record)
                else:
                    _write_scan(self._folder, record, grid)
            except OSError as error:
                raise LibraryError(f"cannot keep scan {scan_id}: {error.strerror}") from error
            with self._lock:
                self._known = {**self._known, scan_id: _summary(record)}
            scan = self._ready(scan_id)
            if scan is None:
                return self._open(scan_id)
            return self._keep(replace(scan, about=about))

    def _ready(self, scan_id: str) -> Scan | None:
        """An opened scan, marked as used last."""
        with self._lock:
            if scan_id in self._opened:
                self._opened.move_to_end(scan_id)
            return self._opened.get(scan_id)

    def _open(self, scan_id: str) -> Scan:
        summary = self._known.get(scan_id)
        if summary is None:
            raise LibraryError(f"no scan {scan_id[:40]!r} in this library")
        try:
            grid = _read_grid(self._folder / scan_id, summary.spec)
            if content_id(grid) != scan_id:
                raise LibraryError("its samples are not what they were when it was kept")
        except LibraryError as error:
            self._give_up(scan_id, str(error))
            raise LibraryError(f"scan {scan_id} is damaged: {error}") from error
        return self._keep(self._prepare(summary, grid))

    def _prepare(self, summary: ScanSummary, grid: Grid) -> Scan:
        coarse = build_coarse(grid, self._first_view_bytes)
        pyramid = build_pyramid(grid.texture, math.floor(min(coarse.texture_spacing)))
        filled = fill_voids(grid.range_steps)
        return Scan(summary.id, grid.spec, summary.about, grid.range_steps, grid.texture, coarse, filled, pyramid)

    def _keep(self, scan: Scan) -> Scan:
        """Have this scan ready, and let go of the one used longest ago when there are too many."""
        with self._lock:
            self._opened[scan.id] = scan
            self._opened.move_to_end(scan.id)
            if len(self._opened) > self._open_max:
                self._opened.popitem(last=False)
        return scan

    def _give_up(self, scan_id: str, reason: str) -> None:
        with self._lock:
            self._known = {key: summary for key, summary in self._known.items() if key != scan_id}
            self._problems = (*self._problems, Problem(scan_id, reason))


def content_id(grid: Grid) -> str:
    """Name of a grid: 32 hexadecimal digits, the first half of SHA-256 over its geometry and samples."""
    digest = hashlib.sha256(b"foveascan scan 1\n")
    digest.update(msgspec.json.encode(grid.spec))
    digest.update(np.ascontiguousarray(grid.range_steps, "<u2").data)
    digest.update(np.ascontiguousarray(grid.texture).data)
    return digest.hexdigest()[:32]


def _survey(folder: Path) -> tuple[dict[str, ScanSummary], tuple[Problem, ...]]:
    """What a folder holds, by its small files alone."""
    known: dict[str, ScanSummary] = {}
    problems: list[Problem] = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise LibraryError(f"the library {folder} cannot be used: {error.strerror}") from error
    for name in names:
        try:
            known[name] = _read_summary(folder / name)
        except LibraryError as error:
            problems.append(Problem(name, str(error)))
    return known, tuple(problems)


def _read_summary(folder: Path) -> ScanSummary:
    if folder.name.startswith(INCOMING):
        raise LibraryError("a scan that was never completely written; it can be deleted")
    if not re.fullmatch("[0-9a-f]{32}", folder.name) or not folder.is_dir():
        raise LibraryError("not a scan")
    record = _read_record(folder)
    if record.id != folder.name:
        raise LibraryError(f"its {RECORD_FILE} belongs to scan {record.id[:40]!r}")
    _check_sizes(folder, record.spec)
    return _summary(record)


def _read_record(folder: Path) -> _Record:
    try:
        with open(folder / RECORD_FILE, "rb") as file:
            data = file.read(RECORD_BYTES_MAX + 1)
        if len(data) > RECORD_BYTES_MAX:
            raise LibraryError(f"its {RECORD_FILE} is larger than {RECORD_BYTES_MAX} bytes")
        if msgspec.json.decode(data, type=_Version).format != FORMAT:
            raise LibraryError("written in a format that this version does not know")
        return msgspec.json.decode(data, type=_Record)
    except OSError as error:
        raise LibraryError(f"its {RECORD_FILE} cannot be read: {error.strerror}") from error
    except msgspec.DecodeError as error:
        raise LibraryError(f"its {RECORD_FILE} is damaged: {error}") from error


def _check_sizes(folder: Path, spec: GridSpec) -> None:
    """A listing must not read samples: the sizes of their files show what was cut or lost."""
    range_bytes = 2 * spec.height * spec.width
    texture_bytes = 3 * spec.texture_height * spec.texture_width
    for name, size_bytes in ((RANGE_FILE, range_bytes), (TEXTURE_FILE, texture_bytes)):
        try:
            header_bytes = os.stat(folder / name).st_size - size_bytes
        except OSError as error:
            raise LibraryError(f"its {name} cannot be read: {error.strerror}") from error
        if not 0 < header_bytes <= ARRAY_HEADER_BYTES_MAX:
            raise LibraryError(f"its {name} has the wrong size")


def _read_grid(folder: Path, spec: GridSpec) -> Grid:
    """A scan's samples, mapped read-only. Raises LibraryError when they are not what its geometry says."""
    try:
        range_steps = np.load(folder / RANGE_FILE, mmap_mode="r", allow_pickle=False)
        texture = np.load(folder / TEXTURE_FILE, mmap_mode="r", allow_pickle=False)
        return Grid(spec, range_steps, texture)
    except (OSError, ValueError, EOFError) as error:
        raise LibraryError(f"its samples cannot be read: {error}") from error


def _write_scan(library: Path, record: _Record, grid: Grid) -> None:
    """Write a scan beside the others under a name that is no scan's, then rename it: it appears whole."""
    incoming = Path(tempfile.mkdtemp(prefix=INCOMING, dir=library))
    try:
        _write_array(incoming / RANGE_FILE, np.ascontiguousarray(grid.range_steps, "<u2"))
        _write_array(incoming / TEXTURE_FILE, np.ascontiguousarray(grid.texture))
        _write_record(incoming, record)
        os.rename(incoming, library / record.id)
        _sync_folder(library)
    except BaseException:
        shutil.rmtree(incoming, ignore_errors=True)
        raise


def _write_array(path: Path, array: StepArray | ImageArray) -> None:
    with open(path, "xb") as file:
        np.save(file, array, allow_pickle=False)
        file.flush()
        os.fsync(file.fileno())


def _write_record(folder: Path, record: _Record) -> None:
    """Put scan.json into a folder, or exchange the one that is there, in one step."""
    new = folder / (RECORD_FILE + ".new")
    with open(new, "wb") as file:
        file.write(msgspec.json.format(msgspec.json.encode(record)))
        file.flush()
        os.fsync(file.fileno())
    os.replace(new, folder / RECORD_FILE)
    _sync_folder(folder)


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _summary(record: _Record) -> ScanSummary:
    return ScanSummary(record.id, record.sequence, record.spec, record.about)
