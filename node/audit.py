"""Who saw, changed, exported or deleted which scan, who came in and who was refused: kept with the library.

Nobody waits for the disk: entries go to a thread that writes what has gathered, and makes it durable, at once. Where it
cannot write (a full disk), the node goes on: a clinic must be able to look, and to delete what fills the disk. Entries
wait then, up to WAITING_MAX, the node calls itself degraded, and what had to be left out is counted in the next entry.
Refusals have files of their own, so that no stranger can push out what those did who were let in.

    <library>/audit/audit.jsonl     one JSON object a line, see Entry; node.trail says how old ones are kept
                    refused.jsonl
"""

from __future__ import annotations

import logging
import re
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Literal

import msgspec

from node.trail import Trail

log = logging.getLogger(__name__)

FOLDER = "audit"
REFUSED_BYTES_MAX = 8 << 20
WAITING_MAX = 10_000
BATCH = 500
RETRY_S = 5.0
SEEN_AGAIN_S = 600.0  # looking at the same scan again within so long is no new entry
SEEN_MAX = 4096
REFUSALS, REFUSALS_S = 100, 10.0  # so many are written down within so long, the others are counted
WHAT_MAX = 300
TIME = "0000-00-00T00:00:00.000Z"
BEGINS_A_TIME = "^" + "".join(f"([{'0-9' if char == '0' else char}]" for char in TIME) + ")?" * len(TIME) + "$"

Event = Literal[
    "started", "stopped", "listed", "watched", "opened", "seen", "read", "exported", "imported", "scanned", "derived",
    "changed", "verified", "deleted", "sweep asked", "sweep resumed", "sweep exported", "sweep deleted", "expired",
    "axis calibrated", "axis forgotten", "backed up", "restored", "code offered", "paired", "revoked", "codes voided",
    "refused",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Who:
    """Whoever does something: the name of a login, its role, and the address it comes from."""

    name: str
    role: str = ""
    address: str = ""


NODE = Who("the node")


class Entry(msgspec.Struct, frozen=True, omit_defaults=True):
    """A line of the audit log. at : UTC, as in RFC 3339.  what : how, or which fields; never what they say.

    scan, sweep : the id.  left_out : how many entries before this one are missing.
    """

    at: str
    event: str
    by: str
    role: str = ""
    address: str = ""
    scan: str = ""
    sweep: str = ""
    what: str = ""
    left_out: int = 0


class Audit:
    """The audit log of a running node. library : its folder.  bytes_max : of what those did who were let in.

    Everything may be called in any thread and returns at once, but close.
    """

    def __init__(self, library: Path, bytes_max: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._done = _Writer(done_trail(library, bytes_max))
        self._refused = _Writer(refused_trail(library))
        self._clock = clock
        self._lock = threading.Lock()
        self._seen: OrderedDict[tuple[Event, Who, str], float] = OrderedDict()
        self._refusals: deque[float] = deque(maxlen=REFUSALS)

    def note(self, event: Event, who: Who, *, scan: str = "", sweep: str = "", what: str = "") -> None:
        """Write down that somebody has done something."""
        self._done.add(entry(event, who, scan=scan, sweep=sweep, what=what))

    def note_seen(self, event: Event, who: Who, scan: str = "") -> None:
        """The same of a look that comes again and again: once in SEEN_AGAIN_S for the same somebody and scan."""
        now_s, key = self._clock(), (event, who, scan)
        with self._lock:
            if now_s - self._seen.get(key, -SEEN_AGAIN_S) < SEEN_AGAIN_S:
                return
            self._seen[key] = now_s
            self._seen.move_to_end(key)
            while len(self._seen) > SEEN_MAX:
                self._seen.popitem(last=False)
        self.note(event, who, scan=scan)

    def refuse(self, who: Who, what: str) -> None:
        """Write down that somebody was not let in, or not to something."""
        now_s = self._clock()
        with self._lock:
            is_flood = len(self._refusals) == REFUSALS and now_s - self._refusals[0] < REFUSALS_S
            if not is_flood:
                self._refusals.append(now_s)
        if is_flood:
            self._refused.leave_out()
        else:
            self._refused.add(entry("refused", who, what=what))

    @property
    def trouble(self) -> str:
        """Why entries cannot be written now; "" when they can."""
        return self._done.trouble or self._refused.trouble

    @property
    def waiting(self) -> int:
        """How many entries are not written yet."""
        return self._done.waiting + self._refused.waiting

    def close(self, timeout_s: float = 3.0) -> None:
        """Write what waits, and end. timeout_s : for both histories to be safe from a power cut, too."""
        until_s = time.monotonic() + timeout_s
        if self._refused.left_out:
            self._refused.add(entry("stopped", NODE))  # which says how many they were
        for writer in (self._done, self._refused):
            writer.end()
        for writer in (self._done, self._refused):
            writer.wait(until_s - time.monotonic())


class _Writer:
    """Entries on their way into one trail, by a thread of their own that starts with the first of them."""

    def __init__(self, trail: Trail) -> None:
        self._trail = trail
        self._news = threading.Condition()
        self._entries: deque[Entry] = deque()
        self._begun = 0  # of these entries, the first so many are being written
        self.left_out = 0
        self._is_closing = False
        self._thread: threading.Thread | None = None
        self.trouble = ""

    @property
    def waiting(self) -> int:
        return len(self._entries)

    def add(self, one: Entry) -> None:
        with self._news:
            if len(self._entries) >= WAITING_MAX:
                self.left_out += 1
                return
            if self.left_out:
                one, self.left_out = msgspec.structs.replace(one, left_out=self.left_out), 0
            self._entries.append(one)
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="audit", daemon=True)
                self._thread.start()
            self._news.notify()

    def leave_out(self) -> None:
        with self._news:
            self.left_out += 1

    def end(self) -> None:
        with self._news:
            self._is_closing = True
            self._news.notify()

    def wait(self, timeout_s: float) -> None:
        if self._thread is not None:
            self._thread.join(max(timeout_s, 0.0))
            if self._thread.is_alive():
                self._hurry()
                return
        if self._entries or self.left_out:
            why = self.trouble or "too many at once"
            log.error("audit: %d entries are lost: %s", len(self._entries) + self.left_out, why)

    def _hurry(self) -> None:
        """Write what the thread, which waits for the disk, has not begun."""
        with self._news:
            rest = [self._entries.pop() for _ in range(len(self._entries) - self._begun)][::-1]
            begun = self._begun
        try:
            self._trail.append_at_once(_lines(rest))
        except OSError as error:
            log.error("audit: %d entries are lost: %s", len(rest), error.strerror or error)
        log.warning("audit: the disk is slow: a power cut now would lose %d entries", begun + len(rest))

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._entries or self._is_closing)
                batch = list(islice(self._entries, BATCH))
                self._begun = len(batch)
            if not batch:
                return
            is_written = self._write(batch)
            with self._news:
                self._begun = 0
                if is_written:
                    for _ in batch:
                        self._entries.popleft()
                elif self._is_closing:
                    return
                else:
                    self._news.wait_for(lambda: self._is_closing, RETRY_S)

    def _write(self, batch: list[Entry]) -> bool:
        try:
            self._trail.append(_lines(batch))
        except OSError as error:
            if not self.trouble:
                log.error("audit: entries cannot be written and wait: %s", error.strerror or error)
            self.trouble = error.strerror or str(error)
            return False
        if self.trouble:
            log.warning("audit: entries are written again")
            self.trouble = ""
        return True


def _lines(entries: Sequence[Entry]) -> list[bytes]:
    return [msgspec.json.encode(one) for one in entries]


def entry(event: Event, who: Who, *, scan: str = "", sweep: str = "", what: str = "") -> Entry:
    """An entry of now."""
    at = datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    return Entry(at, event, who.name[:100], who.role, who.address[:100], scan, sweep, what[:WHAT_MAX])


def done_trail(library: Path, bytes_max: int) -> Trail:
    """Where what those did who were let in is kept."""
    return Trail(library / FOLDER, "audit", bytes_max)


def refused_trail(library: Path) -> Trail:
    """Where refusals are kept."""
    return Trail(library / FOLDER, "refused", REFUSED_BYTES_MAX)


def begins_a_time(text: str) -> bool:
    """Whether an `Entry.at` could begin so."""
    return re.fullmatch(BEGINS_A_TIME, text) is not None


def read_trail(trail: Trail, *, since: str = "", scan: str = "", by: str = "") -> Iterator[Entry]:
    """Entries, the newest first; a line that is torn is passed over. Raises OSError.

    since : a beginning of `Entry.at`, of the oldest one wanted.  scan : the beginning of an id.  by : a login's name.
    """
    for line in trail.newest_first():
        try:
            one = msgspec.json.decode(line, type=Entry)
        except (msgspec.DecodeError, UnicodeError):
            continue
        if one.at >= since and one.scan.startswith(scan) and by in ("", one.by):
            yield one

