"""The scan that a stream looks at: its opening, what the client holds of it, and the updates that change that."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial

from node.classic import ClassicCoded, ClassicState
from node.classic_planner import ClassicUpdate, plan_classic
from node.coded import Coded, Packed
from node.foveate import Planned, Update, plan_update
from node.library import Scan
from node.refine_texture import mse_of_db
from node.state import ClientState
from node.texture_model import TextureModel
from node.wanted import Models, Wanted
from protocol import messages as m
from protocol.codec import JPEG_QUALITY_MAX, TextureCodec
from protocol.errors import LatticeError, RemoteWireError
from protocol.holdings import ChannelHoldings
from protocol.lattice import Channel
from protocol.sphere import region_on

AnyUpdate = Update | Planned | ClassicUpdate


@dataclass(slots=True, eq=False)
class Bound:
    """One opening of a scan. state : what the client holds, as we believe.  next_seq : of the next refinement.

    begun : how many refinements of an update that is being planned are sent.
    """

    epoch: int
    scan: Scan
    state: ClientState | ClassicState
    next_seq: int = 0
    begun: int = 0

    def plan(
        self,
        wanted: Wanted,
        models: Models,
        superseded: Callable[[], bool],
        pool: Executor | None = None,
        ready: Callable[[Sequence[Coded]], None] | None = None,
    ) -> Update | ClassicUpdate:
        """The update that answers a look; arguments as for plan_update, but that the best of the codecs is chosen.

        Raises LatticeError or CodecError where the look does not fit the scan or its opening.
        """
        look, codecs = wanted.look, wanted.codecs
        is_classic = isinstance(self.state, ClassicState)
        if is_classic != (look.profile == "classic"):
            raise LatticeError(f"the scan is not open with the {look.profile} profile")
        if isinstance(self.state, ClassicState):
            return plan_classic(self.scan, self.state, look, wanted.budget_bytes, superseded)
        spares_time = wanted.hurried and wanted.quick and "jpeg" in codecs  # and bytes are to be had
        liked = ("jpeg", *codecs) if spares_time and models.texture is not None else codecs
        codec = choose_codec(liked, self.scan, look, models.texture)

        of_codec = replace(wanted, codecs=(codec,))
        plan = partial(plan_update, self.scan, self.state, models=models, superseded=superseded, pool=pool)
        if codec == "htj2k" or "htj2k" not in codecs:
            return plan(of_codec, ready=ready)
        update = plan(of_codec)
        if not _falls_short(update, look):
            return update
        better = plan(replace(wanted, codecs=("htj2k",)))
        return replace(better, encodes=update.encodes + better.encodes)

    def begin(self, coded: Sequence[Coded], look: m.Look) -> list[bytes]:
        """Count what an update begins with as sent, while the rest is planned; returns it as `take` does."""
        self.begun = len(coded)
        return self._numbered(coded, look)

    def take(self, update: AnyUpdate, look: m.Look) -> list[bytes]:
        """Count an update as sent; returns its refinements on the wire, in order, but those it was begun with."""
        rest, self.begun = update.coded[self.begun :], 0
        self.state = update.state
        return self._numbered(rest, look)

    def _numbered(self, coded: Sequence[Coded | Packed | ClassicCoded], look: m.Look) -> list[bytes]:
        refinements = [one.refinement(self.epoch, seq, look.request) for seq, one in enumerate(coded, self.next_seq)]
        self.next_seq += len(coded)
        return [refinement.to_bytes() for refinement in refinements]

    def enveloped(self, request: int) -> m.Enveloped:
        """How far off each block of range still is. Raises LatticeError for a profile that keeps no account of it."""
        if isinstance(self.state, ClassicState):
            raise LatticeError("the classic profile keeps no account of errors block by block")
        deflater = zlib.compressobj(wbits=-15)
        errors = deflater.compress(self.state.error.astype("<u2").tobytes()) + deflater.flush()
        return m.Enveloped(request, self.epoch, errors)

    def adopt_word(self, said: m.State) -> None:
        """Take the client's word for what it holds. Raises RemoteWireError when it is no statement of this opening."""
        if said.next_seq > self.next_seq:
            raise RemoteWireError(f"state: refinement {said.next_seq} cannot be next, {self.next_seq} is")
        if isinstance(self.state, ClassicState):
            try:
                self.state = self.state.at(said.next_seq)
            except LatticeError as error:
                raise RemoteWireError(f"state: {error}") from None
        else:
            self.adopt_holdings(said.holdings)
        self.next_seq = said.next_seq

    def adopt_holdings(self, said: m.Statement) -> None:
        """The same for holdings alone."""
        if isinstance(self.state, ClassicState):
            raise RemoteWireError("a classic opening begins with its first view, not with holdings")
        shapes = self.state.shapes
        try:
            channels = {
                Channel.RANGE: ChannelHoldings.from_runs(shapes[Channel.RANGE], said.range),
                Channel.TEXTURE: ChannelHoldings.from_runs(shapes[Channel.TEXTURE], said.texture),
            }
        except LatticeError as error:
            raise RemoteWireError(f"holdings: {error}") from None
        self.state = self.state.as_said(channels)


def choose_codec(codecs: Sequence[m.CodecName], scan: Scan, look: m.Look, model: TextureModel | None) -> m.CodecName:
    """The texture codec that the client likes best; but HTJ2K, if it takes that, where JPEG's best will fall short.

    A guess: until the scan's texture is measured nobody knows, and then JPEG of equal quality is a little off.
    """
    if codecs[0] != "jpeg" or "htj2k" not in codecs or model is None:
        return codecs[0]
    share = look.window if look.scale is None else look.scale**2
    window = region_on(scan.spec, look.u, look.v, share, scan.spec.texture_width, scan.spec.texture_height)
    best = model.expect(window, TextureCodec.JPEG).mse(JPEG_QUALITY_MAX)
    return "jpeg" if best <= mse_of_db(look.texture_db) else "htj2k"


def _falls_short(update: Update, look: m.Look) -> bool:
    """Whether the codec, and not the bytes there were, kept the texture from what the look asks for."""
    return update.reason == "complete" and update.texture_db is not None and update.texture_db < look.texture_db


def updated(look: m.Look, next_seq: int, update: AnyUpdate, node_s: float) -> m.Updated:
    """What ends an update, in few digits that promise no more than the truth: errors rounded up, PSNR down."""
    return m.Updated(
        look.request,
        next_seq,
        update.reason,
        None if update.error_max_mm is None else _rounded(math.ceil, update.error_max_mm, 4),
        None if update.texture_db is None else _rounded(math.floor, update.texture_db, 2),
        update.encodes,
        round(1000 * node_s, 3),
    )


def _rounded(to_whole: Callable[[float], int], value: float, digits: int) -> float:
    """A value in so many digits. Noise of float64 far behind them does not count: 51 steps of 0.002 are 0.102."""
    unit = 10.0**digits
    return to_whole(round(value * unit, 6)) / unit
