"""Facts of the machine a node runs on: its account, its ports, its memory, its clock."""

from __future__ import annotations

import ctypes
import glob
import grp
import os
import pwd
import re
from dataclasses import dataclass
from pathlib import Path

ACCOUNT = "foveascan"
READ, WRITE, SEARCH = 4, 2, 1
TIME_ERROR = 5  # adjtimex(2): not synchronised
TIMEX_BYTES = 512  # struct timex takes 208 at most; all zero, it asks and changes nothing


@dataclass(frozen=True, slots=True)
class Account:
    """Whoever runs the node. groups : all it is a member of."""

    name: str
    user_id: int
    groups: frozenset[int]

    def may(self, info: os.stat_result, wanted: int) -> bool:
        """Whether it has the rights `wanted` (READ | WRITE | SEARCH) by owner, group and mode."""
        if self.user_id == 0:
            return True
        if info.st_uid == self.user_id:
            granted = info.st_mode >> 6
        elif info.st_gid in self.groups:
            granted = info.st_mode >> 3
        else:
            granted = info.st_mode
        return granted & wanted == wanted


def node_account() -> Account:
    """Who runs the node here: whoever asks; where root asks, the service's account if there is one."""
    user_id = os.geteuid()
    if user_id != 0:
        return Account(user_name(user_id), user_id, frozenset({os.getegid(), *os.getgroups()}))
    try:
        entry = pwd.getpwnam(ACCOUNT)
    except KeyError:
        return Account("root", 0, frozenset({0}))
    return Account(ACCOUNT, entry.pw_uid, frozenset(os.getgrouplist(ACCOUNT, entry.pw_gid)))


def user_name(user_id: int) -> str:
    """A user's name, or its number where it has none."""
    try:
        return pwd.getpwuid(user_id).pw_name
    except KeyError:
        return str(user_id)


def group_name(group_id: int) -> str:
    """A group's name, or its number where it has none."""
    try:
        return grp.getgrgid(group_id).gr_name
    except KeyError:
        return str(group_id)


def serial_ports() -> list[str]:
    """Ports a scanner may be behind, by the names that last where there are any."""
    return sorted(glob.glob("/dev/serial/by-id/*") or glob.glob("/dev/ttyACM*") + glob.glob("/dev/ttyUSB*"))


def available_bytes() -> int:
    """Memory that programs can still have, as the kernel reckons."""
    lines = Path("/proc/meminfo").read_text()
    match = re.search(r"^MemAvailable: +(\d+) kB$", lines, re.MULTILINE)
    return 1024 * int(match[1]) if match else 0


def is_clock_synchronised() -> bool | None:
    """What the kernel says of its clock; None where it may not be asked."""
    state: int = ctypes.CDLL(None).adjtimex(ctypes.create_string_buffer(TIMEX_BYTES))
    return None if state < 0 else state != TIME_ERROR


def written_last_s(*places: Path) -> float:
    """When the newest of some files and folders was written, by the clock of that time; missing ones do not count."""
    return max((place.stat().st_mtime for place in places if place.exists()), default=0.0)
