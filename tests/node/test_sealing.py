"""A library that is sealed: unreadable on the disk, the same once it is open, whatever cuts the sealing."""

from __future__ import annotations

import argparse
import errno
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from node.config import load_config
from node.daemon import start_node
from node.doctor import examine
from node.journal import Journals
from node.library import About, Library, survey, verify
from node.library_command import add_library_command
from node.sealed import NEW_KEY, beside, is_open, is_sealed, is_shut, opened, read_key, sealed_folder
from node.sealing import rekey, seal, unseal
from node.sidecar import Changes
from protocol.errors import ConfigError, LibraryError
from protocol.grid import GridSpec
from protocol.scanner_messages import DeviceInfo, RangeColumn, SweepHeader
from tests.node.scans import make_grid
from tests.node.sealed_places import KEY, open_at

pytestmark = pytest.mark.usefixtures("mounts")

OTHER = KEY[::-1]
SPEC = GridSpec(width=96, height=200, texture_width=32, texture_height=12, step_mm=0.05, pitch_mm=1.0)
HEADER = SweepHeader(7, SPEC, 3200, range_rows=200, texture_rows=12, calibration=99)
SAID = "mole beside the left ear"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A library with a scan, what is said of it, and half a sweep."""
    folder = tmp_path / "library"
    library = Library(folder)
    scan = library.add(make_grid(), About(1e9, name="first"))
    library.annotate(scan.id, Changes(notes=SAID), "ana")
    half_a_sweep(library.sweeps)
    library.close()
    (folder / "access").mkdir(mode=0o700)
    (folder / "access" / "access.json").write_text("{}")
    os.utime(folder / "access" / "access.json", ns=(10**18, 10**18))
    return folder


def half_a_sweep(sweeps: Journals) -> None:
    journal = sweeps.begin(DeviceInfo("A7", 5, 1000, 100), HEADER, 1.0)
    for column in range(SPEC.width):
        journal.add(RangeColumn(7, 0, column, 0, 33 * column, column, bytes(2 * SPEC.height)))
        journal.flush()
    sweeps.keep(journal, "the plug was pulled")


def content(folder: Path) -> dict[str, tuple[int, int, bytes]]:
    """Every file: rights, time, bytes; but for the lock."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name != "lock"]
    told = ((str(path.relative_to(folder)), path.stat(), path.read_bytes()) for path in files)
    return {name: (info.st_mode, info.st_mtime_ns, data) for name, info, data in told}


def ignore(size_bytes: int) -> None:
    """Nobody watches."""


def run(*arguments: object) -> int:
    parser = argparse.ArgumentParser()
    add_library_command(parser.add_subparsers())
    args = parser.parse_args(["library", *map(str, arguments)])
    status: int = args.run(args)
    return status


def test_sealed_it_cannot_be_read_and_open_it_is_the_same(folder: Path, tmp_path: Path) -> None:
    before = content(folder)
    done: list[int] = []
    seal(folder, KEY, done.append)
    assert sum(done) == sum(len(data) for _, _, data in before.values())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["library", "library.sealed"]
    assert list(folder.iterdir()) == [] and is_shut(folder)
    for path in sealed_folder(folder).rglob("*"):
        assert not any(part in path.name for name in before for part in Path(name).parts)
        assert path.is_dir() or not any(data in path.read_bytes() for _, _, data in before.values() if len(data) > 2)
    with open_at(folder):
        assert content(folder) == before and is_open(folder) and not is_shut(folder)
        [scan_id] = survey(folder)[0]
        assert [problem for _, problem in verify(folder, [scan_id])] == [None]
    unseal(folder, KEY, ignore)
    assert content(folder) == before and not is_sealed(folder)
    assert [path.name for path in tmp_path.iterdir()] == ["library"]


def test_a_library_that_is_not_there_yet_is_sealed_from_its_first_scan_on(tmp_path: Path) -> None:
    folder = tmp_path / "library"
    with pytest.raises(LibraryError, match="there is no folder .*library: name the library's, or make one"):
        seal(folder, KEY, ignore)
    assert not list(tmp_path.iterdir())
    folder.mkdir()
    seal(folder, KEY, ignore)
    with open_at(folder):
        library = Library(folder)
        library.add(make_grid(), About(1e9))
        library.close()
    assert list(folder.iterdir()) == []


def cut_at(change: Callable[..., None], folder: Path, step: str, at: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a seal or an unseal fail at a step that changes the disk. at : how many of that kind are done before."""
    done = 0
    owner = shutil if step == "rmtree" else os
    take = getattr(owner, step)

    def cut(*places: Path) -> None:
        nonlocal done
        if done == at:
            raise OSError(errno.EIO, "cut")
        done += 1
        take(*places)

    with monkeypatch.context() as patched:
        patched.setattr(owner, step, cut)
        with pytest.raises(LibraryError, match="cut"):
            change(folder, KEY, ignore)


@pytest.mark.parametrize("change", [seal, unseal])
@pytest.mark.parametrize(("step", "at"), [("replace", 2), ("rename", 0), ("rename", 1), ("rmtree", 0)])
def test_what_was_cut_goes_on_and_nothing_is_lost(
    folder: Path, change: Callable[..., None], step: str, at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = content(folder)
    if change is unseal:
        seal(folder, KEY, ignore)
    cut_at(change, folder, step, at, monkeypatch)
    if not is_shut(folder):  # then it is as it was, and may be used meanwhile
        assert content(folder) == before
        (folder / "access" / "access.json").write_text("changed meanwhile")
        before = content(folder)
    if change is seal and (not is_sealed(folder) or beside(folder, "away").exists()):
        seal(folder, KEY, ignore)
    if change is unseal and (is_sealed(folder) or beside(folder, "gone").exists()):
        unseal(folder, KEY, ignore)
    if change is seal:
        assert list(folder.iterdir()) == []
        unseal(folder, KEY, ignore)
    assert content(folder) == before
    assert [path.name for path in folder.parent.iterdir()] == ["library"]


@pytest.mark.parametrize("change", [seal, unseal])
@pytest.mark.parametrize("other", [seal, unseal])
@pytest.mark.parametrize(("step", "at"), [("replace", 2), ("rename", 0), ("rename", 1), ("rmtree", 0)])
def test_either_command_ends_what_was_cut_and_only_with_its_key(
    folder: Path,
    change: Callable[..., None],
    other: Callable[..., None],
    step: str,
    at: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = content(folder)
    if change is unseal:
        seal(folder, KEY, ignore)
    cut_at(change, folder, step, at, monkeypatch)
    lies = content(folder.parent)
    with pytest.raises(LibraryError, match="does not open the library"):
        other(folder, OTHER, ignore)
    assert content(folder.parent) == lies
    other(folder, KEY, ignore)
    names = sorted(path.name for path in folder.parent.iterdir())
    if other is seal:
        assert names == ["library", "library.sealed"] and not list(folder.iterdir())
        unseal(folder, KEY, ignore)
    else:
        assert names == ["library"]
    assert content(folder) == before


@pytest.mark.parametrize(("change", "left"), [(seal, "away"), (unseal, "gone")])
def test_a_copy_is_not_deleted_while_it_is_the_only_one(
    folder: Path, change: Callable[..., None], left: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if change is unseal:
        seal(folder, KEY, ignore)
    cut_at(change, folder, "rmtree", 0, monkeypatch)
    away, place = beside(folder, left), folder if change is seal else sealed_folder(folder)
    before = content(away)
    shutil.rmtree(sealed_folder(folder) if change is seal else folder)
    for again in seal, unseal:
        with pytest.raises(LibraryError, match=f"the library is in {away}: mv -T {away} {place}$"):
            again(folder, KEY, ignore)
    assert os.system(f"mv -T {away} {place}") == 0
    assert content(place) == before


def test_a_clear_copy_that_was_left_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cut_at(seal, folder, "rmtree", 0, monkeypatch)
    again = f"stop the node, and foveascan library seal --library {folder} --key FILE"
    overrides = {"library.folder": str(folder)}
    [left, shut] = examine(None, overrides)
    assert (left.state, left.cure) == ("warning", again) and str(beside(folder, "away")) in left.found
    assert (shut.state, shut.cure) == ("problem", again)
    with pytest.raises(ConfigError, match="was being sealed or unsealed when that was cut"):
        _ = load_config(overrides=overrides).library.path
    with open_at(folder):
        assert next(iter(examine(None, overrides))) == left
    seal(folder, KEY, ignore)
    [shut] = examine(None, overrides)
    assert "vault" in shut.cure


async def test_a_node_that_starts_names_what_was_left(
    folder: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut_at(seal, folder, "replace", 2, monkeypatch)
    settings = {"server.listen": "127.0.0.1:0", "server.insecure": True, "discovery.enabled": False}
    async with AsyncExitStack() as stack:
        await start_node(load_config(overrides={"library.folder": str(folder), **settings}), stack)
    assert f"{beside(folder, 'sealing')} was left by a seal or an unseal; stop the node, and foveascan" in caplog.text


@pytest.mark.parametrize("change", [seal, unseal])
def test_a_copy_that_changed_since_it_was_compared_is_compared_again(
    folder: Path, change: Callable[..., None], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = content(folder)
    if change is unseal:
        seal(folder, KEY, ignore)
    cut_at(change, folder, "rename", 1, monkeypatch)
    if change is seal:
        with opened(beside(folder, "sealing"), beside(folder, "open"), KEY) as place:
            (place / "access" / "access.json").unlink()
        seal(folder, KEY, ignore)
    else:
        (beside(folder, "coming") / "access" / "access.json").unlink()
    unseal(folder, KEY, ignore)
    assert content(folder) == before


@pytest.mark.parametrize(("change", "left"), [(seal, "away"), (unseal, "gone")])
def test_of_two_that_may_be_wanted_neither_is_deleted(
    folder: Path, change: Callable[..., None], left: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if change is unseal:
        seal(folder, KEY, ignore)
    cut_at(change, folder, "rmtree", 0, monkeypatch)
    if change is seal:
        (folder / "written").write_text("meanwhile")
    else:
        shutil.copytree(beside(folder, left), sealed_folder(folder))
    before = content(folder.parent)
    for again in seal, unseal:
        with pytest.raises(LibraryError, match="move away the one that is not wanted"):
            again(folder, KEY, ignore)
    assert content(folder.parent) == before


def test_a_link_leads_to_the_same_library(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, key, link = content(folder), tmp_path / "key", tmp_path / "link"
    key.write_bytes(KEY)
    link.symlink_to(folder)
    monkeypatch.chdir(folder)
    assert run("seal", "--library", link, "--key", key) == 0
    assert link.is_symlink() and is_sealed(folder)
    monkeypatch.chdir(folder)
    for way in link, ".":
        with pytest.raises(ConfigError, match=f"{folder} is sealed and not open"):
            run("list", "--library", way)
    assert run("unseal", "--library", ".", "--key", key) == 0
    assert content(folder) == before
    with pytest.raises(ConfigError, match=r"library.folder: / cannot be a library"):
        run("seal", "--library", "/", "--key", key)


@pytest.mark.parametrize("verb", ["seal", "unseal"])
def test_a_command_that_is_killed_goes_on(folder: Path, tmp_path: Path, verb: str) -> None:
    before, key = content(folder), tmp_path / "key"
    key.write_bytes(KEY)
    if verb == "unseal":
        seal(folder, KEY, ignore)
    command = [sys.executable, "-P", "-m", "foveascan", "library", verb, "--library", str(folder), "--key", str(key)]
    with subprocess.Popen(command) as process:
        while not beside(folder, "open").is_mount() and process.poll() is None:
            time.sleep(0.001)
        process.kill()
    if process.returncode:
        assert subprocess.run(command, check=False).returncode == 0
    if verb == "seal":
        unseal(folder, KEY, ignore)
    assert content(folder) == before


def test_a_wrong_key_is_one_error_and_touches_nothing(folder: Path) -> None:
    seal(folder, KEY, ignore)
    before = content(sealed_folder(folder))
    with pytest.raises(LibraryError, match="does not open the library: give the one that it was sealed with"):
        unseal(folder, OTHER, ignore)
    with pytest.raises(LibraryError, match="is sealed already"):
        seal(folder, KEY, ignore)
    assert content(sealed_folder(folder)) == before
    assert sorted(path.name for path in folder.parent.iterdir() if path.name != ".library.open") == [
        "library", "library.sealed"
    ]  # fmt: skip


def test_another_key_opens_it_from_then_on(folder: Path) -> None:
    seal(folder, KEY, ignore)
    files = [path for path in sealed_folder(folder).rglob("*") if path.name != "gocryptfs.conf"]
    scans = {path: path.stat().st_mtime_ns for path in files}
    rekey(folder, KEY, OTHER)
    assert {path: path.stat().st_mtime_ns for path in scans} == scans
    with pytest.raises(LibraryError, match="does not open"):
        unseal(folder, KEY, ignore)
    with pytest.raises(LibraryError, match="does not open"):
        rekey(folder, KEY, KEY + b"!")
    unseal(folder, OTHER, ignore)


def test_what_is_no_library_or_in_use_is_not_sealed(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "dog.jpg").write_text("woof")
    with pytest.raises(LibraryError, match="holds no library; nothing was touched"):
        seal(tmp_path / "photos", KEY, ignore)
    library = Library(folder)
    with pytest.raises(LibraryError, match="in use by process"):
        seal(folder, KEY, ignore)
    library.close()
    (folder / "elsewhere").symlink_to("/etc")
    with pytest.raises(LibraryError, match="neither file nor folder"):
        seal(folder, KEY, ignore)
    assert not is_shut(folder)


def test_nothing_uses_a_library_that_is_shut(folder: Path) -> None:
    seal(folder, KEY, ignore)
    overrides = {"library.folder": str(folder)}
    with pytest.raises(ConfigError, match="is sealed and not open: systemctl start foveascan-vault"):
        _ = load_config(overrides=overrides).library.path
    with pytest.raises(ConfigError, match="is sealed and not open"):
        run("list", "--library", folder)
    [finding] = examine(None, overrides)
    assert (finding.check, finding.state) == ("library", "problem") and "foveascan-vault" in finding.cure
    assert list(folder.iterdir()) == []
    with open_at(folder):
        assert load_config(overrides=overrides).library.path == folder
        with pytest.raises(LibraryError, match="is open as a sealed library: stop the node"):
            unseal(folder, KEY, ignore)


def test_the_commands(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = content(folder)
    key, other, weak = tmp_path / "key", tmp_path / "other", tmp_path / "weak"
    key.write_bytes(KEY + b"\n")
    other.write_bytes(OTHER)
    weak.write_text("1234")
    with pytest.raises(LibraryError, match=r"holds no key, which is a line of 22 to 500 characters: head -c 32"):
        run("seal", "--library", folder, "--key", weak)
    assert run("seal", "--library", folder, "--key", key) == 0
    assert run("rekey", "--library", folder, "--key", key, "--new-key", other) == 0
    assert run("unseal", "--library", folder, "--key", other) == 0
    assert capsys.readouterr().out.splitlines() == [
        f"sealed {folder}", f"{folder} opens with the new key, and with the old one no more", f"unsealed {folder}"
    ]  # fmt: skip
    assert content(folder) == before


def test_the_key_that_is_recommended_is_one(tmp_path: Path) -> None:
    assert os.system(f"{NEW_KEY} > {tmp_path}/key") == 0
    assert len(read_key(tmp_path / "key")) == 44


def test_without_gocryptfs_the_cure_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = content(folder)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(LibraryError, match="apt-get install gocryptfs fuse3"):
        seal(folder, KEY, ignore)
    assert content(folder) == before and not is_shut(folder)


def rot(folder: Path, size_bytes: int, at: int) -> None:
    """Turn a byte of the encrypted file that is about as large."""
    files = (path for path in sealed_folder(folder).rglob("*") if path.is_file())
    path = min(files, key=lambda path: abs(path.stat().st_size - size_bytes))
    with open(path, "r+b") as file:
        file.seek(at)
        byte = file.read(1)
        file.seek(at)
        file.write(bytes([byte[0] ^ 1]))


def test_a_scan_that_rotted_on_the_disk_is_a_problem_and_no_crash(folder: Path) -> None:
    [scan_id] = survey(folder)[0]
    size_bytes = (folder / scan_id / "texture.npy").stat().st_size
    seal(folder, KEY, ignore)
    rot(folder, size_bytes, size_bytes // 2)
    with open_at(folder):
        [(_, problem)] = verify(folder, [scan_id])
        assert problem is not None and problem.reason == "its texture.npy cannot be read: Input/output error"


def test_a_sweep_that_rotted_on_the_disk_keeps_the_rest(folder: Path) -> None:
    [journal] = (folder / "sweeps").iterdir()
    size_bytes = journal.stat().st_size
    held = Journals(folder / "sweeps").interrupted()[0].held
    seal(folder, KEY, ignore)
    rot(folder, size_bytes, size_bytes // 2)
    with open_at(folder):
        [sweep] = Journals(folder / "sweeps").interrupted()
        assert 0 < sweep.held < held and sweep.damaged_bytes > 0


def test_a_vault_that_dies_loses_nothing_that_was_kept(folder: Path) -> None:
    seal(folder, KEY, ignore)
    with open_at(folder) as vault:
        library = Library(folder)
        kept = library.add(make_grid(), About(1e9)).id
        vault.send_signal(signal.SIGKILL)
        vault.wait()
        with pytest.raises(LibraryError):
            library.annotate(kept, Changes(name="x"), "ana")
        library.close()
        with pytest.raises(LibraryError, match="cannot be used: Transport endpoint is not connected"):
            Library(folder)
        with pytest.raises(ConfigError, match="which is sealed, has died: systemctl restart foveascan-vault"):
            run("list", "--library", folder)
        [finding] = examine(None, {"library.folder": str(folder)})
        assert finding.state == "problem" and "foveascan-vault" in finding.cure
    with open_at(folder):
        library = Library(folder)
        assert [problem for _, problem in library.verify()] == [None]
        assert not library.problems
        library.close()
