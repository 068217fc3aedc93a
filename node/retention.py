"""Which scans and interrupted sweeps were kept long enough, by the rules of [retention]. Off unless there are some.

A scan that somebody has pinned (its sidecar has a pin) is never deleted, nor one whose sidecar cannot be read, nor one
that is open. Its age counts from when it came, or was taken, whichever is later. A clock that is wrong must delete
nothing: what seems to come from the future, or from before there were such nodes, is left alone.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from node.config import Retention
from node.journal import Interrupted
from node.library import Library, ScanSummary
from node.sidecar import read_sidecar
from protocol.errors import LibraryError

DAY_S = 86400.0
CLOCK_SET_UNIX_S = 1.5e9  # a clock before this (2017) was never set


@dataclass(frozen=True, slots=True)
class Expired:
    """What is to go. kind : what it is.  why : in words for people."""

    kind: str
    id: str
    why: str
    size_bytes: int


def expired(
    folder: Path,
    scans: Collection[ScanSummary],
    sweeps: Collection[Interrupted],
    rules: Retention,
    now_unix_s: float,
    is_open: Collection[str] = (),
) -> Iterator[Expired]:
    """What the rules say is to go, the oldest first. Reads the sidecars, so it may take its time.

    folder : of the library.  scans, sweeps : all in it.  is_open : ids that are looked at now.
    """
    if rules.max_age_days is not None:
        for sweep in sorted(sweeps, key=lambda sweep: sweep.ended_unix_s):
            if _is_old(sweep.ended_unix_s, rules.max_age_days, now_unix_s):
                yield Expired("sweep", sweep.id, _age(sweep.ended_unix_s, now_unix_s), sweep.size_bytes)
    sizes = {scan.id: _size(folder / scan.id) for scan in scans}
    total = sum(sizes.values())
    for scan in sorted(scans, key=lambda scan: (scan.sequence, scan.id)):
        why = _why(folder / scan.id, scan, rules, now_unix_s, total)
        if why and scan.id not in is_open and not _is_pinned(folder / scan.id):
            total -= sizes[scan.id]
            yield Expired("scan", scan.id, why, sizes[scan.id])


def delete(library: Library, one: Expired) -> None:
    """Delete it. Raises LibraryError."""
    if one.kind == "scan":
        library.delete(one.id)
    else:
        library.sweeps.delete(one.id)


def expired_in(library: Library, rules: Retention, is_open: Collection[str] = ()) -> list[Expired]:
    """The same of a library, now."""
    return [*expired(library.folder, library.scans(), library.sweeps.interrupted(), rules, time.time(), is_open)]


def _why(folder: Path, scan: ScanSummary, rules: Retention, now_unix_s: float, total_bytes: int) -> str:
    if rules.max_age_days is not None:
        came_unix_s = max(scan.about.created_unix_s, _taken(folder))
        if _is_old(came_unix_s, rules.max_age_days, now_unix_s):
            return _age(came_unix_s, now_unix_s)
    if rules.max_gb is not None and total_bytes > rules.max_gb * 1e9:
        return f"{total_bytes / 1e9:.2f} GB of scans were kept"
    return ""


def _is_old(came_unix_s: float, max_age_days: float, now_unix_s: float) -> bool:
    return CLOCK_SET_UNIX_S <= came_unix_s < now_unix_s - max_age_days * DAY_S


def _age(came_unix_s: float, now_unix_s: float) -> str:
    return f"{(now_unix_s - came_unix_s) / DAY_S:.0f} days old"


def _taken(folder: Path) -> float:
    try:
        return read_sidecar(folder).taken_unix_s or 0.0
    except LibraryError:
        return 0.0


def _is_pinned(folder: Path) -> bool:
    """Whether somebody has pinned it; as far as can be known."""
    try:
        return bool(read_sidecar(folder).pins)
    except LibraryError:
        return True


def _size(folder: Path) -> int:
    try:
        return sum(path.stat().st_size for path in folder.iterdir())
    except OSError:
        return 0  # deleted at this moment
