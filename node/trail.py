"""A bounded history on disk: lines appended durably to private files, of which the oldest goes when they are too many.

    <folder>/<name>.jsonl     the current file; .1.jsonl the one before it, and so on up to FILES - 1
             lock             held by whoever appends: the node, and the commands beside it
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from node.durable import give_to_owner_of, make_private_folder, sync_folder

FILES = 8
LOCK_FILE = "lock"


class Trail:
    """One history. folder : private to its owner, made if it is missing.  bytes_max : of all its files together.

    Several processes may append. Methods raise OSError.
    """

    def __init__(self, folder: Path, name: str, bytes_max: int) -> None:
        self._folder = folder
        self._name = name
        self._file_bytes_max = bytes_max // FILES

    def append(self, lines: Sequence[bytes]) -> None:
        """Add lines, all of them or none, durable before this returns. lines : without their ends."""
        data = _joined(lines)
        with self._locked():
            if self._size() and self._size() + len(data) > self._file_bytes_max:
                self._rotate()
            with self._opened() as handle:
                give_to_owner_of(self._folder, self._path(0))
                size = os.fstat(handle).st_size
                try:
                    _write(handle, data)
                    os.fsync(handle)
                except OSError:  # of a full disk, say
                    os.ftruncate(handle, size)
                    raise

    def append_at_once(self, lines: Sequence[bytes]) -> None:
        """The same for who cannot wait, neither for others who append nor for the disk: a power cut may lose it."""
        with self._opened() as handle:
            _write(handle, _joined(lines))

    def newest_first(self) -> Iterator[bytes]:
        """Every line, the last one first. Lines that are added meanwhile may be missing."""
        for number in range(FILES):
            try:
                data = self._path(number).read_bytes()
            except FileNotFoundError:
                continue
            yield from reversed(data.splitlines())

    def _path(self, number: int) -> Path:
        return self._folder / (f"{self._name}.{number}.jsonl" if number else f"{self._name}.jsonl")

    def _size(self) -> int:
        try:
            return self._path(0).stat().st_size
        except FileNotFoundError:
            return 0

    def _rotate(self) -> None:
        for number in reversed(range(FILES - 1)):
            with suppress(FileNotFoundError):
                os.replace(self._path(number), self._path(number + 1))
        sync_folder(self._folder)

    @contextmanager
    def _opened(self) -> Iterator[int]:
        handle = os.open(self._path(0), os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            yield handle
        finally:
            os.close(handle)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        make_private_folder(self._folder)
        lock = self._folder / LOCK_FILE
        handle = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        try:
            give_to_owner_of(self._folder, lock)
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)


def _joined(lines: Sequence[bytes]) -> bytes:
    return b"".join(line + b"\n" for line in lines)


def _write(handle: int, data: bytes) -> None:
    size = os.fstat(handle).st_size
    if size and os.pread(handle, 1, size - 1) != b"\n":
        data = b"\n" + data  # a power cut tore the last line
    written = 0
    while written < len(data):
        written += os.write(handle, data[written:])
