import hashlib
import io
import os
import subprocess
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from node import archive, durable
from node.archive import MARK, SUMS, backup
from node.durable import NoRoom
from node.library import About, Library, survey
from node.library_folder import OWN
from node.sidecar import Changes
from protocol.errors import LibraryError
from protocol.grid import Grid, GridSpec

SPEC = GridSpec(24, 16, 64, 48, step_mm=0.05, pitch_mm=1.0)
Members = list[tuple[str, bytes]]


def grid(seed: int) -> Grid:
    rng = np.random.default_rng(seed)
    range_steps = rng.integers(0, 3, (SPEC.height, SPEC.width)).astype(np.uint16)
    texture = rng.integers(0, 256, (SPEC.texture_height, SPEC.texture_width, 3)).astype(np.uint8)
    repairs = np.array([[3, 4, 0], [3, 5, 7]][: seed % 3], np.int32).reshape(-1, 3)
    return Grid(SPEC, range_steps, texture, repairs)


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A library of three scans, one of them with a sidecar, and its backup."""
    folder = tmp_path_factory.mktemp("saved")
    library = Library(folder / "library")
    ids = [library.add(grid(seed), About(1e9 + seed, name=f"scan {seed}")).id for seed in range(3)]
    library.annotate(ids[1], Changes(name="knee", subject="P-17"), "ana")
    backup(library.folder, [scan.id for scan in library.scans()], folder / "all.tar")
    library.close()
    return library.folder, folder / "all.tar"


def files(folder: Path) -> dict[str, bytes]:
    """Every file of every scan."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.parent.name not in ("library", "sweeps"))
    return {f"{path.parent.name}/{path.name}": path.read_bytes() for path in paths if path.name not in OWN}


def members(path: Path) -> Members:
    with tarfile.open(path) as tar:
        return [(member.name, tar.extractfile(member).read()) for member in tar]  # type: ignore[union-attr]


def packed(path: Path, contents: Members) -> Path:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in contents:
            member = tarfile.TarInfo(name)
            member.size = len(data)
            tar.addfile(member, io.BytesIO(data))
    return path


def summed(contents: Members) -> Members:
    """The same with checksums that agree."""
    lines = "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in contents if name != SUMS)
    return [*(item for item in contents if item[0] != SUMS), (SUMS, lines.encode())]


def test_a_backup_restored_is_the_same_library(saved: tuple[Path, Path], tmp_path: Path) -> None:
    source, path = saved
    library = Library(tmp_path / "library")
    restored = library.restore(path)
    assert set(restored.added) == set(survey(source)[0]) and restored.kept == ()
    assert files(library.folder) == files(source)
    assert library.scans() == sorted(survey(source)[0].values(), key=lambda scan: -scan.sequence)
    assert [scan.about.name for scan in library.scans()] == ["scan 2", "knee", "scan 0"]
    assert all(problem is None for _, problem in library.verify())
    assert set(os.listdir(library.folder)) - OWN == set(restored.added)


def test_nobody_else_reads_a_backup_what_was_restored_or_what_was_cut(saved: tuple[Path, Path], tmp_path: Path) -> None:
    source, _ = saved
    before = os.umask(0o022)
    try:
        backup(source, survey(source)[0], tmp_path / "mine.tar")
        library = Library(tmp_path / "library")
        restored = library.restore(tmp_path / "mine.tar")
    finally:
        os.umask(before)
    private = [tmp_path / "mine.tar", library.folder / "sweeps", *(library.folder / scan for scan in restored.added)]
    assert len(private) > 3 and [oct(path.stat().st_mode & 0o077) for path in private] == ["0o0"] * len(private)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files away")
def test_what_root_restores_belongs_to_the_account_of_the_library(saved: tuple[Path, Path], tmp_path: Path) -> None:
    os.chown(tmp_path, 4711, 4712)
    library = Library(tmp_path)
    folders = [tmp_path / "sweeps", *(tmp_path / scan for scan in library.restore(saved[1]).added)]
    assert {(path.stat().st_uid, path.stat().st_gid) for path in folders} == {(4711, 4712)}


def test_tar_and_sha256sum_understand_a_backup(saved: tuple[Path, Path], tmp_path: Path) -> None:
    subprocess.run(["tar", "xf", saved[1]], cwd=tmp_path, check=True)
    subprocess.run(["sha256sum", "-c", "--quiet", "--strict", "SHA256SUMS"], cwd=tmp_path, check=True)
    names = [name for name, _ in members(saved[1])]
    assert names[0] == MARK and names[-1] == SUMS


def test_scans_that_are_here_keep_what_they_have(saved: tuple[Path, Path], tmp_path: Path) -> None:
    library = Library(tmp_path / "library")
    mine = library.add(grid(1), About(5.0, name="mine")).id
    library.annotate(mine, Changes(notes="newer"), "ben")
    restored = library.restore(saved[1])
    assert restored.kept == (mine,) and len(restored.added) == 2
    assert library.sidecar(mine).notes == "newer"
    assert library.add(grid(9), About(1.0)).id == library.scans()[0].id


def test_a_backup_never_replaces_a_file_and_leaves_nothing_when_it_fails(
    saved: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, _ = saved
    path = tmp_path / "b.tar"
    path.write_text("mine")
    with pytest.raises(LibraryError, match="exists already"):
        backup(folder, survey(folder)[0], path)
    assert path.read_text() == "mine"
    with pytest.raises(LibraryError, match="cannot back up: scan 000.*: not a scan"):
        backup(folder, ["0" * 32], tmp_path / "c.tar")
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(NoRoom):
        backup(folder, survey(folder)[0], tmp_path / "c.tar")
    assert os.listdir(tmp_path) == ["b.tar"]


def full_disk(*_: object) -> None:
    raise OSError(28, "No space left on device")


def test_a_rotten_scan_is_not_backed_up(saved: tuple[Path, Path], tmp_path: Path) -> None:
    library = Library(tmp_path / "library")
    library.restore(saved[1])
    scan_id = library.scans()[0].id
    path = library.folder / scan_id / "texture.npy"
    path.write_bytes(path.read_bytes()[:-1] + b"\0")
    with pytest.raises(LibraryError, match="not what they were"):
        backup(library.folder, [scan_id], tmp_path / "b.tar")


def cut(contents: Members) -> Members:
    return contents[:-1]


def foreign(contents: Members) -> Members:
    return [("holiday.jpg", b"x"), *contents]


def newer(contents: Members) -> Members:
    return summed([(MARK, b'{"format": 2, "scans": 3}'), *contents[1:]])


def no_number(contents: Members) -> Members:
    return summed([(MARK, b'{"format": 1, "scans": -1}'), *contents[1:]])


def scan_missing(contents: Members) -> Members:
    name = contents[1][0][:32]
    return summed([item for item in contents if not item[0].startswith(name)])


def file_missing(contents: Members) -> Members:
    return summed([item for item in contents if item != contents[1]])


def twice(contents: Members) -> Members:
    return summed([*contents[:2], *contents[1:]])


def path_trick(contents: Members) -> Members:
    return summed([contents[0], ("../evil.npy", b"x"), *contents[1:]])


def absolute_path(contents: Members) -> Members:
    return summed([contents[0], ("/tmp/evil/range.npy", b"x"), *contents[1:]])


def hidden_path(contents: Members) -> Members:
    return summed([contents[0], (contents[1][0][:32] + "/../range.npy", b"x"), *contents[1:]])


def other_file(contents: Members) -> Members:
    return summed([contents[0], (contents[1][0][:32] + "/letter.txt", b"x"), *contents[1:]])


def oversized(contents: Members) -> Members:
    return summed([(name, data if not name.endswith("scan.json") else b" " * 70000) for name, data in contents])


def wrong_sum(contents: Members) -> Members:
    return [*contents[:-1], (SUMS, contents[-1][1].replace(b"a", b"b", 1))]


def samples_exchanged(contents: Members) -> Members:
    return summed([(name, data[:-1] + b"\x7f" if name.endswith("texture.npy") else data) for name, data in contents])


def newer_scan(contents: Members) -> Members:
    return summed([
        (name, data.replace(b'"format": 1', b'"format": 2') if name.endswith("scan.json") else data)
        for name, data in contents
    ])  # fmt: skip


@pytest.mark.parametrize("data", [b"", b"hello", b"hello " * 1000])
def test_a_file_of_another_kind_is_no_backup(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "notes.txt").write_bytes(data)
    (tmp_path / "library").mkdir()
    with pytest.raises(LibraryError, match=": not a backup of a library: it does not begin as one$"):
        archive.restore(tmp_path / "notes.txt", tmp_path / "library")
    assert list((tmp_path / "library").iterdir()) == []


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (cut, "empty header|end of file|cut off|damaged"),
        (foreign, "not a backup"),
        (newer, "has format 2"),
        (no_number, "-1 scans"),
        (scan_missing, "do not agree"),
        (file_missing, "cannot be read"),
        (twice, "one too many"),
        (path_trick, "no business"),
        (absolute_path, "no business"),
        (hidden_path, "no business"),
        (other_file, "no business"),
        (oversized, "larger than"),
        (wrong_sum, "do not agree"),
        (samples_exchanged, "not what they were"),
        (newer_scan, "format that this version does not know"),
    ],
)
def test_a_bad_backup_is_refused_and_nothing_of_it_stays(
    saved: tuple[Path, Path], tmp_path: Path, spoil: Callable[[Members], Members], words: str
) -> None:
    path = packed(tmp_path / "bad.tar", spoil(members(saved[1])))
    library = Library(tmp_path / "library")
    with pytest.raises(LibraryError, match=words):
        library.restore(path)
    assert library.scans() == [] and set(os.listdir(library.folder)) <= OWN


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.DIRTYPE, tarfile.FIFOTYPE, tarfile.XHDTYPE])
def test_a_member_that_is_no_plain_file_is_refused(saved: tuple[Path, Path], tmp_path: Path, kind: bytes) -> None:
    contents = members(saved[1])
    with tarfile.open(tmp_path / "bad.tar", "w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in contents:
            member = tarfile.TarInfo(name)
            if name.endswith("range.npy"):
                member.type, member.linkname = kind, "/etc/passwd"
            else:
                member.size = len(data)
            tar.addfile(member, io.BytesIO(data[: member.size]))
    library = Library(tmp_path / "library")
    with pytest.raises(LibraryError, match="no plain file"):
        library.restore(tmp_path / "bad.tar")
    assert set(os.listdir(library.folder)) <= OWN


@settings(max_examples=60)
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255), cut_here=st.booleans())
def test_a_damaged_backup_is_all_there_or_refused(
    saved: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory, place: float, flip: int, cut_here: bool
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    data = bytearray(saved[1].read_bytes())
    at = int(place * len(data))
    data[at] ^= flip
    (folder / "bad.tar").write_bytes(data[:at] if cut_here else data)
    library = Library(folder / "library")
    try:
        library.restore(folder / "bad.tar")
    except LibraryError:
        assert files(library.folder) == {}
    else:
        assert files(library.folder) == files(saved[0])  # it hit the padding, or a field that nobody reads
    library.close()


def test_a_disk_without_room_refuses_a_backup(
    saved: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library(tmp_path / "library")
    with monkeypatch.context() as patch:
        patch.setattr(durable, "free_bytes", lambda folder: 1000)
        with pytest.raises(NoRoom, match="restoring needs"):
            library.restore(saved[1])
    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(NoRoom):
        library.restore(saved[1])
    assert set(os.listdir(library.folder)) <= OWN


@pytest.mark.parametrize("moved", [0, 1, 2])
def test_a_restore_that_was_cut_while_moving_is_finished_by_the_next_start(
    saved: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moved: int
) -> None:
    library, left = Library(tmp_path / "library"), moved
    really_rename = os.rename

    def rename(source: Path, target: Path) -> None:
        nonlocal left
        if left == 0:
            raise OSError(5, "Input/output error")
        left -= 1
        really_rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", rename)
        with pytest.raises(LibraryError, match="the next start finishes it"):
            library.restore(saved[1])
    library.close()
    library = Library(library.folder)
    assert library.found == [f"finished restoring a backup: its last {3 - moved} scans"]
    assert files(library.folder) == files(saved[0])


def test_a_restore_that_was_cut_while_unpacking_is_undone_by_the_next_start(
    saved: tuple[Path, Path], tmp_path: Path
) -> None:
    library = Library(tmp_path / "library")
    library.close()
    staged = library.folder / ".restore-x1" / ("a" * 32)
    staged.mkdir(parents=True)
    (staged / "range.npy").write_bytes(b"half")
    library = Library(library.folder)
    assert library.found == ["removed .restore-x1: a backup that was never completely unpacked"]
    assert library.problems == () and set(os.listdir(library.folder)) <= OWN


def test_every_member_has_a_bound(saved: tuple[Path, Path]) -> None:
    names = {name.partition("/")[2] for name, _ in members(saved[1])} - {""}
    assert names == set(archive.BYTES_MAX)
