"""A library as one file, and back: a plain tar that `tar` unpacks and `sha256sum -c SHA256SUMS` checks.

    foveascan-backup.json    format, number of scans: the first member, so that nobody unpacks what he does not know
    <scan id>/...            the files of a scan's folder, one scan after the other
    SHA256SUMS               a line for every member before it: the last member, so that a cut archive has none

Unpacking trusts nothing: only these names, only plain files, only sizes that a scan can have. Everything is unpacked
beside the scans and checked, and only then moved to its place; a crash in the middle is finished or undone by the
next start (node.library_folder).
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import shutil
import tarfile
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import BinaryIO

import msgspec

from node.durable import (
    decode_kept,
    disk_error,
    give_to_owner_of,
    make_private_folder,
    require_room,
    sync_folder,
    write_whole,
)
from node.library_folder import CHECKED, RESTORE, move_in
from node.scan_folder import (
    ARRAY_HEADER_BYTES_MAX,
    RANGE_FILE,
    RECORD_BYTES_MAX,
    RECORD_FILE,
    REPAIR_BYTES,
    REPAIRS_FILE,
    TEXTURE_FILE,
    read_record,
    read_sound_grid,
)
from node.sidecar import FILE as SIDECAR_FILE
from node.sidecar import FILE_BYTES_MAX, read_sidecar
from protocol.errors import LibraryError
from protocol.grid import HEIGHT_MAX, WIDTH_MAX

FORMAT = 1
MARK, SUMS = "foveascan-backup.json", "SHA256SUMS"
SCANS_MAX = 100_000
BYTES_MAX = {
    RANGE_FILE: 2 * WIDTH_MAX * HEIGHT_MAX + ARRAY_HEADER_BYTES_MAX,
    TEXTURE_FILE: 3 * WIDTH_MAX * HEIGHT_MAX + ARRAY_HEADER_BYTES_MAX,
    REPAIRS_FILE: REPAIR_BYTES * WIDTH_MAX * HEIGHT_MAX + ARRAY_HEADER_BYTES_MAX,
    RECORD_FILE: RECORD_BYTES_MAX,
    SIDECAR_FILE: FILE_BYTES_MAX,
}
OPTIONAL = frozenset({REPAIRS_FILE, SIDECAR_FILE})
_PORTION_BYTES = 1 << 20
_BLOCK_BYTES = 512
_MEMBER = re.compile(r"([0-9a-f]{32})/([a-z.]+)")
_MARK_BYTES_MAX = 4096
_SUMS_BYTES_MAX = SCANS_MAX * len(BYTES_MAX) * 128


@dataclass(frozen=True, slots=True)
class Restored:
    """added : ids that were not here.  kept : ids that were here already and stay as they were."""

    added: tuple[str, ...]
    kept: tuple[str, ...]


class _Mark(msgspec.Struct, frozen=True):
    """foveascan-backup.json."""

    format: int
    scans: int


def backup(folder: Path, scan_ids: Iterable[str], path: Path) -> None:
    """Write some scans of a library into a new file, for its owner alone, which is whole or absent; needs no lock.

    Raises LibraryError when a scan is damaged or gone or the file exists or cannot be written.
    """
    if path.exists():
        raise LibraryError(f"{path} exists already: choose another name")
    scan_ids = list(scan_ids)
    new = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(new, "xb", opener=partial(os.open, mode=0o600)) as file:
            _pack(folder, scan_ids, file)
            file.flush()
            os.fsync(file.fileno())
        os.link(new, path)  # unlike a rename, this never replaces a file
        sync_folder(path.parent)
    except OSError as error:
        raise disk_error(f"cannot write the backup {path}", error) from error
    finally:
        new.unlink(missing_ok=True)


def restore(path: Path, folder: Path) -> Restored:
    """Bring the scans of a backup into a library, for whoever holds its lock: all of them, or none.

    Raises LibraryError for whatever is not a sound backup, and when there is no room; OSError when it cannot be opened.
    """
    with open(path, "rb") as file:
        require_room(folder, os.fstat(file.fileno()).st_size, "restoring")
        staged = Path(tempfile.mkdtemp(prefix=RESTORE, dir=folder))
        try:
            give_to_owner_of(folder, staged)
            scan_ids = _unpack(_TarReader(file), staged)
            for scan_id in scan_ids:
                _check(staged / scan_id, "the backup is damaged")
            write_whole(staged / CHECKED, b"")
        except BaseException as error:
            shutil.rmtree(staged, ignore_errors=True)
            if isinstance(error, OSError):
                raise disk_error(f"cannot restore the backup {path}", error) from error
            if isinstance(error, LibraryError):
                raise LibraryError(f"{path}: {error}") from error
            raise
    kept = tuple(scan_id for scan_id in scan_ids if (folder / scan_id).exists())
    try:
        move_in(folder, staged)
    except OSError as error:
        raise disk_error("the backup is restored in part; the next start finishes it", error) from error
    return Restored(tuple(sorted(set(scan_ids) - set(kept))), kept)


def _pack(folder: Path, scan_ids: list[str], file: BinaryIO) -> None:
    sums: list[str] = []
    with tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        _pack_bytes(archive, MARK, msgspec.json.encode(_Mark(FORMAT, len(scan_ids))) + b"\n", sums)
        for scan_id in scan_ids:
            scan = folder / scan_id
            _check(scan, "cannot back up")
            for name in BYTES_MAX:
                if name not in OPTIONAL or (scan / name).exists():
                    _pack_file(archive, f"{scan_id}/{name}", scan / name, sums)
        _pack_bytes(archive, SUMS, "".join(sums).encode(), [])


def _pack_bytes(archive: tarfile.TarFile, name: str, data: bytes, sums: list[str]) -> None:
    sums.append(f"{hashlib.sha256(data).hexdigest()}  {name}\n")
    archive.addfile(_member(name, len(data)), io.BytesIO(data))


def _pack_file(archive: tarfile.TarFile, name: str, path: Path, sums: list[str]) -> None:
    with open(path, "rb") as file:  # an exchanged sidecar keeps its bytes for whoever has it open
        sums.append(f"{hashlib.file_digest(file, 'sha256').hexdigest()}  {name}\n")
        file.seek(0)
        archive.addfile(_member(name, os.fstat(file.fileno()).st_size), file)


def _member(name: str, size: int) -> tarfile.TarInfo:
    member = tarfile.TarInfo(name)
    member.size = size
    return member


class _TarReader:
    """The plain files of a tar, one after the other. Knows no links, no extensions, nothing that leads elsewhere."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._left = 0
        self._padding = 0

    def next_member(self) -> tuple[str, int]:
        """Name and size of the next file, whose bytes `read` gives. Raises LibraryError."""
        self._exactly(self._padding)
        header = self._exactly(_BLOCK_BYTES)
        try:
            member = tarfile.TarInfo.frombuf(header, "ascii", "strict")
        except (tarfile.HeaderError, UnicodeDecodeError) as error:
            raise LibraryError(f"not a sound backup: {error}") from error
        if member.type != tarfile.REGTYPE or member.size < 0:
            raise LibraryError(f"not a sound backup: {member.name[:80]!r} is no plain file")
        self._left, self._padding = member.size, -member.size % _BLOCK_BYTES
        return member.name, member.size

    def read(self) -> bytes:
        """The next portion of the file, b"" at its end. Raises LibraryError."""
        data = self._exactly(min(self._left, _PORTION_BYTES))
        self._left -= len(data)
        return data

    def read_small(self, bytes_max: int) -> bytes:
        """The whole file. Raises LibraryError when it is larger than `bytes_max`."""
        if self._left > bytes_max:
            raise LibraryError("not a sound backup: one of its lists is too long")
        data, self._left = self._exactly(self._left), 0
        return data

    def _exactly(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) != size:
            raise LibraryError("the backup is cut off")
        return data


def _unpack(reader: _TarReader, staged: Path) -> list[str]:
    """Write a backup's scans into a folder, compared with its checksums. Returns their ids."""
    try:
        name, _ = reader.next_member()
    except LibraryError as error:
        raise LibraryError("not a backup of a library: it does not begin as one") from error
    if name != MARK:
        raise LibraryError(f"not a backup of a library: it begins with {name[:80]!r}")
    mark_data = reader.read_small(_MARK_BYTES_MAX)
    mark = _decode_mark(mark_data)
    sums = {MARK: hashlib.sha256(mark_data).hexdigest()}
    scan_ids: dict[str, None] = {}
    while (name := reader.next_member()[0]) != SUMS:
        scan_id, file_name = _parse(name)
        if name in sums or len(sums) > len(BYTES_MAX) * mark.scans:
            raise LibraryError(f"not a sound backup: {name} is one too many")
        if scan_id not in scan_ids:
            scan_ids[scan_id] = None
            make_private_folder(staged / scan_id)
        sums[name] = _unpack_file(reader, staged / name, BYTES_MAX[file_name])
    expected = "".join(f"{digest}  {name}\n" for name, digest in sums.items()).encode()
    if reader.read_small(_SUMS_BYTES_MAX) != expected or len(scan_ids) != mark.scans:
        raise LibraryError("the backup is damaged: its checksums do not agree")
    for scan_id in scan_ids:
        sync_folder(staged / scan_id)
    return list(scan_ids)


def _decode_mark(data: bytes) -> _Mark:
    mark = decode_kept(data, _Mark, f"the backup: its {MARK}")
    if mark.format != FORMAT:
        raise LibraryError(f"the backup has format {mark.format}, this version knows {FORMAT} only")
    if not 0 <= mark.scans <= SCANS_MAX:
        raise LibraryError(f"not a sound backup: {mark.scans} scans")
    return mark


def _parse(name: str) -> tuple[str, str]:
    """Scan id and file of a member. Raises LibraryError for any name that a backup does not have."""
    match = _MEMBER.fullmatch(name)
    if match is None or match[2] not in BYTES_MAX:
        raise LibraryError(f"not a sound backup: it has no business with {name[:80]!r}")
    return match[1], match[2]


def _unpack_file(reader: _TarReader, path: Path, bytes_max: int) -> str:
    """Write a member to disk. Returns its SHA-256."""
    digest, size = hashlib.sha256(), 0
    with open(path, "xb") as file:
        while data := reader.read():
            size += len(data)
            if size > bytes_max:
                raise LibraryError(f"not a sound backup: {path.name} is larger than {bytes_max} bytes")
            digest.update(data)
            file.write(data)
        file.flush()
        os.fsync(file.fileno())
    return digest.hexdigest()


def _check(scan: Path, trouble: str) -> None:
    """Raises LibraryError unless a folder holds a sound scan."""
    try:
        read_sound_grid(scan, read_record(scan).spec)
        read_sidecar(scan)
    except LibraryError as error:
        raise LibraryError(f"{trouble}: scan {scan.name[:40]}: {error}") from error
