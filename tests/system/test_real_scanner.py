"""The capture tests against a real device: `pytest tests/system/test_real_scanner.py --scanner /dev/ttyACM0`.

Without --scanner they run against a simulated one, so that they are known to work when a device is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from drivers.conformance import examine_link
from drivers.discover import config_for, open_port
from drivers.scanner import Scanner, SweepFinished, SweepInterrupted, SweepStarted
from node.assemble import Assembler
from node.resume import add_column, assembler_of
from protocol.grid import Grid
from protocol.scanner_messages import RangeColumn, SweepHeader, SweepRequest, TextureColumn
from tests.system.fault_rig import Bench, pty

QUIET_S = 5.0  # a real table may take its time to home


@pytest.fixture
def address(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """Where the scanner is: the real one, or one made for the test."""
    if named := request.config.getoption("scanner"):
        yield named
        return
    with pty(Bench("", 1, tmp_path)) as line:
        with closing(line.open_port()) as port:
            name = port.name
        yield name


@pytest.fixture
def scanner(address: str) -> Iterator[Scanner]:
    with closing(Scanner(open_port(address), config_for(address, QUIET_S))) as made:
        made.hello()
        yield made


def swept(scanner: Scanner, request: SweepRequest) -> tuple[SweepHeader, Grid]:
    assembler: Assembler | None = None
    for event in scanner.sweep(request):
        if isinstance(event, SweepStarted):
            header, assembler = event.header, assembler_of(event.header)
        elif isinstance(event, RangeColumn | TextureColumn):
            assert assembler is not None
            add_column(assembler, event)
        elif isinstance(event, SweepInterrupted):
            pytest.fail(event.reason)
    assert assembler is not None and isinstance(event, SweepFinished)
    return header, assembler.finish()


def test_it_follows_the_protocol(address: str) -> None:
    with closing(open_port(address)) as port:
        problems = [finding for finding in examine_link(port, config_for(address, QUIET_S)) if finding.state != "ok"]
    assert problems == []


def test_a_sweep_makes_a_grid(scanner: Scanner) -> None:
    header, grid = swept(scanner, SweepRequest())
    assert grid.spec == header.spec and np.count_nonzero(grid.range_steps) > 0


def test_two_sweeps_of_a_thing_that_stands_still_agree(scanner: Scanner) -> None:
    _, one = swept(scanner, SweepRequest())
    header, other = swept(scanner, SweepRequest())
    both = (one.range_steps > 0) & (other.range_steps > 0)
    apart_mm = np.abs(one.range_steps.astype(int) - other.range_steps)[both] * header.spec.step_mm
    assert np.percentile(apart_mm, 90) < header.spec.pitch_mm


def test_the_table_can_be_homed(scanner: Scanner) -> None:
    assert scanner.calibrate().calibration == scanner.calibrate().calibration
