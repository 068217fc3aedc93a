"""Every fault on every carrier: a scan as without it, or one whose report tells, or a cut sweep on disk. Seeded."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from node.scan_quality import ScanQuality
from protocol.errors import PortLost
from protocol.scanner_messages import Channel, Order, SweepRequest
from simulators.scanner import APART, TOGETHER
from simulators.usb_preload import is_available
from tests.system.fault_rig import (
    REQUEST,
    SPEC,
    Bench,
    Capturing,
    Ending,
    Line,
    acm,
    bumpy,
    memory,
    pty,
    tcp,
    usb,
    usb_double,
)
from tests.system.usb_bed import CONTROLLERS, HAS_USB

Carrier = Callable[[Bench], AbstractContextManager[Line]]
CARRIERS: dict[str, Carrier] = {"memory": memory, "pty": pty, "tcp": tcp}
if CONTROLLERS:  # in a machine of nightly's
    CARRIERS = {"usb": usb, "acm": acm}
elif HAS_USB:  # in the process that test_usb.py starts
    CARRIERS["usb"] = usb
elif not is_available():
    CARRIERS["usb_double"] = usb_double  # the driver without libusb, where umockdev is missing

REPAIRED = [
    "", "loss=0.03", "flip=0.03", "burst=0.05", "truncate=0.03", "lie=0.03", "twice=0.2", "reorder=0.1", "dribble=1",
    "stall=0.1", "unplug=0.2", "minor", "reversed", "overshoot=0.1", "loss=0.01,unplug=0.2",
    "loss=0.02,flip=0.02,burst=0.02,twice=0.1,reorder=0.1", "reversed,flip=0.02,overshoot=0.2",
]  # fmt: skip
CUT = ["stall=4", "stall=30", "reset", "loss=0.02,reset"]
REPORTED = {
    "slip=0.05": lambda q: q.has_slipped and abs(q.slip_deg - 18) < 2,
    "slip=0.02": lambda q: q.has_slipped and abs(q.slip_deg - 7.2) < 2,
    "ticks=3000": lambda q: q.has_slipped,
    "dead=3": lambda q: q.dead_rows == 3,
    "saturated=4": lambda q: q.saturated_columns >= 1,
    "spikes=0.002": lambda q: q.spikes > 5 and q.filled > 5,
    "dropouts=0.002": lambda q: q.filled > 5,
    "noise=10": lambda q: q.noise_mm is not None and 0.07 < q.noise_mm < 0.13,
    "spikes=0.001,loss=0.02,slip=0.04": lambda q: q.spikes > 2 and q.has_slipped,
}  # fmt: skip
JITTER_COUNTS = 60
SMALL = replace(SPEC, height=40, texture_height=30)  # whose columns come one byte at a time


@pytest.fixture(params=CARRIERS)
def carrier(request: pytest.FixtureRequest) -> Carrier:
    return CARRIERS[request.param]


@pytest.fixture(params=[name for name in CARRIERS if name.startswith(("pty", "usb", "acm"))])
def wire(request: pytest.FixtureRequest) -> Carrier:
    """What a scanner hangs on; ways to sweep go wrong there or nowhere."""
    return CARRIERS[request.param]


def swept(carrier: Carrier, bench: Bench, request: SweepRequest = REQUEST) -> Ending:
    with carrier(bench) as line:
        return Capturing(line, bench.folder, request).run()


@pytest.mark.parametrize("faults", REPAIRED)
def test_what_the_link_can_repair_leaves_no_trace(carrier: Carrier, faults: str, tmp_path: Path) -> None:
    bench = Bench(faults, 1, tmp_path, specimen=bumpy(SMALL if faults == "dribble=1" else SPEC))
    ending = swept(carrier, bench)
    assert ending.kind == "scan", ending.why
    assert ending.equals(bench.specimen.grid) and not ending.kept
    assert ending.assembly is not None and ending.assembly.quality.complaints == ()


@pytest.mark.parametrize("faults", CUT)
def test_what_ends_a_sweep_leaves_it_on_disk_as_interrupted(carrier: Carrier, faults: str, tmp_path: Path) -> None:
    ending = swept(carrier, Bench(faults, 2, tmp_path))
    assert ending.kind == "interrupted" and ending.assembly is None
    (sweep,) = ending.kept
    assert 0 < sweep.held < sweep.expected and not sweep.is_complete


@pytest.mark.parametrize("faults", REPORTED)
def test_what_cannot_be_repaired_is_reported(carrier: Carrier, faults: str, tmp_path: Path) -> None:
    tells: Callable[[ScanQuality], bool] = REPORTED[faults]
    ending = swept(carrier, Bench(faults, 3, tmp_path))
    assert ending.kind == "scan", ending.why
    assert ending.assembly is not None and tells(ending.assembly.quality), ending.assembly
    assert ending.assembly.quality.complaints or ending.assembly.quality.noise_mm


def test_a_jittering_encoder_blurs_little(carrier: Carrier, tmp_path: Path) -> None:
    bench = Bench("", 4, tmp_path, jitter_counts=JITTER_COUNTS)
    ending = swept(carrier, bench)
    assert ending.assembly is not None
    grid, truth = ending.assembly.grid, bench.specimen.grid
    assert np.abs(grid.range_steps.astype(int) - truth.range_steps).max() <= 3
    assert np.abs(grid.texture.astype(int) - truth.texture).max() <= 8


def test_a_device_of_another_major_version_is_refused_by_name(carrier: Carrier, tmp_path: Path) -> None:
    ending = swept(carrier, Bench("major", 5, tmp_path))
    assert ending.kind == "refused" and "speaks link version 2, this node 1.1" in ending.why and not ending.kept


def test_two_scanners_at_once_do_not_disturb_each_other(carrier: Carrier, tmp_path: Path) -> None:
    endings: dict[str, Ending] = {}

    def sweep(number: int, name: str) -> None:
        folder = tmp_path / name
        folder.mkdir()
        endings[name] = swept(carrier, Bench("loss=0.01", 6, folder, serial_number=name, place=number))

    threads = [threading.Thread(target=sweep, args=named) for named in ((1, "ONE"), (2, "TWO"))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert {name: ending.equals(bumpy().grid) for name, ending in endings.items()} == {"ONE": True, "TWO": True}


def test_one_port_opened_twice_is_refused_the_second_time(carrier: Carrier, tmp_path: Path) -> None:
    if carrier not in (pty, usb, acm):
        pytest.skip("what keeps a second program out is the kernel, or its emulation")
    with carrier(Bench("", 7, tmp_path)) as line, closing(line.open_port()):
        with pytest.raises(PortLost, match="another program"):
            line.open_port()


@pytest.mark.parametrize("faults", ["", "loss=0.02"])
def test_range_and_texture_in_turns_of_their_own_make_the_same_scan(
    wire: Carrier, faults: str, tmp_path: Path
) -> None:
    bench = Bench(faults, 12, tmp_path, channels=APART)
    ending = swept(wire, bench)
    assert ending.equals(bench.specimen.grid), ending.why
    assert ending.turns == [Channel.RANGE, Channel.TEXTURE] and ending.assembly is not None
    assert ending.assembly.quality.complaints == () and ending.assembly.quality.slip_deg == 0.0
    assert ending.report.requested_columns > 0 or not faults


@pytest.mark.parametrize(("seed", "cut"), [(2, Channel.RANGE), (4, Channel.TEXTURE)])
def test_a_plug_pulled_in_either_turn_costs_nothing(wire: Carrier, seed: int, cut: Channel, tmp_path: Path) -> None:
    bench = Bench("unplug=0.2", seed, tmp_path, channels=APART)
    ending = swept(wire, bench, SweepRequest())
    assert ending.equals(bench.specimen.grid), ending.why
    assert sorted(ending.turns) == sorted([*APART, cut])


@pytest.mark.parametrize(("faults", "channels"), [("slip=0.05", TOGETHER), ("slip=0.05", APART), ("nudge=0.05", APART)])
def test_what_moves_in_a_turn_or_between_two_is_told_by_a_second_pass(
    wire: Carrier, faults: str, channels: tuple[Channel, ...], tmp_path: Path
) -> None:
    ending = swept(wire, Bench(faults, 13, tmp_path, channels=channels), SweepRequest(passes=2))
    assert ending.turns == 2 * [*channels] * (channels is APART) and ending.assembly is not None
    quality = ending.assembly.quality
    assert quality.has_slipped and abs(abs(quality.slip_deg or 0) - 18) < 2, quality


def test_a_scanner_that_takes_no_texture_says_so_before_it_turns(wire: Carrier, tmp_path: Path) -> None:
    ending = swept(wire, Bench("", 14, tmp_path, channels=(Channel.RANGE,)))
    assert ending.kind == "refused" and "one turn takes range alone, not both" in ending.why and not ending.kept


@pytest.mark.parametrize("faults", ["", "loss=0.02,unplug=0.2"])
def test_a_buffered_scanner_sends_coarse_to_fine_and_makes_the_same_scan(
    wire: Carrier, faults: str, tmp_path: Path
) -> None:
    bench = Bench(faults, 8, tmp_path, order=Order.BUFFERED)
    ending = swept(wire, bench)
    assert ending.equals(bench.specimen.grid), ending.why


def test_columns_that_a_buffered_scanner_could_not_hold_cut_the_sweep(wire: Carrier, tmp_path: Path) -> None:
    ending = swept(wire, Bench("", 9, tmp_path, order=Order.BUFFERED, retention_columns=50))
    assert ending.kind == "interrupted" and "holds them no longer" in ending.why and len(ending.kept) == 1


@pytest.mark.parametrize(
    ("request_", "faults"),
    [
        (SweepRequest(stride=8), "flip=0.02"),
        (SweepRequest(passes=3, stride=4), ""),
        (SweepRequest(passes=4), "flip=0.02,unplug=0.2"),
    ],
)
def test_fast_first_passes_and_several_passes_make_the_same_scan(
    wire: Carrier, request_: SweepRequest, faults: str, tmp_path: Path
) -> None:
    bench = Bench(faults, 10, tmp_path)
    ending = swept(wire, bench, request_)
    assert ending.equals(bench.specimen.grid), ending.why
    assert ending.assembly is not None and ending.assembly.quality.passes >= request_.passes


def test_a_fast_first_turn_shows_the_whole_object_early(wire: Carrier, tmp_path: Path) -> None:
    with wire(Bench("", 11, tmp_path)) as line:
        capturing = Capturing(line, tmp_path, SweepRequest(stride=8))
        ending = capturing.run()
    assert ending.kind == "scan", ending.why
    width = bumpy().grid.spec.width
    seen = [c.column for c in capturing._held if c.CHANNEL is Channel.RANGE and c.row0 == 0]
    assert seen[: width // 8] == list(range(0, width, 8))
