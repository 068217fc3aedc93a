"""A process for test_power_cut to kill: it forks at every line of its input, and the fork works until it is killed.

Line: PHASE SEED LIBRARY DIARY. Answer: the number of the fork's process, and another line when it ended. What the fork
has been promised by the library it writes into the diary, a line each, before it goes on; so the test knows what must
be there after the cut.
"""

import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from drivers.scanner import ScannerConfig
from node.archive import backup
from node.assemble import Assembly
from node.capture import Capture
from node.library import About, Library
from node.sidecar import Changes
from protocol.grid import Grid, GridSpec
from simulators.carriers import MemoryPort
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable

SPEC = GridSpec(width=96, height=64, texture_width=256, texture_height=192, step_mm=0.05, pitch_mm=1.0)


def grid(seed: int) -> Grid:
    """The scan of a seed."""
    rng = np.random.default_rng(seed)
    range_steps = rng.integers(0, 60000, (SPEC.height, SPEC.width)).astype(np.uint16)
    texture = rng.integers(0, 256, (SPEC.texture_height, SPEC.texture_width, 3)).astype(np.uint8)
    return Grid(SPEC, range_steps, texture)


def main() -> None:
    for line in sys.stdin:
        phase, seed, library, diary = line.split()
        worker = os.fork()
        if worker == 0:
            work(phase, int(seed), Path(library), Path(diary))
        print(worker, flush=True)
        os.waitpid(worker, 0)
        print("ended", flush=True)


def work(phase: str, seed: int, folder: Path, diary: Path) -> None:
    """Do one kind of thing for ever."""
    try:
        with open(diary, "a", buffering=1) as file:
            library = Library(folder)

            def note(*words: object) -> None:
                print(*words, file=file)

            PHASES[phase](library, seed, note)
    finally:
        os._exit(1)  # never back into the loop that forks


Note = Callable[..., None]


def add(library: Library, seed: int, note: Note) -> None:
    while True:
        seed += 1
        note("adding", seed)
        note("added", library.add(grid(seed), About(time.time(), "import")).id, seed)


def delete(library: Library, seed: int, note: Note) -> None:
    while True:
        scans = library.scans()
        if len(scans) < 2:
            seed += 1
            note("adding", seed)
            note("added", library.add(grid(seed), About(0.0)).id, seed)
            continue
        note("deleting", scans[-1].id)
        library.delete(scans[-1].id)
        note("deleted", scans[-1].id)


def annotate(library: Library, seed: int, note: Note) -> None:
    scan_id = library.scans()[0].id
    while True:
        revision = library.sidecar(scan_id).revision
        if revision >= 500:  # a long history makes every change slow
            note("deleting", scan_id)
            library.delete(scan_id)
            note("deleted", scan_id)
            scan_id = library.scans()[0].id
            continue
        now = library.annotate(scan_id, Changes(notes=f"note {revision + 1}"), "worker")
        note("said", scan_id, now.revision)


def restore(library: Library, seed: int, note: Note) -> None:
    path = library.folder.parent / "backup.tar"
    path.unlink(missing_ok=True)
    ids = [scan.id for scan in library.scans()][:4]
    revisions = {scan_id: library.sidecar(scan_id).revision for scan_id in ids}
    backup(library.folder, ids, path)
    while True:
        for scan_id in ids:
            note("deleting", scan_id)
            library.delete(scan_id)
            note("deleted", scan_id)
        for scan_id in ids:
            note("restoring", scan_id, revisions[scan_id])
        library.restore(path)
        for scan_id in ids:
            note("added", scan_id, -1)


def sweep(library: Library, seed: int, note: Note) -> None:
    ended = threading.Event()

    def deliver(assembly: Assembly) -> None:
        note("delivering", seed)
        note("added", library.add(assembly.grid, About(time.time())).id, seed)
        ended.set()

    scanner = SimulatedScanner(Turntable(Specimen("noise", grid(seed)), turn_s=0.05), boot_id=1 + seed)
    config = ScannerConfig(progress_s=0.005)
    capture = Capture(lambda: MemoryPort(scanner), config, deliver, sweeps=library.sweeps)
    capture.start()
    while not capture.request_sweep():
        time.sleep(0.001)
    while True:
        ended.wait()
        ended.clear()
        while not capture.request_sweep():
            time.sleep(0.001)


PHASES = {"add": add, "delete": delete, "annotate": annotate, "restore": restore, "sweep": sweep}

if __name__ == "__main__":
    main()
