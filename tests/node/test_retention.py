"""What was kept long enough goes, and nothing that is pinned, open or of a wrong clock; what is deleted is gone."""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import AsyncIterator
from contextlib import closing
from pathlib import Path

import pytest

from client import RequestRefused, connect
from node import serve
from node.audit import done_trail, read_trail
from node.config import Retention
from node.library import About, Library
from node.library_command import add_library_command
from node.retention import DAY_S, Expired, expired
from node.sidecar import FILE, Changes, Pin
from tests.node.entrance import Entrance, entrance
from tests.node.scans import make_grid
from tests.node.test_journal import HEADER, INFO
from tests.node.test_library_command import run
from tests.waiting import until

NOW = 1.8e9
MONTH = Retention(max_age_days=30)


def kept(library: Library, days_old: float, *, pinned: bool = False) -> str:
    """A scan that came so long ago; its id."""
    seed = len(library.scans())
    scan = library.add(make_grid(40, 24, seed=seed), About(NOW - days_old * DAY_S)).id
    if pinned:
        library.annotate(scan, Changes(pins=(Pin(0.5, 0.5),)), "test")
    return scan


def found(library: Library, rules: Retention, is_open: tuple[str, ...] = ()) -> list[str]:
    sweeps = library.sweeps.interrupted()
    return [one.id for one in expired(library.folder, library.scans(), sweeps, rules, NOW, is_open)]


@pytest.fixture
def library(tmp_path: Path) -> Library:
    return Library(tmp_path / "library")


def test_without_rules_nothing_goes(library: Library) -> None:
    kept(library, 20000)
    assert found(library, Retention()) == []


def test_what_is_old_goes_unless_it_is_pinned_or_open(library: Library) -> None:
    old, opened, pinned, _ = (kept(library, 31), kept(library, 31), kept(library, 99, pinned=True), kept(library, 29))
    assert found(library, MONTH, (opened,)) == [old]
    assert found(library, MONTH) == [old, opened]
    library.annotate(pinned, Changes(pins=()), "test")
    assert found(library, MONTH) == [old, opened, pinned]


def test_a_wrong_clock_deletes_nothing(library: Library) -> None:
    kept(library, -3)  # from the future
    kept(library, NOW / DAY_S)  # from 1970
    mended = kept(library, NOW / DAY_S - 1)
    library.annotate(mended, Changes(taken_unix_s=NOW - 40 * DAY_S), "test")
    late = kept(library, 40)
    library.annotate(late, Changes(taken_unix_s=NOW - 2 * DAY_S), "test")
    assert found(library, MONTH) == [mended]


def test_a_scan_whose_sidecar_cannot_be_read_stays(library: Library) -> None:
    scan = kept(library, 99)
    (library.folder / scan / FILE).write_text("?")
    assert found(library, MONTH) == []


def test_where_scans_take_too_much_the_oldest_go_until_they_fit(library: Library) -> None:
    first, second, pinned, *others = (kept(library, 5 - n, pinned=n == 2) for n in range(5))
    each = sum(path.stat().st_size for path in (library.folder / others[0]).iterdir())
    rules = Retention(max_gb=0.1)
    assert found(library, rules) == []
    for scan in library.scans():  # so large that two of them fit into 0.1 GB
        os.truncate(library.folder / scan.id / "scan.json", 45_000_000 - each)
    assert found(library, rules) == [first, second, others[0]]
    assert found(library, rules, (first,)) == [second, *others]


def test_interrupted_sweeps_go_by_age(library: Library) -> None:
    journal = library.sweeps.begin(INFO, HEADER, NOW)
    library.sweeps.keep(journal, "cut")
    path = library.folder / "sweeps" / f"{journal.id}.sweep"
    for days, gone in ((29, []), (31, [journal.id])):
        os.utime(path, (NOW - days * DAY_S,) * 2)
        library.close()
        library = Library(library.folder)
        assert found(library, MONTH) == gone


# The command


def test_the_command_says_what_would_go_and_deletes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "library"
    with closing(Library(folder)) as library:
        old, pinned = (library.add(make_grid(40, 24, seed=seed), About(1.6e9 + seed)).id for seed in (0, 1))
        library.annotate(pinned, Changes(pins=(Pin(0.5, 0.5),)), "test")
        common = "--library", folder, "--json"
        run("prune", *common, "--dry-run")
        assert json.loads(capsys.readouterr().out) == {"expired": [], "deleted": 0}
        run("prune", *common, "--dry-run", "--max-age-days", 30)  # also while a node has the library
        [would] = json.loads(capsys.readouterr().out)["expired"]
        assert (would["id"], len(library.scans())) == (old, 2)
    run("prune", *common, "--yes", "--max-age-days", 30)
    assert json.loads(capsys.readouterr().out)["deleted"] == 1
    with closing(Library(folder)) as library:
        assert [scan.id for scan in library.scans()] == [pinned]
    [noted] = read_trail(done_trail(folder, 1 << 26))
    assert (noted.event, noted.role, noted.scan) == ("expired", "console", old)
    assert add_library_command.__doc__


# A node


@pytest.fixture
async def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Entrance]:
    assert serve.RETAIN_S == 600, "README says every ten minutes"
    monkeypatch.setattr(serve, "RETAIN_S", 0.05)
    async with entrance(tmp_path / "library", retention=MONTH) as node:
        yield node


async def test_a_node_deletes_by_itself_but_never_what_somebody_looks_at(node: Entrance) -> None:
    node.library.delete(node.scan)
    pinned = node.library.add(make_grid(40, 24, seed=9), About(1.6e9))
    node.library.annotate(pinned.id, Changes(pins=(Pin(0.5, 0.5),)), "test")
    async with connect(node.url, node.token("view"), node.tls.fingerprint) as session:
        await session.open(pinned.id)
        node.library.annotate(pinned.id, Changes(pins=()), "test")
        other = node.library.add(make_grid(40, 24, seed=8), About(1.6e9))
        await until(lambda: [scan.id for scan in node.library.scans()] == [pinned.id])
        await asyncio.sleep(0.2)
        assert (await session.look(0.5, 0.5)).reason == "complete"
    await until(lambda: node.library.scans() == [])
    await until(lambda: node.server.audit.waiting == 0)
    trail = done_trail(node.library.folder, 1 << 26)
    await until(lambda: {other.id, pinned.id} <= {one.scan for one in read_trail(trail) if one.event == "expired"})
    entries = [one for one in read_trail(trail) if one.event == "expired"]
    assert all(one.by == "the node" and one.what.endswith("days old") for one in entries)


async def test_what_is_deleted_is_gone_from_the_node(tmp_path: Path) -> None:
    async with (
        entrance(tmp_path / "library") as node,
        connect(node.url, node.token("view"), node.tls.fingerprint) as session,
    ):
        token, place = node.token("operate"), f"/v1/scans/{node.scan}"
        await session.open(node.scan)
        async with node.ask("GET", f"{place}/fovea?u=0.5&v=0.5", token) as answer:
            fovea = answer.headers["Location"]
        for path in (fovea, f"{place}.glb", f"{place}/coarse"):
            async with node.ask("GET", path, token) as answer:
                assert (answer.status, len(await answer.read()) > 0) == (200, True)
        async with node.ask("DELETE", place, token) as answer:
            assert answer.status == 204
        with pytest.raises(RequestRefused, match="deleted"):
            await session.look(0.5, 0.5)
        for path, status in ((fovea, 410), (f"{place}.glb", 404), (f"{place}/coarse", 404), (f"{place}/sidecar", 404)):
            async with node.ask("GET", path, token) as answer:
                assert answer.status == status, path
        left = {path.name for path in node.library.folder.rglob("*") if path.is_file()}
        assert left == {
            "library.json", "lock", "access.json", "certificate.pem", "audit.jsonl", "refused.jsonl"
        } - ({"refused.jsonl"} - left)  # fmt: skip
        maps = Path("/proc/self/maps")  # a thread may be measuring its texture still
        place_on_disk = f"{node.library.folder}/{node.scan}/"  # other tests may hold the same scan of theirs
        await until(lambda: place_on_disk not in maps.read_text())


def test_what_expires_is_said_in_words(library: Library) -> None:
    kept(library, 31)
    [one] = expired(library.folder, library.scans(), [], MONTH, NOW)
    assert isinstance(one, Expired) and one.why == "31 days old"
