"""Planning one update: a pure function of a scan, a client's state, what it asks for and the bytes it may take.

Range goes first, since shape without colour helps and colour on the wrong shape does not; texture takes what is left.
Nothing over the budget is ever returned: every candidate is encoded and weighed before it counts.

Source: Cheng, Basu, Pan 2003, Eq. (15), with REQUIREMENTS F-14 and F-14b.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Literal

import msgspec
import numpy as np

from node.beside import both
from node.coded import Coded, Packed, framed
from node.library import Scan
from node.quality import Encodes, Superseded
from node.range_search import RangeSearch
from node.refine_range import code_range, settle_range
from node.refine_texture import code_texture, db_of_mse, mse_of_db, select_texture, settle_texture
from node.state import ClientState
from node.texture_search import TextureSearch
from node.wanted import NO_MODELS, Models, Wanted
from protocol.grid import RANGE_BLOCK
from protocol.lattice import Channel
from protocol.messages import (
    LookParameters,
    RangeParameters,
    TextureParameters,
    Updated,
    encode_message,
)
from protocol.region import Region
from protocol.sphere import region_on
from protocol.strips import samples_of

LONGEST_REPLY = Updated(0xFFFFFFFF, 0xFFFFFFFF, "byte limit", 99999.9999, 100.01, 99, 99999.9)
REPLY_BYTES = framed(len(encode_message(LONGEST_REPLY)))  # the Updated message that ends an update, at most
FILL = 0.95  # of the bytes there are: less is worth one more encode of range
RANGE_LEAST = 0.8  # of the bytes kept for range: texture that leaves no less is not coded again
DOUBLINGS_MAX = 6
SKIRTS = (64.0, 32.0, 16.0, 8.0, 4.0, 2.0)
CAPS: tuple[tuple[Literal[2, 4, 8], float], ...] = ((2, 2.5), (4, 6.0), (8, 16.0))  # spacing, how much more area
SKIRT_MARGIN = 2.0  # a skirt's cells differ more from each other than a window's texels

Reason = Literal["complete", "byte limit", "superseded"]


@dataclass(frozen=True, slots=True)
class Update:
    """A planned update.

    coded : its refinements, in order.    state : the client's state once they have arrived.
    error_max_mm, texture_db : what is left in the window; None where this update did not measure it, or not yet.
    settle : computes what may wait until the bytes are sent (digest, errors); None when nothing does.
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


@dataclass(frozen=True, slots=True)
class Planned:
    """An update that another process has planned and settled; fields as of Update."""

    coded: tuple[Packed, ...]
    state: ClientState
    reason: Reason
    error_max_mm: float | None
    texture_db: float | None
    encodes: int

    @classmethod
    def of(cls, update: Update) -> Planned:
        """What of a settled update is handed over."""
        coded = tuple(Packed.of(one) for one in update.coded)
        return cls(coded, update.state, update.reason, update.error_max_mm, update.texture_db, update.encodes)


def plan_update(
    scan: Scan,
    state: ClientState,
    wanted: Wanted,
    models: Models = NO_MODELS,
    superseded: Callable[[], bool] = lambda: False,
    pool: Executor | None = None,
    ready: Callable[[Sequence[Coded]], None] | None = None,
) -> Update:
    """Plan the update that answers a look, its texture by the first of the codecs.

    superseded : asked between encodes; when true, what is planned so far is dropped.
    pool : a free thread of it plans range meanwhile, where that does not depend on what texture takes.
    ready : told the refinements of range, with which the update begins, as soon as these are there in that case.
    Raises LatticeError or CodecError where explicit parameters do not fit the scan.
    """
    planner = _Planner(scan, state.copy(), wanted, models, superseded, pool, ready)
    try:
        planner.run()
    except Superseded:
        return Update((), state, "superseded")
    return planner.update()


class _Planner:
    """One update in the making."""

    def __init__(
        self,
        scan: Scan,
        state: ClientState,
        wanted: Wanted,
        models: Models,
        superseded: Callable[[], bool],
        pool: Executor | None,
        ready: Callable[[Sequence[Coded]], None] | None,
    ) -> None:
        look, codec, budget_bytes, hurried = wanted.look, wanted.codecs[0], wanted.budget_bytes, wanted.hurried
        self._scan, self._state, self._look, self._codec, self._quick = scan, state, look, codec, wanted.quick
        self._pool, self._ready = pool, ready
        self._left = math.inf if budget_bytes is None else float(budget_bytes - REPLY_BYTES)
        self._spare = 0.0 if budget_bytes is None else (1 - FILL) * budget_bytes
        self._encodes = {channel: Encodes(superseded) for channel in Channel}  # each counted by one thread
        self._coded: list[Coded] = []
        self._limited = False
        self._window = look.window if look.scale is None else look.scale**2
        self._range_region, self._texture_region = self._regions(self._window)
        self._range = RangeSearch(
            scan, state, look, self._range_region, models.range, hurried, self._encodes[Channel.RANGE]
        )
        self._texture = TextureSearch(
            scan, state, look, self._texture_region, codec, models.texture, wanted.quick, hurried,
            self._encodes[Channel.TEXTURE],
        )  # fmt: skip

    def _regions(self, window: float) -> tuple[Region, Region]:
        """What a share of the area round the click is of range and of texture."""
        s, u, v = self._scan.spec, self._look.u, self._look.v
        return (
            region_on(s, u, v, window, s.width, s.height),
            region_on(s, u, v, window, s.texture_width, s.texture_height),
        )

    def run(self) -> None:
        """Choose, encode and note the refinements."""
        if self._look.parameters is not None:
            self._run_explicit(self._look.parameters)
        elif math.isinf(self._left):
            of_range, texture = both(self._pool, self._reach_range, lambda: self._texture.search(math.inf, math.inf))
            self._limited = self._texture.limited
            for coded in (*of_range, texture):
                self._take(coded)
        else:
            self._run_within()

    def _run_explicit(self, wanted: LookParameters) -> None:
        """Encode as the look says."""
        for coded in both(
            self._pool,
            lambda: self._code_range(wanted.range, self._range_region, quick=True),
            lambda: self._code_texture(wanted.texture, self._texture_region, merged=False),
        ):
            self._take(coded)

    def _reach_range(self) -> list[Coded]:
        found = self._range.reach(self._range.choose(self._range.target_steps))
        if self._ready is not None:
            self._ready(found)
        return found

    def _run_within(self) -> None:
        """Choose, encode and note what fits the budget; in turn, since each takes what the other leaves."""
        wanted, range_bytes = self._divide()
        aim, limit = self._left - range_bytes - self._spare / 2, self._left - RANGE_LEAST * range_bytes
        texture = self._texture.search(aim, limit)
        self._limited |= self._texture.limited
        if texture is None:
            self._spare /= 2  # range alone is coded so quickly that one more encode may fill it better
        for coded in self._fill_range(wanted, self._left - (texture.wire_bytes if texture else 0)):
            self._take(coded)
        self._take(texture)
        if self._look.fill and not self._limited:
            self._fill_periphery(wanted)

    def update(self) -> Update:
        """What came of it."""
        reason: Reason = "byte limit" if self._limited else "complete"
        texture_db = None if self._texture.mse is None else db_of_mse(self._texture.mse)
        encodes = sum(each.count for each in self._encodes.values())
        update = Update(tuple(self._coded), self._state, reason, None, texture_db, encodes, self._settle)
        return update if self._coded else update.settled()

    def _settle(self) -> float:
        """Note the errors that were left, and the digest. Returns the largest error of range in the window. [mm]"""
        for coded in self._coded:
            if coded.channel is Channel.RANGE:
                settle_range(self._scan, self._state, coded, self._range.target_steps)
            else:
                settle_texture(self._scan, self._state, coded)
        return _error_in(self._state, self._range_region) * self._scan.spec.step_mm

    def _divide(self) -> tuple[RangeParameters, float]:
        """The range parameters to use and the bytes to keep for them.

        Where both qualities fit the limit: the cheapest that reach the quality. Else the pair that falls short the
        least, a doubled range error counting as much as 6 dB of texture.
        """
        target_steps = self._range.target_steps
        wanted = self._range.choose(target_steps)
        range_bytes = self._range.expected_bytes(wanted)
        best, least = (wanted, range_bytes), self._shortfall(0, range_bytes)
        doubled = 0
        while least > doubled and doubled < DOUBLINGS_MAX:
            doubled += 1
            wanted = self._range.choose(max(target_steps, 0.5) * 2**doubled)
            range_bytes = self._range.expected_bytes(wanted)
            shortfall = self._shortfall(doubled, range_bytes)
            if shortfall < least:
                best, least = (wanted, range_bytes), shortfall
                self._limited = True
        return best

    def _shortfall(self, doubled: int, range_bytes: float) -> float:
        """How far an update falls short, in doublings of error, where range takes so many bytes."""
        if range_bytes > self._left:
            return math.inf
        mse, target_mse = self._texture.expected_mse(self._left - range_bytes), mse_of_db(self._look.texture_db)
        return float(doubled + math.log2(max(mse / target_mse, 1)) / 2)

    def _fill_range(self, wanted: RangeParameters, limit_bytes: float) -> list[Coded]:
        """Range as wanted; where bytes are short, the best that they allow."""
        if not self._limited:
            found = self._range.reach(wanted)
            if sum(coded.wire_bytes for coded in found) <= limit_bytes:
                return found
            self._limited = True
        coded = self._range.within(wanted, limit_bytes, self._spare)
        return [coded] if coded is not None else []

    # -- the periphery ---------------------------------------------------------------------------------------------

    def _fill_periphery(self, wanted: RangeParameters) -> None:
        """Spend what is left round the window, range first: the widest skirt that is expected to fit, on a sphere caps
        ever wider and coarser."""
        last = next((coded for coded in reversed(self._coded) if coded.channel is Channel.TEXTURE), None)
        texture = None
        if last is not None:
            sample_bytes = len(last.payload) / samples_of(last.strips)
            texture = TextureParameters(last.parameters.spacing, int(last.quality), self._codec), sample_bytes
        if self._scan.spec.geometry == "sphere":
            self._fill_caps(wanted, texture)
            return
        window = self._range_region, self._texture_region
        for s in SKIRTS:
            skirted = msgspec.structs.replace(wanted, s=s)
            if self._range.expected_bytes(skirted) <= self._left:
                self._take(self._code_range(skirted, window[0]))
                break
        if texture is not None:
            for s in SKIRTS:
                if self._texture_fits(texture, s, window[1]):
                    self._take(self._code_texture(msgspec.structs.replace(texture[0], s=s), window[1]))
                    return

    def _texture_fits(self, texture: tuple[TextureParameters, float], s: float | None, region: Region) -> bool:
        """Whether texture with a skirt is expected to fit what is left; bytes a sample as in the window."""
        parameters, sample_bytes = texture
        strips, _ = select_texture(self._state, region, msgspec.structs.replace(parameters, s=s))
        seen = sum(strip.selection.samples * strip.selection.adopted.mean() for strip in strips)
        return bool(strips) and seen * sample_bytes * SKIRT_MARGIN <= self._left

    def _fill_caps(self, wanted: RangeParameters, texture: tuple[TextureParameters, float] | None) -> None:
        for p, wider in CAPS:
            of_range, of_texture = self._regions(min(self._window * wider, 1.0))
            coarser = msgspec.structs.replace(wanted, p=max(p, wanted.p))
            if self._range.expected_bytes(coarser, of_range) <= self._left:
                self._take(self._code_range(coarser, of_range))
            if texture is not None:
                of_cap = msgspec.structs.replace(texture[0], p=max(p, texture[0].p)), texture[1]
                if self._texture_fits(of_cap, None, of_texture):
                    self._take(self._code_texture(of_cap[0], of_texture))

    # -- one refinement --------------------------------------------------------------------------------------------

    def _code_range(self, wanted: RangeParameters | None, region: Region, *, quick: bool = False) -> Coded | None:
        if wanted is None:
            return None
        self._encodes[Channel.RANGE].add()
        return code_range(self._scan, self._state, region, wanted, quick=quick)

    def _code_texture(self, wanted: TextureParameters | None, region: Region, *, merged: bool = True) -> Coded | None:
        if wanted is None:
            return None
        self._encodes[Channel.TEXTURE].add()
        return code_texture(self._scan, self._state, region, wanted, quick=self._quick, merged=merged)

    def _take(self, coded: Coded | None) -> None:
        """Add a refinement to the update, if it fits what is left."""
        if coded is None:
            return
        if coded.wire_bytes > self._left:
            self._limited = True
            return
        self._left -= coded.wire_bytes
        coded.note(self._state)
        self._coded.append(coded)


def _error_in(state: ClientState, region: Region) -> float:
    """Largest range error left in the blocks a region touches. [steps]"""
    left, top, wide, high = region.blocks(RANGE_BLOCK)
    columns = np.arange(left, left + wide) % state.error.shape[1]
    touched = region.touched(RANGE_BLOCK)
    return float(state.error[top : top + high][:, columns].max(where=touched, initial=0))
