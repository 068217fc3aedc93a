"""Laying the service out in a folder: what is made, what is kept, what is taken away. Nothing runs."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest

from node import install, release
from node.install import PLACES, Installer
from protocol.errors import InstallError

VERSIONS = "opt/foveascan/releases"


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine, on which a release is an empty folder."""
    monkeypatch.setattr(install, "build", lambda place: (place / "bin").mkdir(parents=True))
    be(monkeypatch, "1")
    return tmp_path


def be(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    """Run another version from now on."""
    monkeypatch.setattr(install, "identity", lambda: version)


def done(root: Path, *, is_dry: bool = False) -> list[str]:
    steps: list[str] = []
    Installer(root, is_dry, steps.append).install()
    return steps


def removed(root: Path, *, purge: bool = False) -> list[str]:
    steps: list[str] = []
    Installer(root, False, steps.append).remove(purge=purge)
    return steps


def test_everything_gets_its_place_and_the_same_again_changes_nothing(root: Path) -> None:
    done(root)
    for name, place in PLACES.items():
        assert (root / place).read_bytes() == (release.unit_files() / name).read_bytes()
        assert (root / place).stat().st_mode & 0o777 == 0o644
    assert os.readlink(root / "opt/foveascan/bin") == "releases/1/bin"
    before = {path: path.lstat().st_mtime_ns for path in root.rglob("*") if path.name != "laid.json"}
    assert all(step.startswith(("kept", "nothing")) for step in done(root))
    assert before.keys() <= set(root.rglob("*"))
    assert all(path.lstat().st_mtime_ns == before[path] for path in before if not path.is_dir())


def test_a_rehearsal_says_the_same_and_does_nothing(root: Path) -> None:
    said = done(root, is_dry=True)
    assert list(root.iterdir()) == []
    assert said == done(root)


def test_what_somebody_changed_is_kept_and_what_is_newer_lies_beside(
    root: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    done(root)
    (root / PLACES["node.toml"]).write_text("mine")
    assert f"kept     /{PLACES['node.toml']}: as somebody changed it" in done(root)
    assert not (root / "etc/foveascan/node.toml.new").exists()
    newer = tmp_path_factory.mktemp("newer")
    for name in PLACES:
        (newer / name).write_text("newer")
    monkeypatch.setattr(install, "unit_files", lambda: newer)
    done(root)
    assert (root / PLACES["node.toml"]).read_text() == "mine"
    assert (root / "etc/foveascan/node.toml.new").read_text() == "newer"
    assert (root / PLACES["foveascan.service"]).read_text() == "newer"


def test_an_update_switches_and_keeps_the_one_before(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for version in ("1", "2", "3"):
        be(monkeypatch, version)
        done(root)
        assert os.readlink(root / "opt/foveascan/bin") == f"releases/{version}/bin"
    assert sorted(path.name for path in (root / VERSIONS).iterdir()) == ["2", "3"]


def test_an_update_that_fails_leaves_everything_as_it_was(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done(root)
    unit = root / PLACES["foveascan.service"]
    unit.write_text("of an older version")
    laid = {PLACES["foveascan.service"]: install._hash(unit.read_bytes())}
    (root / "opt/foveascan/laid.json").write_text(json.dumps(laid))
    be(monkeypatch, "2")
    monkeypatch.setattr(Installer, "_starts", True)

    def fail(self: Installer) -> None:
        assert unit.read_text() != "of an older version"
        raise InstallError("it does not come up")

    monkeypatch.setattr(Installer, "_bring_up", fail)
    monkeypatch.setattr(install, "run", lambda command: None)
    with pytest.raises(InstallError, match="it does not come up"):
        done(root)
    assert os.readlink(root / "opt/foveascan/bin") == "releases/1/bin"
    assert unit.read_text() == "of an older version"


def test_what_is_removed_and_what_only_purged(root: Path) -> None:
    done(root)
    (root / "var/lib/foveascan").mkdir(parents=True)
    assert removed(root)[-1].startswith("kept: settings in /etc/foveascan, scans")
    left = sorted(str(path.relative_to(root)) for path in root.rglob("*") if not path.is_dir())
    assert left == ["etc/foveascan/nginx-cache.conf", "etc/foveascan/node.toml"]
    removed(root, purge=True)
    assert not (root / "etc/foveascan").exists() and not (root / "var/lib/foveascan").exists()
    assert removed(root, purge=True) == []


def test_an_older_way_of_installing_is_not_overwritten(root: Path) -> None:
    (root / "opt/foveascan/bin").mkdir(parents=True)
    with pytest.raises(InstallError, match="/opt/foveascan/bin is a folder, so installed in another way"):
        done(root)
    assert not (root / PLACES["foveascan.service"]).exists()


def test_who_is_not_root_is_told_so(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(install.os, "geteuid", lambda: 1000)  # type: ignore[attr-defined]
    with pytest.raises(InstallError, match="only root"):
        done(Path("/"))


def test_a_python_in_a_home_cannot_be_run_by_a_service(monkeypatch: pytest.MonkeyPatch) -> None:
    for home, is_fine in (("/usr", True), ("/home/me/python", False), ("/root/.pyenv/versions/3.11", False)):
        monkeypatch.setattr(release.sys, "base_prefix", home)  # type: ignore[attr-defined]
        if is_fine:
            release.require_python()
            continue
        with pytest.raises(InstallError, match=r"no service sees; make the environment with the system's Python"):
            release.require_python()


def test_a_command_that_does_not_end_is_an_error_of_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(release, "RUN_S", 0.05)
    with pytest.raises(InstallError, match=r"^sleep 60 did not end within 0\.05 s$"):
        release.run(["sleep", "60"])


def test_a_release_runs_alone_and_holds_no_tools_of_ours(tmp_path: Path) -> None:
    place = tmp_path / "opt/foveascan/releases" / release.identity()
    place.parent.mkdir(parents=True)
    release.build(place)
    assert release.identity() == place.name
    said = subprocess.run(
        [place / "bin/python", "-I", "-m", "foveascan", "--version"], capture_output=True, text=True, timeout=60,
        env={}, check=True,
    ).stdout  # fmt: skip
    assert said.startswith("foveascan ")
    [site] = (place / "lib").glob("python*/site-packages")
    assert (site / "client/viewer/dist/index.html").is_file() and not (site / "client/viewer/src").exists()
    assert not (site / "pytest").exists() and not (site / "tests").exists()
    assert {path.name for path in (site / "node/systemd").iterdir()} >= set(PLACES)
    assert all(path.stat().st_mode & 0o005 for path in place.rglob("*"))
    assert (place / "bin/foveascan").read_text().startswith(f"#!/opt/foveascan/releases/{place.name}/bin/python -I\n")
    assert not list(place.parent.glob(".*"))
