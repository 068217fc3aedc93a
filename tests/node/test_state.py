"""What the node believes of a client after the client has stated its holdings itself."""

from __future__ import annotations

import numpy as np

from node.first_view import build_first_view
from node.library import Scan
from node.state import ClientState
from protocol.holdings import ChannelHoldings
from protocol.lattice import Channel
from protocol.messages import Look, LookParameters, RangeParameters
from protocol.reconstruct import paste
from protocol.region import region_round
from tests.node.planning import plan_look


def restated(state: ClientState, level: int | None = None, rank: int = 65534) -> ClientState:
    """A copy that has taken a client's word: its own holdings, or one level and rank everywhere."""
    channels = {channel: held.copy() for channel, held in state.holdings.channels.items()}
    if level is not None:
        shape = state.shapes[Channel.RANGE]
        size = shape.blocks[0] * shape.blocks[1]
        channels[Channel.RANGE] = ChannelHoldings.from_runs(shape, [[size, level, rank]])
    return state.as_said(channels)


def test_a_client_that_holds_what_we_thought_changes_nothing(scan: Scan) -> None:
    first = build_first_view(scan, "htj2k", 32768).state
    look = Look(1, 0.5, 0.5, parameters=LookParameters(RangeParameters(2, 9)))
    after = plan_look(scan, first, look).settled().state
    same = restated(after)
    np.testing.assert_array_equal(same.error, after.error)
    np.testing.assert_array_equal(same.far, after.far)
    np.testing.assert_array_equal(same.target_steps, after.target_steps)
    assert same.error is after.error and same.missed is after.missed  # hundreds who only look on take no memory
    assert same.holdings.content == 0


def test_whoever_says_to_have_everything_is_told_that_nothing_is_left(scan: Scan) -> None:
    state = restated(build_first_view(scan, "htj2k", 32768).state, level=0)
    update = plan_look(scan, state, Look(1, 0.5, 0.5, parameters=LookParameters(RangeParameters(1, 1))))
    assert update.coded == ()
    assert update.error_max_mm == 0


def test_what_is_held_in_a_way_unknown_to_us_is_sent_again_where_it_matters(scan: Scan) -> None:
    first = build_first_view(scan, "htj2k", 32768).state
    state = restated(first, level=2, rank=65535 - 9)
    np.testing.assert_array_equal(state.error, first.error)
    region = region_round(0.5, 0.5, 1.0, scan.spec.width, scan.spec.height)
    assert (state.cells_beyond(10, region) == 64).any()


def test_cells_beyond_are_counted_as_they_are(scan: Scan) -> None:
    first = build_first_view(scan, "htj2k", 32768).state
    look = Look(1, 0.52, 0.47, range_mm=0.02, parameters=LookParameters(RangeParameters(4, 9)))
    update = plan_look(scan, first, look).settled()
    (coded,) = update.coded
    region = region_round(0.5, 0.5, 0.02, scan.spec.width, scan.spec.height)
    (part,) = coded.parts
    patch, selection = part.range_steps, part.selection
    dense = np.array(scan.range_steps)
    paste(dense, patch, selection)
    far = np.abs(dense.astype(int) - scan.range_steps) > 0.02 / scan.spec.step_mm
    counted = update.state.cells_beyond(0.02 / scan.spec.step_mm, region)
    assert counted.sum() == far[region.rows][:, region.columns].sum()
    assert counted.any()
