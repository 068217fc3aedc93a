"""`foveascan access audit`, and what other commands on the node's machine write to that log."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from node.audit import Entry, Event
    from node.config import Config

SINCE_HELP = "not older than this, such as 2026-11 or 2026-11-22 (UTC)"


def add_audit_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """Offer `audit`."""
    audit = actions.add_parser("audit", help="who saw, changed, exported or deleted which scan, newest first")
    audit.add_argument("--since", type=_since, default="", metavar="DATE", help=SINCE_HELP)
    audit.add_argument("--scan", default="", metavar="ID", help="of this scan: its id, or the beginning of it")
    audit.add_argument("--by", default="", metavar="NAME", help="of this login alone")
    audit.add_argument("--refused", action="store_true", help="who was turned away instead")
    audit.add_argument("--limit", type=_limit, default=100, metavar="N", help="as many at most (100); 0: all")
    return audit


def print_audit(config: Config, library: Path, args: argparse.Namespace) -> int:
    """Print what was asked for. Raises AccessError."""
    import msgspec

    from node.audit import done_trail, read_trail, refused_trail

    trail = refused_trail(library) if args.refused else done_trail(library, config.audit.bytes_max)
    found = _readable(read_trail(trail, since=args.since, scan=args.scan, by=args.by))
    for one in islice(found, args.limit or None):
        print(msgspec.json.encode(one).decode() if args.json else _line(one))
    return 0


def note_at_console(config: Config, event: Event, scans: Sequence[str] = ("",), what: str = "") -> None:
    """Write down what a command has done; where that cannot be, say so: it is done all the same."""
    import msgspec

    from node.audit import Who, done_trail, entry
    from node.machine import user_name

    who = Who(user_name(os.getuid()), "console")  # whoever it is: $USER is what somebody says
    lines = [msgspec.json.encode(entry(event, who, scan=scan, what=what)) for scan in scans]
    try:
        done_trail(config.library.path, config.audit.bytes_max).append(lines)
    except OSError as error:
        print(f"foveascan: this is not in the audit log: {error.strerror or error}", file=sys.stderr)


def _readable(entries: Iterator[Entry]) -> Iterator[Entry]:
    """The same entries. Raises AccessError where they cannot be read."""
    from protocol.errors import AccessError

    try:
        yield from entries
    except OSError as error:
        raise AccessError(f"the audit log cannot be read: {error.strerror}; ask as root") from error


def _line(one: Entry) -> str:
    from protocol.printable import printable

    left_out = f"({one.left_out} before this are missing)" if one.left_out else ""
    who = " ".join(filter(None, (one.by, one.role and f"({one.role})", one.address and f"at {one.address}")))
    parts = one.at, f"{one.event:14}", one.scan or one.sweep, who, one.what, left_out
    return printable("  ".join(filter(None, parts)))


def _since(text: str) -> str:
    from node.audit import begins_a_time

    if not begins_a_time(text):
        raise argparse.ArgumentTypeError(f"expected a date such as 2026-11 or 2026-11-22, got {text!r}")
    return text


def _limit(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) <= 9):
        raise argparse.ArgumentTypeError(f"expected a number of entries, got {text!r}")
    return int(text)
