"""The device spoken to byte by byte, by the host's end of the link; time is a number."""

from typing import TypeVar

import numpy as np
import pytest

from protocol.grid import Grid, GridSpec
from protocol.scanner_link import Accepted, Command, Event, HostCommand, Refused, Role, ScannerLink, Sent
from protocol.scanner_messages import (
    Calibrate,
    Calibration,
    Channel,
    ColumnRun,
    ColumnsGone,
    NakCode,
    Outcome,
    RangeColumn,
    RequestColumns,
    Reset,
    State,
    Status,
    SweepEnd,
    SweepHeader,
    SweepRequest,
    SweepStart,
    SweepStop,
    TextureColumn,
)
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable

W, H, WT, HT = 16, 600, 32, 400
Heard = Event | Sent
T = TypeVar("T")


class Node:
    """A node that accepts everything and remembers what it was told."""

    def __init__(
        self,
        *,
        window_bytes: int = 65536,
        turn_s: float = 1.0,
        retention_columns: int = 65535,
        calibration: int = 1,
    ) -> None:
        rng = np.random.default_rng(5)
        steps, texture = rng.integers(0, 60000, (H, W)), rng.integers(0, 256, (HT, WT, 3))
        grid = Grid(GridSpec(W, H, WT, HT, 0.01, 1.0), steps.astype(np.uint16), texture.astype(np.uint8))
        table = Turntable(Specimen("noise", grid), turn_s=turn_s)
        self.device = SimulatedScanner(table, retention_columns=retention_columns, calibration=calibration)
        self.now_s = 0.0
        self.listens = self.accepts = True
        self.greet(7, window_bytes)

    def greet(self, session: int, window_bytes: int = 65536) -> None:
        self.link = ScannerLink(Role.HOST, session=session, window_bytes=window_bytes)
        self.heard: list[Heard] = []
        self.link.greet()
        self.run(0.02)

    def run(self, for_s: float, step_s: float = 0.01) -> None:
        """Let the time pass, and listen."""
        until_s = self.now_s + for_s
        while self.now_s < until_s:
            self.now_s += step_s
            self.link.tick(self.now_s)
            self.device.receive_data(self.link.data_to_send(), self.now_s)
            self.device.step(self.now_s)
            self.link.receive_data(self.device.data_to_send(65536), self.now_s)
            while self.listens and (event := self.link.next_event()) is not None:
                if isinstance(event, Command) and self.accepts:
                    self.link.accept(event)
                self.heard.append(event.message if isinstance(event, Command) else event)

    def say(self, *messages: HostCommand, for_s: float = 0.05) -> list[Heard]:
        """Send commands. Returns what was heard in answer."""
        before = len(self.heard)
        for message in messages:
            self.link.send(message)
        self.run(for_s)
        return self.heard[before:]

    def sweep(self, for_s: float = 2.0) -> list[Heard]:
        return self.say(Reset(), SweepRequest(), SweepStart(1), for_s=for_s)

    def kinds(self, kind: type[T]) -> list[T]:
        return [event for event in self.heard if isinstance(event, kind)]


def code_of(heard: list[Heard]) -> NakCode:
    (refused,) = [event for event in heard if isinstance(event, Refused)]
    return refused.code


def test_a_sweep_is_header_then_columns_then_end() -> None:
    node = Node()
    heard = [type(event) for event in node.sweep() if not isinstance(event, Accepted | Status)]
    assert heard[0] is SweepHeader and heard[-1] is SweepEnd
    assert heard.count(RangeColumn) == 2 * W and heard.count(TextureColumn) == 2 * WT
    (end,) = node.kinds(SweepEnd)
    assert (end.outcome, end.pieces) == (Outcome.COMPLETE, 2 * (W + WT))
    assert node.device.state is State.HOLDING


def test_pieces_put_together_are_the_truth() -> None:
    node = Node()
    node.sweep()
    truth = node.device._table.specimen.grid
    rebuilt = np.zeros_like(truth.texture)
    for piece in node.kinds(TextureColumn):
        rebuilt[piece.row0 : piece.row0 + piece.rows, piece.column] = piece.samples
    np.testing.assert_array_equal(rebuilt, truth.texture)


def test_no_column_leaves_before_the_header_is_acknowledged() -> None:
    node = Node()
    node.accepts = False
    node.sweep()
    assert len(node.kinds(SweepHeader)) == 1
    assert not node.kinds(RangeColumn) and not node.kinds(TextureColumn)


def test_the_table_stops_without_credit_and_asks_for_more() -> None:
    node = Node(window_bytes=4096)
    node.sweep(for_s=0.03)
    node.listens = False  # takes nothing, so gives no credit
    node.run(3.0)
    encoder, sent_bytes = node.device._table.encoder, node.device._link.sent_bytes
    assert sent_bytes <= node.link._credit_bytes
    node.run(3.0)
    assert node.device._table.encoder == encoder
    node.listens = True
    node.run(3.0)
    assert any(status.out_of_credit for status in node.kinds(Status))
    assert node.kinds(SweepEnd)[-1].pieces == 2 * (W + WT)


def test_columns_asked_for_again_are_the_same_and_the_end_is_said_again() -> None:
    node = Node()
    node.sweep()
    first = {(piece.column, piece.row0): piece for piece in node.kinds(RangeColumn)}
    heard = node.say(RequestColumns(1, (ColumnRun(Channel.RANGE, 0, 3, 2),)))
    again = [event for event in heard if isinstance(event, RangeColumn)]
    assert [(piece.column, piece.row0) for piece in again] == [(3, 0), (3, 502), (4, 0), (4, 502)]
    assert all(piece == first[piece.column, piece.row0] for piece in again)
    assert node.kinds(SweepEnd)[0] == node.kinds(SweepEnd)[1]


def test_columns_no_longer_held_are_said_to_be_gone() -> None:
    node = Node(retention_columns=5)
    node.sweep()
    heard = node.say(RequestColumns(1, (ColumnRun(Channel.RANGE, 0, 0, W),)))
    (gone,) = [event for event in heard if isinstance(event, ColumnsGone)]
    sent = {event.column for event in heard if isinstance(event, RangeColumn)}
    assert sent | {run.first for run in gone.runs} == set(range(W))
    assert 0 < len(sent) <= 5


def test_columns_not_seen_yet_are_neither_sent_nor_gone() -> None:
    node = Node(turn_s=100.0)
    node.sweep(for_s=0.2)
    heard = node.say(RequestColumns(1, (ColumnRun(Channel.RANGE, 0, W - 1, 1),)))
    assert {type(event) for event in heard} <= {Accepted, Status}


def test_status_comes_while_it_sweeps_and_not_when_idle() -> None:
    node = Node(turn_s=4.0)
    node.sweep(for_s=3.9)
    assert len(node.kinds(Status)) >= 6
    assert {status.state for status in node.kinds(Status)} == {State.SWEEPING}
    node.say(Reset())
    before = len(node.heard)
    node.run(5.0)
    assert len(node.heard) == before


def test_stop_ends_the_sweep_at_once() -> None:
    node = Node(turn_s=100.0)
    node.sweep(for_s=0.5)
    heard = node.say(SweepStop(1))
    assert [event.outcome for event in heard if isinstance(event, SweepEnd)] == [Outcome.STOPPED]
    assert not node.device._table.is_moving


def test_reset_drops_everything() -> None:
    node = Node(turn_s=100.0)
    node.sweep(for_s=0.5)
    node.say(Reset())
    assert node.device.state is State.IDLE
    assert code_of(node.say(SweepStart(2))) is NakCode.NOT_NOW
    assert code_of(node.say(RequestColumns(1, (ColumnRun(Channel.RANGE, 0, 0, 1),)))) is NakCode.NOT_NOW


def test_calibrate_turns_home_and_reports() -> None:
    node = Node(calibration=42)
    node.sweep(for_s=0.4)
    node.say(Reset())
    assert code_of(node.say(Calibrate(), SweepStart(1), for_s=0.03)) is NakCode.BUSY
    node.run(2.0)
    assert node.kinds(Calibration) == [Calibration(42, 0)]
    assert node.device._table.encoder == 0


@pytest.mark.parametrize(
    ("message", "code"),
    [
        (SweepStart(1), NakCode.NOT_NOW),
        (SweepStop(1), NakCode.NOT_NOW),
        (SweepRequest(height=H + 1), NakCode.UNSUPPORTED),
        (SweepRequest(texture_width=WT - 1), NakCode.UNSUPPORTED),
    ],
)
def test_an_idle_scanner_refuses_what_makes_no_sense(message: HostCommand, code: NakCode) -> None:
    assert code_of(Node().say(message)) is code


@pytest.mark.parametrize("message", [SweepStart(2), SweepRequest(), Calibrate()])
def test_a_sweeping_scanner_is_busy(message: HostCommand) -> None:
    node = Node(turn_s=100.0)
    node.sweep(for_s=0.1)
    assert code_of(node.say(message)) is NakCode.BUSY


def test_a_sweep_outlives_the_session_and_its_columns_can_be_asked_for() -> None:
    node = Node()
    node.sweep()
    node.greet(8)
    heard = node.say(RequestColumns(1, (ColumnRun(Channel.TEXTURE, 0, 0, WT),)), for_s=0.5)
    assert len([event for event in heard if isinstance(event, TextureColumn)]) == 2 * WT
    assert any(isinstance(event, SweepEnd) for event in heard)


def test_a_header_lost_with_its_session_is_said_again() -> None:
    node = Node()
    node.accepts = False
    node.sweep(for_s=0.1)
    node.accepts = True
    node.greet(8)
    node.run(2.0)
    assert len(node.kinds(SweepHeader)) == 1
    assert node.kinds(SweepEnd)
