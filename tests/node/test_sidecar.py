import json
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from node import sidecar as sidecar_module
from node.sidecar import Changes, Conflict, Pin, Sidecar, change_sidecar, decode_changes, read_sidecar
from protocol.errors import LibraryError

SHARES = st.floats(0, 1, exclude_max=True)


def test_a_scan_of_which_nobody_said_anything_has_nothing_said(tmp_path: Path) -> None:
    assert read_sidecar(tmp_path) == Sidecar()
    assert list(tmp_path.iterdir()) == []


def test_changes_add_up_and_the_history_has_them_all(tmp_path: Path) -> None:
    pins = (Pin(0.25, 0.5, "mole"), Pin(0.0, 0.999))
    first = Changes(subject="P-17", body_site="left forearm", notes="itches", pins=pins)
    change_sidecar(tmp_path, first, "ana", 10.0)
    change_sidecar(tmp_path, Changes(notes="", taken_unix_s=1e9), "ben", 5.0)
    now = change_sidecar(tmp_path, Changes(name="arm", taken_unix_s=None), "ana", 11.0)
    assert now == read_sidecar(tmp_path)
    assert (now.revision, now.name, now.subject, now.body_site) == (3, "arm", "P-17", "left forearm")
    assert (now.notes, now.taken_unix_s, now.pins) == ("", None, pins)
    assert [(change.at_unix_s, change.by) for change in now.history] == [(10.0, "ana"), (5.0, "ben"), (11.0, "ana")]
    assert now.history[0].set == first


def test_a_change_meant_for_another_revision_is_a_conflict(tmp_path: Path) -> None:
    change_sidecar(tmp_path, Changes(notes="a"), "ana", 1.0, revision=0)
    with pytest.raises(Conflict, match="at revision 1, not 0"):
        change_sidecar(tmp_path, Changes(notes="b"), "ben", 2.0, revision=0)
    assert read_sidecar(tmp_path).notes == "a"


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("{}", "changes nothing"),
        ('{"subject": "' + "x" * 65 + '"}', "subject"),
        ('{"name": "' + "x" * 201 + '"}', "name"),
        ('{"notes": "' + "x" * 8001 + '"}', "notes"),
        ('{"body_site": 3}', "body_site"),
        ('{"pins": [{"u": 1.0, "v": 0.5}]}', r"pins\[0\].u|pins\[...\].u"),
        ('{"pins": [{"u": NaN, "v": 0.5}]}', "malformed"),
        ('{"pins": [' + ",".join(['{"u":0,"v":0}'] * 101) + "]}", "pins"),
        ('{"taken_unix_s": 1e300}', "taken_unix_s"),
        ('{"surname": "x"}', "surname"),
        ('{"notes": "' + "x" * 70000 + '"}', "at most"),
        ("[]", "object"),
        ("", "truncated"),
        ("\udcff", "utf|UTF|invalid|malformed"),
    ],
)
def test_changes_out_of_bounds_are_refused_by_name_and_change_nothing(tmp_path: Path, text: str, field: str) -> None:
    with pytest.raises(ValueError, match=field):
        change_sidecar(tmp_path, decode_changes(text.encode("utf-8", "surrogateescape")), "ana", 1.0)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("changes", [Changes(), Changes(notes="x" * 8001), Changes(pins=(Pin(2.0, 0.0),))])
def test_bounds_hold_for_callers_in_this_process_too(tmp_path: Path, changes: Changes) -> None:
    with pytest.raises(ValueError):
        change_sidecar(tmp_path, changes, "ana", 1.0)
    with pytest.raises(ValueError, match="by"):
        change_sidecar(tmp_path, Changes(notes="a"), "x" * 101, 1.0)
    assert list(tmp_path.iterdir()) == []


def test_a_full_history_takes_no_more_and_stays_readable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sidecar_module, "FILE_BYTES_MAX", 1000)
    with pytest.raises(LibraryError, match="is full"):
        for count in range(100):
            change_sidecar(tmp_path, Changes(notes=f"note {count}"), "ana", 1.0)
    assert 1 < read_sidecar(tmp_path).revision < 100


@given(
    changes=st.lists(
        st.builds(
            Changes,
            subject=st.text(max_size=64),
            notes=st.text(st.characters(codec="utf-8"), max_size=200),
            pins=st.lists(st.builds(Pin, SHARES, SHARES, st.text(max_size=9)), max_size=3).map(tuple),
        ),
        min_size=1,
        max_size=4,
    )
)
def test_what_is_written_is_read_back(tmp_path_factory: pytest.TempPathFactory, changes: list[Changes]) -> None:
    folder = tmp_path_factory.mktemp("scan")
    for change in changes:
        now = change_sidecar(folder, change, "ana", 1.0)
    assert read_sidecar(folder) == now
    assert [entry.set for entry in now.history] == changes
    assert (now.subject, now.pins) == (changes[-1].subject, changes[-1].pins)


@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_no_flipped_byte_of_what_was_said_goes_unnoticed(
    tmp_path_factory: pytest.TempPathFactory, place: float, flip: int
) -> None:
    folder = tmp_path_factory.mktemp("scan")
    said = change_sidecar(folder, Changes(subject="P-17", notes="itches"), "ana", 1.0)
    path = folder / "sidecar.json"
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= flip
    path.write_bytes(data)
    try:
        found = read_sidecar(folder)
    except LibraryError:
        with pytest.raises(LibraryError):
            change_sidecar(folder, Changes(notes="more"), "ana", 2.0)
        assert path.read_bytes() == data
    else:
        assert found == said  # it hit white space


def test_a_sidecar_of_a_newer_format_is_left_alone(tmp_path: Path) -> None:
    change_sidecar(tmp_path, Changes(notes="a"), "ana", 1.0)
    path = tmp_path / "sidecar.json"
    path.write_text(json.dumps(json.loads(path.read_bytes()) | {"format": 2, "surprise": 1}))
    before = path.read_bytes()
    with pytest.raises(LibraryError, match="format that this version does not know"):
        read_sidecar(tmp_path)
    with pytest.raises(LibraryError, match="format that this version does not know"):
        change_sidecar(tmp_path, Changes(notes="b"), "ana", 1.0)
    assert path.read_bytes() == before


def test_a_sidecar_larger_than_any_is_refused_before_it_is_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sidecar.json").write_bytes(b" " * (sidecar_module.FILE_BYTES_MAX + 1))
    monkeypatch.setattr(msgspec.json, "decode", lambda *_, **__: pytest.fail("it was parsed"))
    with pytest.raises(LibraryError, match="larger than"):
        read_sidecar(tmp_path)
