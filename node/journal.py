"""Sweeps on disk as they come in, so that what a scanner sent is never lost, whatever ends the sweep.

    <library>/sweeps/<id>.sweep     one file per sweep, only ever appended to, removed once its scan is kept

A journal is a row of records: magic, length, checksum, and as payload some messages, each behind its type and length.
The messages are those of the scanner link, byte for byte; the first record has BEGIN (our own: format and time),
HELLO_ACK and SWEEP_HEADER, the others have columns, the last one has SWEEP_END where the scanner's count agreed with
ours, or ERROR with the reason of an early end. Where range and texture have turns of their own, SWEEP_HEADER comes
again before each turn's columns: as the scanner said it, but for `passes`, which counts the turns of that channel.
A record stands for itself: a torn tail costs that record, a rotten stretch in the middle costs what lies in it.
A sweep is complete when it has every piece that its header promises and a SWEEP_END that agrees with them, whoever
asks and whenever: pieces that nobody counted, or that were counted otherwise, do not become a scan by themselves.
"""

from __future__ import annotations

import mmap
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from drivers.ledger import Ledger
from node.background_writer import BackgroundWriter, append_whole
from node.durable import (
    NEW,
    disk_error,
    make_private_folder,
    read_readable,
    read_through,
    require_room,
    sync_folder,
    write_whole,
)
from node.journal_records import (
    ENTRY_OVERHEAD,
    RECORD_OVERHEAD,
    column_parts,
    columns_in,
    decode_opening,
    encode_entry,
    encode_opening,
    encode_record,
    messages_in,
    read_records,
)
from node.scan_folder import Problem
from node.turns import TurnStarted
from protocol.errors import LibraryError
from protocol.scanner_messages import (
    COLUMN_OVERHEAD,
    Channel,
    Column,
    DeviceInfo,
    Fault,
    Message,
    Outcome,
    Payload,
    RangeColumn,
    SweepEnd,
    SweepHeader,
    TextureColumn,
)

SUFFIX = ".sweep"
RECORD_BYTES = 65536  # a record is written once its messages reach this
PATIENCE_S = 1.5  # with the disk, of a sweep that was ended early: the node may be stopping
SPARE_BYTES = 16 << 20  # what a sweep must leave free: sidecars, logs, other programs
CUT_SHORT = "the node was cut off in the middle of it"
COMPLETE = "it is complete, and was not published yet"

_COLUMNS = (RangeColumn, TextureColumn)
_ID = re.compile("[0-9a-f]{16}")


@dataclass(frozen=True, slots=True)
class Interrupted:
    """A sweep that has not become a scan.

    started_unix_s, ended_unix_s : by the node's clock.  info : the scanner that made it.  why : what ended it.
    held, expected : pieces of columns on disk, and those a complete sweep has.  damaged_bytes : rotten ones set aside.
    turn : the one that was under way, where range and texture had turns of their own.
    is_complete : whether every column is there, as the scanner counted them: a scan can be made without the scanner.
    """

    id: str
    started_unix_s: float
    ended_unix_s: float
    info: DeviceInfo
    header: SweepHeader
    held: int
    expected: int
    size_bytes: int
    damaged_bytes: int
    why: str
    is_complete: bool
    turn: TurnStarted | None = None


class Journal:
    """The journal of a running sweep. For one thread; errors of the disk surface as LibraryError in any call."""

    def __init__(self, path: Path) -> None:
        self.id = path.stem
        self._writer = BackgroundWriter(path)
        self._messages: list[Payload] = []
        self._size = 0
        self._is_closed = False

    def add(self, column: Column) -> None:
        """Take a column."""
        self._take(column)
        if self._size >= RECORD_BYTES:
            self.flush()

    def begin_turn(self, turn: TurnStarted) -> None:
        """The columns that follow are of this turn."""
        self._take(replace(turn.header, passes=turn.pass_index + 1))

    def flush(self) -> None:
        """Send what was taken on its way to the disk; call it now and then, it bounds what a crash costs."""
        if not self._messages:
            return
        record = encode_record(b"".join(self._messages))
        self._messages.clear()
        self._size = 0
        try:
            self._writer.write(record)
        except OSError as error:
            raise disk_error("cannot keep the sweep", error) from error

    def confirm(self, end: SweepEnd) -> None:
        """Every piece is in, and they are what the scanner counted. end : its count, ours too."""
        self._take(end)

    def close(self, why: str | None = None) -> None:
        """Let go of the file, with all that was taken in it. why : what ended the sweep, unless it ended well.

        Everything is durable then; but of a sweep that ended early, a slow disk may get to it later.
        """
        if self._is_closed:
            return
        self._is_closed = True
        if why is not None:
            self._take(_reason(why))
        failure: LibraryError | None = None
        try:
            self.flush()
        except LibraryError as error:
            failure = error
        try:
            self._writer.close(PATIENCE_S if why is not None else None)
        except OSError as error:
            failure = disk_error("cannot keep the sweep", error)
        if failure is not None:
            raise failure

    def _take(self, message: Message) -> None:
        parts = column_parts(message) if isinstance(message, _COLUMNS) else (encode_entry(message),)
        self._messages += parts
        self._size += sum(map(len, parts))


class Journals:
    """The journals in one folder, which is made if it is missing. Nobody else may use the folder meanwhile.

    found : what was made good at the start.  problems : what lies in the folder and is no journal; it is left alone.
    Safe to use from several threads.  Raises LibraryError when the folder cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.found: list[str] = []
        self.problems: list[Problem] = []
        self._sweeps: dict[str, Interrupted] = {}
        try:
            make_private_folder(folder)
            for name in sorted(os.listdir(folder)):
                self._meet(folder / name)
        except OSError as error:
            raise disk_error(f"the folder {folder} cannot be used", error) from error

    def interrupted(self) -> list[Interrupted]:
        """Every sweep that ended and did not become a scan, oldest first. One that runs is not among them."""
        return sorted(list(self._sweeps.values()), key=lambda sweep: (sweep.started_unix_s, sweep.id))

    def get(self, sweep_id: str) -> Interrupted:
        """One of them. Raises LibraryError when there is none such."""
        try:
            return self._sweeps[sweep_id]
        except KeyError:
            raise LibraryError(f"no interrupted sweep {sweep_id[:40]!r}") from None

    def require_room(self) -> None:
        """Raises NoRoom when not even the smallest sweep would fit."""
        require_room(self._folder, SPARE_BYTES, "a sweep")

    def begin(self, info: DeviceInfo, header: SweepHeader, started_unix_s: float) -> Journal:
        """Open the journal of a new sweep. Raises NoRoom, before anything is written, when it would not fit."""
        require_room(self._folder, needed_bytes(header) + SPARE_BYTES, "this sweep")
        path = self._path(secrets.token_hex(8))
        try:
            write_whole(path, encode_opening(info, header, started_unix_s))
            return Journal(path)
        except OSError as error:
            raise disk_error("cannot keep the sweep", error) from error

    def reopen(self, sweep_id: str) -> Journal:
        """Go on with an interrupted one. Raises LibraryError, NoRoom."""
        sweep = self.get(sweep_id)
        require_room(self._folder, needed_bytes(sweep.header) - sweep.size_bytes + SPARE_BYTES, "going on")
        self._unlist(sweep_id)
        try:
            return Journal(self._path(sweep_id))
        except OSError as error:
            self._sweeps[sweep_id] = sweep
            raise disk_error("cannot go on with the sweep", error) from error

    def keep(self, journal: Journal, why: str) -> Interrupted:
        """Close the journal of a sweep that ended early: it is listed from now on, with all that was kept of it."""
        with suppress(LibraryError):  # whoever adds columns heard of a failing disk; here it is kept what fits
            journal.close(why)
        path = self._path(journal.id)
        try:
            sweep = self._survey(path)
            if sweep.why == CUT_SHORT:  # the disk did not take the reason either
                sweep = self._explain(path, sweep, why)
            return sweep
        except OSError as error:
            raise disk_error("cannot look at what was kept of the sweep", error) from error

    def _explain(self, path: Path, sweep: Interrupted, why: str) -> Interrupted:
        """Say why a sweep ended, behind what was kept of it; where a full disk has no room for that, until we end."""
        try:
            with open(path, "ab", buffering=0) as file:
                append_whole(file.fileno(), encode_record(encode_entry(_reason(why))))
                os.fsync(file.fileno())
            return self._survey(path)
        except OSError:
            self._sweeps[sweep.id] = replace(sweep, why=why)
            return self._sweeps[sweep.id]

    def discard(self, journal: Journal) -> None:
        """Remove a closed journal, because its scan is kept. Raises LibraryError."""
        self._remove(journal.id)

    def columns(self, sweep_id: str) -> Iterator[Column]:
        """The columns of an interrupted sweep, each piece once; their samples lie in the file. Raises LibraryError."""
        ledger = Ledger(self.get(sweep_id).header)
        for _, payload in read_records(_map(self._path(sweep_id))):
            yield from (column for column in columns_in(payload) if ledger.take(column))

    def delete(self, sweep_id: str) -> None:
        """Delete an interrupted sweep. Raises LibraryError when there is none such."""
        self._unlist(sweep_id)
        self._remove(sweep_id)

    def _unlist(self, sweep_id: str) -> None:
        """Take a sweep off the list; of several threads that want it, one gets it. Raises LibraryError."""
        if self._sweeps.pop(sweep_id, None) is None:
            raise LibraryError(f"no interrupted sweep {sweep_id[:40]!r}")

    def _remove(self, sweep_id: str) -> None:
        try:
            self._path(sweep_id).unlink()
            sync_folder(self._folder)
        except OSError as error:
            raise disk_error(f"cannot delete sweep {sweep_id}", error) from error

    def _path(self, sweep_id: str) -> Path:
        return self._folder / (sweep_id + SUFFIX)

    def _meet(self, path: Path) -> None:
        """Something that lay here at the start."""
        if path.name.endswith(SUFFIX + NEW) and _ID.fullmatch(path.name.removesuffix(SUFFIX + NEW)):
            path.unlink()  # a sweep that had not begun
            return
        if path.suffix != SUFFIX or not _ID.fullmatch(path.stem) or not path.is_file():
            self.problems.append(Problem(f"{self._folder.name}/{path.name}", "not a journal of a sweep"))
            return
        try:
            sweep = self._survey(path)
        except LibraryError as error:
            self.problems.append(Problem(f"{self._folder.name}/{path.name}", str(error)))
            return
        self.found.append(f"sweep {sweep.id}: {sweep.held} of {sweep.expected} pieces of columns; {sweep.why}")

    def _survey(self, path: Path) -> Interrupted:
        """Read a journal through, cut its torn tail, and list it. Raises LibraryError when it is none."""
        file_was = path.stat()
        size_bytes = file_was.st_size
        sweep = replace(survey_journal(path.stem, _map(path)), ended_unix_s=file_was.st_mtime)
        if sweep.size_bytes < size_bytes:
            self.found.append(f"sweep {sweep.id}: its last {size_bytes - sweep.size_bytes} bytes were torn and are cut")
            with open(path, "r+b") as file:
                file.truncate(sweep.size_bytes)
                os.fsync(file.fileno())
        self._sweeps[sweep.id] = sweep
        return sweep


def survey_sweeps(folder: Path) -> list[Interrupted]:
    """The interrupted sweeps in a folder, and one that runs; nothing is changed. Raises LibraryError."""
    found: list[Interrupted] = []
    try:
        for path in sorted(folder.glob(f"*{SUFFIX}")):
            with suppress(LibraryError):  # no journal: `Journals` names it
                found.append(replace(survey_journal(path.stem, _map(path)), ended_unix_s=path.stat().st_mtime))
    except OSError as error:
        raise disk_error(f"the folder {folder} cannot be used", error) from error
    return found


def needed_bytes(header: SweepHeader) -> int:
    """What a sweep takes on disk until it is published: its journal and its scan. [bytes]"""
    spec = header.spec
    total = 2 * spec.height * spec.width + 3 * spec.texture_height * spec.texture_width + RECORD_BYTES
    for channel, sample_bytes in ((Channel.RANGE, 2), (Channel.TEXTURE, 3)):
        if channel in header.channels:
            _, rows, piece_rows = header.shape(channel)
            column_bytes = rows * sample_bytes + -(-rows // piece_rows) * (ENTRY_OVERHEAD + COLUMN_OVERHEAD)
            total += sum(header.columns_in(channel)) * column_bytes
    return total


def survey_journal(sweep_id: str, data: bytes | mmap.mmap) -> Interrupted:
    """What a journal holds, up to its last whole record. Raises LibraryError when it is none."""
    records = read_records(data)
    end, opening = next(records, (0, memoryview(b"")))
    if end != RECORD_OVERHEAD + len(opening) or not opening:
        raise LibraryError("its beginning is damaged")
    started_unix_s, info, header = decode_opening(opening)
    ledger, read_bytes, why = Ledger(header), end, CUT_SHORT
    counted: SweepEnd | None = None
    turn: TurnStarted | None = None
    for place, payload in records:
        end, read_bytes = place, read_bytes + RECORD_OVERHEAD + len(payload)
        for message in messages_in(payload):
            if isinstance(message, Fault):
                why = message.text
            elif isinstance(message, SweepEnd):
                counted = message
            elif isinstance(message, SweepHeader):
                turn = TurnStarted(replace(message, passes=1), message.passes - 1)
            elif isinstance(message, RangeColumn | TextureColumn):
                ledger.take(message)
    is_complete = counted == SweepEnd(header.sweep, Outcome.COMPLETE, ledger.expected, ledger.digest)
    counts = ledger.held, ledger.expected, end, end - read_bytes
    said = COMPLETE if is_complete else why
    return Interrupted(sweep_id, started_unix_s, started_unix_s, info, header, *counts, said, is_complete, turn)


def _reason(why: str) -> Fault:
    """What ended a sweep, as its journal says it."""
    return Fault(0, why.encode()[:150].decode(errors="ignore"))


def _map(path: Path) -> bytes | mmap.mmap:
    """A file's bytes; they stay readable for as long as somebody holds them. Raises LibraryError."""
    try:
        with open(path, "rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return b""
            mapped = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
            try:
                read_through(file.fileno())
            except OSError:
                return read_readable(file.fileno())
            return mapped
    except OSError as error:
        raise disk_error("it cannot be read", error) from error
