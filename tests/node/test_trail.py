"""A bounded history: durable, private, whole lines only, never larger than allowed."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from node.trail import FILES, Trail


def lines(trail: Trail) -> list[int]:
    return [int(line) for line in trail.newest_first()]


def test_lines_come_back_the_last_one_first(tmp_path: Path) -> None:
    trail = Trail(tmp_path / "t", "a", 8000)
    trail.append([b"1", b"2"])
    trail.append([b"3"])
    assert lines(trail) == [3, 2, 1]


def test_the_oldest_go_when_there_are_too_many(tmp_path: Path) -> None:
    trail, bytes_max = Trail(tmp_path, "a", FILES * 50), FILES * 50
    for number in range(1000):
        trail.append([b"%05d" % number])
        assert sum(path.stat().st_size for path in tmp_path.glob("*.jsonl")) <= bytes_max
    kept = lines(trail)
    assert kept == sorted(kept, reverse=True)
    assert (kept[0], len(kept)) == (999, len(range(kept[-1], 1000)))
    assert len(kept) * 6 > bytes_max * (FILES - 2) / FILES


def test_several_may_begin_at_once(tmp_path: Path) -> None:
    for attempt in range(50):
        trails = [Trail(tmp_path / str(attempt), name, 8000) for name in "abcd"]
        start = threading.Barrier(len(trails))

        def begin(trail: Trail, start: threading.Barrier = start) -> None:
            start.wait()
            trail.append([b"1"])

        with ThreadPoolExecutor(len(trails)) as together:
            [*together.map(begin, trails)]
        assert [lines(trail) for trail in trails] == [[1]] * len(trails)


def test_only_its_owner_may_read_it(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        Trail(tmp_path / "t", "a", 8000).append([b"1"])
    finally:
        os.umask(before)
    assert (tmp_path / "t").stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "t").iterdir()} == {0o600}


def test_a_torn_line_costs_itself_alone(tmp_path: Path) -> None:
    trail = Trail(tmp_path, "a", 8000)
    trail.append([b"1"])
    with open(tmp_path / "a.jsonl", "ab") as file:
        file.write(b"99")
    trail.append([b"2"])
    assert lines(trail) == [2, 99, 1]


def test_on_a_full_disk_nothing_is_left_of_what_did_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trail = Trail(tmp_path, "a", 8000)
    trail.append([b"1"])

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            trail.append([b"2", b"3"])
    assert lines(trail) == [1]
    trail.append([b"4"])
    assert lines(trail) == [4, 1]


def test_processes_append_at_once_and_lose_nothing(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from node.trail import Trail; "
        "t = Trail(Path(sys.argv[1]), 'a', 80000); [t.append([sys.argv[2].encode() + b'%03d' % n]) for n in range(100)]"
    )
    workers = [subprocess.Popen([sys.executable, "-c", program, str(tmp_path), name]) for name in "12"]
    assert [worker.wait(60) for worker in workers] == [0, 0]
    assert sorted(lines(Trail(tmp_path, "a", 80000))) == [*range(1000, 1100), *range(2000, 2100)]
