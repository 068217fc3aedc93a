import json
from dataclasses import replace
from pathlib import Path

import pytest

from node.axes import FILE, SCANNERS_MAX, SPOILT, Axes
from node.durable import NEW
from node.library import Library
from protocol.errors import LibraryError
from tests.node.round_bodies import KNOWN

FOUND = KNOWN.estimate


def test_what_is_kept_is_there_after_a_restart(tmp_path: Path) -> None:
    axes = Axes(tmp_path)
    other = replace(KNOWN, scanner="µ/2 \"", settings=7)
    axes.keep(KNOWN)
    axes.keep(other)
    again = Axes(tmp_path)
    assert again.known() == axes.known() == (KNOWN, other)
    assert again.of("SIM-0001", (1 << 64) - 1) == (FOUND.axis, "") and again.of(other.scanner, 7) == (FOUND.axis, "")
    assert again.of("SIM-9", 1) == (None, "")


def test_other_settings_of_the_scanner_void_it_and_say_so(tmp_path: Path) -> None:
    axes = Axes(tmp_path)
    axes.keep(KNOWN)
    axis, trouble = axes.of("SIM-0001", 3)
    assert axis is None and "settings changed since: calibrate again" in trouble


def test_a_new_calibration_takes_the_place_of_the_old_one(tmp_path: Path) -> None:
    axes = Axes(tmp_path)
    axes.keep(KNOWN)
    axes.keep(replace(KNOWN, scanner="other"))
    newer = replace(KNOWN, diameter_mm=60.0)
    axes.keep(newer)
    assert [known.scanner for known in axes.known()] == ["other", "SIM-0001"] and axes.known()[-1] == newer


def test_what_is_forgotten_is_gone(tmp_path: Path) -> None:
    axes = Axes(tmp_path)
    axes.keep(KNOWN)
    assert axes.forget("SIM-0001") and not axes.forget("SIM-0001")
    assert axes.of("SIM-0001", KNOWN.settings) == (None, "") and Axes(tmp_path).known() == ()


def test_as_many_scanners_are_kept_as_can_be_read_again(tmp_path: Path) -> None:
    axes = Axes(tmp_path)
    for number in range(SCANNERS_MAX + 3):
        axes.keep(replace(KNOWN, scanner=f"{'s' * 190}{number:04}"))
    again = Axes(tmp_path)
    assert len(again.known()) == SCANNERS_MAX and again.known()[0].scanner.endswith("0003")
    assert again.of("anybody", 1) == (None, "")


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"format": 1', '"format": 2'),
        lambda text: text.replace('"lateral_mm": 0.8', '"lateral_mm": 1e9'),
        lambda text: text.replace('"lean_rad": 0.002', '"lean_rad": 0.2'),
        lambda text: text.replace('"scanner": "SIM-0001"', '"scanner": 1'),
        lambda text: text + " " * (1 << 18),
    ],
    ids=["cut", "newer", "far off", "too slanting", "no text", "too long"],
)
def test_a_damaged_file_stops_no_node_and_is_told_with_every_scan(tmp_path: Path, damage) -> None:  # type: ignore[no-untyped-def]
    Axes(tmp_path).keep(KNOWN)
    path = tmp_path / FILE
    sound = path.read_text()
    path.write_text(damage(sound))
    assert path.read_text() != sound
    axes = Axes(tmp_path)
    axis, trouble = axes.of("SIM-0001", KNOWN.settings)
    assert axis is None and "axes.json cannot be read: calibrate again" in trouble
    assert axes.damaged.startswith("axes.json cannot be read")
    axes.keep(KNOWN)
    assert axes.damaged == "" == Axes(tmp_path).damaged
    assert axes.of("SIM-0001", KNOWN.settings) == (FOUND.axis, "") and json.loads(path.read_text())["format"] == 1
    assert path.with_name(SPOILT).read_text() == damage(sound), "other scanners may stand in it"
    for again in (axes, Axes(tmp_path)):
        assert "if axes.json.damaged knew it" in again.of("OTHER", 1)[1]
    path.with_name(SPOILT).unlink()
    assert Axes(tmp_path).of("OTHER", 1) == (None, "")


def test_what_cannot_be_written_changes_nothing(tmp_path: Path) -> None:
    axes = Axes(tmp_path)
    axes.keep(KNOWN)
    (tmp_path / (FILE + NEW)).mkdir()
    with pytest.raises(LibraryError, match="cannot keep the scanner's axis"):
        axes.keep(replace(KNOWN, diameter_mm=1.0))
    assert axes.known() == (KNOWN,)


def test_the_library_takes_the_file_for_its_own(tmp_path: Path) -> None:
    library = Library(tmp_path)
    library.axes.keep(KNOWN)
    library.close()
    (tmp_path / (FILE + NEW)).write_text("half")
    library = Library(tmp_path)
    assert library.problems == () and library.axes.known() == (KNOWN,)
    library.close()
