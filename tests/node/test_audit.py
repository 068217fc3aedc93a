"""The audit log: nobody waits for it, a full disk loses nothing that fits in memory, strangers push nothing out."""

from __future__ import annotations

import errno
import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from node import audit as audit_module
from node.audit import REFUSALS, Audit, Entry, Who, done_trail, read_trail, refused_trail
from node.trail import Trail

BYTES_MAX = 1_000_000
ROOM = Who("room 2", "view", "10.0.0.7")


def done(library: Path) -> list[Entry]:
    """Oldest first."""
    return [*read_trail(done_trail(library, BYTES_MAX))][::-1]


def test_an_entry_says_who_did_what_to_which_scan_and_when(tmp_path: Path) -> None:
    audit = Audit(tmp_path, BYTES_MAX)
    audit.note("exported", ROOM, scan="ab" * 16, what="glb")
    audit.close()
    [one] = done(tmp_path)
    assert (one.event, one.by, one.role, one.address) == ("exported", "room 2", "view", "10.0.0.7")
    assert (one.scan, one.what) == ("ab" * 16, "glb")
    assert one.at.startswith(time.strftime("%Y-%m-%dT", time.gmtime())) and one.at.endswith("Z")


def test_looking_again_soon_is_no_new_entry(tmp_path: Path) -> None:
    now_s = 0.0
    audit = Audit(tmp_path, BYTES_MAX, clock=lambda: now_s)
    for now_s in (0.0, 1.0, 599.0, 600.0, 601.0):  # noqa: B007  # the clock reads it; README says ten minutes
        audit.note_seen("seen", ROOM, "a")
    audit.note_seen("seen", ROOM, "b")
    audit.note_seen("seen", Who("room 3", "view", "10.0.0.8"), "a")
    audit.close()
    assert [(one.by, one.scan) for one in done(tmp_path)] == [("room 2", s) for s in "aab"] + [("room 3", "a")]


def test_entries_wait_while_the_disk_is_full_and_nobody_waits_for_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    is_full = threading.Event()
    is_full.set()
    real = Trail.append

    def append(trail: Trail, lines: Sequence[bytes]) -> None:
        if is_full.is_set():
            raise OSError(errno.ENOSPC, "No space left on device")
        real(trail, lines)

    monkeypatch.setattr(Trail, "append", append)
    monkeypatch.setattr(audit_module, "RETRY_S", 0.01)
    monkeypatch.setattr(audit_module, "WAITING_MAX", 3)
    audit = Audit(tmp_path, BYTES_MAX)
    for number in range(5):
        audit.note("opened", ROOM, scan=str(number))
    until(lambda: audit.trouble != "")
    assert (audit.trouble, audit.waiting) == ("No space left on device", 3)
    is_full.clear()
    until(lambda: audit.waiting == 0 and not audit.trouble)
    audit.note("opened", ROOM, scan="5")
    audit.close()
    assert [(one.scan, one.left_out) for one in done(tmp_path)] == [("0", 0), ("1", 0), ("2", 0), ("5", 2)]
    assert [record.levelno for record in caplog.records] == [logging.ERROR, logging.WARNING]


def test_an_end_with_a_full_disk_says_how_much_is_lost(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "audit").write_text("no folder")
    audit = Audit(tmp_path, BYTES_MAX)
    audit.note("opened", ROOM, scan="a")
    audit.close()
    assert "1 entries are lost" in caplog.text


def test_strangers_push_nothing_out_and_are_counted(tmp_path: Path) -> None:
    now_s = 0.0
    audit = Audit(tmp_path, BYTES_MAX, clock=lambda: now_s)
    audit.note("opened", ROOM, scan="a")
    for number in range(REFUSALS + 7):
        audit.refuse(Who("nobody", "", f"10.0.{number}.1"), "wrong token")
    now_s = 60.0
    audit.refuse(Who("nobody", "", "10.1.0.1"), "wrong token")
    audit.close()
    refused = [*read_trail(refused_trail(tmp_path))]
    assert (len(refused), refused[0].left_out, refused[0].address) == (REFUSALS + 1, 7, "10.1.0.1")
    assert [one.event for one in done(tmp_path)] == ["opened"]


def test_those_who_were_not_written_down_are_counted_at_the_end(tmp_path: Path) -> None:
    audit = Audit(tmp_path, BYTES_MAX, clock=lambda: 0.0)
    for number in range(REFUSALS + 7):
        audit.refuse(Who("nobody", "", f"10.0.{number}.1"), "wrong token")
    audit.close()
    refused = [*read_trail(refused_trail(tmp_path))]
    assert (len(refused), refused[0].event, refused[0].left_out) == (REFUSALS + 1, "stopped", 7)


def test_a_disk_that_is_slow_at_the_end_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    is_waiting, may_go_on = threading.Event(), threading.Event()

    def fsync(handle: int) -> None:
        is_waiting.set()
        assert may_go_on.wait(60)

    monkeypatch.setattr("node.trail.os.fsync", fsync)
    audit = Audit(tmp_path, BYTES_MAX)
    audit.note("opened", ROOM, scan="0")
    assert is_waiting.wait(60)
    for scan in "123":
        audit.note("opened", ROOM, scan=scan)
    audit.close(timeout_s=0.05)
    assert [one.scan for one in done(tmp_path)] == ["0", "1", "2", "3"]
    assert "a power cut now would lose 4 entries" in caplog.text
    may_go_on.set()
    until(lambda: audit.waiting == 0)
    assert [one.scan for one in done(tmp_path)] == ["0", "1", "2", "3"]


def test_what_is_wanted_is_found(tmp_path: Path) -> None:
    trail = done_trail(tmp_path, BYTES_MAX)
    for at, by, scan in [("2026-01-01T00:00", "a", "aa11"), ("2026-02-01T00", "b", "aa22"), ("2026-03-01T", "a", "")]:
        trail.append([f'{{"at":"{at}","event":"seen","by":"{by}","scan":"{scan}","later":1}}'.encode()])
    trail.append([b"{torn", b'{"at":1}'])

    def found(**wanted: str) -> list[str]:
        return [one.at[:7] for one in read_trail(trail, **wanted)]

    assert found() == ["2026-03", "2026-02", "2026-01"]
    assert found(since="2026-02") == ["2026-03", "2026-02"]
    assert found(by="a") == ["2026-03", "2026-01"]
    assert found(scan="aa1") == ["2026-01"]


def until(is_so: object) -> None:
    """Wait for another thread."""
    assert callable(is_so)
    for _ in range(500):
        if is_so():
            return
        time.sleep(0.01)
    raise AssertionError("it never happened")
