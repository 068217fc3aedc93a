"""The program of a process that plans looks for a node; node.planners starts it and talks to it.

It takes messages from the one line that it is started with and ends with that line, so never outlives the node. What
many looks need (scans, and what was measured of them) comes once, in parcels that all these processes share; samples it
maps from the library itself, as the node does.
"""

from __future__ import annotations

import os
import signal
import sys
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.reduction import recv_handle
from pathlib import Path
from typing import Any, Literal

from node.bound import Bound
from node.coarse import Coarse
from node.foveate import Planned, Update
from node.library import Scan
from node.scan_folder import About, read_grid
from node.state import ClientState
from node.tray import Laid, Tray, end_of
from node.wanted import Models, Wanted
from protocol.errors import CodecError, LatticeError, LibraryError
from protocol.grid import GridSpec, ImageArray, StepArray

Kind = Literal["scan", "range model", "texture model"]
Key = tuple[Kind, str]  # of which scan, by its id
READY = "ready"
GIVES_WAY = 10  # niceness of what computes for clients: a scanner does not wait


@dataclass(frozen=True, slots=True)
class Parcel:
    """Something that many looks need; the file of its tray comes after it."""

    key: Key
    laid: Laid


@dataclass(frozen=True, slots=True)
class Forget:
    """Nothing that is planned from now on needs these."""

    keys: frozenset[Key]


@dataclass(frozen=True, slots=True)
class Task:
    """A look to plan, and over what: the scan and its models are parcels that have come."""

    scan_id: str
    has_range_model: bool
    has_texture_model: bool
    state: ClientState
    wanted: Wanted


@dataclass(frozen=True, slots=True)
class Ask:
    """Answer a Wanted that lies in the tray. number : by which it may be stopped."""

    number: int
    task: Laid


@dataclass(frozen=True, slots=True)
class Stop:
    """A newer look has come: drop what is planned for the one with this number."""

    number: int


@dataclass(frozen=True, slots=True)
class ScanParts:
    """What a scan is made of, but for its samples, which lie in a folder; fields as of node.library.Scan."""

    folder: Path
    id: str
    spec: GridSpec
    about: About
    coarse: Coarse
    filled: StepArray
    smaller: tuple[ImageArray, ...]

    @classmethod
    def of(cls, scan: Scan, library: Path) -> ScanParts:
        """The parts of a scan of a library."""
        return cls(
            library / scan.id, scan.id, scan.spec, scan.about, scan.coarse, scan.filled, scan.pyramid[1:]
        )

    def whole(self) -> Scan:
        """The scan, its samples mapped. Raises LibraryError, when it was deleted meanwhile."""
        grid = read_grid(self.folder, self.spec)
        return Scan(
            self.id, self.spec, self.about, grid.range_steps, grid.texture, self.coarse, self.filled,
            (grid.texture, *self.smaller), grid.repairs,
        )  # fmt: skip


class PlanningProcess:
    """What runs in the process: takes messages, answers each Ask. tray : for looks and their updates."""

    def __init__(self, line: Connection, tray: Tray) -> None:
        self._line = line
        self._tray = tray
        self._come: deque[object] = deque()  # while a look was planned
        self._has: dict[Key, Any] = {}

    def run(self) -> None:
        """Until the line ends: raises EOFError or OSError then."""
        self._line.send(READY)
        while True:
            match self._come.popleft() if self._come else self._receive():
                case (Parcel(key=key), value):
                    self._keep(key, value)
                case Forget(keys=keys):
                    for key in keys:
                        self._has.pop(key, None)
                case Ask(number=number, task=task):
                    answer = self._answer(self._tray.take(task, copied=False), self._stopped(number))
                    self._line.send(self._tray.lay(answer, end_of(task)))

    def _keep(self, key: Key, value: Any) -> None:
        with suppress(LibraryError):  # it was deleted meanwhile: its looks are answered by None
            self._has[key] = value.whole() if isinstance(value, ScanParts) else value

    def _receive(self) -> object:
        """The next message; a parcel with what it holds."""
        said = self._line.recv()
        return (said, Tray(recv_handle(self._line)).take(said.laid, copied=False)) if isinstance(said, Parcel) else said

    def _answer(self, task: Task, stopped: Callable[[], bool]) -> Planned | LatticeError | CodecError | None:
        scan_id = task.scan_id
        if ("scan", scan_id) not in self._has:
            return None
        models = Models(
            self._has["range model", scan_id] if task.has_range_model else None,
            self._has["texture model", scan_id] if task.has_texture_model else None,
        )
        try:
            update = Bound(0, self._has["scan", scan_id], task.state).plan(task.wanted, models, stopped)
        except (LatticeError, CodecError) as error:
            return error
        assert isinstance(update, Update)  # classic looks are planned elsewhere
        return Planned.of(update.settled())

    def _stopped(self, number: int) -> Callable[[], bool]:
        """Whether a look that is planned is wanted no more; what else comes meanwhile waits."""
        stop = Stop(number)

        def stopped() -> bool:
            while self._line.poll():
                self._come.append(self._receive())
            return stop in self._come

        return stopped


def main() -> None:
    """Serve the node at the other end of a line; the numbers of its file and of the tray's are the arguments."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # they mean the node, and who hears of its end by the line
    with suppress(OSError):  # a sandbox may forbid even that
        os.setpriority(os.PRIO_PROCESS, 0, GIVES_WAY)
    line, tray = (int(argument) for argument in sys.argv[1:])
    with Connection(line) as connection, suppress(EOFError, OSError):
        PlanningProcess(connection, Tray(tray)).run()
