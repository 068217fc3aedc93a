"""What of the nightly machine can be tried without booting it."""

from __future__ import annotations

import io
import subprocess
from pathlib import Path

import pytest

from tests.nightly import machine

ROOT, HERE = Path(__file__).parents[2], Path(__file__).parent
LONG_S = 60.0


def unpacked(data: bytes) -> dict[str, tuple[int, bytes]]:
    """Mode and content by name of a cpio archive."""
    files: dict[str, tuple[int, bytes]] = {}
    at = 0
    while True:
        assert data[at : at + 6] == b"070701"
        fields = [int(data[start : start + 8], 16) for start in range(at + 6, at + 110, 8)]
        mode, size, name_size = fields[1], fields[6], fields[11]
        name = data[at + 110 : at + 110 + name_size - 1].decode()
        at = -(-(at + 110 + name_size) // 4) * 4
        if name == "TRAILER!!!":
            return files
        files[name] = mode, data[at : at + size]
        at = -(-(at + size) // 4) * 4


def test_an_archive_holds_what_was_packed() -> None:
    files = {"init": (0o100755, b"#!"), "bin": (0o40755, b""), "a/longer/name": (0o100644, bytes(range(101)))}
    assert unpacked(machine.archive(files)) == files


@pytest.mark.parametrize("script", [".ci/nightly", "tests/nightly/init", "tests/nightly/inside"])
def test_the_scripts_can_be_read_by_a_shell(script: str) -> None:
    checked = subprocess.run(["bash", "-n", ROOT / script], capture_output=True, text=True, timeout=LONG_S)
    assert checked.returncode == 0 and not checked.stderr, checked.stderr


def test_the_tests_that_it_runs_are_there() -> None:
    assert all((ROOT / test).is_file() for test in machine.TESTS)


def test_what_is_missing_here_is_named_with_its_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(machine, "_ADMIN_PATH", "/nowhere")
    with pytest.raises(SystemExit, match="2"):
        machine.main([])


def test_what_a_machine_says_is_kept_to_its_end() -> None:
    log, command = io.BytesIO(), ["bash", "-c", "printf mach; sleep 0.1; echo ine: up; echo all well"]
    assert machine.follow(command, log, LONG_S, LONG_S) == "over"
    assert log.getvalue() == b"machine: up\nall well\n"


def test_a_machine_that_does_not_boot_is_silent() -> None:
    assert machine.follow(["bash", "-c", "echo no processor; exit 1"], io.BytesIO(), LONG_S, LONG_S) == "silent"


@pytest.mark.parametrize(("limit_s", "silent_s", "ended"), [(LONG_S, 0.1, "silent"), (0.1, 0.1, "late")])
def test_a_machine_that_hangs_is_ended(limit_s: float, silent_s: float, ended: str) -> None:
    assert machine.follow(["sleep", f"{LONG_S}"], io.BytesIO(), limit_s, silent_s) == ended
