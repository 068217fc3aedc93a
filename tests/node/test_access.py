from __future__ import annotations

import os
from pathlib import Path

import pytest

from node.access import TOKENS_MAX, Access, access_folder
from protocol import pairing
from protocol.errors import AccessError

NOW = 1.8e9


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return access_folder(tmp_path)


def proving(text: str):  # type: ignore[no-untyped-def]
    key = pairing.key_of(pairing.parse_code(text))
    return lambda other: other == key


def paired(access: Access, name: str, role: pairing.Role = "view") -> str:
    made = access.redeem(proving(access.offer(role, name, NOW)), NOW)
    assert made is not None
    return made[0]


def test_a_code_makes_one_token_of_its_name_and_role(folder: Path) -> None:
    access = Access(folder)
    code = access.offer("operate", "room 2", NOW)
    made = access.redeem(proving(code), NOW + 1)
    assert made is not None
    text, token, _ = made
    assert (token.name, token.role, access.find(text)) == ("room 2", "operate", token)
    assert access.redeem(proving(code), NOW + 1) is None


def test_neither_codes_nor_tokens_can_be_read_off_the_disk(folder: Path) -> None:
    access = Access(folder)
    code = access.offer("view", "a", NOW)
    text = paired(access, "b")
    for file in folder.iterdir():
        kept = file.read_text()
        assert code not in kept and code.replace("-", "") not in kept and text not in kept
        assert file.stat().st_mode & 0o077 == 0
    assert folder.stat().st_mode & 0o077 == 0


@pytest.mark.parametrize(("later_s", "is_good"), [(599.0, True), (600.0, False), (1e6, False), (-1e6, False)])
def test_a_code_is_good_for_ten_minutes_also_when_the_clock_jumps(folder: Path, later_s: float, is_good: bool) -> None:
    access = Access(folder)
    code = access.offer("view", "a", NOW)
    assert (access.redeem(proving(code), NOW + later_s) is not None) == is_good


def test_another_process_is_noticed_at_once(folder: Path) -> None:
    daemon, command = Access(folder), Access(folder)
    text = paired(command, "a")
    token = daemon.find(text)
    assert token is not None
    assert command.revoke("a")
    assert daemon.find(text) is None
    assert not command.revoke("a")


def test_a_name_is_given_once_and_a_new_code_replaces_one_that_waits(folder: Path) -> None:
    access = Access(folder)
    first, second = access.offer("view", "a", NOW), access.offer("admin", "a", NOW)
    assert access.redeem(proving(first), NOW) is None
    assert access.redeem(proving(second), NOW) is not None
    with pytest.raises(AccessError, match="revoke"):
        access.offer("view", "a", NOW)


@pytest.mark.parametrize("name", ["", "x" * 61, "two\nlines", "\x1b[31m"])
def test_names_that_could_forge_a_line_are_refused(folder: Path, name: str) -> None:
    with pytest.raises(AccessError, match="1 to 60"):
        Access(folder).offer("view", name, NOW)


def test_revoking_ends_a_code_that_waits(folder: Path) -> None:
    access = Access(folder)
    code = access.offer("view", "a", NOW)
    assert access.revoke("a")
    assert access.redeem(proving(code), NOW) is None


def test_all_codes_can_be_voided_and_tokens_stay(folder: Path) -> None:
    access = Access(folder)
    text, code = paired(access, "a"), access.offer("view", "b", NOW)
    assert access.void_codes() == 1
    assert access.redeem(proving(code), NOW) is None
    assert access.find(text) is not None


@pytest.mark.parametrize("content", [b"", b"{", b'{"format": 2}', b'{"tokens": [{"name": "a"}]}', bytes(2 << 20)])
def test_a_damaged_file_lets_nobody_in_and_is_not_overwritten(folder: Path, content: bytes) -> None:
    access = Access(folder)
    text = paired(access, "a")
    (folder / "access.json").write_bytes(content)
    for use in (lambda: access.find(text), lambda: access.offer("view", "b", NOW), lambda: Access(folder)):
        with pytest.raises(AccessError, match="access.json"):
            use()
    assert (folder / "access.json").read_bytes() == content


def test_a_file_that_is_gone_lets_nobody_in(folder: Path) -> None:
    access = Access(folder)
    text = paired(access, "a")
    (folder / "access.json").unlink()
    assert access.find(text) is None


def test_a_folder_that_others_can_read_is_refused(folder: Path) -> None:
    folder.chmod(0o755)
    with pytest.raises(AccessError, match="chmod 700"):
        access_folder(folder.parent)


def test_logins_are_bounded(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("node.access.TOKENS_MAX", 2)
    assert TOKENS_MAX > 2
    access = Access(folder)
    paired(access, "a")
    paired(access, "b")
    with pytest.raises(AccessError, match="too many"):
        access.offer("view", "c", NOW)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_what_root_writes_belongs_to_the_account_of_the_library(tmp_path: Path) -> None:
    os.chown(tmp_path, 4711, 4712)
    folder = access_folder(tmp_path)
    Access(folder).offer("view", "a", NOW)
    assert {(path.stat().st_uid, path.stat().st_gid) for path in (folder, *folder.iterdir())} == {(4711, 4712)}
