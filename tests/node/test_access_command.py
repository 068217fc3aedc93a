"""`foveascan pair`, `access` and `join` beside a real node."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from foveascan import PROGRAM, started
from node.audit_command import note_at_console
from node.config import Config
from node.config import Library as LibrarySettings
from node.library import About, Library
from tests.node.scans import make_grid


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("home")


@pytest.fixture(scope="module")
def url(home: Path) -> Iterator[str]:
    library = Library(home / "library")
    library.add(make_grid(40, 24), About(0.0))
    library.close()
    serve = ["serve", "--library", str(home / "library"), "--listen", "127.0.0.1:0", "--name", "paired node", "--json"]
    with started(*serve) as (_, ready):
        yield ready["url"]


def run(home: Path, *arguments: str) -> tuple[int, dict[str, object], str]:
    """Status, the JSON printed, and what was said on standard error."""
    environ = os.environ | {"XDG_CONFIG_HOME": str(home / "config")}
    ran = subprocess.run([*PROGRAM, *arguments, "--json"], env=environ, capture_output=True, text=True, timeout=60)
    said = [json.loads(line) for line in ran.stdout.splitlines()]
    return ran.returncode, said[0] if said else {}, ran.stderr


def test_a_client_is_let_in_looks_and_is_put_out(home: Path, url: str) -> None:
    library = ("--library", str(home / "library"))
    status, offered, _ = run(home, "pair", "--name", "room 2", "--role", "operate", *library)
    assert status == 0 and url.startswith("https://")
    status, joined, _ = run(home, "join", str(offered["code"]), "--node", url)
    assert (status, joined["name"], joined["role"]) == (0, "room 2", "operate")
    status, _, trouble = run(home, "join", str(offered["code"]), "--node", url)
    assert (status, "used" in trouble) == (1, True)
    assert run(home, "look", "--node", url)[0] == 0
    _, listed, _ = run(home, "access", "list", *library)
    assert [(one["name"], one["role"]) for one in listed["tokens"]] == [("room 2", "operate")]  # type: ignore[attr-defined]
    assert run(home, "access", "revoke", "room 2", *library)[:2] == (0, {"revoked": "room 2"})
    status, _, trouble = run(home, "look", "--node", url)
    assert (status, "foveascan join" in trouble) == (1, True)
    assert run(home, "access", "revoke", "room 2", *library)[0] == 1


def test_the_node_is_found_with_its_fingerprint(home: Path, url: str) -> None:
    _, offered, _ = run(home, "pair", "--name", "another", "--library", str(home / "library"))
    _, found, _ = run(home, "discover", "--name", "paired node")
    assert (found["url"], found["tls"], found["fingerprint"]) == (url, True, offered["fingerprint"])


def test_a_code_that_takes_the_place_of_another_says_so(home: Path, url: str) -> None:
    again = ("pair", "--name", "room 3", "--library", str(home / "library"))
    assert run(home, *again)[2] == ""
    assert run(home, *again)[2] == "foveascan: the code offered to 'room 3' before is void now\n"


def test_whoever_reads_the_audit_log_may_go_away(tmp_path: Path) -> None:
    note_at_console(Config(library=LibrarySettings(str(tmp_path))), "code offered", what="a: view")
    environ = os.environ | {"XDG_CONFIG_HOME": str(tmp_path), "PYTHONUNBUFFERED": "1"}
    read_end, write_end = os.pipe()
    os.close(read_end)
    audit = [*PROGRAM, "access", "audit", "--library", str(tmp_path)]
    done = subprocess.run(audit, env=environ, stdout=write_end, stderr=subprocess.PIPE, timeout=60)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, b"")


def test_pairing_needs_a_node_that_has_run(tmp_path: Path) -> None:
    status, _, trouble = run(tmp_path, "pair", "--name", "a", "--library", str(tmp_path / "nowhere"))
    assert (status, "start the node once" in trouble) == (1, True)
    status, _, trouble = run(tmp_path, "pair", "--name", "a", "--library", str(tmp_path))
    assert (status, "without --insecure" in trouble) == (1, True)
