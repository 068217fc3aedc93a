"""`bench fuzz`: parsers and ports under mutated messages, each in a process of its own: a crash is a finding, too."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from tests.fuzz.parsers import fuzz, targets
from tests.fuzz.ports import PORTS, attack

ROOT = Path(__file__).parents[2]
GROWN_MB_MAX = 20.0
TAIL = 2000


def run(names: Sequence[str], count: int, first: int) -> dict[str, Any]:
    """What each target did. names : of targets, none: all.  first : seed. Raises ConfigError for an unknown name."""
    with tempfile.TemporaryDirectory() as folder:
        known = [*(target.name for target in targets(Path(folder))), *PORTS]
    for name in names:
        if name not in known:
            raise ConfigError(f"bench: no target {name!r}; there are {', '.join(known)}")
    rows = [_apart(name, count, first) for name in names or known]
    return {"count": count, "seed": first, "rows": rows, "ok": all(row["ok"] for row in rows)}


def _apart(name: str, count: int, first: int) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.fuzz.campaign", name, str(count), str(first)]
    began_s = time.monotonic()
    done = subprocess.run(command, capture_output=True, text=True, errors="replace", cwd=ROOT)
    row = {"target": name, "seconds": time.monotonic() - began_s}
    if done.returncode:
        return {**row, "ok": False, "found": f"status {done.returncode}: {done.stderr[-TAIL:]}"}
    return {**row, **json.loads(done.stdout.splitlines()[-1])}


def one(name: str, count: int, first: int) -> dict[str, Any]:
    """One target, here. Raises what a parser raises."""
    if name in PORTS:
        record = attack(name, count, first)
        is_ok = not record["failures"] and record["served"] > 0 and record["grown_mb"] <= GROWN_MB_MAX
        return {"ok": is_ok, "found": record["failures"], **record}
    with tempfile.TemporaryDirectory() as folder:
        [target] = [target for target in targets(Path(folder)) if target.name == name]
        fuzz(target, count, first)
    return {"ok": True, "found": []}


def told(record: dict[str, Any]) -> str:
    """A line for each target, and below it what was found."""
    lines = []
    for row in record["rows"]:
        port = ""
        if "grown_mb" in row:
            port = f", {row['served']} others served meanwhile, memory {row['grown_mb']:+.1f} MB"
        lines.append(f"{'ok' if row['ok'] else 'FOUND':6} {row['target']:20} {row['seconds']:.0f} s{port}")
        if not row["ok"]:
            lines.append(f"{'':7}{row['found']}")
    return "\n".join(lines)


if __name__ == "__main__":
    print(json.dumps(one(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
