"""`bench fuzz`: parsers and ports under mutated messages, each in a process of its own: a crash is a finding, too."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from protocol.errors import ConfigError
from tests.fuzz.described import attack_described
from tests.fuzz.parsers import targets
from tests.fuzz.ports import PORTS, attack
from tests.fuzz.target import fuzz

ROOT = Path(__file__).parents[2]
GROWN_MB_MAX = 20.0
DESCRIBED = "openapi"
MEMORY = Path("/dev/shm")  # where it is, a file that is written again and again costs no disk
TAIL = 2000
START_S, EACH_S = 600.0, 0.05  # what a target, and a message to it, may take on a machine with other work
END_S = 20.0  # what one that is told to end may take: it ends its node first


def run(names: Sequence[str], count: int, first: int) -> dict[str, Any]:
    """What each target did. names : of targets, none: all.  first : seed. Raises ConfigError for an unknown name."""
    with tempfile.TemporaryDirectory() as folder:
        known = [*(target.name for target in targets(Path(folder))), *PORTS, DESCRIBED]
    for name in names:
        if name not in known:
            raise ConfigError(f"bench: no target {name!r}; there are {', '.join(known)}")
    rows = []
    with _ended_in_order():
        for name in names or known:
            rows.append(_apart(name, count, first))
            print(_line(rows[-1]), file=sys.stderr, flush=True)
    return {"count": count, "seed": first, "rows": rows, "ok": all(row["ok"] for row in rows)}


def _apart(name: str, count: int, first: int) -> dict[str, Any]:
    command = [sys.executable, "-m", "tests.fuzz.campaign", name, str(count), str(first)]
    began_s = time.monotonic()
    patience_s = START_S + count * EACH_S * (10 if name == DESCRIBED else 1)  # its requests are made with more thought
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, errors="replace", cwd=ROOT
    ) as program:
        try:
            out, err = program.communicate(timeout=patience_s)
        except subprocess.TimeoutExpired:
            return {"target": name, "seconds": patience_s, "ok": False, "found": "did not come to an end"}
        finally:
            _end(program)
    row = {"target": name, "seconds": time.monotonic() - began_s}
    if program.returncode:
        return {**row, "ok": False, "found": f"status {program.returncode}: {err[-TAIL:]}"}
    return {**row, **json.loads(out.splitlines()[-1])}


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """SIGTERM, too, leaves every block on its way out: so what was started here is ended here."""
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _end(program: subprocess.Popen[str]) -> None:
    program.terminate()
    try:
        program.communicate(timeout=END_S)
    except subprocess.TimeoutExpired:
        program.kill()


def one(name: str, count: int, first: int) -> dict[str, Any]:
    """One target, here. Raises what a parser raises."""
    if name in PORTS:
        record = attack(name, count, first)
        is_ok = not record["failures"] and record["served"] > 0 and record["grown_mb"] <= GROWN_MB_MAX
        return {"ok": is_ok, "found": record["failures"], **record}
    if name == DESCRIBED:
        record = attack_described(count, first)
        return {"ok": not record["failures"], "found": record["failures"], "asked": record["requests"]}
    with tempfile.TemporaryDirectory(dir=MEMORY if MEMORY.is_dir() else None) as folder:
        [target] = [target for target in targets(Path(folder)) if target.name == name]
        fuzz(target, count, first)
    return {"ok": True, "found": []}


def told(record: dict[str, Any]) -> str:
    """The verdict; a line for each target has been printed already."""
    bad = [row["target"] for row in record["rows"] if not row["ok"]]
    verdict = f"found something in {', '.join(bad)}" if bad else "nothing found"
    return f"{record['count']} messages each to {len(record['rows'])} targets, seed {record['seed']}: {verdict}"


def _line(row: dict[str, Any]) -> str:
    """What a target did, and below it what was found."""
    port = ""
    if "grown_mb" in row:
        port = f", {row['messages']} messages, others served {row['served']} times, memory {row['grown_mb']:+.1f} MB"
    if "asked" in row:
        port = f", {row['asked']} requests"
    found = "" if row["ok"] else f"\n{'':7}{row['found']}"
    return f"{'ok' if row['ok'] else 'FOUND':6} {row['target']:20} {row['seconds']:.0f} s{port}{found}"


if __name__ == "__main__":
    with _ended_in_order():
        print(json.dumps(one(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))))
