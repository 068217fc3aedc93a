"""Planning one update: a pure function of a scan, a client's state, what it asks for and the bytes it may take.

Range goes first, since shape without colour helps and colour on the wrong shape does not; texture takes what is left.
Nothing over the budget is ever returned: every candidate is encoded and weighed before it counts.

Source: Cheng, Basu, Pan 2003, Eq. (15), with REQUIREMENTS F-14 and F-14b.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import numpy as np

from node.coded import Coded, wire_overhead
from node.library import Scan
from node.quality import FILL, Point, QualitySearch
from node.range_bitmaps import reach_range
from node.refine_range import (
    QUANTUM_MAX,
    choose_range,
    code_range,
    expected_range_bytes,
    note_range,
    select_range,
    settle_range,
)
from node.refine_texture import (
    CODECS,
    SPACINGS,
    adopted_error,
    choose_spacing,
    code_texture,
    code_texture_lattice,
    db_of_mse,
    held_error,
    listed_texture,
    measured,
    mse_of_db,
    note_texture,
    quality_bounds,
    quality_to_mend,
    select_texture,
    texture_lattice,
)
from node.state import ClientState
from node.texture_model import Expected, TextureModel
from protocol.grid import RANGE_BLOCK, TEXTURE_BLOCK
from protocol.lattice import Channel, Parameters
from protocol.messages import CodecName, Look, RangeParameters, TextureParameters
from protocol.region import Region
from protocol.sphere import region_on
from protocol.strips import blocks_of, samples_of

REPLY_BYTES = 220  # the Updated message that ends an update, carrier included
RANGE_OVERHEAD_BYTES = wire_overhead(Parameters(2, 0, 0, 1, 1)) + 64  # a void mask included
WHOLE_SHARE = 0.7  # of what a whole window takes: where a part takes more, the whole is tried too
TEXTURE_BYTES_MIN = 128  # for less, no texture is tried
HELD_MARGIN = 0.95  # what is held is known block by block, not texel by texel
RANGE_MARGIN = 1.1  # expectations of range are a tenth off
DOUBLINGS_MAX = 6
NO_TEXTURE = 16.0  # how much larger than wanted an error is left where no texture is sent, until it is known
GENERIC_BYTES_PER_TEXEL = 0.04
QUANTA_PER_SPACING = 6
SKIRT_S = 1.0
SKIRTS = (64.0, 32.0, 16.0, 8.0, 4.0, 2.0)
CAPS: tuple[tuple[Literal[2, 4, 8], float], ...] = ((2, 2.5), (4, 6.0), (8, 16.0))  # spacing, how much more area
SKIRT_MARGIN = 2.0  # a skirt's cells differ more from each other than a window's texels

Reason = Literal["complete", "byte limit", "superseded"]


@dataclass(frozen=True, slots=True)
class Update:
    """A planned update.

    coded : its refinements, in order.    state : the client's state once they have arrived.
    error_max_mm, texture_db : what is left in the window; None where this update did not measure it, or not yet.
    settle : computes what may wait (digest, errors); None when nothing does.
    """

    coded: tuple[Coded, ...]
    state: ClientState
    reason: Reason
    error_max_mm: float | None = None
    texture_db: float | None = None
    encodes: int = 0
    settle: Callable[[], float] | None = None

    def settled(self) -> Update:
        """The same with its state complete and error_max_mm known: work that can wait until the bytes are sent."""
        if self.settle is None:
            return self
        return replace(self, error_max_mm=self.settle(), settle=None)

    @property
    def wire_bytes(self) -> int:
        """What the update takes on the wire, reply and carrier included."""
        return REPLY_BYTES + sum(coded.wire_bytes for coded in self.coded)


def plan_update(
    scan: Scan,
    state: ClientState,
    look: Look,
    codec: CodecName,
    budget_bytes: int | None = None,
    superseded: Callable[[], bool] = lambda: False,
    model: TextureModel | None = None,
    quick: bool = False,
) -> Update:
    """Plan the update that answers a look.

    codec : the texture codec for this client.   budget_bytes : what the update may take; None for no limit.
    superseded : asked between encodes; when true, what is planned so far is dropped.
    model : what the scan's texture takes, where that is known by now.   quick : spare time rather than bytes.
    Raises LatticeError or CodecError where explicit parameters do not fit the scan.
    """
    planner = _Planner(scan, state.copy(), look, codec, budget_bytes, superseded, model, quick)
    try:
        planner.run()
    except _Superseded:
        return Update((), state, "superseded")
    return planner.update()


class _Superseded(Exception):
    """A newer look has come."""


class _Planner:
    """One update in the making."""

    def __init__(
        self,
        scan: Scan,
        state: ClientState,
        look: Look,
        codec: CodecName,
        budget_bytes: int | None,
        superseded: Callable[[], bool],
        model: TextureModel | None,
        quick: bool,
    ) -> None:
        self._scan, self._state, self._look, self._codec, self._model = scan, state, look, codec, model
        self._quick = quick
        self._left = math.inf if budget_bytes is None else budget_bytes - REPLY_BYTES
        self._superseded = superseded
        self._coded: list[Coded] = []
        self._unsettled: list[Coded] = []
        self._encodes = 0
        self._limited = False
        self._texture_db: float | None = None
        self._window = look.window if look.scale is None else look.scale**2
        self._range_region, self._texture_region = self._regions(self._window)
        self._target_steps = look.range_mm / scan.spec.step_mm
        self._target_mse = mse_of_db(look.texture_db)

    def _regions(self, window: float) -> tuple[Region, Region]:
        """What a share of the area round the click is of range and of texture."""
        s, u, v = self._scan.spec, self._look.u, self._look.v
        return (
            region_on(s, u, v, window, s.width, s.height),
            region_on(s, u, v, window, s.texture_width, s.texture_height),
        )

    def run(self) -> None:
        """Choose, encode and note the refinements."""
        explicit = self._look.parameters
        if explicit is not None:
            self._take(self._code_range(explicit.range) if explicit.range else None, settle=False)
            self._take(self._code_texture(explicit.texture) if explicit.texture else None)
            return
        wanted, range_bytes = self._divide()
        texture = self._search_texture(self._left - range_bytes)
        for coded in self._fill_range(wanted, self._left - (texture.wire_bytes if texture else 0)):
            self._take(coded)
        self._take(texture)
        if self._look.fill and not self._limited and math.isfinite(self._left):
            self._fill_periphery(wanted)

    def update(self) -> Update:
        """What came of it."""
        reason: Reason = "byte limit" if self._limited else "complete"
        coded = tuple(self._coded)
        update = Update(coded, self._state, reason, None, self._texture_db, self._encodes, self._settle)
        return update if self._unsettled else update.settled()

    def _settle(self) -> float:
        """Note what was left for later. Returns the largest range error left in the window. [mm]"""
        while self._unsettled:
            settle_range(self._scan, self._state, self._unsettled.pop(), self._target_steps)
        return _error_in(self._state, self._range_region) * self._scan.spec.step_mm

    # -- how much for range, how much for texture ------------------------------------------------------------------

    def _divide(self) -> tuple[RangeParameters, float]:
        """The range parameters to use and the bytes to keep for them.

        Without a limit, or where both qualities fit it: the cheapest that reach the quality. Else the pair that falls
        short the least, a doubled range error counting as much as 6 dB of texture.
        """
        wanted = self._choose_range(self._target_steps)
        range_bytes = self._range_bytes(wanted)
        if math.isinf(self._left):
            return wanted, range_bytes
        best, least = (wanted, range_bytes), self._shortfall(0, self._left - range_bytes)
        doubled = 0
        while least > doubled and doubled < DOUBLINGS_MAX:
            doubled += 1
            wanted = self._choose_range(max(self._target_steps, 0.5) * 2**doubled)
            range_bytes = self._range_bytes(wanted)
            shortfall = self._shortfall(doubled, self._left - range_bytes)
            if shortfall < least:
                best, least = (wanted, range_bytes), shortfall
                self._limited = True
        return best

    def _choose_range(self, target_steps: float) -> RangeParameters:
        """The cheapest parameters that reach a range error, with the skirt asked for."""
        chosen = choose_range(self._scan, self._state, self._range_region, target_steps).parameters
        return msgspec.structs.replace(chosen, s=self._skirt(chosen.p))

    def _skirt(self, p: float) -> float:
        """S' of the skirt: as the viewer's alpha says, else thin."""
        return SKIRT_S if self._look.alpha is None else 1 / (self._look.alpha * p)

    def _range_bytes(self, wanted: RangeParameters) -> float:
        """What range is expected to take on the wire; 0 when the client holds it already."""
        strips, quantum = select_range(self._state, self._range_region, wanted)
        if not strips:
            return 0.0
        return RANGE_OVERHEAD_BYTES + RANGE_MARGIN * expected_range_bytes(self._scan, strips, quantum)

    def _shortfall(self, doubled: int, texture_left: float) -> float:
        """How far an update falls short, in doublings of error, when texture is left so many bytes."""
        if texture_left < TEXTURE_BYTES_MIN:
            mse = self._texture_error(None) if self._model is not None else self._target_mse * NO_TEXTURE**2
        else:
            expected = self._expected()
            mse = expected.mse(max(expected.quality_for_bytes(texture_left), 0))
        return float(doubled + max(math.log2(mse / self._target_mse) / 2, 0))

    def _expected(self) -> Expected:
        """What texture takes and reaches in the window."""
        if self._model is None:
            expected_bytes = self._texture_region.area * GENERIC_BYTES_PER_TEXEL
            return Expected.generic(self._target_mse, max(expected_bytes, 64.0))
        return self._model.expect(self._texture_region, CODECS[self._codec])

    # -- texture ---------------------------------------------------------------------------------------------------

    def _search_texture(self, limit_bytes: float) -> Coded | None:
        """The cheapest refinement within limit_bytes that reaches the quality, else the best one that fits."""
        if limit_bytes < TEXTURE_BYTES_MIN:
            self._limited = True
            return None
        if self._model is not None and (held := self._texture_error(None)) <= HELD_MARGIN * self._target_mse:
            self._texture_db = db_of_mse(held)
            return None
        listed = listed_texture(self._state, self._texture_region, self._target_mse)
        found = self._search_spacings(limit_bytes, listed)
        if listed is None or found is None or found.wire_bytes < WHOLE_SHARE * self._expected_whole_bytes():
            return found
        whole = self._search_spacings(limit_bytes, None)  # one quality all over may cost less than a good one in parts
        return whole if whole is not None and whole.wire_bytes < found.wire_bytes else found

    def _expected_whole_bytes(self) -> float:
        expected = self._expected()
        return expected.size_bytes(expected.quality_for_mse(self._target_mse))

    def _search_spacings(self, limit_bytes: float, listed: tuple[int, ...] | None) -> Coded | None:
        finest = choose_spacing(self._scan, self._state, self._texture_region, self._look.texture_db, self._codec)
        for p in (spacing for spacing in reversed(SPACINGS) if spacing >= finest):
            search = QualitySearch(self._target_mse, limit_bytes, self._expected(), *quality_bounds(self._codec))
            wanted_any = self._try_qualities(search, p, listed)
            self._limited |= search.limited
            found = search.best()
            if found is not None:
                self._texture_db = db_of_mse(found.mse)
                return found.coded
            if not wanted_any:
                return None
        return None

    def _try_qualities(self, search: QualitySearch, p: float, listed: tuple[int, ...] | None) -> bool:
        """Feed a search; False when the client holds all of this already."""
        while (quality := search.next_quality()) is not None:
            coded = self._code_listed(TextureParameters(p, quality, self._codec, self._skirt(p)), listed)
            if coded is None:
                if self._texture_error(None) <= self._target_mse:
                    return False
                search.missed_all(quality, self._mending_quality(None))
                continue
            if search.fits(coded):
                coded = measured(coded)
                mse = self._texture_error(coded)
                search.measured(Point(quality, mse, coded))
                if mse > self._target_mse:
                    search.at_least(self._mending_quality(coded))
            else:
                search.too_large(quality, coded.wire_bytes)
            self._learn(p, quality, coded)
        return True

    def _mending_quality(self, coded: Coded | None) -> int:
        return quality_to_mend(self._state, coded, self._texture_region, self._target_mse)

    def _texture_error(self, coded: Coded | None) -> float:
        """Squared error per value that a refinement (or none) leaves in the window, what is held there included."""
        region = self._texture_region
        total, count = 0.0, 0
        if coded is not None:
            total, count = adopted_error(self._scan, coded, region)
        held_total, held_count = held_error(self._state, coded, region, self._model, self._target_mse)
        return (total + held_total) / max(count + held_count, 1)

    def _learn(self, p: float, quality: int, coded: Coded) -> None:
        if self._model is not None and p == 1:
            touched = self._texture_region.touched(TEXTURE_BLOCK).sum()
            share = min(blocks_of(coded.strips).size / touched, 1.0)
            self._model.learn(CODECS[self._codec], share * self._expected().size_bytes(quality), len(coded.payload))

    # -- range -----------------------------------------------------------------------------------------------------

    def _fill_range(self, wanted: RangeParameters, limit_bytes: float) -> list[Coded]:
        """Range as wanted; where the limit binds, with the smallest quantum that fits it."""
        if not (self._limited and math.isfinite(limit_bytes)):
            self._count_encode()
            found = reach_range(self._scan, self._state, self._range_region, wanted, self._target_steps)
            self._encodes += len(found) - 1 if found else 0
            if sum(coded.wire_bytes for coded in found) <= limit_bytes:
                return found
            self._limited = True
        coded = self._range_within(wanted, limit_bytes)
        return [coded] if coded is not None else []

    def _range_within(self, wanted: RangeParameters, limit_bytes: float) -> Coded | None:
        """Range with the smallest quantum that fits a limit that binds."""
        wanted = self._affordable(wanted, limit_bytes)
        coded = self._first_that_fits(wanted, limit_bytes)
        if coded is None or coded.quality == 1 or coded.wire_bytes >= FILL * limit_bytes:
            return coded
        expected = max(self._range_bytes(msgspec.structs.replace(wanted, quantum=coded.quality)), 1.0)
        wanted = self._affordable(wanted, (FILL + 1) / 2 * limit_bytes * expected / coded.wire_bytes)
        finer = self._code_range(wanted)
        return finer if finer is not None and coded.wire_bytes < finer.wire_bytes <= limit_bytes else coded

    def _first_that_fits(self, wanted: RangeParameters, limit_bytes: float) -> Coded | None:
        for parameters in _ever_coarser(wanted, self._scan.spec.width):
            coded = self._code_range(parameters)
            if coded is None or coded.wire_bytes <= limit_bytes:
                return coded
            self._limited = True
        return None

    def _affordable(self, wanted: RangeParameters, limit_bytes: float) -> RangeParameters:
        """The same spacing with the smallest quantum expected to fit."""
        low, high = 1, max(wanted.quantum, 2)
        while high - low > low // 16:
            middle = (low + high) // 2
            quantised = msgspec.structs.replace(wanted, quantum=middle)
            if self._range_bytes(quantised) <= limit_bytes:
                high = middle
            else:
                low = middle + 1
        return msgspec.structs.replace(wanted, quantum=high)

    # -- the periphery ---------------------------------------------------------------------------------------------

    def _fill_periphery(self, wanted: RangeParameters) -> None:
        """Spend what is left round the window, range first: the widest skirt that is expected to fit, on a sphere caps
        ever wider and coarser."""
        last = next((coded for coded in reversed(self._coded) if coded.channel is Channel.TEXTURE), None)
        texture = None
        if last is not None:
            sample_bytes = len(last.payload) / samples_of(last.strips)
            texture = TextureParameters(last.parameters.spacing, last.quality, self._codec), sample_bytes
        if self._scan.spec.geometry == "sphere":
            self._fill_caps(wanted, texture)
            return
        for s in SKIRTS:
            if self._range_bytes(msgspec.structs.replace(wanted, s=s)) <= self._left:
                self._take(self._code_range(msgspec.structs.replace(wanted, s=s)))
                break
        if texture is not None:
            for s in SKIRTS:
                if self._texture_fits(texture, s):
                    self._take(self._code_texture(msgspec.structs.replace(texture[0], s=s)))
                    return

    def _texture_fits(self, texture: tuple[TextureParameters, float], s: float | None) -> bool:
        """Whether texture with a skirt is expected to fit what is left; bytes a sample as in the window."""
        parameters, sample_bytes = texture
        strips, _ = select_texture(self._state, self._texture_region, msgspec.structs.replace(parameters, s=s))
        seen = sum(strip.selection.samples * strip.selection.adopted.mean() for strip in strips)
        return bool(strips) and seen * sample_bytes * SKIRT_MARGIN <= self._left

    def _fill_caps(self, wanted: RangeParameters, texture: tuple[TextureParameters, float] | None) -> None:
        window = self._range_region, self._texture_region
        for p, wider in CAPS:
            self._range_region, self._texture_region = self._regions(min(self._window * wider, 1.0))
            coarser = msgspec.structs.replace(wanted, p=max(p, wanted.p))
            if self._range_bytes(coarser) <= self._left:
                self._take(self._code_range(coarser))
            if texture is not None:
                of_cap = msgspec.structs.replace(texture[0], p=max(p, texture[0].p)), texture[1]
                if self._texture_fits(of_cap, None):
                    self._take(self._code_texture(of_cap[0]))
        self._range_region, self._texture_region = window

    # -- one refinement --------------------------------------------------------------------------------------------

    def _code_range(self, wanted: RangeParameters) -> Coded | None:
        self._count_encode()
        return code_range(self._scan, self._state, self._range_region, wanted)

    def _code_texture(self, wanted: TextureParameters) -> Coded | None:
        self._count_encode()
        return code_texture(self._scan, self._state, self._texture_region, wanted, quick=self._quick)

    def _code_listed(self, wanted: TextureParameters, listed: tuple[int, ...] | None) -> Coded | None:
        """The same for some blocks of the window (None: all)."""
        self._count_encode()
        parameters = texture_lattice(self._texture_region, wanted)
        if listed is not None:
            parameters = replace(parameters, listed=listed)
        codec = CODECS[wanted.codec]
        return code_texture_lattice(
            self._scan, self._state, parameters, wanted.quality, codec, quick=self._quick
        )

    def _count_encode(self) -> None:
        if self._superseded():
            raise _Superseded
        self._encodes += 1

    def _take(self, coded: Coded | None, *, settle: bool = True) -> None:
        """Add a refinement to the update, if it fits what is left; note its errors at once or later."""
        if coded is None:
            return
        if coded.wire_bytes > self._left:
            self._limited = True
            return
        self._left -= coded.wire_bytes
        if coded.channel is Channel.RANGE and not settle:
            coded.note(self._state)
            self._unsettled.append(coded)
        elif coded.channel is Channel.RANGE:
            note_range(self._scan, self._state, coded, self._target_steps)
        else:
            note_texture(self._scan, self._state, coded)
        self._coded.append(coded)


def _ever_coarser(first: RangeParameters, width: int) -> Iterator[RangeParameters]:
    """The parameters chosen, then ever cheaper ones, for when they take more than was expected."""
    quantum = first.quantum
    for p in (p for p in (1, 2, 4, 8) if p >= first.p and width % p == 0):
        for _ in range(QUANTA_PER_SPACING):
            yield msgspec.structs.replace(first, p=p, quantum=min(quantum, QUANTUM_MAX))
            quantum += max(quantum // 6, 1)
        quantum *= 2


def _error_in(state: ClientState, region: Region) -> float:
    """Largest range error left in the blocks a region touches. [steps]"""
    left, top, wide, high = region.blocks(RANGE_BLOCK)
    columns = np.arange(left, left + wide) % state.error.shape[1]
    touched = region.touched(RANGE_BLOCK)
    return float(state.error[top : top + high][:, columns].max(where=touched, initial=0))
