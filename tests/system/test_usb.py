"""The USB driver on the real libusb: the device is emulated under umockdev's preload, in processes started for it."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from simulators.usb_preload import PRELOAD, is_available

TESTS = Path(__file__).parents[1]


def run_under_preload(*arguments: str, timeout_s: float = 110) -> subprocess.CompletedProcess[str]:
    """A Python that sees no USB but what is made under a folder of its own, whose path is short: sockets lie in it."""
    if not is_available() and "CI" not in os.environ:
        pytest.skip(f"no {PRELOAD} here; as root: apt-get install umockdev libusb-1.0-0")
    assert is_available(), f"CI must have {PRELOAD}: see .ci/run"
    with tempfile.TemporaryDirectory(prefix="fs-") as root:
        environment = os.environ | {"LD_PRELOAD": PRELOAD, "UMOCKDEV_DIR": root}
        return subprocess.run(
            [sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=timeout_s,
            cwd=TESTS.parent, check=False,
        )  # fmt: skip


@pytest.mark.parametrize(
    "tests",
    ["test_fault_matrix.py -k [usb", "test_flow_control.py", "usb_device.py", "usb_capture.py", "tty_emulated.py"],
)
def test_on_an_emulated_device(tests: str) -> None:
    file, *chosen = tests.split()
    quietly = ("-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--timeout", "30")
    ran = run_under_preload("-m", "pytest", *quietly, str(TESTS / "system" / file), *chosen)
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-2000:]
    assert " passed" in ran.stdout
