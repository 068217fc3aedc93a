"""When tokens were shown last: noted by whoever lets them in, kept over a restart, told to admins."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

import pytest

from foveascan import PROGRAM
from node.access import Access, access_folder
from node.last_used import FILE, LastUsed
from tests.node.entrance import entrance

TOKEN, OTHER = "0" * 64, "1" * 64


async def test_a_token_s_last_use_is_told_and_kept(tmp_path: Path) -> None:
    library = tmp_path / "library"
    began_s = time.time()
    async with entrance(library) as node:
        admin, _ = node.token("admin"), node.token("view", "never")
        async with node.ask("GET", "/v1/tokens", admin) as answer:
            listed = {one["name"]: one["lastUsed"] for one in await answer.json()}
    assert listed["never"] is None and began_s <= listed["admin"] <= time.time()
    ran = subprocess.run(
        [*PROGRAM, "access", "list", "--library", str(library), "--json"], capture_output=True, check=True, timeout=60
    )
    assert {one["name"]: one["lastUsed"] for one in json.loads(ran.stdout)["tokens"]} == listed


def test_what_was_revoked_is_not_kept(tmp_path: Path) -> None:
    used = LastUsed(tmp_path)
    used.note(TOKEN, 5.0)
    used.note(OTHER, 6.0)
    used.keep({OTHER})
    assert (LastUsed(tmp_path).of(TOKEN), LastUsed(tmp_path).of(OTHER)) == (None, 6.0)
    assert (tmp_path / FILE).stat().st_mode & 0o077 == 0


@pytest.mark.parametrize("kept", [b"?", b"[]", b'{"x": 1}', b'{"%s": -1}' % TOKEN.encode(), b"\xff", b" " * (2 << 20)])
def test_what_has_rotted_is_forgotten_and_written_anew(tmp_path: Path, kept: bytes) -> None:
    (tmp_path / FILE).write_bytes(kept)
    used = LastUsed(tmp_path)
    assert used.of(TOKEN) is None
    used.note(TOKEN, 5.0)
    used.keep({TOKEN})
    assert LastUsed(tmp_path).of(TOKEN) == 5.0


def test_a_full_disk_is_tried_again(tmp_path: Path) -> None:
    used = LastUsed(tmp_path / "gone")
    used.note(TOKEN, 5.0)
    used.keep({TOKEN})
    (tmp_path / "gone").mkdir()
    used.keep({TOKEN})
    assert LastUsed(tmp_path / "gone").of(TOKEN) == 5.0


def test_a_command_beside_the_node_reads_it(tmp_path: Path) -> None:
    access = Access(access_folder(tmp_path))
    access.grant("view", "room 2", 1.0)
    [token] = access.tokens()
    access.last_used.note(token.digest, 7.0)
    access.keep_last_used()
    assert Access(access_folder(tmp_path)).last_used.of(token.digest) == 7.0
