"""What may keep a node from working on this machine: each check says what it found, and the cure.

Nothing is changed, no lock is taken, and a port is opened only while no node uses it: a doctor may come at any time.
Whether a disk takes a file is tried with one that has no name.
"""

from __future__ import annotations

import datetime as dt
import fcntl
import os
import shutil
import socket
import ssl
import stat
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.conformance import examine_link
from drivers.discover import config_for, find_ports, open_port
from node import config as settings
from node.access import FOLDER
from node.advertise import HEARD_S, is_heard
from node.audit import FOLDER as AUDIT
from node.durable import EASY_BYTES
from node.identity import known_identity
from node.library import survey
from node.library_folder import holder_of
from node.listener import Listener, who_answers
from node.machine import (
    ACCOUNT,
    READ,
    SEARCH,
    WRITE,
    Account,
    available_bytes,
    group_name,
    is_clock_synchronised,
    node_account,
    serial_ports,
    written_last_s,
)
from node.scan_folder import name_problems
from node.sealed import finish, is_open, leftovers, why_shut
from node.tls import CREDENTIAL, certificate_file, key_file, read_certificate
from protocol.errors import AccessError, ConfigError, LibraryError, PortLost
from protocol.printable import counted

RULE = "70-foveascan.rules"
SWEEP_M_BYTES = 1440 * 1024 * 2 + 4096 * 2048 * 3
SWEEP_L_BYTES = 4096 * 2048 * 2 + 8192 * 4096 * 3
DISK_MIN_BYTES = 2 * SWEEP_L_BYTES  # a journal and the scan it becomes
MEMORY_BASE_BYTES, MEMORY_FACTOR = 150 << 20, 6  # issue 3: 6x the arrays of a scan, and this
ENDS_SOON = dt.timedelta(days=14)

LOOKED_UP = ("usb:", "serial:", "tcp:")  # addresses that are no paths

State = Literal["ok", "warning", "problem"]


@dataclass(frozen=True, slots=True)
class Finding:
    """What one check found. A warning is worth knowing; with a problem, the node does not do its work."""

    check: str
    state: State
    found: str
    cure: str = ""


def examine(path: Path | None, overrides: Mapping[str, object]) -> Iterator[Finding]:
    """Every check, one after the other. path, overrides : as for load_config."""
    try:
        config = settings.load_config(path, overrides)
        place = config.library.place
    except ConfigError as error:
        yield Finding("configuration", "problem", str(error), "correct the setting named; the rest was not looked at")
        return
    try:
        left, shut = leftovers(place), why_shut(place)
    except OSError as error:
        found = f"whether it is sealed cannot be seen: {error.filename or place}: {error.strerror}"
        yield Finding("library", "problem", f"{found}; the rest was not looked at", "ask as root or as its owner")
        return
    if left:
        found = f"left by a seal or an unseal that was cut, if none runs: {', '.join(map(str, left))}"
        yield Finding("library", "warning", found, f"stop the node, and {finish(place)}")
    if shut:
        yield Finding("library", "problem", f"{shut[0]}; the rest was not looked at", shut[1])
        return
    library = config.library.path
    yield Finding("configuration", "ok", str(path) if path else "the defaults: no file was named")
    account, port = node_account(), config.capture.scanner
    who = who_answers(config.server)
    holder = holder_of(library)
    runs = who == "node" and holder != 0  # the node of these settings, as far as can be seen
    yield check_port(port, is_used=runs)
    yield check_permission(port, account)
    yield check_server(config.server, who, holder)
    yield check_certificate(config.server, library, dt.datetime.now(dt.UTC), account)
    yield check_disk(library, account)
    yield check_memory(available_bytes())
    yield check_clock(time.time(), written_last_s(Path(__file__), library), is_clock_synchronised())
    yield check_discovery(config, runs)
    yield check_library(library)
    yield check_audit(library, account)


def examine_scanner(address: str, path: Path | None, overrides: Mapping[str, object]) -> Iterator[Finding]:
    """Every check of a scanner's firmware; it sweeps, several times. path, overrides : as for load_config.

    Raises ConfigError.
    """
    capture = settings.load_config(path, overrides).capture
    try:
        port = open_port(address, capture.baud)
    except PortLost as error:
        yield _no_port(str(error))
        return
    try:
        for finding in examine_link(port, config_for(address, capture.stale_s)):
            yield Finding(finding.check, finding.state, finding.found, finding.cure)
    finally:
        port.close()


def check_port(port: str | None, *, is_used: bool = False) -> Finding:
    """Whether the scanner's port is there and can be opened. is_used : a node has it open now."""
    if port is None:
        return Finding("port", "ok", "none is set: a library without a scanner", "set capture.scanner, to sweep")
    if port.startswith(LOOKED_UP):
        return _looked_up(port, is_used)
    try:
        info = os.stat(port)
    except OSError as error:
        return _no_port(f"{port}: {error.strerror}")
    if not stat.S_ISCHR(info.st_mode):
        return Finding("port", "problem", f"{port} is no serial port", "correct capture.scanner")
    if is_used:
        return Finding("port", "ok", f"{port}, in use by the node")
    return _opened(port)


def _no_port(found: str) -> Finding:
    there = ", ".join([*serial_ports(), *(port.address for port in find_ports() if port.address.startswith("usb:"))])
    found, _, cure = found.partition("; ")  # what the port itself advises, where it does
    cure = cure or "plug the scanner in and switch it on, or correct its address"
    return Finding("port", "problem", found, f"{cure}; ports here: {there or 'none'}")


def _looked_up(address: str, is_used: bool) -> Finding:
    """A port that is named by its USB ids."""
    if is_used:
        return Finding("port", "ok", f"{address}, in use by the node")
    try:
        open_port(address).close()
    except PortLost as error:
        return _no_port(str(error))
    return Finding("port", "ok", address)


def _opened(port: str) -> Finding:
    try:
        handle = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except PermissionError:
        return Finding("port", "ok", f"{port} is there; whether it works cannot be tried without permission")
    except OSError as error:
        return Finding("port", "problem", f"{port}: {error.strerror}", "unplug the scanner and plug it in again")
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_terminal = os.isatty(handle)
    except OSError:
        cure = f"end the program that has it open: fuser -v {port}"
        return Finding("port", "problem", f"{port} is in use by another program", cure)
    finally:
        os.close(handle)
    if not is_terminal:
        return Finding("port", "problem", f"{port} is no serial port", "correct capture.scanner")
    return Finding("port", "ok", port)


def check_permission(port: str | None, account: Account) -> Finding:
    """Whether the node's account may read and write the port."""
    if port is None or not os.path.exists(port):
        return Finding("permission", "ok", "there is no port to open")
    info = os.stat(port)
    if account.may(info, READ | WRITE):
        return Finding("permission", "ok", f"{account.name} may use {port}")
    found = f"{account.name} may not use {port}, which belongs to the group {group_name(info.st_gid)}"
    join = f"usermod -aG {ACCOUNT} {account.name}, then log in again"
    if group_name(info.st_gid) == ACCOUNT:
        return Finding("permission", "problem", found, join)
    rule = f"install systemd/{RULE} as /etc/udev/rules.d/{RULE}; udevadm control --reload && udevadm trigger"
    return Finding("permission", "problem", found, rule if account.name == ACCOUNT else f"{rule}; {join}")


def check_server(server: settings.Server, who: Listener, holder: int | None = None) -> Finding:
    """Whether the address can be served.

    who : answers there.  holder : the process that works in the library, 0: none.
    """
    if who == "node" and holder == 0:
        cure = "stop it, or choose another server.listen; or name its own library"
        return Finding("server", "problem", f"a node with another library answers at {server.listen}", cure)
    if who == "nobody" and holder:
        found = f"process {holder} works in the library, and no node answers at {server.listen}"
        return Finding("server", "warning", found, "if it is a node, name its own address: --listen, or its --config")
    if who == "node":
        return Finding("server", "ok", f"a node answers at {server.listen}")
    if who == "other":
        cure = "stop it, or choose another server.listen"
        return Finding("server", "problem", f"another program listens at {server.listen}", cure)
    try:
        family = socket.AF_INET6 if ":" in server.host else socket.AF_INET
        with socket.create_server((server.host, server.port), family=family):
            return Finding("server", "ok", f"{server.listen} is free; no node runs there")
    except OSError as error:
        return Finding("server", "problem", f"{server.listen}: {error.strerror}", "correct server.listen")


def check_certificate(server: settings.Server, library: Path, now: dt.datetime, account: Account) -> Finding:
    """Whether clients will find a certificate that is valid, and its key is kept by those who should."""
    if server.insecure:
        return Finding("certificate", "warning", "none: no encryption, no logins", "remove server.insecure")
    path = certificate_file(server, library / FOLDER)
    if server.certificate is None and not path.exists():
        return Finding("certificate", "ok", "none yet: the node makes one when it starts")
    try:
        certificate = read_certificate(path)
    except AccessError as error:
        return Finding("certificate", "problem", str(error), "correct server.certificate, or run this as root")
    left = certificate.not_valid_after_utc - now
    found = f"{path}, until {certificate.not_valid_after_utc:%Y-%m-%d}"
    cure = "renew it" if server.certificate else "restart the node, which renews its own"
    if left <= dt.timedelta() or now < certificate.not_valid_before_utc:
        return Finding("certificate", "problem", f"{found}: not valid now", cure)
    if left < ENDS_SOON:
        return Finding("certificate", "warning", f"{found}: {left.days} days are left", cure)
    return _check_key(server, library, path, account) or Finding("certificate", "ok", found)


def _check_key(server: settings.Server, library: Path, certificate: Path, account: Account) -> Finding | None:
    """What is wrong with the key of a certificate. A credential of systemd's is looked at by the service alone."""
    if server.key is not None and server.key.startswith(CREDENTIAL):
        return None
    key = key_file(server, library / FOLDER)
    try:
        info = key.stat()
        if info.st_mode & 0o007:
            return Finding("certificate", "problem", f"everybody may read the key {key}", f"chmod 640 {key}")
        if not account.may(info, READ):
            found = f"{account.name} may not read the key {key}"
            return Finding("certificate", "problem", found, f"chgrp {ACCOUNT} {key} && chmod 640 {key}")
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except PermissionError:
        return None  # we may not look, and the account may
    except ssl.SSLError as error:
        cure = "correct server.certificate and server.key: the one belongs to another of the other"
        return Finding("certificate", "problem", f"{certificate} and {key} do not go together: {error.reason}", cure)
    except OSError as error:
        return Finding("certificate", "problem", f"{key}: {error.strerror}", "correct server.key")
    return None


def check_disk(folder: Path, account: Account) -> Finding:
    """Whether the library can be written, and holds another sweep of the largest size."""
    there = _nearest(folder)
    if not there.is_dir():
        return Finding("disk", "problem", f"{there} is no folder", "choose another library.folder")
    if not account.may(there.stat(), READ | WRITE | SEARCH):
        cure = f"chown -R {account.name} {folder}, or choose another library.folder"
        return Finding("disk", "problem", f"{account.name} may not write in {there}", cure)
    if os.statvfs(there).f_flag & os.ST_RDONLY:
        cure = "mount it anew, or choose another library.folder"
        return Finding("disk", "problem", f"{there} is mounted read-only", cure)
    if why := _refusal(there):
        return Finding("disk", "problem", f"nothing can be kept in {there}: {why}", "choose another library.folder")
    free = shutil.disk_usage(there).free
    found = f"{_size(free)} free in {there}"
    if free < DISK_MIN_BYTES:
        cure = f"free some space: a sweep of size L takes {_size(DISK_MIN_BYTES)} while it is kept"
        return Finding("disk", "problem", found, cure)
    if free < EASY_BYTES:
        return Finding("disk", "warning", found, "back scans up and delete them here, or use a larger disk")
    return Finding("disk", "ok", found)


def check_memory(available: int) -> Finding:
    """Whether scans of size M fit, and of size L. available : bytes."""
    found = f"{_size(available)} available"
    cure = "scans of size {} need {}: end other programs, or use a machine with more memory"
    for_m, for_l = (MEMORY_FACTOR * arrays + MEMORY_BASE_BYTES for arrays in (SWEEP_M_BYTES, SWEEP_L_BYTES))
    if available < for_m:
        return Finding("memory", "problem", found, cure.format("M", _size(for_m)))
    if available < for_l:
        return Finding("memory", "warning", found, cure.format("L", _size(for_l)))
    return Finding("memory", "ok", found)


def check_clock(now_s: float, written_s: float, is_synchronised: bool | None) -> Finding:
    """Whether the clock can be right. written_s : when something here was written that must be in the past."""
    found = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(now_s))
    cure = "timedatectl set-ntp true, or set it by hand; scans keep their order all the same"
    if now_s < written_s:
        return Finding("clock", "problem", f"{found} is before what was written here last", cure)
    if is_synchronised is False:
        return Finding("clock", "warning", f"{found}, not synchronised", cure)
    return Finding("clock", "ok", found)


def check_discovery(config: settings.Config, is_running: bool) -> Finding:
    """Whether others on the network can find the node."""
    if not config.discovery.enabled:
        return Finding("discovery", "ok", "switched off", "set discovery.enabled = true, to be found")
    try:
        heard = is_heard(config.server.host, known_identity(config.library.path) if is_running else None)
    except (OSError, LibraryError) as error:
        cure = "connect a network, or set discovery.enabled = false"
        return Finding("discovery", "problem", f"multicast DNS cannot be used: {error}", cure)
    if not heard:
        cure = "let UDP port 5353 through the firewall (ufw allow mdns), and restart the node"
        return Finding("discovery", "problem", f"the node runs, but is not heard within {HEARD_S:g} s", cure)
    if settings.is_loopback(config.server.host):
        cure = "set server.listen to an address of the network"
        return Finding("discovery", "warning", "only this machine can reach and find it", cure)
    return Finding("discovery", "ok", "the node is heard" if is_running else "multicast DNS works; no node runs")


def check_library(folder: Path) -> Finding:
    """Whether the library can be read, and what lies in it that is no sound scan."""
    if not os.path.exists(folder):
        if why := _refusal(_nearest(folder)):
            found = f"{folder} is not there, and cannot be made: {why}"
            return Finding("library", "problem", found, "choose another library.folder")
        return Finding("library", "ok", f"{folder} is not there yet: the node makes it")
    try:
        known, problems = survey(folder)
    except LibraryError as error:
        return Finding("library", "problem", str(error), "choose another library.folder, or restore a backup")
    found = f"{counted(len(known), 'scan')} in {folder}{', sealed' if is_open(folder) else ''}"
    if not problems:
        return Finding("library", "ok", found)
    found += f", and beside them {counted(len(problems), 'thing')}: {name_problems(problems)}"
    cure = "they are left alone: move away what does not belong there, restore damaged scans from a backup"
    return Finding("library", "warning", found, cure)


def check_audit(library: Path, account: Account) -> Finding:
    """Whether the node can go on with its audit log, and others cannot read it."""
    folder = library / AUDIT
    try:
        places = [folder, *folder.iterdir()]
        for place in places:
            info = place.stat()
            wanted = READ | WRITE | (SEARCH if place is folder else 0)
            if not account.may(info, wanted):
                cure = f"chown -R {account.name} {folder}"
                return Finding("audit log", "problem", f"{account.name} may not write {place}", cure)
            if info.st_mode & 0o077:
                return Finding("audit log", "problem", f"others may read {place}", f"chmod -R go= {folder}")
    except FileNotFoundError:
        return Finding("audit log", "ok", "none yet: the node begins one when it starts")
    except PermissionError:
        return Finding("audit log", "ok", f"{folder}; what is in it cannot be looked at without permission")
    except OSError as error:
        return Finding("audit log", "problem", f"{folder}: {error.strerror}", "move it away, and restart the node")
    return Finding("audit log", "ok", str(folder))


def _nearest(folder: Path) -> Path:
    """The folder, else the closest place above it that is there."""
    return next(place for place in (folder, *folder.absolute().parents) if os.path.exists(place))


def _refusal(folder: Path) -> str:
    """Why nothing can be made in a folder; "" when something can."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            return ""
    except OSError as error:
        return error.strerror or str(error)


def _size(size_bytes: int) -> str:
    return f"{size_bytes / 1e9:.1f} GB" if size_bytes >= 1e9 else f"{size_bytes / 1e6:.0f} MB"
