"""The library's own things: its version mark, its lock, and what a crash may have left lying about.

    <library>/library.json   {"format": 1}: written first, so that no version works on a folder that it does not know
              lock           held by the one process that may write here; it holds the process's number
              sweeps/        journals (node.journal)
              axes.json      where the axes of scanners are (node.axes)
              .incoming-*    a scan that is being written          the next start removes it
              .trash-*       a scan that is being deleted          the next start removes it
              .restore-*     a backup that is being unpacked       the next start finishes it, if checked, or removes it
"""

from __future__ import annotations

import fcntl
import os
import shutil
from contextlib import suppress
from pathlib import Path

import msgspec

from node.axes import FILE as AXES
from node.axes import SPOILT
from node.durable import NEW, decode_kept, disk_error, read_bounded, sync_folder, write_whole
from node.scan_folder import INCOMING, RANGE_FILE, RECORD_FILE, REPAIRS_FILE, SCAN_ID, TEXTURE_FILE
from node.sidecar import FILE as SIDECAR_FILE
from protocol.errors import LibraryError

FORMAT = 1
MARK_FILE, LOCK_FILE, SWEEPS = "library.json", "lock", "sweeps"
OWN = frozenset({MARK_FILE, LOCK_FILE, SWEEPS, AXES, SPOILT, "node-id", "access", "audit"})  # of other modules, too
TRASH, RESTORE = ".trash-", ".restore-"
UNFINISHED = (INCOMING, TRASH, RESTORE)
CHECKED = "checked"  # in a .restore- folder: everything in it was unpacked and found sound
SCAN_FILES = frozenset({RANGE_FILE, TEXTURE_FILE, REPAIRS_FILE, RECORD_FILE, SIDECAR_FILE})
LOCKS = Path("/proc/locks")
_MARK_BYTES_MAX = 4096


class _Mark(msgspec.Struct, frozen=True):
    """library.json."""

    format: int


class Lock:
    """The right to write in a library, held until `release` or the end of the process."""

    def __init__(self, folder: Path) -> None:
        self._handle = -1
        self._handle = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            holder = os.pread(self._handle, 20, 0).decode(errors="replace").strip() or "another one"
            self.release()
            raise LibraryError(f"the library {folder} is in use by process {holder}; end that first") from None
        os.ftruncate(self._handle, 0)
        os.pwrite(self._handle, f"{os.getpid()}\n".encode(), 0)

    def release(self) -> None:
        """Let go of it; harmless when repeated."""
        if self._handle >= 0:
            handle, self._handle = self._handle, -1
            with suppress(OSError):  # the disk is gone, and the lock with it
                os.close(handle)

    def __del__(self) -> None:
        self.release()


def holder_of(folder: Path) -> int | None:
    """Which process works in a library: its id, 0 for nobody, None where that cannot be seen. The lock is not taken."""
    try:
        inode = (folder / LOCK_FILE).stat().st_ino
    except FileNotFoundError:
        return 0
    except OSError:
        return None
    try:
        with open(os.memfd_create("foveascan", os.MFD_CLOEXEC)) as ours:
            fcntl.flock(ours, fcntl.LOCK_EX)  # to see whether locks are seen: there may be no others
            lines = [line.split() for line in LOCKS.read_text().splitlines()]
            seen = os.fstat(ours.fileno()).st_ino, os.getpid()
    except OSError:
        return None
    held = [(int(lock[5].rpartition(":")[2]), int(lock[4])) for lock in lines if lock[1] == "FLOCK"]
    if seen not in held:
        return None
    held.remove(seen)
    return dict(held).get(inode, 0)


def check_format(folder: Path) -> None:
    """Raises LibraryError when a library was written by a version that knows more; nothing is touched."""
    try:
        data = read_bounded(folder / MARK_FILE, _MARK_BYTES_MAX)
    except FileNotFoundError:
        return  # empty, or not a library yet
    except OSError as error:
        raise disk_error(f"the library {folder} cannot be used", error) from error
    mark = decode_kept(data, _Mark, f"the library {folder} cannot be used: its {MARK_FILE}")
    if mark.format != FORMAT:
        raise LibraryError(f"the library {folder} has format {mark.format}, this version knows {FORMAT} only")


def take(folder: Path) -> Lock:
    """Make a folder a library, unless it is one, and lock it. Raises LibraryError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_format(folder)
        lock = Lock(folder)
        if not (folder / MARK_FILE).exists():
            write_whole(folder / MARK_FILE, msgspec.json.encode(_Mark(FORMAT)) + b"\n")
        return lock
    except OSError as error:
        raise disk_error(f"the library {folder} cannot be used", error) from error


def tidy(folder: Path) -> list[str]:
    """Finish or undo what a crash interrupted; for whoever holds the lock. Returns what was done. Raises OSError."""
    done: list[str] = []
    for name in sorted(os.listdir(folder)):
        path = folder / name
        if name.startswith(INCOMING) and _is_ours(path):
            shutil.rmtree(path)
            done.append(f"removed {name}: a scan that was never completely written")
        elif name.startswith(TRASH) and _is_ours(path):
            shutil.rmtree(path)
            done.append(f"finished deleting scan {name.removeprefix(TRASH)[:32]}")
        elif name.startswith(RESTORE) and _is_restore(path):
            done.append(_finish_restore(folder, path))
        elif SCAN_ID.fullmatch(name) and path.is_dir():
            for file in (RECORD_FILE, SIDECAR_FILE):
                (path / (file + NEW)).unlink(missing_ok=True)
    return done


def move_in(folder: Path, staged: Path) -> list[str]:
    """Give every scan of a checked .restore- folder its place, then remove the folder. Returns the ids. Raises OSError.

    It may be repeated after a crash at any moment. A scan that is there already keeps what it has.
    """
    moved = [name for name in sorted(os.listdir(staged)) if SCAN_ID.fullmatch(name)]
    for name in moved:
        if not (folder / name).exists():
            os.rename(staged / name, folder / name)
    sync_folder(folder)
    shutil.rmtree(staged)
    return moved


def _finish_restore(folder: Path, staged: Path) -> str:
    if (staged / CHECKED).exists():
        return f"finished restoring a backup: its last {len(move_in(folder, staged))} scans"
    shutil.rmtree(staged)
    return f"removed {staged.name}: a backup that was never completely unpacked"


def _is_restore(path: Path) -> bool:
    return path.is_dir() and all(
        entry.removesuffix(NEW) == CHECKED or (SCAN_ID.fullmatch(entry) and _is_ours(path / entry))
        for entry in os.listdir(path)
    )


def _is_ours(path: Path) -> bool:
    """Whether a folder holds nothing but what a scan's folder may hold while it is written."""
    return path.is_dir() and all(entry.removesuffix(NEW) in SCAN_FILES for entry in os.listdir(path))
