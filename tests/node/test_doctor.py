from __future__ import annotations

import datetime as dt
import fcntl
import json
import os
import pty
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

import foveascan
from node import config as settings
from node import doctor, library_folder, listener, machine
from node.access import access_folder
from node.audit import done_trail
from node.doctor import Finding
from node.durable import EASY_BYTES
from node.identity import node_identity
from node.library import About, Library
from node.listener import who_answers
from node.machine import Account
from node.tls import renew_own
from protocol.grid import Grid, GridSpec

ROOT = Account("root", 0, frozenset({0}))
STRANGER = Account("stranger", 4711, frozenset({4711}))


def states(*findings: Finding) -> list[str]:
    return [finding.state for finding in findings]


@pytest.fixture
def port() -> Iterator[str]:
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


# Configuration


def test_a_wrong_setting_is_named_and_ends_the_examination(tmp_path: Path) -> None:
    (tmp_path / "node.toml").write_text("[capture]\nbaud = 1\n")
    (finding,) = doctor.examine(tmp_path / "node.toml", {})
    assert (finding.check, finding.state) == ("configuration", "problem")
    assert "capture.baud" in finding.found and finding.cure


def test_every_check_has_its_say(tmp_path: Path) -> None:
    findings = list(doctor.examine(None, {"library.folder": str(tmp_path), "server.listen": "127.0.0.1:0"}))
    assert [finding.check for finding in findings] == [
        "configuration", "port", "permission", "server", "certificate", "disk", "memory", "clock", "discovery",
        "library", "audit log",
    ]  # fmt: skip
    assert all(finding.cure for finding in findings if finding.state != "ok")


# Port and permission


def test_a_port_that_is_there_is_fine(port: str) -> None:
    assert doctor.check_port(port) == Finding("port", "ok", port)
    assert states(doctor.check_port(None)) == ["ok"]


def test_a_missing_port_names_those_that_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "serial_ports", lambda: ["/dev/ttyACM3"])
    finding = doctor.check_port("/dev/ttyACM0")
    assert (finding.state, finding.found) == ("problem", "/dev/ttyACM0: No such file or directory")
    assert "/dev/ttyACM3" in finding.cure


def test_a_port_that_another_program_uses_is_a_problem_unless_it_is_the_node(port: str) -> None:
    with open(port, "rb", buffering=0) as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        busy = doctor.check_port(port)
        assert (busy.state, port in busy.cure) == ("problem", True)
        assert states(doctor.check_port(port, is_used=True)) == ["ok"]
        (told,) = doctor.examine_scanner(port, None, {})
        assert told.found.endswith("another program has it open") and told.cure.startswith("end that")


@pytest.mark.parametrize("address", ["usb:1209:5ca1:NONE", "serial:1209:5ca1:NONE", "usb:nonsense"])
def test_a_scanner_named_by_its_ids_that_is_not_there_is_a_problem(address: str) -> None:
    for finding in (doctor.check_port(address), *doctor.examine_scanner(address, None, {})):
        assert (finding.check, finding.state) == ("port", "problem") and address in finding.found and finding.cure
    assert states(doctor.check_port(address, is_used=True)) == ["ok"]


@pytest.mark.parametrize("path", ["/dev/null", __file__])
def test_what_is_no_serial_port_is_a_problem(path: str) -> None:
    assert states(doctor.check_port(path)) == ["problem"]


def rights(mode: int, user: int = 0, group: int = 0) -> os.stat_result:
    return cast(os.stat_result, SimpleNamespace(st_mode=mode, st_uid=user, st_gid=group))


@pytest.mark.parametrize(
    ("info", "may"),
    [
        (rights(0o660), False),
        (rights(0o660, user=4711), True),
        (rights(0o660, group=4711), True),
        (rights(0o066, user=4711), False),
        (rights(0o606, group=4711), False),
        (rights(0o640, group=4711), False),
        (rights(0o666), True),
    ],
)
def test_rights_are_the_owners_the_groups_or_everybodys(info: os.stat_result, may: bool) -> None:
    assert STRANGER.may(info, machine.READ | machine.WRITE) is may
    assert ROOT.may(info, machine.READ | machine.WRITE)


def test_without_permission_the_udev_rule_is_named(port: str) -> None:
    os.chmod(port, 0o620)
    finding = doctor.check_permission(port, STRANGER)
    assert finding.state == "problem" and port in finding.found
    assert "70-foveascan.rules" in finding.cure and "usermod -aG foveascan stranger" in finding.cure
    service = doctor.check_permission(port, Account("foveascan", 4711, frozenset()))
    assert "70-foveascan.rules" in service.cure and "usermod" not in service.cure


def test_where_the_rule_works_the_group_is_what_lacks(port: str, monkeypatch: pytest.MonkeyPatch) -> None:
    os.chmod(port, 0o660)
    monkeypatch.setattr(doctor, "group_name", lambda group_id: "foveascan")
    finding = doctor.check_permission(port, STRANGER)
    assert finding.cure == "usermod -aG foveascan stranger, then log in again"


def test_permission_is_not_asked_for_where_there_is_no_port(port: str) -> None:
    for place, account in ((None, STRANGER), ("/dev/nothing", STRANGER), (port, ROOT)):
        assert states(doctor.check_permission(place, account)) == ["ok"]


def test_root_examines_for_the_services_account(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = SimpleNamespace(pw_uid=995, pw_gid=995)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr("pwd.getpwnam", lambda name: entry)
    monkeypatch.setattr(os, "getgrouplist", lambda name, group: [995, 20])
    assert machine.node_account() == Account("foveascan", 995, frozenset({995, 20}))


# Server


def server(port: int) -> settings.Server:
    return settings.Server(listen=f"127.0.0.1:{port}", insecure=True)


@contextmanager
def answering(body: bytes) -> Iterator[int]:
    """A program that answers so; gives its port."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, *_: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as program:
        thread = Thread(target=program.serve_forever)
        thread.start()
        try:
            yield program.server_port
        finally:
            program.shutdown()
            thread.join()


@pytest.mark.parametrize(
    ("body", "state"),
    [
        (b'{"status": "ready", "capture": {}}', "ok"), (b"<html>", "problem"), (b"[]", "problem"),
        (b'{"\xff"', "problem"),
    ],
)  # fmt: skip
def test_a_node_at_its_address_is_fine_another_program_is_not(body: bytes, state: str) -> None:
    with answering(body) as other:
        settled = server(other)
        assert states(doctor.check_server(settled, who_answers(settled))) == [state]


def test_a_node_is_known_whether_it_serves_tls_or_not() -> None:
    with answering(b'{"status": "ready"}') as node:
        settled = settings.Server(listen=f"127.0.0.1:{node}")
        assert who_answers(settled) == "node", "started with --insecure, of which the settings say nothing"


def test_a_node_with_another_library_is_not_the_one_that_is_meant(tmp_path: Path, port: str) -> None:
    library = Library(tmp_path / "ours")
    meant = {"capture.scanner": port, "library.folder": str(tmp_path / "ours")}
    with answering(b'{"status": "ready"}') as node:
        settled = {**meant, "server.listen": f"127.0.0.1:{node}", "discovery.enabled": False}
        told = {finding.check: finding for finding in doctor.examine(None, settled)}
        assert (told["server"].state, told["port"].found) == ("ok", f"{port}, in use by the node")
        library.close()
        told = {finding.check: finding for finding in doctor.examine(None, settled)}
        assert (told["server"].state, told["port"].found) == ("problem", port)
        assert "another library" in told["server"].found
        elsewhere = {**settled, "library.folder": str(tmp_path / "not" / "there")}
        assert {finding.check: finding for finding in doctor.examine(None, elsewhere)}["server"].state == "problem"


def test_a_node_at_another_address_is_told(tmp_path: Path) -> None:
    library = Library(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as free:
        nobody = f"127.0.0.1:{free.getsockname()[1]}"
    settled = {"library.folder": str(tmp_path), "server.listen": nobody, "discovery.enabled": False}
    told = {finding.check: finding for finding in doctor.examine(None, settled)}["server"]
    assert (told.state, told.found) == (
        "warning", f"process {os.getpid()} works in the library, and no node answers at {nobody}",
    )  # fmt: skip
    library.close()


@pytest.mark.parametrize("seen", ["", None])
def test_where_locks_cannot_be_seen_a_node_is_believed(
    seen: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Library(tmp_path / "ours").close()
    if seen is not None:
        (tmp_path / "locks").write_text(seen)
    monkeypatch.setattr(library_folder, "LOCKS", tmp_path / "locks")
    assert library_folder.holder_of(tmp_path / "ours") is None
    assert states(doctor.check_server(server(7345), "node", None)) == ["ok"]


def test_a_program_that_says_nothing_is_another_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "ANSWER_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert who_answers(server(silent.getsockname()[1])) == "other"


def test_a_free_address_is_fine_one_that_is_not_ours_is_a_problem() -> None:
    assert states(doctor.check_server(server(0), "nobody")) == ["ok"]
    assert states(doctor.check_server(settings.Server(listen="192.0.2.1:7345"), "nobody")) == ["problem"]


# Disk, memory, clock


def test_a_disk_is_judged_by_what_a_sweep_takes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for free in (doctor.DISK_MIN_BYTES - 1, EASY_BYTES - 1, EASY_BYTES):
        monkeypatch.setattr("shutil.disk_usage", lambda place, free=free: SimpleNamespace(free=free))
        found.append(doctor.check_disk(tmp_path / "not" / "there", ROOT))
    assert states(*found) == ["problem", "warning", "ok"]
    assert str(tmp_path) in found[0].found


def test_a_file_is_no_library(tmp_path: Path) -> None:
    (tmp_path / "scans").write_text("mine")
    finding = doctor.check_disk(tmp_path / "scans", ROOT)
    assert (finding.found, finding.cure) == (f"{tmp_path}/scans is no folder", "choose another library.folder")


def test_a_folder_the_node_may_not_write_is_a_problem(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    finding = doctor.check_disk(tmp_path / "library", Account("foveascan", 4711, frozenset()))
    assert finding.state == "problem" and "chown" in finding.cure


def test_memory_is_judged_by_what_scans_take() -> None:
    found = [doctor.check_memory(size << 20) for size in (200, 400, 2000)]
    assert states(*found) == ["problem", "warning", "ok"]
    assert "size M" in found[0].cure and "size L" in found[1].cure
    assert machine.available_bytes() > 0


def test_a_clock_before_what_was_written_last_is_a_problem() -> None:
    assert states(
        doctor.check_clock(1e9, 1e9 + 1, True),
        doctor.check_clock(1e9, 1e9, False),
        doctor.check_clock(1e9, 1e9, None),
        doctor.check_clock(1e9, 1e9, True),
    ) == ["problem", "warning", "ok", "ok"]
    assert machine.written_last_s(Path("/nothing"), Path(__file__)) > 1e9
    assert machine.is_clock_synchronised() in (True, False, None)


# Discovery and library


def config(folder: Path, *, enabled: bool = True) -> settings.Config:
    discovery = settings.Discovery(enabled=enabled)
    return settings.Config(library=settings.Library(folder=str(folder)), discovery=discovery)


def test_discovery_says_what_it_is_worth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert states(doctor.check_discovery(config(tmp_path, enabled=False), False)) == ["ok"]
    asked: list[str | None] = []

    def is_heard(host: str, node_id: str | None) -> bool:
        asked.append(node_id)
        return node_id is None

    monkeypatch.setattr(doctor, "is_heard", is_heard)
    assert states(doctor.check_discovery(config(tmp_path), False)) == ["warning"]  # on loopback
    assert states(doctor.check_discovery(config(tmp_path), True)) == ["warning"]
    assert not any(tmp_path.iterdir()), "a doctor changes nothing"
    known = node_identity(tmp_path)
    unheard = doctor.check_discovery(config(tmp_path), True)
    assert unheard.state == "problem" and "5353" in unheard.cure
    assert asked == [None, None, known]


def test_no_network_is_a_problem_of_discovery(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_network(host: str, node_id: str | None) -> bool:
        raise OSError("no such device")

    monkeypatch.setattr(doctor, "is_heard", no_network)
    finding = doctor.check_discovery(config(tmp_path), False)
    assert (finding.state, "no such device" in finding.found) == ("problem", True)


def test_a_library_is_counted_and_what_does_not_belong_there_named(tmp_path: Path) -> None:
    assert states(doctor.check_library(tmp_path / "none")) == ["ok"]
    spec = GridSpec(16, 8, 32, 16, 0.01, 1.0)
    library = Library(tmp_path)
    library.add(Grid(spec, np.ones((8, 16), np.uint16), np.zeros((16, 32, 3), np.uint8)), About(1.0))
    assert doctor.check_library(tmp_path) == Finding("library", "ok", f"1 scan in {tmp_path}")
    (tmp_path / "holiday.jpg").touch()
    finding = doctor.check_library(tmp_path)
    assert finding.state == "warning" and "holiday.jpg" in finding.found


def test_a_library_that_cannot_be_made_is_a_problem() -> None:
    folder = Path("/proc/foveascan")
    library, disk = doctor.check_library(folder), doctor.check_disk(folder, ROOT)
    assert states(library, disk) == ["problem", "problem"]
    assert str(folder) in library.found and "cannot be made" in library.found and "/proc" in disk.found


def test_a_library_of_a_newer_version_is_a_problem(tmp_path: Path) -> None:
    (tmp_path / "library.json").write_text('{"format": 999}')
    assert states(doctor.check_library(tmp_path)) == ["problem"]


# The command


def test_the_command_prints_a_line_a_check_and_fails_where_there_is_a_problem(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["doctor", "--library", str(tmp_path), "--scanner", "/dev/nothing"]
    assert foveascan.main(arguments) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:2] == ["problem", "port"] for line in lines)
    assert any(line.startswith(" ") and "cure: plug the scanner in" in line for line in lines)
    assert foveascan.main([*arguments, "--json"]) == 1
    records = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {"check", "state", "found", "cure"} == set(records[0])
    assert {record["check"]: record["state"] for record in records}["port"] == "problem"


# Audit log


def test_an_audit_log_that_the_node_cannot_write_or_others_can_read_is_a_problem(tmp_path: Path) -> None:
    mine = Account("me", os.geteuid(), frozenset({os.getegid()}))
    assert states(doctor.check_audit(tmp_path, mine)) == ["ok"]
    done_trail(tmp_path, 8000).append([b"{}"])
    assert states(doctor.check_audit(tmp_path, mine)) == ["ok"]
    stranger = doctor.check_audit(tmp_path, STRANGER)
    assert (stranger.state, stranger.cure) == ("problem", f"chown -R stranger {tmp_path / 'audit'}")
    os.chmod(tmp_path / "audit" / "audit.jsonl", 0o644)
    assert "others may read" in doctor.check_audit(tmp_path, mine).found
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "audit").write_text("no folder")
    assert doctor.check_audit(tmp_path / "elsewhere", mine).found.endswith("audit: Not a directory")


# Certificate


def test_a_certificate_is_judged_by_the_days_it_has_left(tmp_path: Path) -> None:
    now = dt.datetime(2026, 11, 22, tzinfo=dt.UTC)
    secure = settings.Server()
    found = [doctor.check_certificate(settings.Server(insecure=True), tmp_path, now, ROOT)]
    found.append(doctor.check_certificate(secure, tmp_path, now, ROOT))
    renew_own(access_folder(tmp_path), "1234", "127.0.0.1", now)
    for days in (0, 790, 800, -400):
        found.append(doctor.check_certificate(secure, tmp_path, now + dt.timedelta(days=days), ROOT))
    assert states(*found) == ["warning", "ok", "ok", "warning", "problem", "problem"]
    elsewhere = settings.Server(certificate="/nowhere", key="/nowhere")
    assert states(doctor.check_certificate(elsewhere, tmp_path, now, ROOT)) == ["problem"]


def test_a_key_that_others_may_read_or_that_belongs_to_another_certificate_is_a_problem(tmp_path: Path) -> None:
    now = dt.datetime(2026, 11, 22, tzinfo=dt.UTC)
    for name in ("one", "other"):
        (tmp_path / name).mkdir(mode=0o700)
        renew_own(tmp_path / name, name, "127.0.0.1", now)
    one, other = (str(tmp_path / name / "certificate.pem") for name in ("one", "other"))

    def found(key: str, account: Account = ROOT) -> Finding:
        return doctor.check_certificate(settings.Server(certificate=one, key=key), tmp_path, now, account)

    assert found(one).state == "ok"
    assert "do not go together" in found(other).found
    assert found(one, STRANGER).cure.startswith("chgrp foveascan ")
    assert found(str(tmp_path / "none")).found.endswith("none: No such file or directory")
    os.chmod(one, 0o644)
    assert (found(one).found, found(one).cure) == (f"everybody may read the key {one}", f"chmod 640 {one}")
