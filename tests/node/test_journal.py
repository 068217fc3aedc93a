import errno
import os
import zlib
from collections.abc import Iterable
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from node import durable
from node.durable import NoRoom
from node.journal import COMPLETE, CUT_SHORT, Journals, needed_bytes, survey_journal
from node.journal_records import encode_opening, encode_record, read_records
from protocol.errors import LibraryError
from protocol.grid import GridSpec
from protocol.scanner_messages import (
    Channel,
    Column,
    DeviceInfo,
    Outcome,
    RangeColumn,
    SweepEnd,
    SweepHeader,
    TextureColumn,
)

SPEC = GridSpec(width=16, height=10, texture_width=32, texture_height=12, step_mm=0.05, pitch_mm=1.0)
HEADER = SweepHeader(7, SPEC, 3200, range_rows=6, texture_rows=12, calibration=99)
INFO = DeviceInfo("SN-1", 5, 3200, 100, "table")
PIECES = 2 * 16 + 32


def columns(seed: int = 0) -> list[Column]:
    """Every piece of a sweep, in an order of its own."""
    rng = np.random.default_rng(seed)
    pieces: list[Column] = []
    for column in range(SPEC.width):
        for row0, rows in ((0, 6), (6, 4)):
            pieces.append(RangeColumn(7, 0, column, row0, 200 * column + 100, column, rng.bytes(2 * rows)))
    for column in range(SPEC.texture_width):
        pieces.append(TextureColumn(7, 0, column, 0, 100 * column + 50, column, rng.bytes(36)))
    rng.shuffle(pieces)
    return pieces


def as_bytes(found: Iterable[Column]) -> list[bytes]:
    return [column.to_bytes() for column in found]


def kept(folder: Path, pieces: Iterable[Column], why: str = "unplugged") -> str:
    """The id of a sweep that was cut after some pieces, each in a record of its own."""
    journals = Journals(folder)
    journal = journals.begin(INFO, HEADER, 1e9)
    for piece in pieces:
        journal.add(piece)
        journal.flush()
    return journals.keep(journal, why).id


def count(pieces: Iterable[Column]) -> SweepEnd:
    """What a scanner says that has sent these pieces."""
    digests = [zlib.crc32(piece.to_bytes()) for piece in pieces]
    return SweepEnd(HEADER.sweep, Outcome.COMPLETE, len(digests), sum(digests) % 2**32)


def crashed(folder: Path, pieces: Iterable[Column], end: SweepEnd | None = None) -> Path:
    """The file of a sweep whose node went away without a word after some pieces. end : with which they agreed."""
    journals = Journals(folder)
    journal = journals.begin(INFO, HEADER, 1e9)
    for piece in pieces:
        journal.add(piece)
        journal.flush()
    if end is not None:
        journal.confirm(end)
    journal.close()
    return folder / f"{journal.id}.sweep"


def test_a_cut_sweep_is_listed_with_its_columns_at_once_and_after_a_restart(tmp_path: Path) -> None:
    pieces = columns()[:40]
    sweep_id = kept(tmp_path, pieces)
    journals = Journals(tmp_path)
    (sweep,) = journals.interrupted()
    assert (sweep.id, sweep.info, sweep.header, sweep.started_unix_s) == (sweep_id, INFO, HEADER, 1e9)
    assert (sweep.held, sweep.expected, sweep.damaged_bytes, sweep.why) == (40, PIECES, 0, "unplugged")
    assert not sweep.is_complete
    assert as_bytes(journals.columns(sweep_id)) == as_bytes(pieces)
    assert journals.found == [f"sweep {sweep_id}: 40 of {PIECES} pieces of columns; unplugged"]


def test_a_sweep_that_runs_is_not_among_the_interrupted(tmp_path: Path) -> None:
    journals = Journals(tmp_path)
    journal = journals.begin(INFO, HEADER, 1e9)
    assert journals.interrupted() == []
    journals.keep(journal, "unplugged")
    assert [sweep.id for sweep in journals.interrupted()] == [journal.id]
    resumed = journals.reopen(journal.id)
    assert journals.interrupted() == []
    resumed.close()


def test_a_sweep_with_every_piece_that_was_counted_is_complete_whoever_cut_it(tmp_path: Path) -> None:
    crashed(tmp_path, columns(), count(columns()))
    (sweep,) = Journals(tmp_path).interrupted()
    assert sweep.is_complete and sweep.why == COMPLETE


@pytest.mark.parametrize(
    "end",
    [
        None,
        replace(count(columns()), digest=0),
        replace(count(columns()), pieces=PIECES - 1),
        replace(count(columns()), sweep=8),
        replace(count(columns()), outcome=Outcome.FAULT),
    ],
)
def test_a_sweep_with_every_piece_that_nobody_counted_so_is_not_complete(
    tmp_path: Path, end: SweepEnd | None
) -> None:
    crashed(tmp_path, columns(), end)
    (sweep,) = Journals(tmp_path).interrupted()
    assert (sweep.held, sweep.is_complete, sweep.why) == (PIECES, False, CUT_SHORT)


def test_pieces_that_are_lost_from_a_counted_sweep_make_it_incomplete(tmp_path: Path) -> None:
    crashed(tmp_path, columns()[1:], count(columns()))
    (sweep,) = Journals(tmp_path).interrupted()
    assert not sweep.is_complete


def test_a_sweep_goes_on_in_the_same_journal(tmp_path: Path) -> None:
    pieces = columns()
    sweep_id = kept(tmp_path, pieces[:20])
    journals = Journals(tmp_path)
    journal = journals.reopen(sweep_id)
    for piece in pieces[10:]:  # some come twice
        journal.add(piece)
    journal.confirm(count(pieces))
    journal.close()
    (sweep,) = Journals(tmp_path).interrupted()
    assert sweep.is_complete
    assert as_bytes(journals_columns(tmp_path, sweep_id)) == as_bytes(pieces)


def journals_columns(folder: Path, sweep_id: str) -> list[Column]:
    return list(Journals(folder).columns(sweep_id))


@given(cut=st.integers(1, 2000), junk=st.binary(max_size=60))
def test_a_torn_tail_costs_only_what_was_torn(tmp_path_factory: pytest.TempPathFactory, cut: int, junk: bytes) -> None:
    folder = tmp_path_factory.mktemp("torn")
    pieces = columns()[:30]
    path = crashed(folder, pieces)
    whole = path.read_bytes()
    opening = len(encode_opening(INFO, HEADER, 1e9))
    torn = whole[: max(opening, len(whole) - cut)] + junk
    path.write_bytes(torn)
    journals = Journals(folder)
    (sweep,) = journals.interrupted()
    expected = len(list(read_records(torn))) - 1
    assert as_bytes(journals.columns(sweep.id)) == as_bytes(pieces[:expected])
    assert expected >= 30 - 1 - cut // 40
    left = path.read_bytes()
    assert torn.startswith(left) and len(list(read_records(left))) == 1 + expected
    assert any("were torn and are cut" in found for found in journals.found) == (left != torn)
    assert (sweep.why, sweep.size_bytes) == (CUT_SHORT, len(left))
    assert not any("torn" in found for found in Journals(folder).found)


@given(place=st.floats(0, 1, exclude_max=True), length=st.integers(1, 200), seed=st.integers(0, 2**32 - 1))
def test_a_rotten_stretch_costs_only_the_records_in_it(
    tmp_path_factory: pytest.TempPathFactory, place: float, length: int, seed: int
) -> None:
    folder = tmp_path_factory.mktemp("rotten")
    pieces = columns()
    path = crashed(folder, pieces)
    data = bytearray(path.read_bytes())
    opening, record = len(encode_opening(INFO, HEADER, 1e9)), 70
    begin = opening + int(place * (len(data) - opening - record - length))
    data[begin : begin + length] = np.random.default_rng(seed).bytes(length)
    path.write_bytes(data)
    journals = Journals(folder)
    (sweep,) = journals.interrupted()
    found = as_bytes(journals.columns(sweep.id))
    assert set(found) <= set(as_bytes(pieces))
    assert len(found) >= PIECES - 2 - length // 30
    assert len(data) == len(path.read_bytes())
    assert sweep.damaged_bytes > 0 or len(found) == PIECES


def test_records_are_read_back_whatever_lies_between(tmp_path: Path) -> None:
    payloads = [b"a" * size for size in (1, 100, 65536)]
    data = b"".join(b"junk" + encode_record(payload) for payload in payloads) + b"FSj\x01half"
    assert [bytes(payload) for _, payload in read_records(data)] == payloads


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"junk",
        encode_record(b""),
        encode_record(b"\x00\x01"),
        encode_record(b"\x00\x02\x00\x01\x00"),
        encode_record(b"\xff" * 40),
        encode_opening(INFO, HEADER, 1e9)[1:],
        encode_opening(INFO, HEADER, 1e9) + encode_record(b"\x24\xff\xff" + bytes(40)),
        encode_opening(INFO, HEADER, 1e9) + encode_record(b"\x24\x03\x00abc"),
        encode_opening(INFO, HEADER, 1e9) + encode_record(b"\xee\x03\x00abc"),
        encode_record(encode_opening(INFO, HEADER, 1e9)[12:].replace(b"\x01\x00", b"\x02\x00", 1)),
    ],
)
def test_what_is_no_journal_is_reported_and_left_alone(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / ("0" * 16 + ".sweep")
    path.write_bytes(data)
    journals = Journals(tmp_path)
    assert journals.interrupted() == []
    assert [problem.name for problem in journals.problems] == [f"{tmp_path.name}/{path.name}"]
    assert path.read_bytes() == data


def test_a_journal_of_a_newer_format_says_so() -> None:
    opening = encode_opening(INFO, HEADER, 1e9)[12:]
    newer = encode_record(opening[:3] + b"\x02\x00" + opening[5:])
    with pytest.raises(LibraryError, match="format that this version does not know"):
        survey_journal("0" * 16, newer)


def test_foreign_files_are_reported_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / ("0" * 16 + ".sweep")).mkdir()
    journals = Journals(tmp_path)
    assert {problem.reason for problem in journals.problems} == {"not a journal of a sweep"}
    assert len(journals.problems) == len(list(tmp_path.iterdir())) == 2


def test_a_sweep_that_had_not_begun_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / ("0" * 16 + ".sweep.new")).write_bytes(b"half")
    journals = Journals(tmp_path)
    assert (journals.interrupted(), journals.problems, list(tmp_path.iterdir())) == ([], [], [])


def test_a_deleted_sweep_is_gone(tmp_path: Path) -> None:
    sweep_id = kept(tmp_path, columns()[:5])
    journals = Journals(tmp_path)
    journals.delete(sweep_id)
    assert list(tmp_path.iterdir()) == [] and journals.interrupted() == []
    for use in (journals.get, journals.delete, journals.reopen, lambda name: list(journals.columns(name))):
        for name in (sweep_id, "../library", "", "0" * 15 + "\0"):
            with pytest.raises(LibraryError):
                use(name)


def test_columns_stay_readable_after_their_journal_is_removed(tmp_path: Path) -> None:
    pieces = columns()[:5]
    sweep_id = kept(tmp_path, pieces)
    journals = Journals(tmp_path)
    held = list(journals.columns(sweep_id))
    journals.delete(sweep_id)
    assert as_bytes(held) == as_bytes(pieces)


def test_a_sweep_that_would_not_fit_is_refused_naming_the_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journals = Journals(tmp_path)
    monkeypatch.setattr(durable, "free_bytes", lambda folder: needed_bytes(HEADER))
    with pytest.raises(NoRoom, match=rf"this sweep needs \d+ bytes and {needed_bytes(HEADER)} are free"):
        journals.begin(INFO, HEADER, 1e9)
    with pytest.raises(NoRoom):
        journals.require_room()
    assert list(tmp_path.iterdir()) == []


def test_what_a_sweep_needs_is_its_journal_and_its_scan(tmp_path: Path) -> None:
    path = crashed(tmp_path, columns())
    scan_bytes = 2 * 16 * 10 + 3 * 32 * 12
    assert path.stat().st_size + scan_bytes <= needed_bytes(HEADER) <= path.stat().st_size + scan_bytes + 65536
    twice = SweepHeader(7, SPEC, 3200, range_rows=6, texture_rows=12, passes=2)
    one = SweepHeader(7, SPEC, 3200, range_rows=6, texture_rows=12, channels=Channel.RANGE)
    beyond = replace(HEADER, overlap=128)
    assert needed_bytes(one) < needed_bytes(HEADER) < needed_bytes(beyond) < needed_bytes(twice)


def test_a_disk_that_fills_up_ends_the_sweep_and_keeps_what_fits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    room, really_write = 1000, os.write

    def write(file: int, data: bytes) -> int:
        nonlocal room
        if room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        written = really_write(file, bytes(data)[:room])
        room -= written
        return written

    journals, pieces = Journals(tmp_path), columns()
    journal = journals.begin(INFO, HEADER, 1e9)
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", write)
        with pytest.raises(NoRoom, match="No space left"):
            for piece in cycle(pieces):  # the disk is another thread's business, so the news takes a moment
                journal.add(piece)
                journal.flush()
        sweep = journals.keep(journal, "the disk is full")
    assert 0 < sweep.held < len(pieces) and sweep.why == "the disk is full"
    assert journals.get(sweep.id) == sweep, "known until the next start, though there was no room to write it down"
    assert as_bytes(journals.columns(sweep.id)) == as_bytes(pieces[: sweep.held])
    assert (tmp_path / f"{sweep.id}.sweep").stat().st_size == sweep.size_bytes
    assert [left.held for left in Journals(tmp_path).interrupted()] == [sweep.held]


def test_why_a_full_disk_ended_a_sweep_is_written_down_as_soon_as_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    really_write = os.write

    def write(file: int, data: bytes) -> int:
        if len(data) > 500:
            raise OSError(errno.ENOSPC, "No space left on device")
        return really_write(file, data)

    journals = Journals(tmp_path)
    journal = journals.begin(INFO, HEADER, 1e9)
    monkeypatch.setattr(os, "write", write)
    journal.add(columns()[0])
    journal.flush()
    with pytest.raises(NoRoom, match="No space left on device; free some disk space") as full:
        while True:  # the disk is another thread's business, so the news takes a moment
            for piece in columns():
                journal.add(piece)
            journal.flush()
    sweep = journals.keep(journal, str(full.value))
    assert (sweep.why, sweep.held) == (str(full.value), 1)
    assert Journals(tmp_path).interrupted() == [sweep]


def test_the_layout_on_disk_is_the_documented_one(tmp_path: Path) -> None:
    path = crashed(tmp_path, [columns()[0]])
    data = path.read_bytes()
    assert data[:4] == b"FSj\x01"
    size = int.from_bytes(data[4:8], "little")
    assert int.from_bytes(data[8:12], "little") == zlib.crc32(data[12 : 12 + size], size)
    assert data[12:17] == b"\x00\x0a\x00\x01\x00"
