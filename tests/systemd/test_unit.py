"""What an administrator installs: checked by systemd's own tools, which CI has and other machines may not."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import pytest

from node.config import Config, load_config

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = SYSTEMD / "foveascan.service"
PROGRAM = "/opt/foveascan/bin/foveascan"
EXPOSURE_MAX = 1.5
# Nothing by default: the file shows an example.
OPTIONAL = {
    "capture.scanner", "discovery.name", "server.certificate", "server.key",
    "retention.max_age_days", "retention.max_gb",
}  # fmt: skip


def tool(name: str) -> str:
    """The path of one of systemd's programs; skips the test where there is none, but not in CI."""
    path = shutil.which(name)
    if path is None and "CI" in os.environ:
        pytest.fail(f"{name} is missing: .ci/run installs it")
    if path is None:
        pytest.skip(f"{name} is missing: install Debian's package systemd")
    return path


def run(*command: str | Path) -> str:
    told = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert told.returncode == 0, told.stdout + told.stderr
    return told.stdout + told.stderr


def settings() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for name, value in re.findall(r"^(\w+)=(.*)$", UNIT.read_text(), re.MULTILINE):
        found.setdefault(name, []).append(value)
    return found


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The unit, with a program that is there: this Python."""
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace(PROGRAM, sys.executable))
    return unit


def test_the_unit_is_sound(installed: Path) -> None:
    assert run(tool("systemd-analyze"), "verify", "--man=no", installed) == ""


def test_the_unit_is_hardly_exposed(installed: Path) -> None:
    told = run(tool("systemd-analyze"), "security", "--offline=true", "--no-pager", installed)
    exposure = re.search(r"Overall exposure level for foveascan\.service: ([0-9.]+)", told)
    assert exposure and float(exposure[1]) <= EXPOSURE_MAX


def test_the_node_is_watched_and_has_time_to_stop() -> None:
    unit = settings()
    assert unit["Type"] == ["notify"] and unit["Restart"] == ["on-failure"]
    assert int(unit["WatchdogSec"][0]) >= 60  # half of it is the capture thread's patience, node/notify.py
    assert int(unit["TimeoutStopSec"][0]) > 5
    assert {"char-ttyACM rw", "char-ttyUSB rw", "char-usb_device rw"} == set(unit["DeviceAllow"])


def test_user_folders_and_rule_name_one_account(tmp_path: Path) -> None:
    unit = settings()
    assert unit["User"] == unit["Group"] == ["foveascan"]
    told = run(tool("systemd-sysusers"), "--dry-run", f"--root={tmp_path}", SYSTEMD / "sysusers.conf")
    assert "Creating user 'foveascan'" in told
    rules = [line for line in (SYSTEMD / "70-foveascan.rules").read_text().splitlines() if line and line[0] != "#"]
    *given, wakes = rules
    assert len(given) == 2 and all('GROUP="foveascan", MODE="0660", TAG+="systemd"' in rule for rule in given)
    for kind in ("ttyACM", "ttyUSB", "usb_device"):
        assert sum(kind in rule for rule in given) == 1
    assert wakes.endswith(f'ENV{{SYSTEMD_WANTS}}+="{UNIT.name}"')
    folders = {line.split()[1] for line in (SYSTEMD / "tmpfiles.conf").read_text().splitlines() if line[0] != "#"}
    assert folders == {"/var/lib/foveascan", "/etc/foveascan", "/etc/foveascan/node.toml"}


def test_folders_are_made_as_written(tmp_path: Path) -> None:
    text = (SYSTEMD / "tmpfiles.conf").read_text()
    mine = re.sub(r"\b(root|foveascan) (root|foveascan) -$", "- - -", text, flags=re.MULTILINE)
    (tmp_path / "tmpfiles.conf").write_text(mine)
    run(tool("systemd-tmpfiles"), "--create", f"--root={tmp_path}", tmp_path / "tmpfiles.conf")
    assert (tmp_path / "var/lib/foveascan").stat().st_mode & 0o777 == 0o750
    assert (tmp_path / "etc/foveascan").is_dir()


def test_the_settings_file_is_accepted_as_it_is() -> None:
    config = load_config(SYSTEMD / "node.toml")
    assert str(config.library.path) == "/var/lib/" + settings()["StateDirectory"][0]
    assert not config.server.insecure and config.server.host == "127.0.0.1"


def test_the_settings_file_shows_every_setting_with_its_default() -> None:
    text = (SYSTEMD / "node.toml").read_text()
    shown = tomllib.loads(re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE))
    assert msgspec.convert(shown, Config)
    changed = {f"{section}.{key}" for section, keys in tomllib.loads(text).items() for key in keys}
    for section, keys in msgspec.json.decode(msgspec.json.encode(Config())).items():
        assert set(shown[section]) == set(keys), section
        for key, value in keys.items():
            place = f"{section}.{key}"
            assert place in changed | OPTIONAL or shown[section][key] == value, place
    assert changed == {"library.folder"}
