"""Laying a service out on this machine, exchanging it for another version, and taking it away again.

What was there and was changed by hand stays: our newer version of such a file is put beside it. Nothing runs otherwise
until the new program is there, whole, and accepts the settings; where the service does not come up with it, what was
before comes back.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from node.durable import write_whole
from node.release import build, identity, logical, require_python, run, unit_files
from protocol.errors import InstallError

PROGRAM = "opt/foveascan"
SETTINGS = "etc/foveascan"
STATE = "var/lib/foveascan"
SEALED = "var/lib/foveascan.sealed"
CREDENTIAL = "etc/credstore/foveascan.key"
LIBRARY_KEY = "etc/credstore.encrypted/foveascan.library-key"
ACCOUNT = SERVICE = "foveascan"
VAULT = "foveascan-vault"
UNIT = "etc/systemd/system/foveascan.service"
VAULT_UNIT = "etc/systemd/system/foveascan-vault.service"
RULE = "etc/udev/rules.d/70-foveascan.rules"
PLACES = {
    "foveascan.service": UNIT,
    "foveascan-vault.service": VAULT_UNIT,
    "sysusers.conf": "etc/sysusers.d/foveascan.conf",
    "tmpfiles.conf": "etc/tmpfiles.d/foveascan.conf",
    "70-foveascan.rules": RULE,
    "node.toml": f"{SETTINGS}/node.toml",
    "nginx-cache.conf": f"{SETTINGS}/nginx-cache.conf",
}
LAID = "laid.json"  # in PROGRAM: what we laid out, and its hash as we did
KEPT_RELEASES = 2
UDEV_CONTROL = Path("/run/udev/control")  # udevd listens there


@dataclass
class Installer:
    """root : "/", or a folder that stands for it, in which nothing is started.  tell : told of every step.

    is_dry : only tell. All methods raise InstallError and OSError.
    """

    root: Path
    is_dry: bool
    tell: Callable[[str], None]
    _before: dict[Path, bytes | None] = field(default_factory=dict)

    @property
    def is_this_machine(self) -> bool:
        """Whether what is laid out is to run here."""
        return self.root == Path("/")

    def install(self) -> None:
        """Lay everything out, or exchange an older version for this one; the same again changes nothing."""
        self._require_rights()
        if self.is_this_machine:
            require_python()
        release = self._release()
        if not self.is_dry and self.is_this_machine:
            self._check_settings(release)
        before = self._running_release()
        try:
            self._lay_out()
            self._switch(release)
            if self._starts:
                self._bring_up()
        except BaseException:
            self._restore(before)
            raise
        self._prune(release, before)
        if not self._starts:
            why = "there is no systemd running here" if self.is_this_machine else f"{self.root} is not this machine"
            self.tell(f"nothing was started: {why}")

    def remove(self, *, purge: bool) -> None:
        """Take the program and its unit away. purge : settings, scans and logins as well."""
        self._require_rights()
        for unit, service in ((UNIT, SERVICE), (VAULT_UNIT, VAULT)):
            if self._starts and (self.root / unit).exists():
                self._run("systemctl", "disable", "--now", service)
        for place in (*PLACES.values(), PROGRAM):
            if place.startswith(SETTINGS):
                continue
            self._delete(self.root / place)
        if purge:
            for place in (SETTINGS, STATE, SEALED, CREDENTIAL, LIBRARY_KEY):
                self._delete(self.root / place)
        if self._starts:
            self._run("systemctl", "daemon-reload")
            self._udevadm("control", "--reload")
            if purge and shutil.which("userdel"):
                self._run("userdel", ACCOUNT)
        if not purge:
            self.tell(f"kept: settings in /{SETTINGS}, scans and logins in /{STATE}; --purge deletes them as well")

    # -- steps -----------------------------------------------------------------------------------------------------

    @property
    def _starts(self) -> bool:
        return self.is_this_machine and Path("/run/systemd/system").is_dir()

    def _require_rights(self) -> None:
        if self.is_this_machine and os.geteuid() != 0 and not self.is_dry:
            raise InstallError("only root can change /opt and /etc; use sudo, or --root DIR to lay it out elsewhere")
        link = self.root / PROGRAM / "bin"
        if link.is_dir() and not link.is_symlink():
            raise InstallError(f"/{PROGRAM}/bin is a folder, so installed in another way: move /{PROGRAM} away first")

    def _release(self) -> Path:
        """The folder of this very version, made if need be."""
        release = self.root / PROGRAM / "releases" / identity()
        if release.is_dir():
            self.tell(f"kept     {logical(release)}: this version is there")
            return release
        self.tell(f"make     {logical(release)}")
        if not self.is_dry:
            release.parent.mkdir(parents=True, exist_ok=True)
            (self.root / PROGRAM).chmod(0o755)
            release.parent.chmod(0o755)
            build(release)
        return release

    def _check_settings(self, release: Path) -> None:
        """Raises InstallError while nothing is changed yet."""
        settings = self.root / PLACES["node.toml"]
        if settings.exists():
            command = [str(release / "bin" / "foveascan"), "serve", "--check", "--config", str(settings)]
            checked = run(command)
            if checked.returncode:
                said = checked.stderr.strip().removeprefix("foveascan: ")
                raise InstallError(f"nothing was changed: this version does not accept the settings: {said}")

    def _lay_out(self) -> None:
        laid = self._laid()
        for name, place in PLACES.items():
            laid[place] = self._lay(unit_files() / name, place, laid.get(place))
        if not self.is_dry:
            self._write(self.root / PROGRAM / LAID, json.dumps(laid, indent=1, sort_keys=True).encode() + b"\n")

    def _lay(self, source: Path, place: str, laid: str | None) -> str:
        """Put a file of ours in its place, unless somebody changed what is there. Returns the hash of ours."""
        path, ours = self.root / place, source.read_bytes()
        there = path.read_bytes() if path.is_file() else None
        own = _hash(ours)
        if there == ours:
            self.tell(f"kept     /{place}: as it is to be")
        elif there is None or _hash(there) == laid:
            self.tell(f"{'make' if there is None else 'renew'}     "[:9] + f"/{place}")
            self._put(path, ours)
        elif laid == own:
            self.tell(f"kept     /{place}: as somebody changed it")
        else:
            self.tell(f"kept     /{place}: as somebody changed it; see what is new in /{place}.new")
            self._put(path.with_name(f"{path.name}.new"), ours)
        return own

    def _switch(self, release: Path) -> None:
        """Let the service run this release from its next start on."""
        link, target = self.root / PROGRAM / "bin", f"releases/{release.name}/bin"
        if link.is_symlink() and os.readlink(link) == target:
            return
        self.tell(f"switch   {logical(link)} to {target}")
        if not self.is_dry:
            new = link.with_name(".bin.new")
            new.unlink(missing_ok=True)
            new.symlink_to(target)
            new.rename(link)

    def _bring_up(self) -> None:
        self._run("systemd-sysusers", f"/{PLACES['sysusers.conf']}")
        self._run("systemd-tmpfiles", "--create", f"/{PLACES['tmpfiles.conf']}")
        self._udevadm("control", "--reload")
        self._udevadm("trigger", "--subsystem-match=tty", "--subsystem-match=usb")
        self._run("systemctl", "daemon-reload")
        self._run("systemctl", "enable", SERVICE)
        self._run("systemctl", "restart", SERVICE)

    def _restore(self, before: Path | None) -> None:
        """Bring back what was before, and start that."""
        if self.is_dry:
            return
        self.tell("failed: what was before comes back")
        for path, content in self._before.items():
            if content is None:
                path.unlink(missing_ok=True)
            else:
                write_whole(path, content)
        if before is None:
            (self.root / PROGRAM / "bin").unlink(missing_ok=True)
        else:
            self._switch(before)
        if self._starts:
            for command in (["daemon-reload"], ["restart", SERVICE] if before else ["reset-failed", SERVICE]):
                with suppress(InstallError):  # why it came to this matters more
                    run(["systemctl", *command])

    def _prune(self, *kept: Path | None) -> None:
        """Delete releases but this one and the one before."""
        names = {path.name for path in kept if path is not None}
        folder = self.root / PROGRAM / "releases"
        for release in sorted(folder.iterdir()) if folder.is_dir() else ():
            if release.name not in names and len(names) == KEPT_RELEASES:
                self._delete(release)

    # -- hands -----------------------------------------------------------------------------------------------------

    def _running_release(self) -> Path | None:
        link = self.root / PROGRAM / "bin"
        return (link.parent / os.readlink(link)).parent if link.is_symlink() else None

    def _laid(self) -> dict[str, str]:
        try:
            laid = json.loads((self.root / PROGRAM / LAID).read_bytes())
        except (OSError, ValueError):
            return {}
        return {str(place): str(value) for place, value in laid.items()} if isinstance(laid, dict) else {}

    def _put(self, path: Path, content: bytes) -> None:
        if not self.is_dry:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._write(path, content)
            path.chmod(0o644)

    def _write(self, path: Path, content: bytes) -> None:
        self._before.setdefault(path, path.read_bytes() if path.is_file() else None)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content)

    def _delete(self, path: Path) -> None:
        if not os.path.lexists(path):
            return
        self.tell(f"delete   /{path.relative_to(self.root)}")
        if self.is_dry:
            return
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()

    def _udevadm(self, *command: str) -> None:
        if UDEV_CONTROL.exists():  # a container may have the command and no udevd
            self._run("udevadm", *command)

    def _run(self, *command: str) -> None:
        self.tell(f"run      {' '.join(command)}")
        if self.is_dry:
            return
        done = run(command)
        if done.returncode:
            said = " ".join((done.stderr or done.stdout).split())
            raise InstallError(f"{' '.join(command)} failed: {said or f'status {done.returncode}'}")


def _hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
