"""Files that survive a power cut: written whole beside their place, made durable, then moved there in one step."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeVar

import msgspec

from protocol.errors import LibraryError

NEW = ".new"
EASY_BYTES = 1 << 30  # with less left, a disk is nearly full
PORTION_BYTES = 1 << 20
BLOCK_BYTES = 4096  # what is lost at once, of a disk or of a sealed folder
Kept = TypeVar("Kept")
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class NoRoom(LibraryError):
    """The disk has no room for what was to be kept."""


def write_whole(path: Path, data: bytes, *, private: bool = False) -> None:
    """Make `data` the content of a file, or leave the file as it was. Raises OSError.

    private : for the owner of its folder alone, also where root writes it.
    """
    new = path.with_name(path.name + NEW)
    try:
        with open(new, "wb", opener=partial(os.open, mode=0o600 if private else 0o666)) as file:
            if private:
                give_to_owner_of(path.parent, new)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(new, path)
    except BaseException:
        new.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def give_to_owner_of(folder: Path, path: Path) -> None:
    """Where root does an account's work, leave nothing behind that the account cannot use. Raises OSError."""
    owner = folder.stat()
    if os.geteuid() == 0 and owner.st_uid != 0:
        os.chown(path, owner.st_uid, owner.st_gid)


def make_private_folder(folder: Path) -> None:
    """Make a folder that only the owner of its parent may use, unless it is there; others may do so at the same time.

    Raises OSError.
    """
    try:
        folder.mkdir(mode=0o700, parents=True)
    except FileExistsError:
        if not folder.is_dir():
            raise
    else:
        give_to_owner_of(folder.parent, folder)


def read_bounded(path: Path, bytes_max: int) -> bytes:
    """The content of a small file. Raises OSError, or LibraryError when it is larger than `bytes_max`."""
    with open(path, "rb") as file:
        data = file.read(bytes_max + 1)
    if len(data) > bytes_max:
        raise LibraryError(f"its {path.name} is larger than {bytes_max} bytes")
    return data


def read_through(file: int) -> None:
    """Read a file to its end, so that what its disk cannot read is an OSError here, not a signal where it is mapped."""
    portion, at = bytearray(PORTION_BYTES), 0
    while count := os.preadv(file, [portion], at):
        at += count


def read_readable(file: int) -> bytes:
    """A file's bytes, zero where its disk cannot read them."""
    data = bytearray(os.fstat(file).st_size)
    for at in range(0, len(data), BLOCK_BYTES):
        with suppress(OSError):
            piece = os.pread(file, BLOCK_BYTES, at)
            data[at : at + len(piece)] = piece
    return bytes(data)


def decode_kept(data: bytes, kind: type[Kept], what: str) -> Kept:
    """The JSON of a small file of ours. what : it is, for the message. Raises LibraryError for one that has rotted."""
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeError) as error:
        raise LibraryError(f"{what} is damaged: {error}") from error


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable. Raises OSError."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def free_bytes(folder: Path) -> int:
    """What an ordinary user may still write beside a folder. [bytes]"""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def require_room(folder: Path, needed_bytes: int, what: str) -> None:
    """Raises NoRoom, naming the bytes, unless the disk of a folder has room for `needed_bytes`."""
    free = free_bytes(folder)
    if free < needed_bytes:
        raise NoRoom(f"the disk is full: {what} needs {needed_bytes} bytes and {free} are free; delete or move scans")


def disk_error(doing: str, error: OSError) -> LibraryError:
    """What failed on the disk, as an error of the library."""
    found = f"{doing}: {error.strerror or error}"
    return NoRoom(f"{found}; free some disk space") if error.errno in _FULL else LibraryError(found)
