"""The USB driver on the real libusb: the device is emulated under umockdev's preload, in processes started for it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from simulators.usb_testbed import PRELOAD, is_available

TESTS = Path(__file__).parents[1]


def run_under_preload(root: Path, *arguments: str, timeout_s: float = 110) -> subprocess.CompletedProcess[str]:
    """A Python that sees no USB but what is made under `root`."""
    if not is_available() and "CI" not in os.environ:
        pytest.skip(f"no {PRELOAD} here; as root: apt-get install umockdev libusb-1.0-0")
    assert is_available(), f"CI must have {PRELOAD}: see .ci/run"
    root.mkdir()
    environment = os.environ | {"LD_PRELOAD": PRELOAD, "UMOCKDEV_DIR": str(root)}
    return subprocess.run(
        [sys.executable, *arguments], env=environment, capture_output=True, text=True, timeout=timeout_s,
        cwd=TESTS.parent, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    "tests",
    ["test_fault_matrix.py -k [usb", "test_flow_control.py", "usb_device.py", "usb_capture.py", "tty_emulated.py"],
)
def test_on_an_emulated_device(tests: str, tmp_path: Path) -> None:
    file, *chosen = tests.split()
    quietly = ("-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--timeout", "30")
    ran = run_under_preload(tmp_path / "usb", "-m", "pytest", *quietly, str(TESTS / "system" / file), *chosen)
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-2000:]
    assert " passed" in ran.stdout
