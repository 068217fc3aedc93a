"""Processes of their own that plan looks, for when several wait: threads hand one interpreter to each other.

They are started when they are first needed, and again when one has died. Until one is up, and whenever one cannot
answer, `Planners.plan` says None and the caller plans the look itself: no look is lost by a process.
node.planning_process is what runs in them.
"""

from __future__ import annotations

import logging
import math
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.reduction import send_handle
from pathlib import Path
from typing import Any

from node.bound import Bound
from node.foveate import Planned
from node.planning_process import Ask, Forget, Key, Parcel, ScanParts, Stop, Task
from node.state import ClientState
from node.tray import Tray
from node.wanted import Models, Wanted
from protocol.errors import FoveascanError

log = logging.getLogger(__name__)

PARCELS_MAX = 12  # three a scan, of some 30 MB at M
PATIENCE_S = 30.0  # a process that has not answered by then never will
RESTART_S = 2.0  # from one start of a process to the next, at least
REAP_S = 1.0
TOLD_S = 60.0  # so long health tells of a process that died
SUPERSEDED_S = 0.01  # how often a look that is planned is asked whether it is still wanted
PROGRAM = [sys.executable, "-I" if sys.flags.isolated else "-P", "-c", "from node.planning_process import main; main()"]


class Planners:
    """The processes, and what is kept for them. count : how many there may be.  library : the folder of the scans."""

    def __init__(self, count: int, library: Path) -> None:
        self._library = library
        self._lock = threading.Lock()  # held for moments, and while a parcel is made
        self._all = [_Planner() for _ in range(count)]
        self._free = list(self._all)
        self._parcels: OrderedDict[Key, _Sent] = OrderedDict()
        self._is_over = False

    def plan(
        self,
        bound: Bound,
        wanted: Wanted,
        models: Models,
        superseded: Callable[[], bool],
    ) -> Planned | None:
        """The update that answers a look, settled; arguments as for Bound.plan. None: plan it yourself.

        Raises LatticeError or CodecError as that does.
        """
        state = bound.state
        if not isinstance(state, ClientState) or wanted.look.profile == "classic":
            return None
        if (planner := self._claim()) is None:
            return None
        try:
            if not planner.is_up():
                return None
            planner.hand(self._needed(bound, models))
            known = models.range is not None, models.texture is not None
            return planner.answer(Task(bound.scan.id, *known, state, wanted), superseded)
        except (OSError, EOFError) as error:
            if not self._is_over:
                planner.bury(str(error))
            return None
        finally:
            self._give_back(planner)

    def start(self) -> None:
        """Have the processes up when looks wait."""
        with self._lock:
            for planner in () if self._is_over else self._free:
                planner.start()

    def forget(self, scan_id: str) -> None:
        """Have nothing of a scan kept that was deleted."""
        with self._lock:
            for key in [key for key in self._parcels if key[1] == scan_id]:
                del self._parcels[key]
            for planner in self._free:
                planner.tidy(self._parcels.keys())

    @property
    def running(self) -> int:
        """How many processes there are."""
        return sum(planner.is_running for planner in self._all)

    @property
    def died(self) -> int:
        """How many have died."""
        return sum(planner.died for planner in self._all)

    @property
    def trouble(self) -> str:
        """What is to be said of processes that died not long ago, or nothing."""
        return next((planner.trouble for planner in self._all if planner.trouble), "")

    def close(self) -> None:
        """End them all, whatever they do; nothing is planned by them any more."""
        with self._lock:
            self._is_over = True
            for planner in self._all:
                planner.kill()
            for planner in self._free:
                planner.end()

    def _claim(self) -> _Planner | None:
        """A process that nobody else uses: of several, the one that was used last."""
        with self._lock:
            return self._free.pop() if self._free and not self._is_over else None

    def _give_back(self, planner: _Planner) -> None:
        with self._lock:
            if self._is_over:
                planner.end()
            else:
                planner.tidy(self._parcels.keys())
                self._free.append(planner)

    def _needed(self, bound: Bound, models: Models) -> list[_Sent]:
        """The parcels of a look, made when they are first needed."""
        scan = bound.scan
        contents: dict[Key, Callable[[], object]] = {("scan", scan.id): lambda: ScanParts.of(scan, self._library)}
        if models.range is not None:
            contents["range model", scan.id] = lambda: models.range
        if models.texture is not None:
            contents["texture model", scan.id] = lambda: models.texture
        with self._lock:
            for key, content in contents.items():
                if key not in self._parcels:
                    self._parcels[key] = _Sent(key, content())
                self._parcels.move_to_end(key)
            while len(self._parcels) > PARCELS_MAX:
                self._parcels.popitem(last=False)
            return [self._parcels[key] for key in contents]


class _Sent:
    """A parcel, and the tray in which its arrays lie."""

    def __init__(self, key: Key, content: object) -> None:
        self.tray = Tray()
        self.parcel = Parcel(key, self.tray.lay(content))


class _Planner:
    """One process and the line to it. For whoever has claimed it, but for `kill` and what tells of it."""

    def __init__(self) -> None:
        self.died = 0
        self._number = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._line: Connection | None = None
        self._tray: Tray | None = None
        self._is_ready = False
        self._has: set[Key] = set()
        self._started_s = self._died_s = -math.inf
        self._why = ""

    @property
    def is_running(self) -> bool:
        return self._process is not None

    @property
    def trouble(self) -> str:
        ago_s = time.monotonic() - self._died_s
        return f"a process that plans looks died {ago_s:.0f} s ago, {self._why}" if ago_s < TOLD_S else ""

    def start(self) -> None:
        """Start it if it is not there, and was not started a moment ago."""
        if self._line is None and time.monotonic() - self._started_s > RESTART_S:
            self._started_s = time.monotonic()
            with suppress(OSError):  # there is no room for one more: tried again with a later look
                self._start()

    def is_up(self) -> bool:
        """Whether it can be asked; started if it is not there. Raises OSError, EOFError."""
        self.start()
        if not self._is_ready and self._line is not None and self._line.poll():
            self._line.recv()
            self._is_ready = True
        return self._is_ready

    def hand(self, needed: Sequence[_Sent]) -> None:
        """Send the parcels that it does not have. Raises OSError."""
        assert self._line is not None and self._process is not None
        for sent in needed:
            if sent.parcel.key not in self._has:
                self._line.send(sent.parcel)
                send_handle(self._line, sent.tray.file, self._process.pid)
                self._has.add(sent.parcel.key)

    def answer(self, task: Task, superseded: Callable[[], bool]) -> Planned | None:
        """What it makes of a look. Raises what it raises, OSError and EOFError when it died or does not answer."""
        assert self._line is not None and self._tray is not None
        self._number += 1
        until_s, is_told = time.monotonic() + PATIENCE_S, False
        self._line.send(Ask(self._number, self._tray.lay(task)))
        while not self._line.poll(SUPERSEDED_S):
            if time.monotonic() > until_s:
                raise TimeoutError(f"it did not answer within {PATIENCE_S:g} s")
            if not is_told and superseded():
                self._line.send(Stop(self._number))
                is_told = True
        answer: Any = self._tray.take(self._line.recv(), copied=True)
        if isinstance(answer, FoveascanError):
            raise answer
        if not isinstance(answer, Planned):
            return None
        state = replace(answer.state, shapes=task.state.shapes, first_error=task.state.first_error)
        return replace(answer, state=state)  # what never changes is shared with other streams

    def tidy(self, needed: Collection[Key]) -> None:
        """Have it forget all parcels but those that are needed."""
        gone = self._has.difference(needed)
        if gone and self._line is not None:
            self._has -= gone
            with suppress(OSError):  # it has died: whoever asks it next will see
                self._line.send(Forget(frozenset(gone)))

    def bury(self, why: str) -> None:
        """It has died, or is as good as dead."""
        assert self._process is not None
        with suppress(subprocess.TimeoutExpired):  # its line ends a moment earlier
            why = _told(self._process.wait(REAP_S))
        self.end()
        self.died, self._died_s, self._why = self.died + 1, time.monotonic(), why
        log.warning("a process that plans looks has died, %s; looks that wait are planned by threads now", self._why)

    def kill(self) -> None:
        """End the process at once; for any thread."""
        if (process := self._process) is not None:
            process.kill()

    def end(self) -> None:
        """End the process and what belongs to it."""
        self.kill()
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):  # it waits for a disk that hangs, and will go then
                self._process.wait(REAP_S)
        if self._line is not None:
            self._line.close()
        self._process, self._line, self._tray, self._is_ready, self._has = None, None, None, False, set()

    def _start(self) -> None:
        """Raises OSError."""
        self._tray = Tray()
        ours, theirs = socket.socketpair()
        with ours, theirs:
            files = theirs.fileno(), self._tray.file
            self._process = subprocess.Popen(
                [*PROGRAM, *map(str, files)], pass_fds=files, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                start_new_session=True,
            )  # fmt: skip
            self._line = Connection(ours.detach())


def _told(ended: int) -> str:
    """How a process ended, by what subprocess says of it."""
    return f"by signal {signal.Signals(-ended).name}" if ended < 0 else f"with status {ended}"
