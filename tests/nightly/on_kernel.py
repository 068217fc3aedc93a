"""What only a real kernel does with a scanner on USB, as pytest; `make nightly` runs it, as root of its machine."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TypeVar

import pytest

from drivers.discover import Arrivals, Found, find_ports
from drivers.usb_port import UsbAddress, UsbPort
from foveascan import PROGRAM, started
from simulators.usb_descriptors import CDC_IDENTITY
from tests.system.usb_bed import CONTROLLERS, acm_bed

ROOT = Path(__file__).parents[2]
SOON_S, RUN_S = 30.0, 900.0  # an emulated processor beside others takes minutes for what hangs nowhere
NOTICED_S = 2.0  # by an event; a machine without them looks four times a second
RULES = Path("/etc/udev/rules.d")
TTY = Path("/dev/ttyACM0")

T = TypeVar("T")


def until(look: Callable[[], T]) -> T:
    """What a look finds, as soon as it finds something."""
    until_s = time.monotonic() + SOON_S
    while not (found := look()):
        assert time.monotonic() < until_s, "it did not come"
        time.sleep(0.02)
    return found


@contextmanager
def plugged(link: str) -> Iterator[Found]:
    """`foveascan simulate` as a USB device, found by the driver."""
    with started("simulate", "--link", link, "--path", CONTROLLERS[0], "--turn", "0.2", "--json"):
        found = until(find_ports)[0]
        subprocess.run(["udevadm", "settle"], check=True)
        yield found
    until(lambda: not find_ports())


@contextmanager
def rule(text: str) -> Iterator[None]:
    """A udev rule, as long as it is needed."""
    RULES.mkdir(parents=True, exist_ok=True)
    file = RULES / "70-foveascan.rules"
    file.write_text(text + "\n")
    subprocess.run(["udevadm", "control", "--reload"], check=True)
    try:
        yield
    finally:
        file.unlink()
        subprocess.run(["udevadm", "control", "--reload"], check=True)


@pytest.fixture(scope="session", autouse=True)
def group() -> None:
    """As the installation makes it."""
    subprocess.run(["systemd-sysusers", ROOT / "systemd/sysusers.conf"], check=True)


def doctor(address: str, *groups: str) -> subprocess.CompletedProcess[str]:
    """`foveascan doctor --link` of somebody who is nobody but a member of those groups."""
    return subprocess.run(
        [*PROGRAM, "doctor", "--link", address], capture_output=True, text=True, timeout=RUN_S, check=False,
        user="nobody", group="nogroup", extra_groups=groups, env=os.environ | {"HOME": "/tmp"},
    )  # fmt: skip


def test_a_stranger_is_told_the_udev_rule_and_with_it_he_may() -> None:
    with plugged("gadget") as found:
        refused = doctor(found.address)
    said = re.search(r"no permission; add the udev rule (SUBSYSTEM.*) in (\S+) and plug it in again", refused.stdout)
    assert refused.returncode == 1 and said, refused.stdout + refused.stderr
    assert said[2] == f"{RULES / '70-foveascan.rules'}"
    with rule(said[1]), plugged("gadget") as found:
        assert doctor(found.address).returncode == 1
        allowed = doctor(found.address, "foveascan")
    assert allowed.returncode == 0, allowed.stdout + allowed.stderr


@pytest.mark.parametrize("link", ["gadget", "acm"])
def test_the_installed_udev_rule_gives_the_scanner_to_the_group(link: str) -> None:
    with rule((ROOT / "systemd/70-foveascan.rules").read_text()), plugged(link) as found:
        node = Path(f"/dev/bus/usb/001/{usb_number():03d}") if link == "gadget" else Path(found.address)
        assert (node.group(), stat.S_IMODE(node.stat().st_mode)) == ("foveascan", 0o660)
        allowed = doctor(found.address, "foveascan")
    assert allowed.returncode == 0, allowed.stdout + allowed.stderr


def usb_number() -> int:
    """Of the one device on the bus."""
    (number,) = Path("/sys/bus/usb/devices/1-1/devnum").read_text().split()
    return int(number)


def test_a_serial_port_of_the_kernels_is_taken_as_a_usb_device_and_given_back() -> None:
    with plugged("acm"):
        for _ in range(2):
            with closing(UsbPort(UsbAddress(CDC_IDENTITY.vendor, CDC_IDENTITY.product))):
                until(lambda: not TTY.exists())
            until(TTY.exists)
        examined = doctor_as_root(f"usb:{CDC_IDENTITY.vendor:04x}:{CDC_IDENTITY.product:04x}")
        assert examined.returncode == 0, examined.stdout + examined.stderr
        until(TTY.exists)
        examined = doctor_as_root(f"{TTY}")
    assert examined.returncode == 0, examined.stdout + examined.stderr


def doctor_as_root(address: str) -> subprocess.CompletedProcess[str]:
    """`foveascan doctor --link`, by us."""
    command = [*PROGRAM, "doctor", "--link", address]
    return subprocess.run(command, capture_output=True, text=True, timeout=RUN_S, check=False)


@pytest.mark.parametrize(
    ("link", "address"),
    [("acm", "/dev/ttyACM0"), ("acm", "serial:1209:5ca2:SIM-0001"), ("acm", "by-id"), ("gadget", "usb:1209:5ca1")],
)
def test_the_kit_for_real_scanners_passes(link: str, address: str) -> None:
    with plugged(link) as found:
        chosen = ["--scanner", found.address if address == "by-id" else address]
        kit = ["-q", "-p", "no:cacheprovider", "-p", "no:xdist", f"{ROOT / 'tests/system/test_real_scanner.py'}"]
        ran = subprocess.run(
            [sys.executable, "-m", "pytest", *kit, *chosen], cwd=ROOT, capture_output=True, text=True, timeout=RUN_S,
            check=False,
        )  # fmt: skip
    assert ran.returncode == 0 and "4 passed" in ran.stdout, ran.stdout[-4000:] + ran.stderr[-1000:]


def test_a_serial_port_that_comes_and_goes_is_noticed_by_its_events() -> None:
    stop = threading.Event()
    with closing(Arrivals()) as arrivals:
        with closing(acm_bed()) as gadget:
            assert arrivals.wait(SOON_S, stop)
            until(lambda: not arrivals.wait(0.5, stop))  # a device, then its port, then the port's other names
            (found,) = find_ports()
            assert found.address.startswith("/dev/serial/by-id/usb-foveascan") and found.serial_number == "SIM-0001"
            began_s = time.monotonic()
            gadget.hang_up()
            assert arrivals.wait(SOON_S, stop) and time.monotonic() - began_s < NOTICED_S
            until(lambda: not find_ports())
