"""Sweeps whose range and texture come in turns of their own, by a capture thread on a pseudo terminal."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from drivers.scanner import SweepEvent, SweepFinished, SweepInterrupted, SweepProgress, SweepStarted
from node.capture import Manner
from node.journal import Journals
from node.resume import publish_complete
from node.turns import TurnStarted, as_of_sweep, as_of_turn
from protocol.errors import LibraryError, ScannerFault
from protocol.grid import Grid
from protocol.scanner_messages import Channel, RangeColumn, SweepHeader, SweepRequest, TextureColumn
from simulators.scanner import APART, TOGETHER, SimulatedScanner
from tests.node.capturing import SPEC, WAIT_S, Node, Plug, device, is_truth

RANGE_SHARE = SPEC.width / (SPEC.width + SPEC.texture_width)
IN_RANGE, IN_TEXTURE = 0.5 * RANGE_SHARE, 0.5 + 0.5 * RANGE_SHARE


def one_camera(**kinds: Any) -> SimulatedScanner:
    """A scanner that takes range in the dark and texture by light, and has turned on between the two."""
    return device(channels=APART, **kinds)


def heard(node: Node) -> Iterator[SweepEvent]:
    """What was told and not looked at yet."""
    while not node.events.empty():
        yield node.events.get()


@pytest.mark.parametrize("request_", [SweepRequest(), SweepRequest(overlap=64), SweepRequest(passes=2, stride=4)])
def test_two_turns_are_one_sweep_for_whoever_watches(plug: Plug, node: Node, request_: SweepRequest) -> None:
    node.capture.sweep_like(Manner(request_))
    plug.plug(one_camera())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    events = list(heard(node))
    (started,) = [event.header for event in events if isinstance(event, SweepStarted)]
    (finished,) = [event.report for event in events if isinstance(event, SweepFinished)]
    shares = [event.share for event in events if isinstance(event, SweepProgress)]
    columns = [event for event in events if isinstance(event, RangeColumn | TextureColumn)]
    assert started.channels is Channel.BOTH and started.passes == request_.passes
    assert shares == sorted(shares) and {column.sweep for column in columns} == {started.sweep}
    assert finished.received == finished.expected == len(columns) == sum(
        sum(started.columns_in(channel)) for channel in (Channel.RANGE, Channel.TEXTURE)
    )
    assert node.sweeps.interrupted() == [] and node.qualities[0].passes == request_.passes


@pytest.mark.parametrize("share", [IN_RANGE, IN_TEXTURE])
def test_a_cut_in_either_turn_is_gone_on_with_by_itself(plug: Plug, node: Node, share: float) -> None:
    scanner = one_camera(turn_s=0.5)
    plug.plug(scanner)
    node.sweep_until_columns(share)
    plug.pull()
    node.wait_until("connecting", "tty")
    (sweep,) = node.sweeps.interrupted()
    assert sweep.turn is not None and sweep.turn.header.channels is APART[share > RANGE_SHARE]
    node.wait_for(SweepInterrupted)
    plug.plug(scanner)
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    assert node.sweeps.interrupted() == []
    resumed = [event for event in heard(node) if isinstance(event, RangeColumn | TextureColumn)]
    assert len(resumed) == SPEC.width + SPEC.texture_width  # those that were kept are shown again


@pytest.mark.parametrize("share", [IN_RANGE, IN_TEXTURE])
def test_a_node_that_starts_anew_goes_on_in_the_turn_that_was_cut(
    plug: Plug, node: Node, tmp_path: Path, share: float
) -> None:
    scanner = one_camera(turn_s=0.5)
    plug.plug(scanner)
    node.sweep_until_columns(share)
    plug.pull()
    node.wait_until("connecting", "tty")
    node.capture.stop()
    again = Node(tmp_path / "tty", tmp_path / "sweeps")
    again.capture.start()
    plug.plug(scanner)
    assert is_truth(again.grids.get(timeout=WAIT_S))
    again.capture.stop()


@pytest.mark.parametrize("share", [IN_RANGE, IN_TEXTURE])
def test_a_scanner_that_was_restarted_goes_on_when_asked(plug: Plug, node: Node, share: float) -> None:
    sweep_id = cut(plug, node, share, one_camera(boot_id=2, home_encoder=12345))
    held = node.sweeps.get(sweep_id).held
    assert node.capture.request_resume(sweep_id)
    assert is_truth(node.grids.get(timeout=WAIT_S))
    node.wait_until("ready")
    finished = node.wait_for(SweepFinished).report
    assert finished.received == finished.expected > held and node.sweeps.interrupted() == []


@pytest.mark.parametrize(
    ("kinds", "why"),
    [
        ({"boot_id": 2, "calibration": 77}, "calibrated anew"),
        ({"serial_number": "SIM-2"}, "begun by scanner SIM-0001"),
    ],
)
def test_a_scanner_that_is_not_the_same_is_refused(plug: Plug, node: Node, kinds: dict[str, Any], why: str) -> None:
    sweep_id = cut(plug, node, IN_TEXTURE, one_camera(**kinds))
    before = node.sweeps.get(sweep_id)
    assert node.capture.request_resume(sweep_id)
    node.wait_until("ready", why)
    assert node.sweeps.get(sweep_id).held == before.held and node.grids.empty()


def test_turns_apart_are_refused_clearly_by_a_scanner_that_takes_both_at_once(plug: Plug, node: Node) -> None:
    node.capture.sweep_like(Manner(apart=True))
    plug.plug(device(channels=TOGETHER))
    node.wait_until("ready")
    assert node.capture.request_sweep()
    node.wait_until("ready", "takes no turn of range or texture alone: set capture.apart = false")
    assert node.sweeps.interrupted() == []
    node.capture.sweep_like(Manner())
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_a_scanner_that_takes_either_turns_twice_where_that_is_wanted(plug: Plug, node: Node) -> None:
    node.capture.sweep_like(Manner(apart=True))
    scanner = device()
    plug.plug(scanner)
    node.wait_until("ready")
    assert node.capture.request_sweep()
    assert is_truth(node.grids.get(timeout=WAIT_S))
    channels = [column.CHANNEL for column in heard(node) if isinstance(column, RangeColumn | TextureColumn)]
    assert channels == SPEC.width * [Channel.RANGE] + SPEC.texture_width * [Channel.TEXTURE]


def test_a_complete_one_whose_grid_was_not_taken_is_published_later(plug: Plug, node: Node, tmp_path: Path) -> None:
    def full(grid: Grid) -> None:
        raise LibraryError("the disk is full")

    node.deliver = full
    plug.plug(one_camera())
    node.wait_until("ready")
    assert node.capture.request_sweep()
    node.wait_until("ready", "the disk is full")
    node.capture.stop()
    sweeps = Journals(tmp_path / "sweeps")
    (sweep,) = sweeps.interrupted()
    assert sweep.is_complete
    node.deliver = node.grids.put
    assert publish_complete(sweeps, node.take)[0].startswith("published sweep")
    assert is_truth(node.grids.get(timeout=WAIT_S))


def test_a_column_beyond_what_an_encoder_counts_is_the_scanner_s_fault() -> None:
    whole = SweepHeader(1, SPEC, 65536, 100, 100, encoder_start=2**31 - 70000)
    turn = TurnStarted(SweepHeader(2, SPEC, 65536, 100, 100, channels=Channel.RANGE), 1)
    column = RangeColumn(2, 0, 3, 0, 500, 0, b"xx")
    near = replace(turn, header=replace(turn.header, encoder_start=2**18))
    assert as_of_turn(as_of_sweep(column, near, whole), near, whole) == column
    with pytest.raises(ScannerFault, match="further than an encoder counts"):
        as_of_sweep(column, turn, whole)


def cut(plug: Plug, node: Node, share: float, scanner: SimulatedScanner) -> str:
    """A sweep that was interrupted by a pulled plug in one of its turns, and another scanner in its place."""
    plug.plug(one_camera(turn_s=0.5))
    node.sweep_until_columns(share)
    plug.pull()
    node.wait_for(SweepInterrupted)
    plug.plug(scanner)
    node.wait_until("ready")
    (sweep,) = node.sweeps.interrupted()
    return sweep.id
