"""The block-aligned rectangle that an update refines, coded alone: same spacing, same codec, same quality, no skirt.

It is no rival but the floor: what foveation costs above it is the smooth transition, and our headers.
"""

from __future__ import annotations

from typing import Any

from node.first_view import build_first_view
from node.library import Scan
from node.refine_range import code_range
from node.refine_texture import code_texture
from protocol.codec import TextureCodec
from protocol.messages import RangeParameters, TextureParameters
from tests.bench.rivals.offer import REPLY_BYTES
from tests.bench.target import Window

FIRST_VIEW_BYTES = 32768
NAMES = {TextureCodec.JPEG: "jpeg", TextureCodec.HTJ2K: "htj2k"}


def crop_bytes(scan: Scan, window: Window, parts: list[dict[str, Any]]) -> int:
    """Bytes of the rectangles of some refinements (as `ours` tells them), in one reply."""
    state = build_first_view(scan, "htj2k", FIRST_VIEW_BYTES).state
    size = REPLY_BYTES
    for part in parts:
        if part["channel"] == "range":
            wanted = RangeParameters(p=int(part["p"]), quantum=part["quality"], s=None)  # type: ignore[arg-type]
            coded = code_range(scan, state, window.range, wanted)
        else:
            codec: Any = NAMES[TextureCodec(part["codec"])]
            texture = TextureParameters(p=part["p"], quality=part["quality"], codec=codec, s=None)
            coded = code_texture(scan, state, window.texture, texture)
        assert coded is not None
        size += len(coded.payload) + len(coded.mask)
    return size
