import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from drivers.ledger import Ledger
from protocol.grid import GridSpec
from protocol.scanner_messages import RUNS_MAX, Channel, Column, ColumnRun, RangeColumn, SweepHeader, TextureColumn

W, H, WT, HT, ROWS = 16, 10, 32, 9, 4


def header(channels: Channel = Channel.BOTH, passes: int = 1, width: int = W) -> SweepHeader:
    return SweepHeader(3, GridSpec(width, H, WT, HT, 1, 1), 1000, ROWS, ROWS, channels, passes)


def piece(
    column: int,
    row0: int = 0,
    rows: int | None = None,
    channel: Channel = Channel.RANGE,
    sweep: int = 3,
    pass_index: int = 0,
) -> Column:
    cls: type[Column] = RangeColumn if channel is Channel.RANGE else TextureColumn
    height = H if channel is Channel.RANGE else HT
    rows = min(ROWS, height - row0) if rows is None else rows
    return cls(sweep, pass_index, column, row0, column, 0, bytes(rows * cls.SAMPLE_BYTES))


def column(index: int, channel: Channel = Channel.RANGE) -> list[Column]:
    return [piece(index, row0, channel=channel) for row0 in range(0, H if channel is Channel.RANGE else HT, ROWS)]


def columns_of(runs: tuple[ColumnRun, ...]) -> set[tuple[Channel, int, int]]:
    return {(run.channel, run.pass_index, run.first + i) for run in runs for i in range(run.count)}


def test_every_piece_counts_once() -> None:
    ledger = Ledger(header())
    assert ledger.expected == W * 3 + WT * 3
    assert ledger.take(piece(0)) and not ledger.take(piece(0))
    assert (ledger.held, ledger.duplicates, ledger.strays) == (1, 1, 0)


def test_what_lies_outside_the_announced_sweep_is_a_stray() -> None:
    ledger = Ledger(header(Channel.RANGE))
    for stray in (
        piece(W),
        piece(0, row0=12, rows=1),
        piece(0, row0=1),
        piece(0, row0=8, rows=3),
        piece(0, rows=3),
        piece(0, sweep=2),
        piece(0, pass_index=1),
        piece(0, channel=Channel.TEXTURE),
    ):
        assert not ledger.take(stray)
    assert (ledger.held, ledger.strays) == (0, 8)


@given(st.sets(st.integers(0, W - 1)), st.sets(st.integers(0, WT - 1)))
def test_missing_names_exactly_the_incomplete_columns(range_lost: set[int], texture_lost: set[int]) -> None:
    ledger = Ledger(header())
    for index in range(W):
        for part in column(index)[: 2 if index in range_lost else 3]:
            ledger.take(part)
    for index in set(range(WT)) - texture_lost:
        for part in column(index, channel=Channel.TEXTURE):
            ledger.take(part)
    wanted = {(Channel.RANGE, 0, i) for i in range_lost} | {(Channel.TEXTURE, 0, i) for i in texture_lost}
    assert columns_of(ledger.missing()) == wanted


def test_one_request_carries_no_more_runs_than_fit() -> None:
    ledger = Ledger(header(Channel.RANGE, width=800))
    for index in range(0, 800, 2):
        for part in column(index):
            ledger.take(part)
    assert len(ledger.missing()) == RUNS_MAX


def test_columns_left_behind_are_named_once() -> None:
    ledger = Ledger(header(Channel.RANGE))
    for index in (0, 1, 5, 6, 7, 8):
        for part in column(index):
            ledger.take(part)
    assert ledger.left_behind() == (ColumnRun(Channel.RANGE, 0, 2, 3),)
    assert ledger.left_behind() == ()
    assert columns_of(ledger.missing()) > columns_of((ColumnRun(Channel.RANGE, 0, 2, 3),))


def test_columns_given_up_are_no_longer_asked_for_but_remain_lost() -> None:
    ledger = Ledger(header(Channel.RANGE))
    ledger.give_up((ColumnRun(Channel.RANGE, 0, 4, 2), ColumnRun(Channel.TEXTURE, 9, 0, 5)))
    assert ledger.lost_columns() == 2
    assert not columns_of(ledger.missing()) & {(Channel.RANGE, 0, 4), (Channel.RANGE, 0, 5)}
    for part in column(4):
        ledger.take(part)
    assert ledger.lost_columns() == 1


@given(st.permutations(range(W)), st.integers(1, 3))
def test_the_digest_knows_no_order(order: list[int], times: int) -> None:
    ahead, mixed = Ledger(header()), Ledger(header())
    for index in range(W):
        ahead.take(piece(index))
    for index in order:
        for _ in range(times):
            mixed.take(piece(index))
    assert ahead.digest == mixed.digest
    assert np.uint32(ahead.digest) == ahead.digest
