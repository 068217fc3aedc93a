"""What is known of the axes of this node's scanners: one small file in the library, an entry for each serial number.

    <library>/axes.json   {"format": 1, "axes": [...]}: the newest KnownAxis of each scanner

An axis was found under the scanner's settings of that time (the calibration that SWEEP_HEADER names). Under others it
may be another one, so it counts no longer, and every scan says so until somebody calibrates again.
"""

from __future__ import annotations

import logging
import os
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec

from node.axis import Axis
from node.axis_fit import Estimate
from node.durable import NEW, decode_kept, disk_error, read_bounded, write_whole
from protocol.errors import LibraryError

log = logging.getLogger(__name__)

FILE = "axes.json"
SPOILT = FILE + ".damaged"  # what could not be read is kept, as it may have been of other scanners
FORMAT = 1
FILE_BYTES_MAX = 1 << 17
SCANNERS_MAX = 64  # the one calibrated longest ago makes room


@dataclass(frozen=True, slots=True)
class KnownAxis:
    """One scanner's axis. scanner : its serial number.  settings : the number of its own calibration then.

    scan, diameter_mm : the sweep and the body that it was found by.  calibrated_unix_s : the node's clock, for people.
    """

    scanner: str
    settings: int
    estimate: Estimate
    scan: str
    diameter_mm: float
    calibrated_unix_s: float


class _Kept(msgspec.Struct, frozen=True):
    """axes.json."""

    format: int
    axes: Annotated[tuple[KnownAxis, ...], msgspec.Meta(max_length=SCANNERS_MAX)] = ()


class Axes:
    """The axes kept in a library's folder. Safe to use from several threads of one process.

    A file that cannot be read keeps no node from starting: scans are not corrected then, and say why.
    """

    def __init__(self, library: Path) -> None:
        self._path = library / FILE
        self._lock = threading.Lock()
        self._known: dict[str, KnownAxis] = {}
        self._trouble = self._told_of_spoilt()
        self._damaged = ""
        try:
            self._path.with_name(FILE + NEW).unlink(missing_ok=True)
            kept = decode_kept(read_bounded(self._path, FILE_BYTES_MAX), _Kept, f"its {FILE}")
            if kept.format != FORMAT:
                raise LibraryError(f"its {FILE} is of a version that this one does not know")
            self._known = {known.scanner: known for known in kept.axes}
        except FileNotFoundError:
            pass
        except (OSError, LibraryError) as error:
            self._damaged = f"{FILE} cannot be read, so sweeps are not corrected for an axis: calibrate again"
            self._trouble = f"not corrected for the scanner's axis, as {FILE} cannot be read: calibrate again"
            log.warning("%s (%s)", self._trouble, error)

    @property
    def damaged(self) -> str:
        """What keeps the file of them from being read, since the start and until one is kept; "" where nothing does."""
        return self._damaged

    def known(self) -> tuple[KnownAxis, ...]:
        """All of them, those calibrated last behind."""
        with self._lock:
            return tuple(self._known.values())

    def of(self, scanner: str, settings: int) -> tuple[Axis | None, str]:
        """The axis to correct a sweep for, if one is known; and why one that should be is not, in words, else ""."""
        with self._lock:
            known, trouble = self._known.get(scanner), self._trouble
        if known is None:
            return None, trouble
        if known.settings != settings:
            return None, "not corrected for the scanner's axis, as its settings changed since: calibrate again"
        return known.estimate.axis, ""

    def keep(self, found: KnownAxis) -> None:
        """Correct that scanner's sweeps by this axis from now on; durable before this returns. Raises LibraryError."""
        with self._lock:
            others = [known for scanner, known in self._known.items() if scanner != found.scanner]
            self._write([*others, found][-SCANNERS_MAX:])

    def forget(self, scanner: str) -> bool:
        """Correct that scanner's sweeps no longer. Returns whether its axis was known. Raises LibraryError."""
        with self._lock:
            if scanner not in self._known:
                return False
            self._write([known for known in self._known.values() if known.scanner != scanner])
            return True

    def _write(self, axes: list[KnownAxis]) -> None:
        try:
            if self._damaged:
                os.replace(self._path, self._path.with_name(SPOILT))
                self._damaged = ""
            write_whole(self._path, msgspec.json.format(msgspec.json.encode(_Kept(FORMAT, tuple(axes)))))
        except OSError as error:
            raise disk_error("cannot keep the scanner's axis", error) from error
        self._known, self._trouble = {known.scanner: known for known in axes}, self._told_of_spoilt()

    def _told_of_spoilt(self) -> str:
        """What is said of sweeps by scanners that are not known, while a file lies there that may have known them."""
        if not self._path.with_name(SPOILT).exists():
            return ""
        return f"not corrected for the scanner's axis, if {SPOILT} knew it: calibrate, or delete that file"
