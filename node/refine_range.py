"""Range for a look: which spacing and quantum reach the quality asked for, and the refinement that carries them.

At every spacing that can reach the quality, the largest quantum that still does is found; the pair expected to take the
fewest bytes wins. Every trial is reconstructed and compared with the scan, as the client will see it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from node.coded import Coded, rho_of
from node.library import Scan
from node.sample import range_samples, void_cells
from node.state import ClientState, block_errors
from protocol.codec import RangeCodec, encode_mask
from protocol.grid import RANGE_BLOCK, VOID, BoolArray, StepArray
from protocol.holdings import COARSE_RANK, ChannelHoldings, range_rank
from protocol.lattice import Channel, Lattice, Parameters, build_lattice
from protocol.messages import RangeParameters
from protocol.range_payload import encode_selection, survey_selection
from protocol.reconstruct import Selection, content_hashes, cut, range_patch, select
from protocol.region import Region

SPACINGS: tuple[Literal[1, 2, 4, 8], ...] = (8, 4, 2, 1)
PERCENTILE = 99
QUANTUM_MAX = 4096
FINENESS_COSTS = 0.35  # blocks held at a small quantum can only be made finer at one as small (F-09c)
QUANTUM_SHARE_MAX = 2.5  # of the target; the error is at most half a quantum, less after interpolation


@dataclass(frozen=True, slots=True)
class Choice:
    """A spacing and quantum, the error they leave in the region [steps], and about how many bytes they take."""

    parameters: RangeParameters
    error: float
    expected_bytes: float


def choose_range(scan: Scan, state: ClientState, region: Region, target_steps: float) -> Choice:
    """The cheapest parameters whose error in the region is at most target_steps (99th percentile, "higher")."""
    fresh = ChannelHoldings.coarse(state.shapes[Channel.RANGE])
    best: Choice | None = None
    for p in SPACINGS:
        selection = _trial_selection(fresh, region, p)
        if selection is None or (p > 1 and target_steps < 1):
            continue
        trial = _Trial(scan, selection, region)
        if trial.error(1) > target_steps:
            continue
        quantum = _largest_quantum(trial, target_steps)
        size_bytes = trial.expected_bytes(quantum) * max(2 * target_steps / quantum, 1) ** FINENESS_COSTS
        if best is not None and size_bytes >= best.expected_bytes:
            break
        best = Choice(RangeParameters(p=p, quantum=quantum), trial.error(quantum), size_bytes)
    return best or Choice(RangeParameters(p=1, quantum=1), 0.0, 0.0)


def code_range(scan: Scan, state: ClientState, region: Region, wanted: RangeParameters) -> Coded | None:
    """Encode a refinement of the region's blocks, or None when the client holds all of it already.

    Where a block that would become finer is held at better values, the whole refinement takes those (F-09c).
    Raises LatticeError for a spacing that does not fit the scan.
    """
    return code_range_lattice(scan, state, range_lattice(region, wanted), wanted.quantum)


def code_range_lattice(scan: Scan, state: ClientState, parameters: Parameters, quantum: int) -> Coded | None:
    """The same for a lattice that is given."""
    found = select_range_lattice(state, parameters, quantum)
    if found is None:
        return None
    selection, adopted, quantum = found
    samples, seen = range_samples(scan, selection)
    payload, decoded = encode_selection(selection, samples, quantum, seen)
    mask = encode_mask(void_cells(scan, selection))
    return Coded(selection, adopted, range_rank(quantum), quantum, RangeCodec.LIFT, payload, mask, decoded)


def client_range(scan: Scan, coded: Coded) -> StepArray:
    """The dense rectangle that a client makes of a range refinement, voids included."""
    assert coded.decoded is not None  # code_range_lattice keeps it
    patch = range_patch(coded.selection, coded.decoded)
    patch[void_cells(scan, coded.selection)] = VOID
    return patch


def select_range(
    state: ClientState, region: Region, wanted: RangeParameters
) -> tuple[Selection, BoolArray, int] | None:
    """What code_range would carry: the selection, the adopted blocks of its lattice, the quantum; None: nothing."""
    return select_range_lattice(state, range_lattice(region, wanted), wanted.quantum)


def select_range_lattice(
    state: ClientState, parameters: Parameters, quantum: int
) -> tuple[Selection, BoolArray, int] | None:
    """The same for a lattice that is given."""
    held = state.holdings.channels[Channel.RANGE]
    lattice = build_lattice(held.shape, parameters)
    quantum = min(quantum, _best_held(held, lattice))
    found = select(lattice, held, range_rank(quantum))
    return (*found, quantum) if found else None


def expected_range_bytes(scan: Scan, selection: Selection, quantum: int) -> float:
    """About how many bytes a selection's payload takes."""
    samples, seen = range_samples(scan, selection)
    return survey_selection(selection, samples, quantum, seen)[1]


def range_lattice(region: Region, wanted: RangeParameters) -> Parameters:
    """The lattice of a region's blocks."""
    rho = rho_of(wanted.s)
    return Parameters(2 * wanted.p, *region.blocks(8), rho, rho)


def note_range(scan: Scan, state: ClientState, coded: Coded, target_steps: float) -> None:
    """Record a range refinement in a client's state: holdings, digest and the error left in its blocks."""
    coded.note(state)
    settle_range(scan, state, coded, target_steps)


def settle_range(scan: Scan, state: ClientState, coded: Coded, target_steps: float) -> None:
    """The part of note_range that can wait until the refinement is on its way: digest and errors."""
    patch, selection = client_range(scan, coded), coded.selection
    state.holdings.add_content(selection.adopted_blocks(), content_hashes(patch, selection))
    truth = np.asarray(cut(scan.range_steps, selection), np.uint16)
    error, far = block_errors(patch, truth, selection.y.size, selection.x.size, target_steps)
    rows, columns = np.nonzero(selection.adopted)
    blocks = selection.y.block[rows], selection.x.block[columns]
    state.error[blocks], state.target_steps[blocks] = error[rows, columns], target_steps
    cells = np.arange(RANGE_BLOCK)
    to, place = blocks[0][:, None] * RANGE_BLOCK + cells, rows[:, None] * RANGE_BLOCK + cells
    state.far[to, blocks[1][:, None]] = far[place, columns[:, None]]


class _Trial:
    """One spacing over a region: what error a quantum leaves."""

    def __init__(self, scan: Scan, selection: Selection, region: Region) -> None:
        self._selection = selection
        self._samples, self._seen = range_samples(scan, selection)
        top, left = region.top - selection.y.start, (region.left - selection.x.start) % region.turn
        columns = (left + np.arange(region.width)) % region.turn
        self._place = np.ix_(np.arange(top, top + region.height), columns)
        truth = scan.range_steps[region.rows][:, region.columns]
        self._measured = truth != VOID
        self._truth = truth[self._measured].astype(np.int32)
        self._known: dict[int, tuple[float, float]] = {}

    def error(self, quantum: int) -> float:
        """99th percentile ("higher") of the error over measured cells of the region. [steps]"""
        return self._measure(quantum)[0]

    def expected_bytes(self, quantum: int) -> float:
        """About how many bytes the refinement takes."""
        return self._measure(quantum)[1]

    def _measure(self, quantum: int) -> tuple[float, float]:
        if quantum not in self._known:
            samples, size_bytes = survey_selection(self._selection, self._samples, quantum, self._seen)
            patch = range_patch(self._selection, samples)[self._place]
            error = np.abs(patch[self._measured].astype(np.int32) - self._truth)
            self._known[quantum] = percentile_higher(error, PERCENTILE) if error.size else 0.0, size_bytes
        return self._known[quantum]


def percentile_higher(values: np.ndarray, percent: float) -> float:
    """Percentile of a non-empty array, the next higher value where it falls between two."""
    return float(np.percentile(values, percent, method="higher"))


def _best_held(held: ChannelHoldings, lattice: Lattice) -> int:
    """Smallest quantum held in the blocks that the lattice would make finer."""
    where = np.ix_(lattice.y.block, lattice.x.block)
    improves = lattice.listed & (lattice.level < held.level[where])
    return 65535 - int(held.rank[where][improves].max(initial=COARSE_RANK))


def _trial_selection(fresh: ChannelHoldings, region: Region, p: int) -> Selection | None:
    if 2 * fresh.shape.width % (2 * p):
        return None
    parameters = Parameters(2 * p, *region.blocks(8))
    found = select(build_lattice(fresh.shape, parameters), fresh, range_rank(1))
    return found[0] if found else None


def _largest_quantum(trial: _Trial, target_steps: float) -> int:
    """Largest quantum that keeps the region's error within target_steps, to a tenth."""
    low, high = 1, min(max(int(QUANTUM_SHARE_MAX * target_steps), 1), QUANTUM_MAX)
    while high - low > low // 10:
        middle = (low + high + 1) // 2
        if trial.error(middle) <= target_steps:
            low = middle
        else:
            high = middle - 1
    return low
