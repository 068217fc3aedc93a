"""The texture of one look: spacing, quality and blocks that reach the PSNR asked for, or that fit a limit.

The scan's model says what every spacing and quality will take and leave, so the choice among them costs no encode, and
one encode is most often all: QualitySearch corrects where the model was wrong.

Source: REQUIREMENTS F-14b, E-01.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from node.coded import Coded, fewest_strips, framed, message_overhead, region_lattice
from node.held_texture import HELD_MARGIN, HeldTexture
from node.library import Scan
from node.polar import SPACINGS as POLAR_SPACINGS
from node.polar import PolarTexture, reaches
from node.quality import MARGIN, MARGIN_CYLINDER, TRIES, Encodes, Point, QualitySearch, ceiled, floored
from node.refine_texture import (
    CODECS,
    Compared,
    ComparedPolar,
    choose_spacing,
    code_texture_strips,
    compared_with,
    measured,
    mse_of_db,
    quality_bounds,
    select_texture_lattice,
    texture_images,
    texture_lattice,
)
from node.state import ClientState
from node.texture_model import SPACINGS, Expected, Place, TextureModel
from protocol.codec import LOSSLESS, SIXTEENTHS
from protocol.grid import TEXTURE_BLOCK, BoolArray, ImageArray
from protocol.lattice import Channel, Parameters, runs_to_mask
from protocol.messages import CodecName, Look, TextureParameters
from protocol.region import Region
from protocol.strips import Strips

SKIRT_S = 1.0
GRAINS = {"htj2k": 1 / SIXTEENTHS, "jpeg": 1.0}  # by how much qualities of a codec can differ
FINEST_SHARE = 1.03  # of what another spacing takes: up to there spacing 1 is preferred
POLAR_SHARE = 0.88  # and up to there one image of a pole at spacing 2: a quarter of the texels of strips at spacing 1
POOR = (1, 2, 4, 16)  # times the error allowed: blocks that are held no better may be sent again
FAR = 16  # steps of quality above the first guess, from where a closer spacing serves better
SPOILT_SHARE = 0.6  # of the error allowed: blocks that stay may take so much of what those that are sent may have
GENERIC_BYTES_PER_TEXEL = 0.04
NO_TEXTURE = 16.0  # how much larger than wanted an error is left where no texture is sent, until it is known
Carried = tuple[tuple[int, int, bytes], ...]
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
        self._margin = MARGIN_CYLINDER if scan.spec.geometry == "cylinder" else MARGIN
        self._aim_mse = self._margin * self._target_mse
        self._lowest, self._highest = quality_bounds(codec)
        self._grain = GRAINS[codec]
        self._places: dict[int, Place] = {}
        self._known: dict[tuple[int, tuple[int, ...] | None], Expected] = {}
        self._least: dict[tuple[int, tuple[int, ...] | None], int] = {}
        self._tried: dict[tuple[int, float, Carried], Coded] = {}
        self._images: dict[tuple[int, Carried], list[ImageArray]] = {}
        self._compared: dict[tuple[int, Carried], list[Compared | ComparedPolar]] = {}
        self.limited = False
        self.mse: float | None = None

    def _is_polar(self, p: int) -> bool:
        """Whether texture at a spacing travels as one image of a pole: where strips of several strides would meet."""
        return p in POLAR_SPACINGS and self._maps is not None

    @cached_property
    def _maps(self) -> PolarTexture | None:
        """The maps of the poles, where they are there and of use."""
        shape = self._state.shapes[Channel.TEXTURE]
        if self._model is None or not reaches(shape, self._region):
            return None
        return self._model.maps

    @cached_property
    def _strides(self) -> tuple[int, ...]:
        """Of the strips that texture travels in elsewhere."""
        return fewest_strips(self._state.shapes[Channel.TEXTURE], self._region)

    @cached_property
    def _held(self) -> HeldTexture:
        """What the client has of the window."""
        return HeldTexture(self._state, self._region, self._model, self._target_mse)

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
        return found if listed is None or found is None else self._unlisted(found)

    def _unlisted(self, coded: Coded) -> Coded:
        """The same without a list of blocks, where that makes no difference to which are changed."""
        strips = select_texture_lattice(self._state, self._lattice(coded.parameters.half_spacing // 2), coded.quality)
        return _of_strips(coded, strips) if _carried(strips) == _carried(coded.strips) else coded

    def _listing(self, aim_bytes: float) -> tuple[int, ...] | None:
        """Which blocks to send: those that are not good enough, or fewer and these better, or all (None)."""
        poor = (self._held.listed(worse * self._target_mse) for worse in POOR)
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
        """The same, worked out.

        Which blocks are changed jumps with the quality, as those held finer or better stay. What counts are the blocks
        changed between the two jumps where the target is reached first.
        """
        if self._model is None:
            self._least[p, listed] = self._lowest
            return Expected.generic(self._target_mse, max(self._region.area * GENERIC_BYTES_PER_TEXEL, 64.0))
        if listed is None and not self._held.is_refined:  # nearly always: then all of it is sent, at any quality
            self._least[p, listed] = self._lowest
            return self._place(p).expect(self._held.touched)
        among = self._held.touched if listed is None else self._blocks(listed)
        needed = self._held.quality_needed(p)
        jumps = np.unique(np.clip(needed[among], self._lowest, self._highest)).tolist()
        for begin, stop in pairwise([*(jumps or [self._lowest]), LOSSLESS]):
            sent = among & (needed <= begin)
            expected, self._least[p, listed] = self._expect_sent(p, sent if sent.any() else among), begin
            if expected.quality_for_mse(self._aim_mse) < stop:
                break
        return expected

    def _expect_sent(self, p: int, sent: BoolArray) -> Expected:
        """What some blocks take at a spacing, and leave in the window with the others as they are held."""
        expected, kept = self._place(p).expect(sent), self._held.touched & ~sent
        if not kept.any():
            return expected
        kept_error, values = self._held.error(kept, most=True)
        return expected.beside(1 - values / max(3 * self._region.area, values), kept_error / max(values, 1))

    def _place(self, p: int) -> Place:
        assert self._model is not None  # else nobody asks
        if p not in self._places:
            self._places[p] = self._model.place(
                self._region, CODECS[self._codec], p, None if self._is_polar(p) else self._strides
            )
        return self._places[p]

    def _blocks(self, listed: tuple[int, ...]) -> BoolArray:
        _, _, wide, high = self._region.blocks(TEXTURE_BLOCK)
        return runs_to_mask(listed, wide * high).reshape(high, wide)

    def _choose(self, aim_bytes: float, listed: tuple[int, ...] | None) -> _Choice | None:
        """The spacing that takes least to reach the target; where none does, the one that comes nearest to it.

        None where none fits that is better than what is held.
        """
        offers = (self._offer(p, aim_bytes, listed) for p in self._spacings())
        choices = [offer for offer in offers if offer is not None and offer.mse < self._held_mse]
        reaching = [choice for choice in choices if choice.reaches]
        if not reaching:
            return min(choices, key=lambda choice: choice.mse, default=None)

        def cost(choice: _Choice) -> float:
            if self._is_polar(choice.p) and choice.p == POLAR_SPACINGS[0]:
                return choice.size_bytes * POLAR_SHARE
            return choice.size_bytes * (1 if choice.p == 1 else FINEST_SHARE)

        return min(reaching, key=cost)

    def _spacings(self) -> tuple[int, ...]:
        if self._model is None:
            found = choose_spacing(self._scan, self._state, self._region, self._look.texture_db, self._codec)
            return (int(found),)
        shape, wide = self._state.shapes[Channel.TEXTURE], self._region.blocks(TEXTURE_BLOCK)[2]
        finer = (p for p in SPACINGS if p * p < 1 << shape.coarse_level)  # than the first view: else nobody adopts it
        return tuple(p for p in finer if wide < shape.blocks[1] or self._region.turn % p == 0)

    def _offer(self, p: int, aim_bytes: float, listed: tuple[int, ...] | None) -> _Choice | None:
        """What a spacing can do for so many bytes of payload; None where it fits at no quality."""
        expected = self._expected(p, listed)
        wanted = max(ceiled(expected.quality_for_mse(self._aim_mse), self._grain), self._least[p, listed])
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
            expected, highest = self._expected(p, listed), self._highest
            if p > 1:
                highest = min(highest, math.ceil(expected.quality_for_mse(self._aim_mse)) + FAR)
            bounds = aim_bytes - OVERHEAD_BYTES, limit_bytes - OVERHEAD_BYTES
            lowest = self._least[p, listed] if math.isinf(limit_bytes) else self._lowest
            search = QualitySearch(
                self._target_mse, *bounds, expected, lowest, highest, self._tries, self._grain, self._margin
            )
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
                coded = self._measured(p, coded)
                mse = self._error(coded)
                self._learn(p, coded, mse)
                search.measured(Point(quality, mse, coded))
                if mse > self._target_mse and self._spoilt(coded):
                    search.at_least(self._mending_quality(p, coded))
            else:
                search.too_large(quality, len(coded.payload))
                self._learn(p, coded)
        return True

    def _code(self, p: int, quality: float, listed: tuple[int, ...] | None) -> Coded | None:
        """Encode a try; what is the same as an earlier one but for how its blocks are told has its payload."""
        parameters = self._lattice(p)
        if listed is not None:
            parameters = replace(parameters, listed=listed)
        strips = select_texture_lattice(self._state, parameters, quality)
        if not strips:
            return None
        carried, codec = _carried(strips), CODECS[self._codec]
        earlier = self._tried.get((p, quality, carried))
        if earlier is not None:
            return _of_strips(earlier, strips)
        self._encodes.add()
        if (p, carried) not in self._images:
            self._images[p, carried] = texture_images(self._scan, strips, codec, self._maps)
        return code_texture_strips(strips, self._images[p, carried], quality, codec, quick=self._quick)

    def _lattice(self, p: int) -> Parameters:
        """Of the whole window at a spacing."""
        if self._is_polar(p):
            return replace(region_lattice(self._region, Channel.TEXTURE, 2 * p), polar=True)
        return texture_lattice(self._state, self._region, TextureParameters(p, s=self.skirt(p)))

    def _measured(self, p: int, coded: Coded) -> Coded:
        """A try with what a client makes of it, and noted, so that it is not made again."""
        coded = measured(coded)
        self._tried[p, coded.quality, _carried(coded.strips)] = coded
        return coded

    def _spoilt(self, coded: Coded) -> bool:
        """Whether blocks that a refinement leaves as they are have so much of the error allowed that it is worth more
        to send them too than to send the others better."""
        kept_error, kept = self._held.error(self._held.left_alone(coded), most=True)
        sent = max(3 * self._region.area - kept, 0)
        return kept_error > self._target_mse * (kept + sent * SPOILT_SHARE)

    def _mending_quality(self, p: int, coded: Coded | None) -> int:
        return self._held.quality_to_mend(self._held.left_alone(coded), p)

    def _error(self, coded: Coded | None) -> float:
        """Squared error per value that a refinement (or none) leaves in the window, what is held there included."""
        total, count = 0.0, 0.0
        if coded is not None:
            for compared, part in zip(self._held_against(coded), coded.parts, strict=True):
                error, values = compared.part_error(part)
                total, count = total + error, count + values
        held_total, held_count = self._held.error(self._held.left_alone(coded), most=coded is not None)
        return (total + held_total) / max(count + held_count, 1)

    def _held_against(self, coded: Coded) -> list[Compared | ComparedPolar]:
        """What its patches are compared with, of each part."""
        key = coded.parameters.half_spacing, _carried(coded.strips)
        if key not in self._compared:
            self._compared[key] = [compared_with(self._scan, strip, self._region) for strip in coded.strips]
        return self._compared[key]

    def _sent(self, coded: Coded) -> BoolArray:
        """Which of the window's blocks a refinement changes."""
        return self._held.touched & ~self._held.left_alone(coded)

    def _learn(self, p: int, coded: Coded, mse: float | None = None) -> None:
        """Tell the model what a refinement took, and missed, where a skirt is not what took it.

        mse : what the window then has. It is expected of tiles, which miss a little less than one image or a pole's.
        """
        if self._model is None or self._look.alpha is not None:
            return
        sent, polar = self._sent(coded), self._is_polar(p)
        expected, worse = self._place(p).expect(sent), 1.0
        is_whole = polar or len(coded.parts) == 1
        if is_whole and mse is not None and bool((sent == self._held.touched).all()):
            worse = mse / expected.mse(coded.quality)
        taken = expected.size_bytes(coded.quality), len(coded.payload)
        self._model.learn(CODECS[self._codec], p, *taken, polar=polar, worse=worse)
        self._known.clear()


def _of_strips(coded: Coded, strips: Strips) -> Coded:
    """A refinement told by strips of another lattice, which carry the same."""
    parts = zip(coded.parts, strips, strict=True)
    return replace(coded, parts=tuple(replace(part, strip=strip) for part, strip in parts))


def _carried(strips: Strips) -> Carried:
    """Tells strips of lattices that differ in what they list by the blocks that they carry."""
    return tuple((strip.selection.y.start, strip.selection.x.start, strip.adopted.tobytes()) for strip in strips)
