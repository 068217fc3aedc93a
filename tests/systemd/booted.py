"""A real systemd as process 1 of a small machine of its own: namespaces over this one, on a file system that forgets.

What is written there is written to memory; processes, mounts and control groups are its own, the network is this
machine's. It needs root, overlayfs and control groups of version 2.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
SITE = Path(sys.prefix) / "lib" / f"python{sys.version_info.major}.{sys.version_info.minor}" / "site-packages"
SYSTEMD = "/lib/systemd/systemd"
BOOT_S, RUN_S = 20, 240
PYTHON = "/opt/python" if sys.base_prefix.startswith(("/root/", "/home/")) else sys.base_prefix
FOVEASCAN = (f"{PYTHON}/bin/python{sys.version_info.major}.{sys.version_info.minor}", "-P", "-m", "foveascan")
TARGETS = "sysinit basic shutdown network-online multi-user booted"

BOOT = r"""
set -e
mount --make-rprivate /
mount -t tmpfs tmpfs "$BED"; mkdir "$BED"/{u,w,m}
mount -t overlay overlay -o lowerdir=/,upperdir="$BED/u",workdir="$BED/w" "$BED/m"
cd "$BED/m"
mkdir -p opt/src opt/site opt/python
mount --rbind "$SOURCES" opt/src; mount --rbind "$SITE" opt/site; mount --rbind "$BASE" opt/python
mount -t proc proc proc
mount --bind proc/sys proc/sys; mount -o remount,ro,bind proc/sys
mount -t sysfs -o ro sysfs sys; mount -t tmpfs tmpfs sys/fs/cgroup 2> /dev/null || true
mount -t cgroup2 cgroup2 sys/fs/cgroup
touch "$BED/kmsg"
mount -t tmpfs -o mode=755 tmpfs dev
nodes="null zero full random urandom tty"; [ ! -e /dev/fuse ] || nodes="$nodes fuse"
for node in $nodes; do touch dev/$node; mount --bind /dev/$node dev/$node; done
touch dev/kmsg; mount --bind "$BED/kmsg" dev/kmsg
mkdir dev/pts dev/shm; mount -t devpts -o newinstance,ptmxmode=0666 devpts dev/pts; ln -s pts/ptmx dev/ptmx
mount -t tmpfs tmpfs dev/shm; ln -s /proc/self/fd dev/fd
mount -t tmpfs -o mode=755 tmpfs run; mount -t tmpfs -o mode=1777 tmpfs tmp
mkdir -p run/units etc/systemd/system/foveascan.service.d
for name in $TARGETS; do printf '[Unit]\nDefaultDependencies=no\n' > run/units/$name.target; done
units="-.slice system.slice init.scope systemd-journald.service systemd-journald.socket"
for unit in $units; do cp /lib/systemd/system/$unit run/units/ 2> /dev/null || true; done
cat > etc/systemd/system/foveascan.service.d/test.conf <<END
[Service]
Environment=LD_LIBRARY_PATH=$PYTHON/lib
StandardError=append:/run/foveascan.log
StandardOutput=append:/run/foveascan.log
RestartSec=0.2
StartLimitIntervalSec=0
END
mkdir -p mnt/old; pivot_root . mnt/old; umount -l /mnt/old
mount --make-rshared /
exec env -i container=test PATH="$PATH" SYSTEMD_UNIT_PATH=/etc/systemd/system:/run/units SYSTEMD_LOG_TARGET=kmsg \
    "$INIT" --system --show-status=no --unit=booted.target
"""


@dataclass(frozen=True)
class Machine:
    """The small machine. pid : of its systemd, as we see it."""

    pid: int

    def run(self, *command: str, sources: str = "/opt/src", check: bool = True) -> subprocess.CompletedProcess[str]:
        """Run a command there, as root."""
        done = subprocess.run(
            [*self._enter, *command], env=_environ(sources), capture_output=True, text=True, timeout=RUN_S, check=False
        )
        assert not check or done.returncode == 0, done.stdout + done.stderr
        return done

    def foveascan(self, *command: str, sources: str = "/opt/src", check: bool = True) -> str:
        """Run our command from a checkout there; what it said."""
        done = self.run(*FOVEASCAN, *command, sources=sources, check=check)
        return done.stdout + done.stderr

    @contextmanager
    def started(self, *command: str) -> Iterator[dict[str, Any]]:
        """Our command, with --json, beside everything else there; what it says once it is ready."""
        with subprocess.Popen(
            [*self._enter, *FOVEASCAN, *command], env=_environ("/opt/src"), stdout=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            try:
                yield json.loads(process.stdout.readline())
            finally:
                process.terminate()

    @property
    def _enter(self) -> list[str]:
        return ["nsenter", "-t", str(self.pid), "--mount", "--pid", "--ipc", "--uts", "--cgroup", "--wd=/"]

    def show(self, key: str) -> str:
        """A property of the service."""
        return self.run("systemctl", "show", "--value", "-p", key, "foveascan").stdout.strip()

    def await_property(self, key: str, value: str, wait_s: float = 30) -> None:
        """Wait until a property has a value."""
        until = time.monotonic() + wait_s
        while (found := self.show(key)) != value:
            assert time.monotonic() < until, f"{key} is {found!r}, not {value!r}: {self.log()}"
            time.sleep(0.1)

    def log(self) -> str:
        """What the service wrote."""
        return self.run("cat", "/run/foveascan.log", check=False).stdout[-3000:]

    def write(self, path: str, text: str) -> None:
        """Make a file there."""
        self.run("sh", "-c", 'mkdir -p "$(dirname "$0")"; printf %s "$1" > "$0"', path, text)


def _environ(sources: str) -> dict[str, str]:
    return {
        "PATH": os.environ["PATH"], "PYTHONPATH": f"{sources}:/opt/site", "LD_LIBRARY_PATH": f"{PYTHON}/lib",
        "HOME": "/run", "PYTHONDONTWRITEBYTECODE": "1",
    }  # fmt: skip


@contextmanager
def booted(bed: Path) -> Iterator[Machine]:
    """Boot one; its end takes everything with it. bed : an empty folder. Raises OSError where it cannot be."""
    group = _control_group(bed.name)
    environ = {
        "BED": str(bed), "SOURCES": str(ROOT), "SITE": str(SITE), "BASE": sys.base_prefix, "PATH": os.environ["PATH"],
        "INIT": SYSTEMD, "PYTHON": PYTHON, "TARGETS": TARGETS,
    }  # fmt: skip
    apart = ["unshare", "--mount", "--pid", "--cgroup", "--ipc", "--uts", "--fork", "--kill-child", "bash", "-c", BOOT]
    enter = ["bash", "-c", 'echo $$ > "$0/cgroup.procs"; exec "$@"', str(group), *apart]
    said = bed.with_suffix(".log")
    with said.open("wb") as log, subprocess.Popen(enter, env=environ, stdout=log, stderr=log) as process:
        try:
            machine = Machine(_child_of(process))
            _await_boot(machine, process, said)
            yield machine
        finally:
            process.kill()
            process.wait()
            _remove(group)


def why_not() -> str:
    """What keeps such a machine from booting here; "" when nothing does."""
    missing = [name for name in ("unshare", "nsenter", "systemctl") if shutil.which(name) is None]
    if missing or not Path(SYSTEMD).exists():
        return f"needs {', '.join(missing) or 'systemd'}"
    if os.geteuid() != 0:
        return "needs root"
    tried = subprocess.run(
        ["unshare", "--mount", "--pid", "--cgroup", "--fork", "bash", "-c", "mount --make-rprivate / && "
         "mount -t tmpfs t /mnt && mkdir /mnt/u /mnt/w /mnt/m && "
         "mount -t overlay o -o lowerdir=/,upperdir=/mnt/u,workdir=/mnt/w /mnt/m && mount -t cgroup2 c /mnt/u"],
        capture_output=True, text=True, timeout=BOOT_S,
    )  # fmt: skip
    if tried.returncode == 0 and _hierarchy() is None:
        return "needs control groups of version 2"
    return "" if tried.returncode == 0 else f"needs namespaces and overlayfs: {tried.stderr.strip()[:200]}"


def _hierarchy() -> Path | None:
    for line in Path("/proc/mounts").read_text().splitlines():
        _, place, kind, options, *_ = line.split()
        if kind == "cgroup2" and options.startswith("rw"):
            return Path(place)
    return None


def _control_group(name: str) -> Path:
    """One of our own, below which the machine sees no other."""
    top = _hierarchy()
    assert top is not None
    group = top / f"foveascan-{os.getpid()}-{name}"
    group.mkdir()
    return group


def _remove(group: Path) -> None:
    until = time.monotonic() + BOOT_S
    while group.exists() and time.monotonic() < until:
        for inner in sorted(group.rglob("*"), reverse=True):
            if inner.is_dir():
                with suppress(OSError):  # somebody in it is not dead yet
                    inner.rmdir()
        with suppress(OSError):
            group.rmdir()
        time.sleep(0.05)


def _child_of(process: subprocess.Popen[bytes]) -> int:
    until = time.monotonic() + BOOT_S
    while time.monotonic() < until and process.poll() is None:
        children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        if children and Path(f"/proc/{children[0]}/comm").read_text().strip() == "systemd":
            return int(children[0])
        time.sleep(0.05)
    raise OSError("systemd did not start")


def _await_boot(machine: Machine, process: subprocess.Popen[bytes], said: Path) -> None:
    until = time.monotonic() + BOOT_S
    while machine.run("systemctl", "is-active", "booted.target", check=False).returncode:
        if process.poll() is not None or time.monotonic() > until:
            raise OSError(f"systemd did not boot: {said.read_text(errors='replace')[-500:]}")
        time.sleep(0.1)
