"""SIGKILL at random moments of everything that writes: nothing complete is lost, nothing partial stays, all is told."""

import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from node.assemble import Assembly
from node.library import About, Library, content_id
from node.library_folder import OWN, SWEEPS
from node.resume import publish_complete
from node.sealing import seal
from tests.node.sealed_places import KEY, open_at, require_mounts
from tests.system.power_cut_worker import grid

ROUNDS_OF_EACH, ROUNDS_SEALED = 6, 2
PHASES = ["sweep", "add", "annotate", "delete", "restore"]
WORKER = Path(__file__).with_name("power_cut_worker.py")


@dataclass
class Promises:
    """What the library must hold, by the diary of those who were killed."""

    kept: set[str] = field(default_factory=set)
    doubtful: set[str] = field(default_factory=set)
    said: Counter[str] = field(default_factory=Counter)

    def read(self, diary: str) -> None:
        for line in diary.splitlines():
            match line.split():
                case ["adding" | "delivering", seed]:
                    self.doubtful.add(self._id(int(seed)))
                case ["added", scan_id, _]:
                    self.kept.add(scan_id)
                case ["deleting", scan_id]:
                    self.kept.discard(scan_id)
                    self.doubtful.add(scan_id)
                case ["deleted", scan_id]:
                    self.kept.discard(scan_id)
                    self.doubtful.discard(scan_id)
                    del self.said[scan_id]
                case ["restoring", scan_id, revision]:
                    self.doubtful.add(scan_id)
                    self.said[scan_id] = int(revision)
                case ["said", scan_id, revision]:
                    self.said[scan_id] = int(revision)

    def _id(self, seed: int) -> str:
        return content_id(grid(seed))


@pytest.fixture
def worker() -> Iterator[subprocess.Popen[str]]:
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    command, pipe = [sys.executable, str(WORKER)], subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


def test_nothing_complete_is_lost_and_nothing_partial_stays(worker: subprocess.Popen[str], tmp_path: Path) -> None:
    work_and_cut(worker, tmp_path / "library", tmp_path, ROUNDS_OF_EACH)


def test_a_sealed_library_loses_no_more(worker: subprocess.Popen[str], tmp_path: Path) -> None:
    require_mounts()
    (tmp_path / "library").mkdir()
    seal(tmp_path / "library", KEY, lambda size_bytes: None)
    with open_at(tmp_path / "library"):
        work_and_cut(worker, tmp_path / "library", tmp_path, ROUNDS_SEALED)


def work_and_cut(worker: subprocess.Popen[str], folder: Path, diaries: Path, rounds: int) -> None:
    """Cut each kind of work so often, and look each time at what is left."""
    rng, promises, told = random.Random(36), Promises(), Counter[str]()
    library = Library(folder)
    fill(library, 0)
    library.close()
    promises.kept = {scan.id for scan in library.scans()}
    for number in range(rounds * len(PHASES)):
        phase = PHASES[number % len(PHASES)]
        diary = diaries / f"diary-{number}"
        cut(worker, phase, 1000 * (1 + number), folder, diary, rng.uniform(0.0, 0.15))
        promises.read(diary.read_text())
        left = {name.split("-")[0] for name in os.listdir(folder) if name.startswith(".")}
        journals = os.listdir(folder / SWEEPS)
        library = Library(folder)
        told.update(left, journals=len(journals))
        assert len(library.found) >= len(left) + len([name for name in journals if name.endswith(".sweep")])
        check_sweeps(library, 1000 * (1 + number), promises)
        check_scans(library, promises)
        fill(library, 1000 * (1 + number) + 500)
        library.close()
        promises.doubtful = set()
        promises.kept = {scan.id for scan in library.scans()}
    assert sum(told.values()) >= rounds, f"hardly a cut hit anything: {told}"


def fill(library: Library, seed: int) -> None:
    """Leave the next one something to work on."""
    while len(library.scans()) < 3:
        seed += 1
        library.add(grid(seed), About(1e9))


def cut(worker: subprocess.Popen[str], phase: str, seed: int, folder: Path, diary: Path, after_s: float) -> None:
    """Have a process work in the library, and kill it some time after it has begun to."""
    assert worker.stdin is not None and worker.stdout is not None
    diary.touch()
    worker.stdin.write(f"{phase} {seed} {folder} {diary}\n")
    worker.stdin.flush()
    process = int(worker.stdout.readline())
    end_s = time.monotonic() + 20
    while not (diary.stat().st_size or (phase == "sweep" and os.listdir(folder / SWEEPS))):
        assert time.monotonic() < end_s, f"{phase}: nothing happens"
        time.sleep(0.001)
    time.sleep(after_s)
    os.kill(process, signal.SIGKILL)
    assert worker.stdout.readline() == "ended\n"


def check_sweeps(library: Library, seed: int, promises: Promises) -> None:
    """Cut sweeps hold nothing but what the scanner saw, and those that are complete become scans now."""
    truth = grid(seed)
    for sweep in library.sweeps.interrupted():
        for column in library.sweeps.columns(sweep.id):
            whole = truth.range_steps if column.SAMPLE_BYTES == 2 else truth.texture
            seen = whole[column.row0 : column.row0 + column.rows, column.column]
            assert np.array_equal(seen, column.samples)

    def deliver(assembly: Assembly) -> None:
        promises.kept.add(library.add(assembly.grid, About(1e9)).id)

    publish_complete(library.sweeps, deliver)
    for sweep in library.sweeps.interrupted():
        assert not sweep.is_complete
        library.sweeps.delete(sweep.id)


def check_scans(library: Library, promises: Promises) -> None:
    listed = {scan.id for scan in library.scans()}
    assert promises.kept - listed == set() and listed - promises.kept - promises.doubtful == set()
    assert library.problems == ()
    assert [problem for _, problem in library.verify() if problem is not None] == []
    assert set(os.listdir(library.folder)) - OWN == listed
    for scan_id in listed:
        files = set(os.listdir(library.folder / scan_id))
        assert {"scan.json", "range.npy", "texture.npy"} <= files
        assert files <= {"scan.json", "range.npy", "texture.npy", "repairs.npy", "sidecar.json"}
        sidecar = library.sidecar(scan_id)
        assert sidecar.revision in (promises.said[scan_id], promises.said[scan_id] + 1)
        assert sidecar.notes == (f"note {sidecar.revision}" if sidecar.revision else "")
        promises.said[scan_id] = sidecar.revision
