"""Sealing a library, and unsealing it: everything is copied and compared, then the copy takes its place.

    <folder>             the library until the copy is whole
    .<folder>.sealing    its encrypted copy, as far as that is      then <folder>.sealed
    .<folder>.away       what was the library, to be deleted
    .<folder>.coming     its copy in the clear, as far as that is   then <folder>
    .<folder>.gone       what was the sealed one, to be deleted

What was cut goes on where it was, when it is asked for again: what is the same already is only compared. Which of two
counts shows by their names alone. Disks keep what was deleted until it is written over, so a library is best sealed
before the first sweep.
"""

from __future__ import annotations

import filecmp
import os
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from node.durable import disk_error, require_room, sync_folder
from node.library_folder import LOCK_FILE, MARK_FILE, Lock, check_format
from node.sealed import beside, change_key, holds_something, is_open, is_sealed, make_sealed, opened, sealed_folder
from protocol.errors import LibraryError

PORTION_BYTES = 1 << 20
SPARE_BYTES = 64 << 20  # encrypted files are a little larger, and take a few more

Tell = Callable[[int], object]


def seal(folder: Path, key: bytes, tell: Tell) -> None:
    """Encrypt a library, or make an empty one that is. tell : told of so many bytes more that are done.

    Raises LibraryError; then the library is as it was, or the same again ends it.
    """
    sealed, sealing, away = sealed_folder(folder), beside(folder, "sealing"), beside(folder, "away")
    with _disk(f"cannot seal {folder}"):
        _require_shut(folder)
        if is_sealed(folder) and not away.exists():
            raise LibraryError(f"{folder} is sealed already")
        if holds_something(folder) and not away.exists():
            with _held(folder):
                require_room(folder.parent, _size(folder) - _size(sealing) + SPARE_BYTES, "sealing")
                make_sealed(sealing, key)
                with opened(sealing, beside(folder, "open"), key) as place:
                    make_same(folder, place, tell)
                os.rename(folder, away)
                sync_folder(folder.parent)
        elif not away.exists():
            make_sealed(sealing, key)
            if folder.exists():
                _keep_owner(folder, sealing)
        if sealing.exists():
            os.rename(sealing, sealed)
        folder.mkdir(mode=0o700, exist_ok=True)
        if away.exists():
            _keep_owner(away, folder)
            sync_folder(folder.parent)
            shutil.rmtree(away)
        sync_folder(folder.parent)


def unseal(folder: Path, key: bytes, tell: Tell) -> None:
    """Make a sealed library one in the clear. Raises LibraryError; then it is as it was, or the same again ends it."""
    sealed, coming, gone = sealed_folder(folder), beside(folder, "coming"), beside(folder, "gone")
    with _disk(f"cannot unseal {folder}"):
        _require_shut(folder)
        if not gone.exists():
            if not is_sealed(folder):
                raise LibraryError(f"{folder} is not sealed")
            if holds_something(folder):
                raise LibraryError(f"{folder} holds something beside what is sealed: move that away first")
            with opened(sealed, beside(folder, "open"), key) as place:
                require_room(folder.parent, _size(place) - _size(coming) + SPARE_BYTES, "unsealing")
                make_same(place, coming, tell)
            os.rename(sealed, gone)
            sync_folder(folder.parent)
        if coming.exists():
            with suppress(FileNotFoundError):
                folder.rmdir()
            os.rename(coming, folder)
            sync_folder(folder.parent)
        shutil.rmtree(gone)
        sync_folder(folder.parent)


def rekey(folder: Path, old: bytes, new: bytes) -> None:
    """Give a sealed library another key, open or not. Raises LibraryError."""
    if not is_sealed(folder):
        raise LibraryError(f"{folder} is not sealed")
    change_key(sealed_folder(folder), old, new)


def size_bytes(folder: Path) -> int:
    """What a library takes, in the clear or sealed. Raises OSError."""
    return _size(folder if holds_something(folder) else sealed_folder(folder))


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """A library in which nobody else writes. Raises LibraryError where it is none."""
    if not (folder / MARK_FILE).exists():
        raise LibraryError(f"{folder} holds no library; nothing was touched")
    check_format(folder)
    lock = Lock(folder)
    try:
        yield
    finally:
        lock.release()


def make_same(source: Path, target: Path, tell: Tell) -> None:
    """Make a folder hold what another one holds, and nothing else: durable, and read again, before this returns.

    What is the same already stays. Raises OSError, LibraryError.
    """
    target.mkdir(mode=0o700, exist_ok=True)
    wanted = {name for name in os.listdir(source) if name != LOCK_FILE}
    for name in set(os.listdir(target)) - wanted:
        _delete(target / name)
    for name in sorted(wanted):
        there, here = source / name, target / name
        kind = stat.S_IFMT(there.lstat().st_mode)
        if here.is_symlink() or (here.exists() and stat.S_IFMT(here.lstat().st_mode) != kind):
            _delete(here)
        if kind == stat.S_IFDIR:
            make_same(there, here, tell)
        elif kind == stat.S_IFREG:
            _copy(there, here)
            tell(there.stat().st_size)
        else:
            raise LibraryError(f"{there} is neither file nor folder: move it away first")
    _keep_owner(source, target)
    sync_folder(target)


def _copy(there: Path, here: Path) -> None:
    if not (here.exists() and filecmp.cmp(there, here, shallow=False)):
        new = here.with_name(f".{here.name}.sealing")
        with open(there, "rb") as source, open(new, "wb") as target:
            shutil.copyfileobj(source, target, PORTION_BYTES)
            target.flush()
            os.fsync(target.fileno())
            os.posix_fadvise(target.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        if not filecmp.cmp(there, new, shallow=False):
            raise LibraryError(f"{there} was not written as it is: check the disk")
        os.replace(new, here)
    _keep_owner(there, here)


def _keep_owner(there: Path, here: Path) -> None:
    """Owner, rights and times; an interrupted sweep knows its end by them."""
    info = there.stat()
    if os.geteuid() == 0:
        os.chown(here, info.st_uid, info.st_gid)
    shutil.copystat(there, here)


def _delete(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def _size(folder: Path) -> int:
    return sum((Path(place) / name).lstat().st_size for place, _, names in os.walk(folder) for name in names)


def _require_shut(folder: Path) -> None:
    if is_open(folder):
        cure = "stop the node, then systemctl stop foveascan-vault, or umount it"
        raise LibraryError(f"{folder} is open as a sealed library: {cure}")


@contextmanager
def _disk(doing: str) -> Iterator[None]:
    """Errors of the disk as those of the library."""
    try:
        yield
    except shutil.Error as error:
        raise LibraryError(f"{doing}: {error}") from error
    except OSError as error:
        raise disk_error(doing, error) from error
