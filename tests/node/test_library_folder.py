"""A library whose folder is not as it should be: damaged, foreign, half written, of another version, in use."""

import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from node.library import Library, survey, verify
from node.scan_folder import read_grid
from protocol.errors import LibraryError
from tests.node.library_cases import ABOUT, SPEC, entries, files_in, noise, reopened


def _cut_range(folder: Path) -> None:
    (folder / "range.npy").write_bytes((folder / "range.npy").read_bytes()[:-300])


def _lose_texture(folder: Path) -> None:
    (folder / "texture.npy").unlink()


def _lose_record(folder: Path) -> None:
    (folder / "scan.json").unlink()


def _garble_record(folder: Path) -> None:
    (folder / "scan.json").write_bytes(b'{"format": 1, \xff')


def _rot_in_a_text(folder: Path) -> None:
    record = (folder / "scan.json").read_bytes()
    (folder / "scan.json").write_bytes(record.replace(b'"sweep"', b'"swe\xe5p"'))


def _bloat_record(folder: Path) -> None:
    (folder / "scan.json").write_bytes(b" " * 70_000)


def _edit_record(folder: Path, **fields: object) -> None:
    record = json.loads((folder / "scan.json").read_bytes())
    (folder / "scan.json").write_text(json.dumps(record | fields))


def _write_as_newer(folder: Path) -> None:
    _edit_record(folder, format=2, surprise=True)


def _claim_another_id(folder: Path) -> None:
    _edit_record(folder, id="0" * 32)


def _claim_a_width_of_0(folder: Path) -> None:
    spec = json.loads((folder / "scan.json").read_bytes())["spec"]
    _edit_record(folder, spec=spec | {"width": 0})


def _rename_folder(folder: Path) -> None:
    folder.rename(folder.with_name("copy of it"))


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (_cut_range, "range.npy has the wrong size"),
        (_lose_texture, "texture.npy cannot be read: No such file"),
        (_lose_record, "scan.json cannot be read: No such file"),
        (_garble_record, "scan.json is damaged"),
        (_rot_in_a_text, "scan.json is damaged"),
        (_bloat_record, "scan.json is larger than 65536 bytes"),
        (_write_as_newer, "written in a format that this version does not know"),
        (_claim_another_id, "scan.json belongs to scan '000"),
        (_claim_a_width_of_0, "width must be between"),
        (_rename_folder, "not a scan"),
    ],
)
def test_a_damaged_folder_is_reported_left_alone_and_disturbs_nothing(
    tmp_path: Path, damage: Callable[[Path], None], reason: str
) -> None:
    library = Library(tmp_path)
    sound, hurt = library.add(noise(0), ABOUT), library.add(noise(1), ABOUT)
    damage(tmp_path / hurt.id)
    before = files_in(tmp_path)
    library = reopened(library)
    assert [summary.id for summary in library.scans()] == [sound.id]
    assert [reason in problem.reason for problem in library.problems] == [True]
    with pytest.raises(LibraryError, match="no scan"):
        library.open(hurt.id)
    assert library.open(sound.id).id == sound.id
    assert files_in(tmp_path) == before


@pytest.mark.parametrize(
    ("file", "offset"), [("range.npy", -1), ("texture.npy", -1), ("range.npy", 0), ("texture.npy", 20)]
)
def test_a_rotten_byte_is_found_when_the_scan_is_opened(tmp_path: Path, file: str, offset: int) -> None:
    library = Library(tmp_path)
    scan_id = library.add(noise(0), ABOUT).id
    path = tmp_path / scan_id / file
    data = bytearray(path.read_bytes())
    data[offset] ^= 1
    path.write_bytes(data)
    library = reopened(library)
    with pytest.raises(LibraryError, match="is damaged"):
        library.open(scan_id)
    assert [problem.name for problem in library.problems] == [scan_id]
    assert library.scans() == []
    with pytest.raises(LibraryError, match="cannot keep scan"):
        library.add(noise(0), ABOUT)
    assert path.read_bytes() == data
    assert len(entries(tmp_path)) == 1


def test_an_archive_in_the_place_of_an_array_is_refused(tmp_path: Path) -> None:
    library = Library(tmp_path)
    scan_id = library.add(noise(0), ABOUT).id
    path = tmp_path / scan_id / "range.npy"
    size_bytes = path.stat().st_size
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("range.npy", bytes(size_bytes - 120))
    assert 2 * SPEC.width * SPEC.height < path.stat().st_size
    library = reopened(library)
    with pytest.raises(LibraryError, match="is damaged"):
        library.open(scan_id)


def test_foreign_things_are_reported_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "holiday").mkdir()
    (tmp_path / ("a" * 32)).write_text("a file with the name of a scan")
    (tmp_path / ".incoming-x1").mkdir()
    (tmp_path / ".incoming-x1" / "letter.txt").write_text("mine")
    library = Library(tmp_path)
    reasons = {problem.name: problem.reason for problem in library.problems}
    assert set(reasons) == {"notes.txt", "holiday", ".incoming-x1", "a" * 32}
    assert "unfinished" in reasons.pop(".incoming-x1")
    assert set(reasons.values()) == {"not a scan"}
    assert library.found == []
    assert (tmp_path / ".incoming-x1" / "letter.txt").read_text() == "mine"


def test_what_a_crash_left_is_cleared_away_and_told(tmp_path: Path) -> None:
    library = Library(tmp_path)
    scan_id = library.add(noise(0), ABOUT).id
    gone_id = library.add(noise(1), ABOUT).id
    (tmp_path / ".incoming-x1").mkdir()
    (tmp_path / ".incoming-x1" / "range.npy").write_bytes(b"half of it")
    (tmp_path / gone_id).rename(tmp_path / f".trash-{gone_id}-12345678")
    (tmp_path / scan_id / "sidecar.json.new").write_text("half of it")
    library = reopened(library)
    removed, finished = library.found
    assert "never completely written" in removed
    assert finished == f"finished deleting scan {gone_id}"
    assert [summary.id for summary in library.scans()] == [scan_id]
    assert library.problems == ()
    assert entries(tmp_path) == {scan_id}
    assert {path.name for path in (tmp_path / scan_id).iterdir()} == {"range.npy", "texture.npy", "scan.json"}


def test_a_library_is_one_process_s_at_a_time(tmp_path: Path) -> None:
    library = Library(tmp_path)
    with pytest.raises(LibraryError, match=f"in use by process {os.getpid()}"):
        Library(tmp_path)
    assert reopened(library).scans() == []


def test_a_library_that_cannot_be_locked_is_refused(tmp_path: Path) -> None:
    (tmp_path / "lock").mkdir()
    with pytest.raises(LibraryError, match="cannot be used: Is a directory"):
        Library(tmp_path)


def test_a_library_of_a_newer_version_is_refused_untouched(tmp_path: Path) -> None:
    library = Library(tmp_path)
    library.add(noise(0), ABOUT)
    library.close()
    (tmp_path / "library.json").write_text('{"format": 2, "surprise": true}')
    (tmp_path / ".incoming-x1").mkdir()
    before = files_in(tmp_path)
    for look in (Library, survey):
        with pytest.raises(LibraryError, match="has format 2"):
            look(tmp_path)
    assert files_in(tmp_path) == before
    assert (tmp_path / ".incoming-x1").exists()


@pytest.mark.parametrize("mark", [b"", b"{}", b'{"format": "x"}', b'{"format": "\xff"}', b" " * 5000, b"\xff"])
def test_a_library_with_a_damaged_mark_is_refused(tmp_path: Path, mark: bytes) -> None:
    (tmp_path / "library.json").write_bytes(mark)
    with pytest.raises(LibraryError):
        Library(tmp_path)
    assert files_in(tmp_path) == {"library.json": mark}


def test_a_scan_with_a_damaged_sidecar_stays_and_the_sidecar_is_left_alone(tmp_path: Path) -> None:
    library = Library(tmp_path)
    scan_id = library.add(noise(0), ABOUT).id
    library.rename(scan_id, "left knee", "ana")
    path = tmp_path / scan_id / "sidecar.json"
    path.write_bytes(path.read_bytes().replace(b"left knee", b"left knew"))
    before = path.read_bytes()
    library = reopened(library)
    assert [problem.name for problem in library.problems] == [f"{scan_id}/sidecar.json"]
    assert library.open(scan_id).about.name == "head"
    with pytest.raises(LibraryError, match="damaged"):
        library.sidecar(scan_id)
    with pytest.raises(LibraryError, match="damaged"):
        library.rename(scan_id, "x", "ana")
    assert path.read_bytes() == before


def test_verify_reads_every_sample_and_needs_no_lock(tmp_path: Path) -> None:
    library = Library(tmp_path)
    sound, rotten = library.add(noise(0), ABOUT).id, library.add(noise(1), ABOUT).id
    path = tmp_path / rotten / "texture.npy"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    for found in (dict(library.verify()), dict(verify(tmp_path, list(survey(tmp_path)[0])))):
        assert found[sound] is None
        assert "not what they were" in str(found[rotten])


def test_a_library_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "library").write_text("")
    with pytest.raises(LibraryError, match="cannot be used"):
        Library(tmp_path / "library")


def test_samples_whose_header_is_no_python_are_damaged(tmp_path: Path) -> None:
    scan = Library(tmp_path).add(noise(0), ABOUT)
    file = tmp_path / scan.id / "range.npy"
    file.chmod(0o600)
    file.write_bytes(file.read_bytes().replace(b"'<u2'", b"'<02'", 1))
    with pytest.raises(LibraryError, match="its samples cannot be read"):
        read_grid(tmp_path / scan.id, scan.spec)
