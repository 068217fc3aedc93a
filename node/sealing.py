"""Sealing a library, and unsealing it: everything is copied and compared, then the copy takes its place.

    <folder>             the library until the copy is whole
    .<folder>.sealing    its encrypted copy, as far as that is      then <folder>.sealed
    .<folder>.away       what was the library, to be deleted
    .<folder>.coming     its copy in the clear, as far as that is   then <folder>
    .<folder>.gone       what was the sealed one, to be deleted

What was cut goes on where it was, when it is asked for again: what is the same already is only compared. Which of two
counts shows by their names alone; each command ends what the other one left, and neither deletes a copy before its key
has opened the sealed one. Disks keep what was deleted until it is written over, so a library is best sealed
before the first sweep.
"""

from __future__ import annotations

import filecmp
import os
import shlex
import shutil
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path

from node.durable import disk_error, require_room, sync_folder
from node.library_folder import LOCK_FILE, MARK_FILE, Lock, check_format
from node.sealed import (
    beside,
    change_key,
    holds_something,
    is_kept,
    is_open,
    is_sealed,
    make_sealed,
    opened,
    sealed_folder,
)
from protocol.errors import LibraryError

PORTION_BYTES = 1 << 20
SPARE_BYTES = 64 << 20  # encrypted files are a little larger, and take a few more

Tell = Callable[[int], object]


def seal(folder: Path, key: bytes, tell: Tell) -> None:
    """Encrypt a library, or an empty folder that is to be one. tell : told of so many bytes more that are done.

    Ends first what was cut. Raises LibraryError; then the library is as it was, or the same again ends it.
    """
    sealed, sealing = sealed_folder(folder), beside(folder, "sealing")
    with _disk(f"cannot seal {folder}"):
        _require_shut(folder)
        ended = _end_what_was_cut(folder, key, tell)
        if is_sealed(folder):
            if not (_discard(folder, ("coming", "sealing"), sealed, key) or ended):
                raise LibraryError(f"{folder} is sealed already")
            return
        if not folder.is_dir():
            raise LibraryError(f"there is no folder {folder}: name the library's, or make one; nothing was touched")
        with _held(folder) if holds_something(folder) else nullcontext():
            require_room(folder.parent, _size(folder) - _size(sealing) + SPARE_BYTES, "sealing")
            make_sealed(sealing, key)
            with opened(sealing, beside(folder, "open"), key) as place:
                make_same(folder, place, tell)
            os.rename(folder, beside(folder, "away"))
            sync_folder(folder.parent)
        _put_sealed(folder)


def unseal(folder: Path, key: bytes, tell: Tell) -> None:
    """Make a sealed library one in the clear. Ends first what was cut.

    Raises LibraryError; then it is as it was, or the same again ends it.
    """
    sealed, sealing, coming = sealed_folder(folder), beside(folder, "sealing"), beside(folder, "coming")
    with _disk(f"cannot unseal {folder}"):
        _require_shut(folder)
        ended = _end_what_was_cut(folder, key, tell)
        if not is_sealed(folder):
            if not ((holds_something(folder) and _discard(folder, ("sealing",), sealing, key)) or ended):
                raise LibraryError(f"{folder} is not sealed")
            return
        if holds_something(folder):
            raise LibraryError(f"{folder} holds something beside what is sealed: move that away first")
        with opened(sealed, beside(folder, "open"), key) as place:
            require_room(folder.parent, _size(place) - _size(coming) + SPARE_BYTES, "unsealing")
            make_same(place, coming, tell)
        os.rename(sealed, beside(folder, "gone"))
        sync_folder(folder.parent)
        _put_clear(folder)


def _end_what_was_cut(folder: Path, key: bytes, tell: Tell) -> bool:
    """Go on with the renames of a seal or an unseal. Returns whether there were any left.

    What would be deleted is deleted only once this key has opened the sealed copy. Raises LibraryError, OSError.
    """
    away, gone = beside(folder, "away"), beside(folder, "gone")
    is_begun = away.exists(), gone.exists()
    if away.exists():
        _end_seal(folder, away, key, tell)
    if gone.exists():
        _end_unseal(folder, gone, key, tell)
    return any(is_begun)


def _end_seal(folder: Path, away: Path, key: bytes, tell: Tell) -> None:
    sealed = sealed_folder(folder) if is_sealed(folder) else beside(folder, "sealing")
    if holds_something(folder):
        raise LibraryError(f"{folder} and {away} both hold something: move away the one that is not wanted")
    if not is_kept(sealed):
        raise LibraryError(f"nothing is sealed, the library is in {away}: {_move_back(away, folder)}")
    with opened(sealed, beside(folder, "open"), key) as place:
        if sealed != sealed_folder(folder):
            make_same(away, place, tell)
        elif holds_something(away) and not holds_something(place):
            raise LibraryError(f"{sealed} is empty, and {away} is not: move away the one that is not wanted")
    _put_sealed(folder)


def _end_unseal(folder: Path, gone: Path, key: bytes, tell: Tell) -> None:
    coming, sealed = beside(folder, "coming"), sealed_folder(folder)
    if is_sealed(folder):
        raise LibraryError(f"{sealed} and {gone} are both sealed libraries: move away the one that is not wanted")
    if coming.exists() and holds_something(folder):
        raise LibraryError(f"{folder} and {coming} both hold something: move away the one that is not wanted")
    if is_kept(gone):  # else nobody can open what is left of it
        with opened(gone, beside(folder, "open"), key) as place:
            if coming.exists():
                make_same(place, coming, tell)
            elif not folder.is_dir() or (not holds_something(folder) and holds_something(place)):
                raise LibraryError(f"nothing is in the clear, the library is in {gone}: {_move_back(gone, sealed)}")
    _put_clear(folder)


def _move_back(left: Path, place: Path) -> str:
    return shlex.join(["mv", "-T", str(left), str(place)])


def _put_sealed(folder: Path) -> None:
    """Have the whole encrypted copy take its place, and delete the library in the clear. Raises OSError."""
    sealing, away = beside(folder, "sealing"), beside(folder, "away")
    if sealing.exists() and not is_sealed(folder):
        os.rename(sealing, sealed_folder(folder))
    folder.mkdir(mode=0o700, exist_ok=True)
    _keep_owner(away, folder)
    sync_folder(folder.parent)
    shutil.rmtree(away)
    sync_folder(folder.parent)


def _put_clear(folder: Path) -> None:
    """Have the whole copy in the clear take its place, and delete the sealed library. Raises OSError."""
    coming = beside(folder, "coming")
    if coming.exists():
        with suppress(FileNotFoundError):
            folder.rmdir()
        os.rename(coming, folder)
        sync_folder(folder.parent)
    shutil.rmtree(beside(folder, "gone"))
    sync_folder(folder.parent)


def _discard(folder: Path, words: tuple[str, ...], sealed: Path, key: bytes) -> bool:
    """Delete copies that never became whole, once the key opens the sealed one. Returns whether there were any."""
    left = [place for word in words if (place := beside(folder, word)).exists()]
    if left and is_kept(sealed):
        with opened(sealed, beside(folder, "open"), key):
            pass
    for place in left:
        shutil.rmtree(place)
    return bool(left)


def rekey(folder: Path, old: bytes, new: bytes) -> None:
    """Give a sealed library another key, open or not. Raises LibraryError."""
    if new == old:
        raise LibraryError("the new key is the old one: nothing was changed")
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
