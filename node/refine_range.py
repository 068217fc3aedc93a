"""Range for a look: which spacing and quantum reach the quality asked for, and the refinement that carries them.

At every spacing that can reach the quality, the largest quantum that still does is found; the pair expected to take the
fewest bytes wins. Every trial is reconstructed and compared with the scan, as the client will see it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np

from node.coded import Coded, Part, framed, message_overhead, own_inside, region_lattice, rho_of
from node.library import Scan
from node.range_model import how_often, percentile_of
from node.sample import range_samples, void_cells
from node.state import ClientState, block_errors
from protocol.codec import RangeCodec, encode_mask
from protocol.codec_lift import Survey, encode_surveyed, expected_bytes
from protocol.grid import RANGE_BLOCK, VOID, FloatArray, IntArray
from protocol.holdings import COARSE_RANK, ChannelHoldings, range_rank
from protocol.lattice import NO_SKIRT, Channel, Lattice, Parameters
from protocol.messages import RangeParameters
from protocol.reconstruct import Selection, content_hashes, cut, range_patch
from protocol.region import Region
from protocol.strips import Strips, build_strips, join_parts, select_strips

SPACINGS: tuple[Literal[1, 2, 4, 8], ...] = (8, 4, 2, 1)
QUANTUM_MAX = 4096
FINENESS_COSTS = 0.35  # blocks held at a small quantum can only be made finer at one as small (F-09c)
TRIES_MAX = 6  # quanta tried at a spacing
MOST_QUANTUM = 2.05  # of the target: the largest that is tried
WELL_WITHIN = 0.75  # of the target: where interpolating leaves no more, no closer spacing takes fewer bytes
ERROR_A_QUANTUM = 0.46  # at the 99th percentile, at most nearly always
FINENESS = 0.05  # of a quantum, to which it is searched


def choose_range(
    trials: Callable[[int], Trial | None], target_steps: float, surely: Literal[1, 2, 4, 8] = 1
) -> RangeParameters:
    """The cheapest parameters whose error in the region is at most target_steps (99th percentile, "higher").

    trials : the trial of each spacing, None where it is impossible.   surely : a spacing that is known to do well; none
    below it is tried, unless it does not.
    """
    best, least_bytes = RangeParameters(p=1, quantum=1), math.inf
    for p in SPACINGS:
        if p < surely and math.isfinite(least_bytes):
            break
        trial = None if p > 1 and target_steps < 1 else trials(p)
        if trial is None or (p > 1 and trial.error(1) > target_steps):
            continue
        quantum = _largest_quantum(trial, p, target_steps)
        if p > 1 and quantum == 1 and trial.checked() > target_steps:
            continue
        size_bytes = trial.expected_bytes(quantum) * max(2 * target_steps / quantum, 1) ** FINENESS_COSTS
        if size_bytes >= least_bytes:
            break
        best, least_bytes = RangeParameters(p=p, quantum=quantum), size_bytes
    return best


def guess_range(interpolated: Callable[[int], float], target_steps: float) -> RangeParameters:
    """About what choose_range would find, without a trial: what comes of it is to be checked.

    interpolated : the error that each spacing leaves at quantum 1, 0 at spacing 1.
    """
    errors = ((p, interpolated(p)) for p in SPACINGS)
    p, error = next((p, e) for p, e in errors if p == 1 or (target_steps >= 1 and e <= WELL_WITHIN * target_steps))
    left = math.sqrt(target_steps**2 - error**2) / ERROR_A_QUANTUM
    return RangeParameters(p=p, quantum=max(min(round(left), _always_within(target_steps)), 1))


def trial_of(scan: Scan, state: ClientState, region: Region, p: int) -> Trial | None:
    """One spacing over a region, as if nothing were held there; None where the scan cannot be sampled so."""
    if scan.spec.width % p:
        return None
    fresh = ChannelHoldings.coarse(state.shapes[Channel.RANGE])
    lattices = build_strips(fresh.shape, region_lattice(region, Channel.RANGE, 2 * p, NO_SKIRT))
    strips = select_strips(lattices, fresh, range_rank(1))
    return Trial(scan, strips, region) if strips else None


def code_range(
    scan: Scan, state: ClientState, region: Region, wanted: RangeParameters, *, quick: bool = False
) -> Coded | None:
    """Encode a refinement of the region's blocks, or None when the client holds all of it already.

    quick : spare time rather than bytes.
    Where a block that would become finer is held at better values, the whole refinement takes those (F-09c).
    Raises LatticeError for a spacing that does not fit the scan.
    """
    parameters = range_lattice(region, wanted)
    return code_range_lattice(scan, state, parameters, wanted.quantum, quick=quick)


def code_range_lattice(
    scan: Scan,
    state: ClientState,
    parameters: Parameters,
    quantum: int,
    *,
    quick: bool = False,
    trial: Trial | None = None,
) -> Coded | None:
    """The same for a lattice that is given.   trial : of its spacing, whose surveys serve where it was of all this."""
    strips, quantum = select_range_lattice(state, parameters, quantum)
    if not strips:
        return None
    was_tried = trial is not None and trial.is_of(strips)
    images = trial.surveys(quantum) if trial is not None and was_tried else _surveyed(scan, strips, quantum)
    voids = [void_cells(scan, strip.selection) for strip in strips]
    parts = tuple(
        Part(strip, mask=encode_mask(void), decoded=image.decoded, void=void)
        for strip, image, void in zip(strips, images, voids, strict=True)
    )
    return Coded(parts, range_rank(quantum), quantum, RangeCodec.LIFT, encode_surveyed(images, quick=quick))


def _surveyed(scan: Scan, strips: Strips, quantum: int) -> list[Survey]:
    return [Survey(samples, quantum, seen) for samples, seen in (range_samples(scan, s.selection) for s in strips)]


def select_range(state: ClientState, region: Region, wanted: RangeParameters) -> tuple[Strips, int]:
    """What code_range would carry, if anything, and its quantum."""
    return select_range_lattice(state, range_lattice(region, wanted), wanted.quantum)


def select_range_lattice(state: ClientState, parameters: Parameters, quantum: int) -> tuple[Strips, int]:
    """The same for a lattice that is given."""
    held = state.holdings.channels[Channel.RANGE]
    lattices = build_strips(held.shape, parameters)
    quantum = min([quantum, *(_best_held(held, lattice) for lattice in lattices)])
    return select_strips(lattices, held, range_rank(quantum)), quantum


def expected_range_bytes(scan: Scan, strips: Strips, quantum: int) -> float:
    """About how many bytes strips take on the wire; 0 where there are none."""
    if not strips:
        return 0.0
    masks = join_parts([encode_mask(void_cells(scan, strip.selection)) for strip in strips])
    payload_bytes = expected_bytes(_surveyed(scan, strips, quantum))
    return framed(message_overhead(strips[0].selection.lattice.parameters) + len(masks) + round(payload_bytes))


def range_lattice(region: Region, wanted: RangeParameters) -> Parameters:
    """The lattice of a region's blocks."""
    return region_lattice(region, Channel.RANGE, 2 * wanted.p, rho_of(wanted.s))


def note_range(scan: Scan, state: ClientState, coded: Coded, target_steps: float) -> None:
    """Record a range refinement in a client's state: holdings, digest and the error left in its blocks."""
    coded.note(state)
    settle_range(scan, state, coded, target_steps)


def settle_range(scan: Scan, state: ClientState, coded: Coded, target_steps: float) -> None:
    """The part of note_range that can wait until the refinement is on its way: digest and errors."""
    for part in coded.parts:
        patch, selection = part.range_steps, part.selection
        state.holdings.add_content(selection.adopted_blocks(), content_hashes(patch, selection))
        truth = np.asarray(cut(scan.range_steps, selection), np.uint16)
        own, stride = slice(0, int(selection.x.size.sum())), selection.lattice.shape.stride
        error, far = block_errors(
            patch[:, own], truth[:, own], selection.y.size, selection.x.size, target_steps, stride
        )
        rows, columns = np.nonzero(selection.adopted)
        blocks = selection.y.block[rows], selection.x.block[columns]
        state.error[blocks], state.target_steps[blocks] = error[rows, columns], target_steps
        cells = np.arange(RANGE_BLOCK)
        to, place = blocks[0][:, None] * RANGE_BLOCK + cells, rows[:, None] * RANGE_BLOCK + cells
        state.far[to, blocks[1][:, None]] = far[place, columns[:, None]]


class Trial:
    """One spacing over a region: what error a quantum leaves."""

    def __init__(self, scan: Scan, strips: Strips, region: Region) -> None:
        self._strips = strips
        self._parts = [_TrialPart(scan, strip.selection, region) for strip in strips]
        self._errors: dict[int, float] = {}

    def error(self, quantum: int) -> float:
        """99th percentile ("higher") of the error over measured samples of the region, by area. [steps]"""
        if quantum not in self._errors:
            counts = [part.errors(quantum) for part in self._parts]
            total = np.zeros(max(each.size for each in counts))
            for each in counts:
                total[: each.size] += each
            self._errors[quantum] = float(percentile_of(total))
        return self._errors[quantum]

    def assume(self, error: float) -> None:
        """Quantum 1 leaves about this error at most: that is known, and not tried. [steps]"""
        self._errors.setdefault(1, error)

    def checked(self) -> float:
        """What quantum 1 leaves, tried whatever was assumed. [steps]"""
        self._errors.pop(1, None)
        return self.error(1)

    def expected_bytes(self, quantum: int) -> float:
        """About how many bytes the refinement takes."""
        return expected_bytes(self.surveys(quantum))

    def surveys(self, quantum: int) -> list[Survey]:
        """What its strips would take."""
        return [part.survey(quantum) for part in self._parts]

    def is_of(self, strips: Strips) -> bool:
        """Whether these carry what it tried."""
        return len(strips) == len(self._strips) and all(
            a.selection.lattice is b.selection.lattice and np.array_equal(a.adopted, b.adopted)
            for a, b in zip(strips, self._strips, strict=True)
        )


class _TrialPart:
    """A strip of it."""

    def __init__(self, scan: Scan, selection: Selection, region: Region) -> None:
        self._selection = selection
        self._samples, self._seen = range_samples(scan, selection)
        inside = own_inside(region, selection)
        rows, columns = (np.flatnonzero(inside.any(axis)) for axis in (1, 0))
        self._crop = _around(rows), _around(columns)
        self._truth = np.asarray(cut(scan.range_steps, selection), np.uint16)[self._crop]
        self._counts = inside[self._crop] & (self._truth != VOID)
        area = selection.lattice.shape.stride * region.sample_area(selection.y.start + rows)
        self._weight = None if (area == 1).all() else np.repeat(area, np.count_nonzero(self._counts, axis=1))
        self._surveys: dict[int, Survey] = {}

    def errors(self, quantum: int) -> FloatArray | IntArray:
        """How many measured samples in the region are off by 0, 1, 2 ... steps, each weighed by its area."""
        samples = self._samples if quantum == 1 else self.survey(quantum).decoded
        patch = range_patch(self._selection, samples)[self._crop]
        off = np.asarray(cv2.absdiff(patch, self._truth), np.uint16)
        if self._weight is None:
            return how_often(off, self._counts)
        return np.bincount(off[self._counts], self._weight)

    def survey(self, quantum: int) -> Survey:
        """What the strip would take."""
        if quantum not in self._surveys:
            self._surveys[quantum] = Survey(self._samples, quantum, self._seen)
        return self._surveys[quantum]


def _around(places: IntArray) -> slice:
    """From the first to the last of ascending places."""
    return slice(int(places[0]), int(places[-1]) + 1) if places.size else slice(0, 0)


def _best_held(held: ChannelHoldings, lattice: Lattice) -> int:
    """Smallest quantum held in the blocks that the lattice would make finer."""
    where = np.ix_(lattice.y.block, lattice.x.block)
    improves = lattice.listed & (lattice.level < held.level[where])
    return 65535 - int(held.rank[where][improves].max(initial=COARSE_RANK))


def _always_within(target_steps: float) -> int:
    """The largest quantum no value coded with which is further off than a target."""
    return min(2 * int(target_steps) + 1, QUANTUM_MAX)


def _largest_quantum(trial: Trial, p: int, target_steps: float) -> int:
    """About the largest quantum that keeps the region's error within target_steps.

    Quantising alone leaves half a quantum at most, and nearly that at the 99th percentile; so a little more than twice
    the target is the most to try. What interpolating leaves adds to it in cubes.
    """
    most = max(min(round(MOST_QUANTUM * target_steps), QUANTUM_MAX), 1)
    if p == 1:
        return most if trial.error(most) <= target_steps else _always_within(target_steps)
    low, left, high, growth = 1, trial.error(1), most + 1, ERROR_A_QUANTUM**3
    for _ in range(TRIES_MAX):
        room = max(target_steps**3 - left**3, 0.0)
        guess = min(round((low**3 + room / growth) ** (1 / 3)), high - 1)
        if guess - low <= low * FINENESS:
            break
        error = trial.error(guess)
        growth = max(error**3 - left**3, 1.0) / (guess**3 - low**3)
        if error <= target_steps:
            low, left = guess, error
        else:
            high = guess
    return low
