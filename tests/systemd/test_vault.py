"""The unit that opens a sealed library: its own commands, under its own bounds, for an account that is not root's."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from node.install import LIBRARY_KEY, PROGRAM, SEALED, STATE
from node.library import Library
from node.sealed import is_open
from node.sealing import seal
from tests.node.sealed_places import KEY, require_mounts
from tests.systemd.test_unit import SYSTEMD, run, tool

UNIT = SYSTEMD / "foveascan-vault.service"
ACCOUNT = 65534


def settings() -> dict[str, str]:
    text = UNIT.read_text().replace("\\\n", " ")
    return dict(re.findall(r"^(\w+)=(.*)$", text, re.MULTILINE))


@pytest.fixture
def state() -> Iterator[Path]:
    """What stands for /var/lib, where every account may look."""
    require_mounts()
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root may mount for other accounts")
    place = Path(tempfile.mkdtemp(prefix="fs-vault-"))
    place.chmod(0o755)
    yield place
    subprocess.run(["umount", "--lazy", "--quiet", place / "foveascan"], check=False)
    shutil.rmtree(place)


def test_the_unit_is_sound() -> None:
    require_mounts()
    assert run(tool("systemd-analyze"), "verify", "--man=no", UNIT) == ""


def test_places_are_those_of_the_service() -> None:
    unit = settings()
    assert unit["AssertPathExists"] == f"/{SEALED}/gocryptfs.conf"
    assert shlex.split(unit["ExecStart"])[-2:] == [f"/{SEALED}", f"/{STATE}"]
    assert unit["LoadCredentialEncrypted"] == Path(LIBRARY_KEY).name
    node = (SYSTEMD / "foveascan.service").read_text()
    assert f"After=network-online.target {UNIT.name}\n" in node and PROGRAM in node
    assert unit["RequiredBy"] == "foveascan.service"


def test_the_account_of_the_node_reads_and_writes_what_is_sealed_for_it(state: Path) -> None:
    folder, key = state / "foveascan", state / Path(LIBRARY_KEY).name
    Library(folder).close()
    for path in (folder, *folder.rglob("*")):
        os.chown(path, ACCOUNT, ACCOUNT)
    folder.chmod(0o750)
    seal(folder, KEY, lambda size_bytes: None)
    key.write_bytes(KEY)
    unit = settings()

    def as_the_unit(command: str) -> None:
        words = shlex.split(command.replace("/var/lib", str(state)).replace("%d", str(state)))
        kept = [f"+{name.removeprefix('CAP_').lower()}" for name in unit["CapabilityBoundingSet"].split()]
        bounds = ["setpriv", "--no-new-privs", "--bounding-set", ",".join(["-all", *kept])]
        subprocess.run([*bounds, *words], check=True, timeout=60, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    as_the_unit(unit["ExecStart"])
    assert is_open(folder)
    account = ["setpriv", f"--reuid={ACCOUNT}", f"--regid={ACCOUNT}", "--clear-groups", "unshare", "--user"]
    assert '"format"' in run(*account, "sh", "-c", f"tee {folder}/written < {folder}/library.json")
    info = (folder / "written").stat()
    assert (info.st_uid, info.st_gid) == (ACCOUNT, ACCOUNT)
    as_the_unit(unit["ExecStop"])
    assert list(folder.iterdir()) == []
