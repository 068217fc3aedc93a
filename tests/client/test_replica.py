from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from client.replica import STATEMENTS_MAX, Replica
from protocol.errors import RemoteWireError
from protocol.holdings import ChannelHoldings
from protocol.lattice import Channel, Parameters
from protocol.messages import State, Updated
from tests.client.scripted_node import WINDOW, Planner, synthetic_grid, updated

GRID = synthetic_grid()
ELSEWHERE = Parameters(2, 8, 5, 2, 2)


def opened() -> tuple[Planner, Replica]:
    planner = Planner(GRID)
    replica = Replica(planner.opened(7))
    for refinement in planner.first_view():
        replica.apply(refinement)
    return planner, replica


def go_on_from(planner: Planner, said: State) -> None:
    """What a node does with a statement: take the client's word, its number included."""
    planner.seq = said.next_seq
    for channel, runs in ((Channel.RANGE, said.holdings.range), (Channel.TEXTURE, said.holdings.texture)):
        planner.holdings.channels[channel] = ChannelHoldings.from_runs(planner.shapes[channel], runs)
    planner.holdings.content = 0


def test_an_acknowledgement_names_the_next_number_and_the_nodes_own_digest() -> None:
    planner, replica = opened()
    replica.apply(planner.range_fovea())
    ack = replica.acknowledge()
    assert (ack.epoch, ack.next_seq, ack.digest) == (planner.epoch, 3, planner.holdings.digest())
    assert ack.apply_ms > 0


def test_apply_time_is_reported_once() -> None:
    _, replica = opened()
    assert replica.acknowledge().apply_ms > 0
    assert replica.acknowledge().apply_ms == 0


def test_a_skipped_number_is_not_applied_and_objected_to_once() -> None:
    planner, replica = opened()
    planner.range_fovea()  # lost on its way
    before = replica.model.range_steps.copy()
    assert replica.apply(planner.range_fovea(ELSEWHERE)) is None
    assert np.array_equal(replica.model.range_steps, before)
    said = replica.object()
    assert said is not None and said.next_seq == 2
    assert replica.apply(planner.texture_fovea()) is None
    assert replica.object() is None
    assert replica.missing(updated(planner, 8)) == 3


def test_after_a_statement_both_ends_go_on_and_agree() -> None:
    planner, replica = opened()
    replica.apply(planner.range_fovea())
    planner.range_fovea(ELSEWHERE)  # lost on its way
    assert replica.apply(planner.texture_fovea()) is None
    go_on_from(planner, replica.state())
    assert replica.apply(planner.range_fovea(ELSEWHERE)) is not None
    assert replica.apply(planner.texture_fovea()) is not None
    assert replica.acknowledge().digest == planner.holdings.digest()
    assert np.array_equal(replica.model.range_steps[40:56, 64:80], GRID.range_steps[40:56, 64:80])


def test_a_refinement_planned_over_other_holdings_is_objected_to() -> None:
    planner, replica = opened()
    fovea = planner.range_fovea()
    assert replica.apply(replace(fovea, samples=fovea.samples - 1)) is None
    said = replica.object()
    assert said is not None and said.next_seq == 2


def test_an_applied_refinement_makes_room_for_a_new_objection() -> None:
    planner, replica = opened()
    replica.state()
    replica.apply(planner.range_fovea())
    planner.texture_fovea()  # lost on its way
    assert replica.apply(planner.range_fovea(ELSEWHERE)) is None
    assert replica.object() is not None


def test_endless_disagreement_is_the_nodes_fault() -> None:
    _, replica = opened()
    for _ in range(STATEMENTS_MAX):
        replica.state()
    with pytest.raises(RemoteWireError, match="no agreement"):
        replica.state()


def test_a_repeated_number_is_the_nodes_fault() -> None:
    planner, replica = opened()
    fovea = planner.range_fovea()
    replica.apply(fovea)
    with pytest.raises(RemoteWireError, match="refinement 2 of epoch 1 when 3"):
        replica.apply(fovea)


def test_another_epoch_is_the_nodes_fault() -> None:
    planner, replica = opened()
    with pytest.raises(RemoteWireError, match="epoch 2 when 2 of epoch 1"):
        replica.apply(replace(planner.range_fovea(WINDOW), epoch=2))


def test_fewer_refinements_announced_than_arrived_is_the_nodes_fault() -> None:
    planner, replica = opened()
    replica.apply(planner.range_fovea())
    with pytest.raises(RemoteWireError, match="2 refinements announced when 3"):
        replica.missing(Updated(8, 2, "complete"))
