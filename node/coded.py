"""A refinement as the node holds it before it is sent: what it carries, and what it does to a client's state."""

from __future__ import annotations

import math
from dataclasses import dataclass

from node.state import ClientState
from protocol.grid import BoolArray, ImageArray, StepArray
from protocol.lattice import NO_SKIRT, RHO_MAX, RHO_ONE, Channel, Parameters
from protocol.reconstruct import Selection
from protocol.refinement import CRC, HEADER, Generator, Refinement, pack_parameters

FRAME_BYTES = 10  # WebSocket's own, at most


@dataclass(frozen=True, slots=True, eq=False)
class Coded:
    """Samples of a lattice, encoded.

    adopted : (by, bx) bool over the lattice's covered blocks.
    rank, quality, codec : as in protocol.holdings and protocol.refinement.
    decoded : range only, the samples as a client decodes them.
    patch : texture only, the dense rectangle that a client makes of it; None where nobody measured it.
    """

    selection: Selection
    adopted: BoolArray
    rank: int
    quality: int
    codec: int
    payload: bytes
    mask: bytes = b""
    decoded: StepArray | None = None
    patch: ImageArray | None = None

    @property
    def channel(self) -> Channel:
        """What it carries."""
        return self.selection.lattice.shape.channel

    @property
    def parameters(self) -> Parameters:
        """What travels of its lattice."""
        return self.selection.lattice.parameters

    @property
    def wire_bytes(self) -> int:
        """What it takes on the wire, carrier included."""
        return wire_overhead(self.parameters) + len(self.mask) + len(self.payload)

    def refinement(self, epoch: int, seq: int, look: int) -> Refinement:
        """The wire record."""
        return Refinement(
            Generator.FOVEA, self.channel, epoch, seq, look, self.codec, self.quality, self.selection.samples,
            self.payload, self.mask, self.parameters,
        )  # fmt: skip

    def note(self, state: ClientState) -> None:
        """Record in a client's state that it holds this now."""
        state.holdings.channels[self.channel].adopt(self.selection.lattice, self.adopted, self.rank)


def wire_overhead(parameters: Parameters) -> int:
    """Bytes of a refinement apart from its mask and payload, carrier included."""
    return FRAME_BYTES + HEADER.size + CRC.size + len(pack_parameters(parameters))


def rho_of(s: float | None) -> int:
    """Growth of the skirt for S', round(65536 exp(1/S')); None is no skirt (F-07b)."""
    if s is None:
        return NO_SKIRT
    return min(max(round(RHO_ONE * math.exp(1 / s)), RHO_ONE), RHO_MAX)
