"""The USB tests on a real kernel: `make nightly` boots a small virtual machine, and runs them there.

The machine has Debian's kernel, fetched once by apt-get, with the module dummy_hcd: a USB bus with device controllers
of its own, where scanners of simulators/usb_gadget.py and tty_gadget.py are plugged in. It reads this machine's files,
so it runs this checkout on this Python; what it writes goes to memory, but for the folder KEPT, where a log lies.

It needs qemu. Where /dev/kvm does not carry a kernel it is emulated, which takes ten times as long.
"""

from __future__ import annotations

import argparse
import lzma
import os
import select
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

ROOT = Path(__file__).parents[2]
KEPT = ROOT / ".nightly"
LIMIT_S, TEST_S = 10800, 1200
SILENT_S = 40.0  # a kernel that KVM does not carry says nothing
UP = b"machine: up"
KERNEL_WORDS = "console=ttyS0 quiet loglevel=4 panic=-1 no_timer_check"  # which fails where a processor is kept waiting
SPEEDS = {"kvm": ["-accel", "kvm", "-cpu", "host"], "tcg": ["-accel", "tcg,thread=multi", "-cpu", "max"]}
TESTS = [
    "tests/nightly/on_kernel.py", "tests/system/usb_device.py", "tests/system/usb_capture.py",
    "tests/system/test_fault_matrix.py", "tests/system/test_flow_control.py", "tests/system/test_usb_line.py",
]  # fmt: skip
MEMORY_MB, PROCESSORS = 4096, 2
TO_BOOT = ("virtio_pci", "9p", "9pnet_virtio", "overlay")  # what it needs to see our files; the rest it loads itself
PROGRAMS = {
    "qemu-system-x86_64": "qemu-system-x86", "depmod": "kmod", "udevadm": "udev", "systemd-sysusers": "systemd",
    "umount": "mount",
}  # fmt: skip
TIMED_OUT = 124  # as timeout(1) says it
_ADMIN_PATH = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
_HERE = Path(__file__).parent


@dataclass(frozen=True)
class Kernel:
    """A kernel unpacked under a folder, and a shell that needs no libraries. version : as uname -r says it."""

    folder: Path
    version: str

    @property
    def image(self) -> Path:
        """What qemu boots."""
        return self.folder / "boot" / f"vmlinuz-{self.version}"

    @property
    def shell(self) -> Path:
        """Busybox, linked statically."""
        return self.folder / "bin/busybox"

    def modules(self, names: Iterable[str]) -> list[Path]:
        """The files of modules and of what they need, in the order to load them."""
        shown = "".join(
            _said("modprobe", "-d", str(self.folder), "-S", self.version, "--show-depends", name) for name in names
        )
        paths = [line.split()[1] for line in shown.splitlines() if line.startswith("insmod ")]
        return [Path(path) for path in dict.fromkeys(paths)]


def fetch(folder: Path) -> Kernel:
    """Debian's newest kernel for this machine and its busybox, from its packages; what is there is not fetched again.

    Raises CalledProcessError, after apt-get or dpkg-deb has said why.
    """
    wanted = [line.split()[1] for line in _said("apt-cache", "depends", "linux-image-amd64").splitlines()
              if line.strip().startswith("Depends: linux-image-")]  # fmt: skip
    version = wanted[0].removeprefix("linux-image-")
    kernel = Kernel(folder / version, version)
    if not kernel.folder.exists():
        with _whole_folder(kernel.folder) as fresh:
            subprocess.run(["apt-get", "-q", "download", wanted[0], "busybox-static"], cwd=fresh, check=True)
            for package in fresh.glob("*.deb"):
                subprocess.run(["dpkg-deb", "-x", package, fresh], check=True)
                package.unlink()
            _said("depmod", "-b", str(fresh), version)
    return kernel


@contextmanager
def _whole_folder(folder: Path) -> Iterator[Path]:
    """A folder that appears whole or not at all."""
    fresh = folder.with_name(f"{folder.name}.{os.getpid()}.tmp")
    fresh.mkdir()
    try:
        yield fresh
        fresh.rename(folder)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def archive(files: dict[str, tuple[int, bytes]]) -> bytes:
    """The first file system of a kernel: a cpio archive ("newc") of mode and content by name."""
    entries = []
    for number, (name, (mode, data)) in enumerate([*files.items(), ("TRAILER!!!", (0, b""))], 1):
        path = name.encode() + b"\0"
        fields = (number, mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(path), 0)
        head = b"070701" + b"".join(b"%08x" % field for field in fields) + path
        entries += [head + bytes(-len(head) % 4), data + bytes(-len(data) % 4)]
    return b"".join(entries)


def first_files(kernel: Kernel) -> bytes:
    """Shell, modules and the script that finds our files."""
    modules = kernel.modules(TO_BOOT)
    files = {name: (0o40755, b"") for name in ("bin", "dev", "proc", "modules", "host", "memory", "root")}
    files["bin/busybox"] = (0o100755, kernel.shell.read_bytes())
    files["init"] = (0o100755, (_HERE / "init").read_bytes())
    files["modules/order"] = (0o100644, "".join(f"{number}.ko\n" for number in range(len(modules))).encode())
    for number, path in enumerate(modules):
        data = path.read_bytes()
        files[f"modules/{number}.ko"] = (0o100644, lzma.decompress(data) if path.suffix == ".xz" else data)
    return archive(files)


def command_line(kernel: Kernel, first: Path, kept: Path, speed: str) -> list[str]:
    """How qemu is started."""
    share = "local,security_model=none,multidevs=remap"
    words = f"{KERNEL_WORDS} bed={kernel.folder} kept={kept} inside={_HERE / 'inside'}"
    return [
        "qemu-system-x86_64", *SPEEDS[speed], "-smp", f"{PROCESSORS}", "-m", f"{MEMORY_MB}", "-nodefaults",
        "-no-reboot", "-display", "none", "-serial", "stdio", "-device", "virtio-rng-pci",
        "-virtfs", f"{share},path=/,mount_tag=host,readonly=on", "-virtfs", f"{share},path={kept},mount_tag=kept",
        "-kernel", str(kernel.image), "-initrd", str(first), "-append", words,
    ]  # fmt: skip


def run(command: list[str], limit_s: float = LIMIT_S, kept: Path = KEPT) -> int:
    """Run a command in the machine; its exit status, or TIMED_OUT. What it says is shown as it comes, and logged.

    Raises OSError where the machine ended without a word about the command.
    """
    (kept / "kernel").mkdir(parents=True, exist_ok=True)
    kernel = fetch(kept / "kernel")
    first, status, log = kept / "first.cpio", kept / "status", kept / "log"
    first.write_bytes(first_files(kernel))
    place = shlex.quote(str(ROOT))
    (kept / "command").write_text(f"cd {place}\nexport PYTHONPATH={place}\n{shlex.join(command)}\n")
    speeds = {"kvm": SILENT_S, "tcg": limit_s} if os.access("/dev/kvm", os.R_OK | os.W_OK) else {"tcg": limit_s}
    for speed, silent_s in speeds.items():
        status.unlink(missing_ok=True)
        with log.open("wb") as kept_log:
            ended = follow(command_line(kernel, first, kept, speed), kept_log, limit_s, silent_s)
        if ended != "silent":
            break
        print(f"machine: does not boot with {speed}", file=sys.stderr)
    if ended == "late":
        print(f"machine: not over after {limit_s:g} s; see {log}", file=sys.stderr)
        return TIMED_OUT
    if not status.exists():
        raise OSError(f"the machine ended without a word about the command; see {log}")
    return int(status.read_text())


def follow(command: list[str], log: IO[bytes], limit_s: float, silent_s: float) -> str:
    """Show and log what a machine says until it has ended ("over").

    It is stopped when it is not over in `limit_s` ("late"), or has not said in `silent_s` that it is up; one that ends
    before it said so is "silent", too.
    """
    is_up, heard = False, b""
    began_s = time.monotonic()
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, env=_environ()) as machine:
        assert machine.stdout is not None
        while True:
            until_s = began_s + (limit_s if is_up else min(silent_s, limit_s))
            if not select.select([machine.stdout], [], [], max(until_s - time.monotonic(), 0.0))[0]:
                ended = "late" if is_up or silent_s >= limit_s else "silent"
                machine.kill()
                break
            data = os.read(machine.stdout.fileno(), 65536)
            if not data:
                ended = "over" if is_up else "silent"
                break
            heard = heard[-len(UP) :] + data  # it may come in pieces
            is_up = is_up or UP in heard
            for stream in (log, sys.stdout.buffer):
                stream.write(data.replace(b"\r\n", b"\n"))
                stream.flush()
    return ended


def _said(*command: str) -> str:
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=_environ()).stdout


def _environ() -> dict[str, str]:
    return os.environ | {"PATH": _ADMIN_PATH}


def main(arguments: list[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="Runs the USB tests on a real kernel, in a small virtual machine.")
    parser.add_argument("--limit", type=float, default=LIMIT_S, metavar="S", help="end it then (%(default)s)")
    parser.add_argument("tests", nargs="*", help="of pytest, with its options behind a --; all USB tests")
    args = parser.parse_args(arguments)
    missing = [package for program, package in PROGRAMS.items() if shutil.which(program, path=_ADMIN_PATH) is None]
    if missing:
        parser.error(f"as root: apt-get install --no-install-recommends {' '.join(missing)}")
    quietly = ["-p", "no:cacheprovider", "-p", "no:xdist", "--timeout", f"{TEST_S}", "--color", "no"]
    return run([sys.executable, "-m", "pytest", "-v", *quietly, *(args.tests or TESTS)], args.limit)


if __name__ == "__main__":
    sys.exit(main())
