"""The texture of one look: spacing, quality and blocks that reach the PSNR asked for, or that fit a limit.

The scan's model says what every spacing and quality will take and leave, so the choice among them costs no encode, and
one encode is most often all: QualitySearch corrects where the model was wrong.

Source: REQUIREMENTS F-14b, E-01.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from node.coded import Coded, fewest_strips, framed, message_overhead
from node.library import Scan
from node.quality import MARGIN, TRIES, Encodes, Point, QualitySearch, ceiled, floored
from node.refine_texture import (
    CODECS,
    HELD_MARGIN,
    adopted_error,
    choose_spacing,
    code_texture_lattice,
    held_error,
    left_alone,
    listed_texture,
    measured,
    mse_of_db,
    quality_bounds,
    quality_needed,
    quality_to_mend,
    texture_lattice,
)
from node.state import ClientState
from node.texture_model import SPACINGS, Expected, TextureModel
from protocol.codec import SIXTEENTHS
from protocol.grid import TEXTURE_BLOCK, BoolArray
from protocol.lattice import Channel, Parameters, runs_to_mask
from protocol.messages import CodecName, Look, TextureParameters
from protocol.region import Region

SKIRT_S = 1.0
GRAINS = {"htj2k": 1 / SIXTEENTHS, "jpeg": 1.0}  # by how much qualities of a codec can differ
WHOLE_SHARE = 0.7  # of what a whole window takes: where a part takes more, the whole is tried too
FINEST_SHARE = 1.03  # of what another spacing takes: up to there spacing 1 is preferred
POOR = (1, 2, 4, 16)  # times the error allowed: blocks that are held no better may be sent again
SPOILT_SHARE = 0.6  # of the error allowed: blocks that stay may take so much of what those that are sent may have
GENERIC_BYTES_PER_TEXEL = 0.04
NO_TEXTURE = 16.0  # how much larger than wanted an error is left where no texture is sent, until it is known
OVERHEAD_BYTES = framed(message_overhead(Parameters(2, 0, 0, 1, 1)))


@dataclass(frozen=True, slots=True)
class _Choice:
    """A spacing, what it is expected to leave of the error and to take, and whether it reaches what was asked for."""

    p: int
    mse: float
    size_bytes: float
    reaches: bool


class TextureSearch:
    """Finds the texture refinement that answers a look.

    limited : bytes have kept it from the quality asked for.   mse : error left in the window; None until measured.
    """

    def __init__(
        self,
        scan: Scan,
        state: ClientState,
        look: Look,
        region: Region,
        codec: CodecName,
        model: TextureModel | None,
        quick: bool,
        hurried: bool,
        encodes: Encodes,
    ) -> None:
        self._scan, self._state, self._look, self._region, self._model = scan, state, look, region, model
        self._codec: CodecName = codec
        self._quick, self._encodes = quick, encodes
        self._tries = 1 if hurried else TRIES
        self._target_mse = mse_of_db(look.texture_db)
        self._lowest, self._highest = quality_bounds(codec)
        self._grain = GRAINS[codec]
        self._known: dict[tuple[int, tuple[int, ...] | None], Expected] = {}
        self.limited = False
        self.mse: float | None = None

    @cached_property
    def _strides(self) -> tuple[int, ...]:
        """Of the strips that texture travels in."""
        return fewest_strips(self._state.shapes[Channel.TEXTURE], self._region)

    @cached_property
    def _held_mse(self) -> float:
        """Error per value in the window as it is held; infinite where nobody knows."""
        return math.inf if self._model is None else self._error(None)

    def expected_mse(self, limit_bytes: float) -> float:
        """Error per value expected in the window when the refinement may take so many bytes on the wire; 0: none."""
        choice = self._choose(limit_bytes - OVERHEAD_BYTES, None)
        return choice.mse if choice is not None else min(self._held_mse, self._target_mse * NO_TEXTURE**2)

    def search(self, aim_bytes: float, limit_bytes: float) -> Coded | None:
        """The cheapest refinement that reaches the quality, else the best one that fits. None: nothing is sent.

        aim_bytes : what it should take on the wire, if it cannot reach the quality.   limit_bytes : what it may.
        """
        if self._held_mse <= HELD_MARGIN * self._target_mse:
            self.mse = self._held_mse
            return None
        listed = self._listing(aim_bytes)
        found = self._search_spacings(aim_bytes, limit_bytes, listed)
        if listed is None or found is None or found.wire_bytes < WHOLE_SHARE * self._expected_whole_bytes():
            return found
        reached = self._left()
        whole = self._search_spacings(aim_bytes, limit_bytes, None)  # one quality all over may cost less than parts do
        if whole is not None and whole.wire_bytes < found.wire_bytes and self._left() <= max(reached, self._target_mse):
            return whole
        self.mse = reached if math.isfinite(reached) else None
        return found

    def _left(self) -> float:
        return math.inf if self.mse is None else self.mse

    def _listing(self, aim_bytes: float) -> tuple[int, ...] | None:
        """Which blocks to send: those that are not good enough, or fewer and these better, or all (None)."""
        poor = (listed_texture(self._state, self._region, worse * self._target_mse) for worse in POOR)
        listings = {listed for listed in poor if listed is not None}
        if not listings or self._model is None:
            return next(iter(listings), None)
        offers = {listed: self._choose(aim_bytes - OVERHEAD_BYTES, listed) for listed in (*listings, None)}

        def cost(listed: tuple[int, ...] | None) -> tuple[bool, float]:
            offer = offers[listed]
            if offer is None:
                return True, math.inf
            return not offer.reaches, offer.size_bytes if offer.reaches else offer.mse

        return min(offers, key=cost)

    def skirt(self, p: float) -> float:
        """S' of the skirt: as the viewer's alpha says, else thin."""
        return SKIRT_S if self._look.alpha is None else 1 / (self._look.alpha * p)

    # -- what is expected ------------------------------------------------------------------------------------------

    def _expected(self, p: int, listed: tuple[int, ...] | None) -> Expected:
        """What texture takes at a spacing, and leaves in the window with what is held there."""
        if (p, listed) not in self._known:
            self._known[p, listed] = self._expect(p, listed)
        return self._known[p, listed]

    def _expect(self, p: int, listed: tuple[int, ...] | None) -> Expected:
        if self._model is None:
            return Expected.generic(self._target_mse, max(self._region.area * GENERIC_BYTES_PER_TEXEL, 64.0))
        touched = self._region.touched(TEXTURE_BLOCK)
        among = touched if listed is None else self._blocks(listed)
        expected = self._model.expect(self._region, CODECS[self._codec], p, among, self._strides)
        needed = quality_needed(self._state, self._region, p)
        adopted = among & (needed <= expected.quality_for_mse(MARGIN * self._target_mse))
        if not adopted.any():
            adopted = among
        if adopted.sum() < among.sum():
            expected = self._model.expect(self._region, CODECS[self._codec], p, adopted, self._strides)
        if adopted.sum() == touched.sum():
            return expected
        kept_error, kept = self._held_error(~adopted & touched)
        return expected.beside(1 - kept / max(3 * self._region.area, kept), kept_error / max(kept, 1))

    def _blocks(self, listed: tuple[int, ...]) -> BoolArray:
        _, _, wide, high = self._region.blocks(TEXTURE_BLOCK)
        return runs_to_mask(listed, wide * high).reshape(high, wide)

    def _expected_whole_bytes(self) -> float:
        expected = self._expected(1, None)
        return expected.size_bytes(expected.quality_for_mse(self._target_mse))

    def _choose(self, aim_bytes: float, listed: tuple[int, ...] | None) -> _Choice | None:
        """The spacing that takes least to reach the target; where none does, the one that comes nearest to it.

        None where none fits that is better than what is held.
        """
        offers = (self._offer(p, aim_bytes, listed) for p in self._spacings())
        choices = [offer for offer in offers if offer is not None and offer.mse < self._held_mse]
        reaching = [choice for choice in choices if choice.reaches]
        if not reaching:
            return min(choices, key=lambda choice: choice.mse, default=None)
        return min(reaching, key=lambda choice: choice.size_bytes * (1 if choice.p == 1 else FINEST_SHARE))

    def _spacings(self) -> tuple[int, ...]:
        if self._model is None:
            found = choose_spacing(self._scan, self._state, self._region, self._look.texture_db, self._codec)
            return (int(found),)
        turn, wide = self._state.shapes[Channel.TEXTURE].blocks[1], self._region.blocks(TEXTURE_BLOCK)[2]
        return tuple(p for p in SPACINGS if wide < turn or self._region.turn % p == 0)

    def _offer(self, p: int, aim_bytes: float, listed: tuple[int, ...] | None) -> _Choice | None:
        """What a spacing can do for so many bytes of payload; None where it fits at no quality."""
        expected = self._expected(p, listed)
        wanted = max(ceiled(expected.quality_for_mse(MARGIN * self._target_mse), self._grain), self._lowest)
        quality = min(wanted, self._highest)
        if math.isfinite(aim_bytes):
            quality = min(quality, floored(expected.quality_for_bytes(aim_bytes), self._grain))
        if quality < self._lowest:
            return None
        return _Choice(p, expected.mse(quality), expected.size_bytes(quality), quality == wanted)

    # -- what is tried ---------------------------------------------------------------------------------------------

    def _search_spacings(self, aim_bytes: float, limit_bytes: float, listed: tuple[int, ...] | None) -> Coded | None:
        """The best refinement of the blocks listed: at the spacing chosen, else at those next to it."""
        choice = self._choose(aim_bytes - OVERHEAD_BYTES, listed)
        if choice is None:
            self.limited = True
        p = choice.p if choice else 0
        best: Point | None = None
        while p in SPACINGS:
            bounds = aim_bytes - OVERHEAD_BYTES, limit_bytes - OVERHEAD_BYTES, self._expected(p, listed)
            search = QualitySearch(self._target_mse, *bounds, self._lowest, self._highest, self._tries, self._grain)
            if not self._try_qualities(search, p, listed):
                return None
            self.limited |= search.limited
            found = search.best()
            if found is not None and (best is None or found.mse < best.mse):
                best = found
            if found is None:
                p = 2 * p if best is None else 0
            else:
                p = p // 2 if found.mse > self._target_mse and not search.limited else 0
        if best is None or best.mse >= self._held_mse:
            self.mse = self._held_mse if math.isfinite(self._held_mse) else None
            return None
        self.mse = best.mse
        return best.coded

    def _try_qualities(self, search: QualitySearch, p: int, listed: tuple[int, ...] | None) -> bool:
        """Feed a search; False when the client holds all of this already."""
        while (quality := search.next_quality()) is not None:
            coded = self._code(p, quality, listed)
            if coded is None:
                if self._error(None) <= self._target_mse:
                    return False
                search.missed_all(quality, self._mending_quality(p, None))
                continue
            if search.fits(coded):
                coded = measured(coded)
                mse = self._error(coded)
                search.measured(Point(quality, mse, coded))
                if mse > self._target_mse and self._spoilt(coded):
                    search.at_least(self._mending_quality(p, coded))
            else:
                search.too_large(quality, len(coded.payload))
            self._learn(p, coded)
        return True

    def _code(self, p: int, quality: float, listed: tuple[int, ...] | None) -> Coded | None:
        self._encodes.add()
        wanted = TextureParameters(p, int(quality), self._codec, self.skirt(p))
        parameters = texture_lattice(self._state, self._region, wanted)
        if listed is not None:
            parameters = replace(parameters, listed=listed)
        return code_texture_lattice(
            self._scan, self._state, parameters, quality, CODECS[self._codec], quick=self._quick
        )

    def _spoilt(self, coded: Coded) -> bool:
        """Whether blocks that a refinement leaves as they are have so much of the error allowed that it is worth more
        to send them too than to send the others better."""
        kept_error, kept = self._held_error(left_alone(self._state, coded, self._region))
        sent = max(3 * self._region.area - kept, 0)
        return kept_error > self._target_mse * (kept + sent * SPOILT_SHARE)

    def _mending_quality(self, p: int, coded: Coded | None) -> int:
        kept = left_alone(self._state, coded, self._region)
        return quality_to_mend(self._state, kept, self._region, p, self._target_mse)

    def _error(self, coded: Coded | None) -> float:
        """Squared error per value that a refinement (or none) leaves in the window, what is held there included."""
        total, count = 0.0, 0.0
        if coded is not None:
            total, count = adopted_error(self._scan, coded, self._region)
        kept = left_alone(self._state, coded, self._region)
        held_total, held_count = self._held_error(kept, most=coded is not None)
        return (total + held_total) / max(count + held_count, 1)

    def _held_error(self, kept: BoolArray, *, most: bool = True) -> tuple[float, float]:
        return held_error(self._state, kept, self._region, self._model, self._target_mse, most=most)

    def _learn(self, p: int, coded: Coded) -> None:
        """Tell the model what a refinement took, where a skirt is not what took it."""
        if self._model is not None and self._look.alpha is None:
            codec = CODECS[self._codec]
            sent = self._region.touched(TEXTURE_BLOCK) & ~left_alone(self._state, coded, self._region)
            expected = self._model.expect(self._region, codec, p, sent, self._strides)
            self._model.learn(codec, p, expected.size_bytes(coded.quality), len(coded.payload))
            self._known.clear()
