import argparse
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from node.audit import done_trail, read_trail
from node.library import About, Library
from node.library_command import add_library_command
from node.machine import user_name
from node.sidecar import Changes
from protocol.errors import LibraryError
from protocol.grid import Grid, GridSpec

SPEC = GridSpec(16, 8, 32, 16, step_mm=0.05, pitch_mm=1.0)
SAMPLES = np.ones((8, 16), np.uint16), np.zeros((16, 32, 3), np.uint8)


def run(*arguments: object) -> int:
    parser = argparse.ArgumentParser()
    add_library_command(parser.add_subparsers())
    args = parser.parse_args(["library", *map(str, arguments)])
    status: int = args.run(args)
    return status


def said(capsys: pytest.CaptureFixture[str]) -> Any:
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A library of two scans: one named knee, and the latest."""
    folder = tmp_path / "library"
    library = Library(folder)
    for seed in range(2):
        rng = np.random.default_rng(seed)
        texture = rng.integers(0, 256, (16, 32, 3)).astype(np.uint8)
        scan = library.add(Grid(SPEC, np.ones((8, 16), np.uint16), texture), About(1e9, name=f"scan {seed}"))
        if seed == 0:
            library.annotate(scan.id, Changes(name="knee", subject="P-17"), "ana")
    library.close()
    return folder


def ids(folder: Path, capsys: pytest.CaptureFixture[str]) -> list[str]:
    run("list", "--library", folder, "--json")
    return [scan["id"] for scan in said(capsys)["scans"]]


def test_list_shows_scans_newest_first_and_what_else_is_there(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "holiday").mkdir()
    assert run("list", "--library", folder) == 0
    first, second, third = capsys.readouterr().out.splitlines()
    assert first.endswith("16 x 8 + 32 x 16  scan 1") and second.endswith("knee")
    assert third == "holiday: not a scan; left alone"


def test_list_tells_closed_objects_from_others(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library = Library(folder)
    library.add(Grid(replace(SPEC, geometry="sphere"), *SAMPLES), About(1e9, name="stone"))
    library.close()
    run("list", "--library", folder)
    first, second, _ = capsys.readouterr().out.splitlines()
    assert first.endswith("16 x 8 + 32 x 16 sphere  stone") and "sphere" not in second


def test_a_name_cannot_steer_the_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    library = Library(folder)
    library.rename(library.scans()[0].id, "red \x1b[31m\nline", "ana")
    library.close()
    assert run("list", "--library", folder) == 0
    assert capsys.readouterr().out.splitlines()[0].endswith(r"red \x1b[31m\nline")


def test_list_works_while_a_node_runs_and_changes_do_not(folder: Path) -> None:
    library = Library(folder)
    assert run("list", "--library", folder) == 0
    with pytest.raises(LibraryError, match="in use by process"):
        run("rename", "latest", "x", "--library", folder)
    with pytest.raises(LibraryError, match="in use by process"):  # and not, that nobody can be asked
        run("delete", "latest", "--library", folder)
    library.close()


def test_a_library_that_is_not_there_is_not_made_by_looking(tmp_path: Path) -> None:
    with pytest.raises(LibraryError, match="No such file"):
        run("list", "--library", tmp_path / "none")
    with pytest.raises(OSError, match="No such file"):
        run("restore", tmp_path / "none.tar", "--library", tmp_path / "none")
    assert list(tmp_path.iterdir()) == []


def test_without_a_library_the_option_that_names_one_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for arguments in (("list",), ("verify",), ("rename", "latest", "x")):
        with pytest.raises(LibraryError, match=f"no library in {tmp_path}.*--library"):
            run(*arguments)


def test_show_tells_what_is_said(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, knee = ids(folder, capsys)
    run("show", knee[:8], "--library", folder, "--json")
    shown = said(capsys)
    assert (shown["id"], shown["sidecar"]["subject"], shown["sidecar"]["history"][0]["by"]) == (knee, "P-17", "ana")


def test_rename_names_the_scan(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("rename", "latest", "elbow", "--library", folder)
    run("list", "--library", folder)
    assert "elbow" in capsys.readouterr().out
    for name in ("x" * 201, "", " "):
        with pytest.raises(LibraryError, match="^name: "):
            run("rename", "latest", name, "--library", folder)


@pytest.mark.parametrize("user_id", [os.getuid(), 987654321])
def test_who_did_it_is_the_account_whatever_the_environment_says(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, user_id: int
) -> None:
    for name in ("LOGNAME", "USER"):
        monkeypatch.setenv(name, "the doctor")
    monkeypatch.setattr(os, "getuid", lambda: user_id)
    run("rename", "latest", "elbow", "--library", folder)
    capsys.readouterr()
    run("show", "latest", "--library", folder, "--json")
    [noted] = read_trail(done_trail(folder, 1 << 20))
    assert noted.by == said(capsys)["sidecar"]["history"][-1]["by"] == user_name(user_id)


def test_list_and_rename_tell_ids_that_every_other_command_takes(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    latest, knee = ids(folder, capsys)
    run("list", "--library", folder)
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == [latest, knee]
    run("rename", "latest", "left\x07 elbow", "--library", folder)
    assert capsys.readouterr().out == f'{latest} is called "left\\x07 elbow" now\n'

@pytest.mark.parametrize("name", ["", "zz", "0" * 32, "../library"])
def test_a_scan_nobody_knows_is_refused(folder: Path, name: str) -> None:
    with pytest.raises(LibraryError, match="no scan begins with"):
        run("show", name, "--library", folder)


def test_delete_asks_first(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    latest, knee = ids(folder, capsys)
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    with pytest.raises(LibraryError, match="--yes"):
        run("delete", latest, "--library", folder)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    for answer, left in (("n", [latest, knee]), ("y", [knee])):
        monkeypatch.setattr("builtins.input", lambda question, answer=answer: answer)
        assert run("delete", latest, "--library", folder) == (answer == "n")
        capsys.readouterr()
        assert ids(folder, capsys) == left
    assert run("delete", knee, "--yes", "--library", folder) == 0


def test_verify_finds_a_rotten_byte(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("verify", "--library", folder) == 0
    assert capsys.readouterr().out == "2 scans checked, 0 problems\n"
    latest, knee = ids(folder, capsys)
    path = folder / knee / "range.npy"
    path.write_bytes(path.read_bytes()[:-1] + b"\x09")
    assert run("verify", "--library", folder, "--json") == 1
    ((name, reason),) = said(capsys)["problems"]
    assert name == knee and "not what they were" in reason
    capsys.readouterr()
    assert run("verify", latest, "--library", folder) == 0
    assert capsys.readouterr().out == "1 scan checked, 0 problems\n"


def test_a_backup_is_restored_elsewhere_with_the_same_ids(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("backup", tmp_path / "all.tar", "--library", folder, "--json")
    assert said(capsys)["scans"] == 2
    run("restore", tmp_path / "all.tar", "--library", tmp_path / "other", "--json")
    assert len(said(capsys)["added"]) == 2
    assert ids(tmp_path / "other", capsys) == ids(folder, capsys)
    run("backup", tmp_path / "one.tar", "latest", "--library", folder, "--json")
    assert said(capsys)["scans"] == 1
