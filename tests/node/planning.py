"""Looks planned as tests ask for them."""

from __future__ import annotations

from node.foveate import Update, plan_update
from node.library import Scan
from node.range_model import RangeModel
from node.state import ClientState
from node.texture_model import TextureModel
from node.wanted import Models, Wanted
from protocol.messages import CodecName, Look


def plan_look(
    scan: Scan,
    state: ClientState,
    look: Look,
    codec: CodecName = "htj2k",
    budget_bytes: int | None = None,
    *,
    model: TextureModel | None = None,
    range_model: RangeModel | None = None,
    hurried: bool = False,
) -> Update:
    """The update that answers a look. model : of the scan's texture."""
    return plan_update(scan, state, Wanted(look, (codec,), budget_bytes, hurried=hurried), Models(range_model, model))
