"""The service from its installation to its removal, under a real systemd with every restriction of its unit."""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from simulators.usb_preload import PRELOAD, is_available
from tests.node.sealed_places import require_mounts
from tests.systemd.booted import ROOT, Machine, booted, why_not

WHY_NOT = why_not()
pytestmark = [pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT), pytest.mark.timeout(300)]
SETTINGS = "/etc/foveascan/node.toml"


@pytest.fixture(scope="module")
def port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        return int(free.getsockname()[1])


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory, port: int) -> Iterator[Machine]:
    """One with the service installed; tests follow each other on it."""
    with booted(tmp_path_factory.mktemp("booted")) as machine:
        machine.write(SETTINGS, settings(port))
        said = machine.foveascan("install-service")
        assert f"kept     {SETTINGS}: as somebody changed it" in said
        yield machine


def settings(port: int, more: str = "") -> str:
    library = "[library]\nfolder = \"/var/lib/foveascan\"\n[discovery]\nenabled = false\n"
    return f"{library}[server]\nlisten = \"127.0.0.1:{port}\"\n{more}"


def health(machine: Machine, port: int) -> dict[str, object]:
    """What the node says of itself, asked within its machine without a login."""
    code = f"""
import http.client, ssl
line = http.client.HTTPSConnection("127.0.0.1", {port}, timeout=5, context=ssl._create_unverified_context())
line.request("GET", "/healthz"); print(line.getresponse().read().decode())
"""
    return dict(json.loads(machine.run("/opt/foveascan/bin/python", "-I", "-c", code).stdout))


def main_pid(machine: Machine) -> str:
    return machine.show("MainPID")


def test_it_runs_as_its_account_behind_every_restriction(machine: Machine, port: int) -> None:
    assert machine.show("ActiveState") == "active"
    assert machine.show("StatusText") == f"Serving https://127.0.0.1:{port}, without a scanner"
    assert health(machine, port) == {"status": "ready"}
    status = machine.run("cat", f"/proc/{main_pid(machine)}/status").stdout
    assert re.search(r"^NoNewPrivs:\t1$.*^Seccomp:\t2$", status, re.MULTILINE | re.DOTALL)
    assert re.search(r"^CapBnd:\t0+$", status, re.MULTILINE)
    account = machine.run("id", "-u", "foveascan").stdout.strip()
    assert account != "0" and re.search(rf"^Uid:\t{account}\t", status, re.MULTILINE)
    mounts = machine.run("cat", f"/proc/{main_pid(machine)}/mountinfo").stdout
    [top] = [line.split() for line in mounts.splitlines() if line.split()[4] == "/"][-1:]
    assert "ro" in top[5].split(",")
    assert machine.run("stat", "-c", "%U %a", "/var/lib/foveascan").stdout.strip() == "foveascan 750"


def test_pairing_and_the_doctor_find_it(machine: Machine, port: int) -> None:
    said = json.loads(machine.foveascan("pair", "--config", SETTINGS, "--name", "me", "--role", "admin", "--json"))
    machine.foveascan("join", said["code"], "--node", f"https://127.0.0.1:{port}")
    assert machine.foveascan("scans", "--node", f"https://127.0.0.1:{port}", "--json") == ""
    doctor = machine.foveascan("doctor", "--config", SETTINGS, check=False)
    assert f"a node answers at 127.0.0.1:{port}" in doctor


def sweep(machine: Machine, port: int, scanner: str) -> None:
    """Set the scanner, wait until the node has it, and sweep to the end."""
    machine.write(SETTINGS, settings(port) + f'[capture]\nscanner = "{scanner}"\n')
    machine.run("systemctl", "restart", "foveascan")
    until = time.monotonic() + 60
    while "scanner: ready" not in machine.show("StatusText"):
        assert time.monotonic() < until, machine.show("StatusText") + machine.log()
        time.sleep(0.1)
    said = machine.foveascan("scan", "--node", f"https://127.0.0.1:{port}", check=False)
    assert "coverage" in said, said + machine.log()


def test_a_scanner_on_a_tty_is_swept_with_behind_every_restriction(machine: Machine, port: int) -> None:
    with machine.started("simulate", "--path", "/run/tty", "--specimen", "sphere", "--json") as ready:
        machine.run("sh", "-c", f"chown foveascan $(readlink -f {ready['path']})")  # as udev's rule does
        sweep(machine, port, ready["path"])
    assert scans(machine, port)


@pytest.mark.skipif(not is_available() and "CI" not in os.environ, reason=f"needs {PRELOAD}")
def test_a_scanner_on_usb_is_swept_with_behind_every_restriction(machine: Machine, port: int) -> None:
    drop_in = "/etc/systemd/system/foveascan.service.d/usb.conf"
    with machine.started("simulate", "--link", "usb", "--path", "/run/usb", "--specimen", "sphere", "--json") as ready:
        machine.run("chown", "-R", "foveascan", "/run/usb")
        variables = " ".join(f"{name}={value}" for name, value in ready["environment"].items())
        machine.write(drop_in, f"[Service]\nEnvironment={variables}\n")
        machine.run("systemctl", "daemon-reload")
        sweep(machine, port, ready["path"])
    machine.run("rm", drop_in)
    machine.run("systemctl", "daemon-reload")


def test_the_journal_has_what_it_says_with_priorities(machine: Machine, port: int) -> None:
    drop_in = "/etc/systemd/system/foveascan.service.d/test.conf"
    before = machine.run("cat", drop_in).stdout
    machine.write(drop_in, re.sub("^Standard(Error|Output)=.*$", r"Standard\1=journal", before, flags=re.MULTILINE))
    machine.run("systemctl", "start", "systemd-journald.socket", "systemd-journald.service")
    machine.write(SETTINGS, settings(port))
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "restart", "foveascan")
    machine.foveascan("join", "ABCD-EFGH-IJKL-MNOP", "--node", f"https://127.0.0.1:{port}", check=False)
    told: dict[str, int] = {}
    until = time.monotonic() + 30
    while not any("wrong code" in message for message in told):
        assert time.monotonic() < until, told
        time.sleep(0.1)
        said = machine.run("journalctl", "-u", "foveascan", "-o", "json", "--no-pager").stdout
        lines = [json.loads(line) for line in said.splitlines()]
        told = {str(line["MESSAGE"]): int(line["PRIORITY"]) for line in lines}
    machine.write(drop_in, before)
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "restart", "foveascan")
    own = {priority for message, priority in told.items() if "certificate: SHA-256" in message}
    wrong = {priority for message, priority in told.items() if "a wrong code" in message}
    assert (own, wrong) == ({6}, {4})


def test_scans_settings_and_logins_come_back_by_the_commands_of_the_readme(machine: Machine, port: int) -> None:
    before = scans(machine, port)
    machine.run("mkdir", "-p", "/srv")
    for command in readme("Back up"):
        machine.run("sh", "-c", command)
    machine.foveascan("install-service", "--remove", "--purge")
    machine.write(SETTINGS, settings(port))
    machine.foveascan("install-service")
    assert machine.foveascan("scans", "--node", f"https://127.0.0.1:{port}", check=False).startswith("foveascan: ")
    for command in readme("Restore"):
        machine.run("sh", "-c", command)
    machine.await_property("ActiveState", "active")
    assert before and scans(machine, port) == before
    for path in ("/var/lib/foveascan/access/access.json", f"/var/lib/foveascan/{before[0]}/scan.json"):
        assert machine.run("stat", "-c", "%U", path).stdout.strip() == "foveascan"


def readme(step: str) -> list[str]:
    """The commands of a step of README's "As a service", for root."""
    text = (ROOT / "README.md").read_text().partition(f"\n**{step}.** ")[2].partition("\n**")[0]
    commands = [line.strip().replace("sudo ", "") for line in text.splitlines() if line.startswith("    ")]
    assert commands
    return commands


def scans(machine: Machine, port: int) -> list[str]:
    """The ids of the node's scans, for whoever was paired."""
    said = machine.foveascan("scans", "--node", f"https://127.0.0.1:{port}", "--json")
    return [json.loads(line)["id"] for line in said.splitlines()]


def test_a_reload_takes_sound_settings_and_refuses_others(machine: Machine, port: int) -> None:
    before = main_pid(machine)
    machine.write(SETTINGS, settings(port, "max_clients = 0\n"))
    assert machine.run("systemctl", "reload", "foveascan", check=False).returncode
    assert "server.max_clients" in machine.log() and "read the settings anew" not in machine.log()
    machine.write(SETTINGS, settings(port, "max_clients = 7\n"))
    machine.run("systemctl", "reload", "foveascan")
    until = time.monotonic() + 10
    while "read the settings anew: server.max_clients changed" not in machine.log():
        assert time.monotonic() < until, machine.log()
        time.sleep(0.1)
    machine.await_property("ActiveState", "active")
    assert main_pid(machine) == before


def test_a_node_that_dies_or_hangs_is_started_anew(machine: Machine, port: int) -> None:
    for signal, more in (("KILL", ""), ("STOP", "[Service]\nWatchdogSec=3\n")):
        machine.write("/etc/systemd/system/foveascan.service.d/watchdog.conf", more)
        machine.run("systemctl", "daemon-reload")
        machine.run("systemctl", "restart", "foveascan")
        machine.run("systemctl", "kill", "-s", signal, "foveascan")
        machine.await_property("NRestarts", "1")
        machine.await_property("ActiveState", "active")
        assert health(machine, port) == {"status": "ready"}
    machine.run("rm", "/etc/systemd/system/foveascan.service.d/watchdog.conf")
    machine.run("systemctl", "daemon-reload")


def test_a_key_is_handed_over_as_a_credential(machine: Machine, port: int) -> None:
    own = machine.run("cat", "/var/lib/foveascan/access/certificate.pem").stdout
    key, certificate = re.findall(r"-----BEGIN.*?-----END[^\n]*\n", own, re.DOTALL)
    machine.write("/etc/foveascan/certificate.pem", certificate)
    machine.write("/etc/credstore/foveascan.key", key)
    machine.run("chmod", "600", "/etc/credstore/foveascan.key")
    named = "certificate = \"/etc/foveascan/certificate.pem\"\nkey = \"credential:foveascan.key\"\n"
    machine.write(SETTINGS, settings(port, named))
    machine.run("systemctl", "restart", "foveascan")
    assert health(machine, port) == {"status": "ready"}
    machine.write(SETTINGS, settings(port))
    machine.run("systemctl", "restart", "foveascan")


def test_the_same_again_changes_nothing_and_settings_that_do_not_fit_stop_it(machine: Machine, port: int) -> None:
    machine.write(SETTINGS, settings(port, "max_clients = 0\n"))
    before = main_pid(machine)
    said = machine.foveascan("install-service", check=False)
    assert f"nothing was changed: this version does not accept the settings: {SETTINGS}: server.max_clients" in said
    assert main_pid(machine) == before
    machine.write(SETTINGS, settings(port))
    said = machine.foveascan("install-service")
    assert not re.search("^(make|renew|switch)", said, re.MULTILINE), said


def test_an_update_runs_and_one_that_does_not_come_up_leaves_what_was_running(machine: Machine, port: int) -> None:
    first = machine.run("readlink", "/opt/foveascan/bin").stdout
    machine.run("sh", "-c", "cp -r /opt/src/. /opt/newer && rm -rf /opt/newer/.git")
    machine.run("sh", "-c", "echo '# newer' >> /opt/newer/node/notify.py")
    machine.foveascan("install-service", sources="/opt/newer")
    second = machine.run("readlink", "/opt/foveascan/bin").stdout
    assert second != first
    assert health(machine, port) == {"status": "ready"}
    bug = "'s/^async def start_node.*/&\\n    raise SystemExit(3)/'"
    machine.run("sh", "-c", f"sed -i {bug} /opt/newer/node/daemon.py")
    said = machine.foveascan("install-service", sources="/opt/newer", check=False)
    assert "failed: what was before comes back" in said and "systemctl restart foveascan failed" in said
    assert machine.run("readlink", "/opt/foveascan/bin").stdout == second
    machine.await_property("ActiveState", "active")
    assert health(machine, port) == {"status": "ready"}


def test_a_library_is_sealed_by_the_commands_of_the_readme(machine: Machine, port: int) -> None:
    require_mounts()
    before, vault = scans(machine, port), "foveascan-vault"
    section = (ROOT / "README.md").read_text().partition("\n## A sealed library\n")[2].partition("\nFrom then on")[0]
    apt, *commands = [line.strip() for line in section.splitlines() if line.startswith("    ")]
    store, seal = (next(at for at, line in enumerate(commands) if what in line) for what in ("creds encrypt", " seal "))
    assert store < seal  # else a machine that goes off in between has nothing but what nobody can open
    assert apt == "apt-get install gocryptfs fuse3"
    machine.run("sh", "-c", "set -e\n" + "\n".join(commands))
    machine.await_property("ActiveState", "active")
    assert health(machine, port) == {"status": "ready"}
    assert before and scans(machine, port) == before
    key = machine.run("cat", "/run/key").stdout
    looked = machine.run("grep", "-raF", key, "/etc", "/var/lib/foveascan.sealed", check=False)
    assert looked.returncode == 1 and before[0] not in machine.run("find", "/var/lib/foveascan.sealed").stdout
    machine.run("systemctl", "kill", "-s", "KILL", vault)
    until = time.monotonic() + 60
    while (told := machine.run("systemctl", "show", "--value", "-p", "NRestarts", vault).stdout.strip()) != "1":
        assert time.monotonic() < until, told
        time.sleep(0.1)
    machine.await_property("ActiveState", "active")
    assert scans(machine, port) == before
    machine.run("systemctl", "stop", vault)
    machine.await_property("ActiveState", "inactive")
    assert machine.run("ls", "-A", "/var/lib/foveascan").stdout == ""
    shut = machine.foveascan("library", "list", "--library", "/var/lib/foveascan", check=False)
    assert "is sealed and not open: systemctl start foveascan-vault" in shut
    machine.foveascan("library", "unseal", "--library", "/var/lib/foveascan", "--key", "/run/key")
    machine.run("systemctl", "disable", vault)
    machine.run("rm", "/etc/credstore.encrypted/foveascan.library-key")
    machine.run("systemctl", "start", "foveascan")
    assert scans(machine, port) == before


def test_it_stops_in_time_and_goes_without_a_trace_but_what_is_kept(machine: Machine) -> None:
    machine.run("systemctl", "stop", "foveascan")
    assert machine.show("Result") == "success"  # what takes longer than the unit's TimeoutStopSec is killed
    said = machine.foveascan("install-service", "--remove")
    assert "kept: settings in /etc/foveascan" in said
    left = machine.run("sh", "-c", "find / -xdev -path '*foveascan*' -not -path '/opt/s*' -not -path '/proc/*' -prune")
    kept = {Path(line) for line in left.stdout.split() if line.startswith(("/etc", "/var/lib", "/opt/foveascan"))}
    assert kept == {
        Path("/etc/foveascan"), Path("/var/lib/foveascan"), Path("/etc/credstore/foveascan.key"),
        Path("/etc/systemd/system/foveascan.service.d"),
    }  # fmt: skip
    machine.foveascan("install-service", "--remove", "--purge")
    for gone in ("/etc/foveascan", "/var/lib/foveascan", "/etc/credstore/foveascan.key"):
        assert machine.run("test", "-e", gone, check=False).returncode == 1
    assert machine.run("id", "foveascan", check=False).returncode
