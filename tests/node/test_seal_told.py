"""What a person is told of a seal: one plain line where it was interrupted, refused, or not to be looked into."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from foveascan import INTERRUPTED, PROGRAM, main
from node.doctor import examine
from node.library import About, Library
from node.library_command import NO_LINK
from node.sealed import beside, is_sealed, sealed_folder, standing
from node.sealing import rekey, seal, unseal
from protocol.errors import LibraryError
from tests.node.scans import make_grid
from tests.node.sealed_places import KEY
from tests.permissions import bound_by_permissions

pytestmark = pytest.mark.usefixtures("mounts")

ROOT = Path(__file__).parents[2]
STOPS = """
import os, signal, sys
from pathlib import Path
import foveascan, node.sealing as sealing
path = Path(sys.argv[3])
step, {step} = sealing.{step}, None
def interrupted(*arguments):
    os.kill(os.getpid(), signal.SIGINT)
    return step(*arguments)
sealing.{step} = interrupted
sys.exit(foveascan.main(["library", sys.argv[1], "--library", sys.argv[2], "--key", sys.argv[3]]))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "library"
    library = Library(folder)
    library.add(make_grid(), About(1e9))
    library.close()
    return folder


@pytest.fixture
def key(tmp_path: Path) -> Path:
    (tmp_path / "key").write_bytes(KEY)
    return tmp_path / "key"


@pytest.mark.parametrize(
    ("verb", "step", "said"),
    [
        ("seal", "make_same", "{folder} is in the clear, as it was, and {sealing} is the part that was copied; to go"),
        ("seal", "_put_sealed", "all of {folder} is encrypted, and {away} is still to be deleted; to end that:"),
        ("unseal", "make_same", "{folder} is sealed, as it was"),
        ("unseal", "_put_clear", "all of {folder} is in the clear, {gone} is still to be deleted; to end that:"),
    ],
)
def test_ctrl_c_says_in_a_line_how_things_are_and_the_same_again_ends_it(
    folder: Path, key: Path, verb: str, step: str, said: str
) -> None:
    if verb == "unseal":
        seal(folder, KEY, lambda size: None)
    ran = subprocess.run(
        [sys.executable, "-c", STOPS.format(step=step), verb, str(folder), str(key)],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    places = {word: beside(folder, word) for word in ("sealing", "away", "gone", "coming")}
    assert ran.returncode == INTERRUPTED and ran.stdout == ""
    (line,) = ran.stderr.splitlines()
    assert line.startswith("foveascan: interrupted: " + said.format(folder=folder, **places))
    assert not beside(folder, "open").exists()
    again = [*PROGRAM, "library", verb, "--library", str(folder), "--key", str(key)]
    assert subprocess.run(again, capture_output=True, check=False).returncode == 0
    assert is_sealed(folder) == (verb == "seal")
    assert standing(folder) == f"{folder} is {'sealed' if verb == 'seal' else 'in the clear'}, as it was"


def test_the_key_that_it_has_is_no_new_one(folder: Path) -> None:
    seal(folder, KEY, lambda size: None)
    with pytest.raises(LibraryError, match="the new key is the old one: nothing was changed"):
        rekey(folder, KEY, KEY)
    unseal(folder, KEY, lambda size: None)


def test_who_may_not_look_into_a_sealed_library_is_told_that_it_is_sealed(folder: Path) -> None:
    seal(folder, KEY, lambda size: None)
    sealed_folder(folder).chmod(0)
    try:
        with bound_by_permissions():
            [finding] = examine(None, {"library.folder": str(folder)})
            folder.parent.chmod(0)
            [unseen] = examine(None, {"library.folder": str(folder)})
    finally:
        folder.parent.chmod(0o700)
        sealed_folder(folder).chmod(0o700)
    assert (finding.state, finding.found) == ("problem", f"{folder} is sealed and not open; the rest was not looked at")
    assert "foveascan-vault" in finding.cure
    assert unseen.state == "problem" and "Permission denied" in unseen.found and "ask as root" in unseen.cure


def test_a_library_that_a_link_leads_to_is_sealed_and_the_vaults_unit_refuses_it(
    folder: Path, key: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    state = tmp_path / "state"
    state.symlink_to(folder)
    assert main(["library", "seal", "--library", str(state), "--key", str(key)]) == 0
    assert capfd.readouterr().err == f"foveascan: {state} is a link to {folder}: {NO_LINK}\n"
    assert main(["library", "seal", "--library", str(folder), "--key", str(key)]) == 1
    unit = (ROOT / "systemd/foveascan-vault.service").read_text()
    assert "\nAssertPathIsSymbolicLink=!/var/lib/foveascan\n" in unit
