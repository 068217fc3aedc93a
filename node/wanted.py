"""A look as it is to be planned, by whoever plans it: a thread of the node or a process of its own."""

from __future__ import annotations

from dataclasses import dataclass

from node.range_model import RangeModel
from node.texture_model import TextureModel
from protocol.messages import CodecName, Look


@dataclass(frozen=True, slots=True)
class Wanted:
    """A look and what its update may cost. Small, so that it is quickly handed from process to process.

    codecs : of texture, those that the client takes, the one it likes best first.
    budget_bytes : what the update may take on the wire, its reply included; None for no limit.
    quick : spare time rather than bytes, since the link is fast.
    hurried : others wait, so spare what a few percent of bytes buy.
    """

    look: Look
    codecs: tuple[CodecName, ...]
    budget_bytes: int | None = None
    quick: bool = False
    hurried: bool = False


@dataclass(frozen=True, slots=True)
class Models:
    """What was measured of a scan by now, None of either until it is.

    range : what interpolating its range misses.   texture : what its texture takes and reaches.
    """

    range: RangeModel | None = None
    texture: TextureModel | None = None


NO_MODELS = Models()
