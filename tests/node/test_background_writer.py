"""Bytes to a disk that takes its time."""

import os
import threading
from pathlib import Path

import pytest

from node.background_writer import BackgroundWriter


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "journal").touch()
    return tmp_path / "journal"


def test_what_waits_for_a_slow_disk_is_handed_to_the_system(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    syncs, synced, is_back = [], threading.Event(), threading.Event()

    def slow_sync(file: int) -> None:
        syncs.append(os.fstat(file).st_size)
        synced.set()
        assert is_back.wait(60)

    monkeypatch.setattr(os, "fdatasync", slow_sync)
    writer = BackgroundWriter(path)
    writer.write(b"first ")
    assert synced.wait(60)
    for piece in (b"second ", b"third"):
        writer.write(piece)
    writer.close(0.0)
    assert path.read_bytes() == b"first second third"
    is_back.set()
    writer.close()
    assert syncs == [6, 18]  # and made durable behind its back


def test_who_has_patience_closes_what_is_durable(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sync, syncs = os.fdatasync, []

    def noted(file: int) -> None:
        syncs.append(os.fstat(file).st_size)
        sync(file)

    monkeypatch.setattr(os, "fdatasync", noted)
    writer = BackgroundWriter(path)
    writer.write(b"all of it")
    writer.close()
    assert path.read_bytes() == b"all of it" and syncs[-1] == 9


def test_a_disk_that_fails_is_told_of(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(file: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", broken)
    writer = BackgroundWriter(path)
    writer.write(b"lost")
    with pytest.raises(OSError, match="Input/output"):
        writer.close(60.0)
