import os
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from node import durable
from node.coarse import build_coarse, fill_voids
from node.durable import NoRoom
from node.library import About, Library, content_id, survey
from node.sidecar import Changes
from protocol.errors import LibraryError
from protocol.grid import Grid, GridSpec
from tests.node.library_cases import ABOUT, SPEC, entries, noise, reopened


def test_six_digits_and_more_that_one_id_begins_with_stand_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library = Library(tmp_path)
    scan_id = library.add(noise(0), ABOUT).id
    for digits in (6, 12, 31, 32):
        assert library.resolve(scan_id[:digits]) == scan_id
    for other in (scan_id[:5], "0" * 6, scan_id + "0"):
        assert library.resolve(other) == other
    twin = scan_id[:8] + "0" * 24
    monkeypatch.setattr(library, "_known", {**library._known, twin: library.summary(scan_id)})
    with pytest.raises(LibraryError, match=f"2 scans begin with '{scan_id[:6]}': give more of the id"):
        library.resolve(scan_id[:6])
    assert library.resolve(scan_id) == scan_id


def test_a_kept_scan_is_the_same_after_a_restart(tmp_path: Path) -> None:
    grid = noise(0)
    added = Library(tmp_path / "new" / "library").add(grid, ABOUT)
    opened = Library(tmp_path / "new" / "library").open(added.id)
    for scan in (added, opened):
        assert (scan.id, scan.spec, scan.about) == (content_id(grid), SPEC, ABOUT)
        assert np.array_equal(scan.range_steps, grid.range_steps)
        assert np.array_equal(scan.texture, grid.texture)
        assert np.array_equal(scan.filled, fill_voids(grid.range_steps))
        assert np.array_equal(scan.coarse.range_steps, build_coarse(grid).range_steps)
        assert np.array_equal(scan.coarse.texture, build_coarse(grid).texture)
        assert [level.shape[:2] for level in scan.pyramid] == [(48, 64), (24, 32), (12, 16)]


def test_samples_of_a_scan_are_mapped_and_everything_is_read_only(tmp_path: Path) -> None:
    scan = Library(tmp_path).add(noise(0), ABOUT)
    assert isinstance(scan.range_steps.base, np.memmap) and isinstance(scan.texture.base, np.memmap)
    steps = [scan.range_steps, scan.filled, scan.coarse.range_steps, scan.coarse.filled]
    images = [scan.texture, scan.coarse.texture, *scan.pyramid]
    assert not any(array.flags.writeable for array in steps)
    assert not any(array.flags.writeable for array in images)


def test_the_id_tells_any_change_of_samples_or_geometry() -> None:
    grid = noise(0)
    other_range, other_texture = grid.range_steps.copy(), grid.texture.copy()
    other_range[3, 4] ^= 1
    other_texture[5, 6, 2] ^= 1
    other_spec = GridSpec(24, 16, 64, 48, step_mm=0.05, pitch_mm=1.0, z_max_mm=12.5, theta0_rad=0.5)
    grids = [
        grid,
        Grid(SPEC, other_range, grid.texture),
        Grid(SPEC, grid.range_steps, other_texture),
        Grid(other_spec, grid.range_steps, grid.texture),
    ]
    grids.append(Grid(replace(SPEC, geometry="sphere"), grid.range_steps, grid.texture))
    grids += [replace(grid, repairs=np.array([row], np.int32)) for row in ((3, 4, 0), (3, 4, 9), (3, 5, 0))]
    assert len({content_id(g) for g in grids}) == 8
    assert content_id(Grid(SPEC, np.asfortranarray(grid.range_steps), grid.texture)) == content_id(grid)


def test_a_cylinders_id_is_what_it_was_before_there_were_spheres() -> None:
    spec = GridSpec(8, 2, 16, 2, step_mm=0.05, pitch_mm=1.0)
    grid = Grid(spec, np.arange(16, dtype=np.uint16).reshape(2, 8), np.zeros((2, 16, 3), np.uint8))
    assert content_id(grid) == "a720f80d2fff05eaaabc107be9b2e809"


def test_what_was_repaired_is_kept_with_the_scan_and_checked(tmp_path: Path) -> None:
    repairs = np.array([[0, 3, 0], [2, 1, 700]], np.int32)
    library = Library(tmp_path)
    scan = library.add(replace(noise(0), repairs=repairs), ABOUT)
    library = reopened(library)
    for found in (scan, library.open(scan.id)):
        assert np.array_equal(found.grid.repairs, repairs) and content_id(found.grid) == scan.id
    path = tmp_path / scan.id / "repairs.npy"
    whole = path.read_bytes()
    path.write_bytes(whole[:-4] + b"\1\0\0\0")
    with pytest.raises(LibraryError, match="not what they were"):
        reopened(library).open(scan.id)
    path.unlink()
    (problem,) = survey(tmp_path)[1]
    assert "repairs.npy cannot be read" in problem.reason


def test_a_sphere_is_kept_as_one(tmp_path: Path) -> None:
    library = Library(tmp_path)
    grid = noise(0)
    scan = library.add(Grid(replace(SPEC, geometry="sphere"), grid.range_steps, grid.texture), ABOUT)
    assert reopened(library).open(scan.id).spec.geometry == "sphere"


def test_scans_are_listed_newest_first_whatever_the_clock_said(tmp_path: Path) -> None:
    library = Library(tmp_path)
    ids = [library.add(noise(seed), About(1e9 - 1000 * seed)).id for seed in range(3)]
    library = reopened(library)
    ids.append(library.add(noise(3), About(0.0)).id)
    for current in (library, reopened(library)):
        assert [summary.id for summary in current.scans()] == ids[::-1]
        assert [summary.sequence for summary in current.scans()] == [4, 3, 2, 1]


def test_a_scan_that_comes_back_as_a_file_keeps_what_is_known_of_it(tmp_path: Path) -> None:
    library = Library(tmp_path)
    library.add(noise(0), About(1e9, "derived", "head", note="lids", made_from=("0" * 32,)))
    again = library.add(noise(0), About(2e9, "import", "bust"))
    assert again.about == About(1e9, "derived", "bust", note="lids", made_from=("0" * 32,))
    assert reopened(library).open(again.id).about == again.about


def test_the_same_content_again_is_the_same_scan_and_the_newest(tmp_path: Path) -> None:
    library = Library(tmp_path)
    first = library.add(noise(0), ABOUT)
    library.add(noise(1), ABOUT)
    again = library.add(noise(0), About(2e9, name="again"))
    assert again.id == first.id
    assert again.range_steps is first.range_steps
    for current in (library, reopened(library)):
        assert [summary.about.name for summary in current.scans()] == ["again", "head"]
        assert current.open(first.id).about == About(2e9, name="again")
        assert current.problems == ()
    assert len(entries(tmp_path)) == 2


def test_listing_reads_no_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Library(tmp_path).add(noise(0), ABOUT)
    opened: list[str] = []
    really_open = open

    def noted_open(path: Path, mode: str = "r") -> object:
        opened.append(Path(path).name)
        return really_open(path, mode)

    monkeypatch.setattr(durable, "open", noted_open, raising=False)
    monkeypatch.setattr(np, "load", lambda *_, **__: pytest.fail("samples were read"))
    assert len(Library(tmp_path).scans()) == 1
    assert set(opened) == {"library.json", "axes.json", "scan.json", "sidecar.json"}


@pytest.mark.parametrize("scan_id", ["", "0" * 32, "../library", "x" * 10_000, "\0"])
def test_an_unknown_scan_is_refused(tmp_path: Path, scan_id: str) -> None:
    with pytest.raises(LibraryError, match="no scan .{0,60} in this library"):
        Library(tmp_path).open(scan_id)


def test_a_scan_that_cannot_be_written_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    library = Library(tmp_path)

    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    for name in ("fsync", "rename"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, full_disk)
            with pytest.raises(NoRoom, match="No space left on device"):
                library.add(noise(0), ABOUT)
        assert entries(tmp_path) == set()
        assert library.scans() == []
    assert library.add(noise(0), ABOUT).id == library.scans()[0].id


def test_a_deleted_scan_is_gone_for_all_but_those_who_look_at_it(tmp_path: Path) -> None:
    library = Library(tmp_path)
    grid = noise(0)
    scan, other = library.add(grid, ABOUT), library.add(noise(1), ABOUT)
    library.delete(scan.id)
    assert np.array_equal(scan.texture, grid.texture)
    for current in (library, reopened(library)):
        assert [summary.id for summary in current.scans()] == [other.id]
        with pytest.raises(LibraryError, match="no scan"):
            current.open(scan.id)
        with pytest.raises(LibraryError, match="no scan"):
            current.delete(scan.id)
    assert entries(tmp_path) == {other.id}


def test_a_renamed_scan_is_listed_under_its_new_name(tmp_path: Path) -> None:
    library = Library(tmp_path)
    scan_id = library.add(noise(0), ABOUT).id
    assert library.sidecar(scan_id).name == ABOUT.name, "or a form that shows none would save none"
    assert library.annotate(scan_id, Changes(body_site="knee"), "ana").name == ABOUT.name
    library.rename(scan_id, "left knee", "ana")
    library.annotate(scan_id, Changes(subject="P-17"), "ben")
    for current in (library, reopened(library)):
        assert [summary.about.name for summary in current.scans()] == ["left knee"]
        assert current.open(scan_id).id == scan_id
        sidecar = current.sidecar(scan_id)
        assert (sidecar.subject, [change.by for change in sidecar.history]) == ("P-17", ["ana", "ana", "ben"])


def test_scans_used_last_stay_open(tmp_path: Path) -> None:
    library = Library(tmp_path, open_max=2)
    a, b = library.add(noise(0), ABOUT), library.add(noise(1), ABOUT)
    assert library.open(a.id) is a
    library.add(noise(2), ABOUT)
    assert library.open(a.id) is a
    assert library.open(b.id) is not b


def test_threads_that_open_one_scan_share_it(tmp_path: Path) -> None:
    scan_id = Library(tmp_path).add(noise(0), ABOUT).id
    library, start = Library(tmp_path), threading.Barrier(4)
    opened: list[object] = []

    def open_it() -> None:
        start.wait()
        opened.append(library.open(scan_id))

    threads = [threading.Thread(target=open_it) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(opened) == 4
    assert len({id(scan) for scan in opened}) == 1


def test_first_views_are_as_large_as_the_library_allows(tmp_path: Path) -> None:
    small = Library(tmp_path, first_view_bytes=64).add(noise(0), ABOUT)
    assert small.coarse.texture.shape == (6, 8, 3)
    assert len(small.pyramid) == 4


@pytest.mark.parametrize("about", [{"created_unix_s": float("nan")}, {"created_unix_s": 0.0, "name": "x" * 201}])
def test_an_about_out_of_bounds_is_refused(about: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be finite|at most 200"):
        About(**about)  # type: ignore[arg-type]
