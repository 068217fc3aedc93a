"""Sweep after sweep with random faults: never a hang, a crash, or a partial scan that passes for a whole one.

`pytest tests/system/test_soak.py --soak 5000` runs as many; a failure names the seed and the faults to repeat it with.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from protocol.grid import GridSpec
from protocol.scanner_messages import Order, SweepRequest
from simulators.scanner import ANY_CHANNELS, APART
from tests.system.fault_rig import Bench, Capturing, Ending, bumpy, memory

S = GridSpec(360, 100, 1024, 256, 0.01, 2.0)
SWEEPS = 200
PORTION = 10
SHARES = ("loss", "flip", "burst", "truncate", "lie", "twice", "reorder")
ONCE = ("stall=0.1", "stall=1", "stall=5", "reset", "unplug=0.2", "minor", "overshoot=0.1", "reversed")
FLAWS = ("slip=0.02", "ticks=2000", "dead=2", "saturated=3", "spikes=0.0005", "dropouts=0.0005", "noise=8")
SPECIMEN = bumpy(S)


def draw(seed: int, folder: Path) -> tuple[Bench, SweepRequest]:
    """A scanner on a bad day, and what is asked of it."""
    rng = np.random.default_rng(seed)
    shares = [f"{name}={rng.uniform(0, 0.03):.4f}" for name in rng.choice(SHARES, rng.integers(0, 4), replace=False)]
    once = [str(rng.choice(ONCE))] if rng.random() < 0.4 else []
    flaws = [str(rng.choice(FLAWS))] if rng.random() < 0.2 else []
    order = Order.BUFFERED if rng.random() < 0.2 else Order.LIVE
    retention = 400 if rng.random() < 0.1 else 65535
    bench = Bench(
        ",".join([*shares, *once, *flaws]), seed, folder, specimen=SPECIMEN, order=order, retention_columns=retention
    )
    overlap = 16 if flaws else int(rng.choice([0, 16]))  # nothing tells of a slip but seeing the same twice
    request = SweepRequest(overlap=overlap, stride=int(rng.choice([1, 1, 8])))
    return replace(bench, channels=APART if rng.random() < 0.2 else ANY_CHANNELS), request


def verdict(bench: Bench, ending: Ending) -> str:
    """Which of the allowed endings this is. Fails when it is none."""
    if ending.kind == "interrupted":
        (sweep,) = ending.kept
        assert ending.assembly is None and sweep.held < sweep.expected
        return "interrupted"
    if ending.kind == "refused":
        assert ending.why and not ending.kept
        return "refused"
    assert not ending.kept and ending.assembly is not None
    if ending.equals(bench.specimen.grid):
        return "equal"
    quality = ending.assembly.quality
    assert quality.complaints or (quality.noise_mm is not None and "noise" in bench.faults), quality
    assert any(flaw.partition("=")[0] in bench.faults for flaw in FLAWS), "nothing but flaws may change a scan"
    return "reported"


@pytest.mark.parametrize("first", range(0, SWEEPS, PORTION))
def test_random_faults_end_in_a_whole_scan_or_in_a_cut_sweep(
    first: int, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    seen = Counter(_soak(seed, tmp_path) for seed in range(first, first + PORTION))
    assert seen.total() == PORTION and seen["equal"] >= PORTION // 4, seen


def test_a_soak_as_long_as_asked_for(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    sweeps = request.config.getoption("soak")
    if not sweeps:
        pytest.skip("only with --soak N")
    assert Counter(_soak(seed, tmp_path) for seed in range(SWEEPS, SWEEPS + sweeps)).total() == sweeps


def _soak(seed: int, folder: Path) -> str:
    bench, request = draw(seed, folder / str(seed))
    try:
        with memory(bench) as line:
            return verdict(bench, Capturing(line, bench.folder, request).run())
    except Exception as problem:
        how = f"{bench.order.name}, {bench.channels}, {request}"
        problem.add_note(f"seed {seed}: simulate --faults {bench.faults}, {how}")
        raise
