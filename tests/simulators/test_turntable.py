import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.grid import Grid, GridSpec
from protocol.scanner_messages import Channel
from simulators.specimen import Specimen
from simulators.turntable import Exposure, Turntable

W, H, WT, HT = 24, 5, 30, 4
ROOMY = 10**6


def specimen(width: int = W, texture_width: int = WT) -> Specimen:
    rng = np.random.default_rng(5)
    steps = rng.integers(0, 60000, (H, width)).astype(np.uint16)
    texture = rng.integers(0, 256, (HT, texture_width, 3)).astype(np.uint8)
    return Specimen("noise", Grid(GridSpec(width, H, texture_width, HT, 0.01, 1.0, theta0_rad=1.1), steps, texture))


def sweep(table: Turntable, *, passes: int = 1, dt_s: float = 0.01) -> list[Exposure]:
    table.begin(Channel.BOTH, passes)
    seen = []
    while table.is_moving:
        seen += table.step(dt_s, ROOMY)
    return seen


@pytest.mark.parametrize(
    ("width", "texture_width"), [(W, WT), (360, 1024), (1440, 4096), (4096, 8192), (7, 13), (1, 1)]
)
def test_a_steady_table_shows_the_truth_at_every_column(width: int, texture_width: int) -> None:
    table = Turntable(specimen(width, texture_width))
    seen = sweep(table)
    truth = table.specimen.grid
    assert len(seen) == width + texture_width
    for exposure in seen:
        array = truth.range_steps if exposure.channel is Channel.RANGE else truth.texture
        np.testing.assert_array_equal(table.samples(exposure), array[:, exposure.column])


def test_columns_come_in_the_order_of_their_angle() -> None:
    seen = sweep(Turntable(specimen()), passes=2)
    encoders = [exposure.encoder for exposure in seen]
    assert encoders == sorted(encoders)
    names = [(e.pass_index, e.column) for e in seen if e.channel is Channel.RANGE]
    assert names == [(pass_index, column) for pass_index in range(2) for column in range(W)]


@given(st.lists(st.floats(1e-4, 0.4), min_size=1, max_size=20), st.integers(1, 20))
def test_the_same_turn_whatever_the_steps(steps_s: list[float], room: int) -> None:
    whole = sweep(Turntable(specimen(), jitter_counts=300.0, seed=9), dt_s=9.0)
    table, seen = Turntable(specimen(), jitter_counts=300.0, seed=9), list[Exposure]()
    table.begin(Channel.BOTH, 1)
    while table.is_moving:
        for dt_s in steps_s:
            part = table.step(dt_s, room)
            assert len(part) <= room
            seen += part
    assert [(e.channel, e.column, e.encoder) for e in seen] == [(e.channel, e.column, e.encoder) for e in whole]


def test_a_table_without_room_stands_still_while_time_goes_on() -> None:
    table = Turntable(specimen())
    table.begin(Channel.BOTH, 1)
    (first,) = table.step(0.5, 1)
    stands_at = table.encoder
    assert table.step(5.0, 0) == [] and table.encoder == stands_at
    second = table.step(0.5, 1)[0]
    assert second.time_us - first.time_us > 5_000_000


def test_a_turn_takes_its_time() -> None:
    table = Turntable(specimen(), turn_s=4.0)
    seen = sweep(table)
    times_us = [exposure.time_us for exposure in seen]
    assert times_us == sorted(times_us)
    assert seen[-1].time_us - seen[0].time_us == pytest.approx(4e6, rel=0.1)


def test_jitter_moves_triggers_and_the_encoder_says_so() -> None:
    table = Turntable(specimen(), jitter_counts=200.0, seed=1)
    seen = [e for e in sweep(table) if e.channel is Channel.RANGE]
    nominal = (np.array([e.column for e in seen]) + 0.5) * table.counts_per_turn / W
    off = np.array([e.encoder for e in seen]) - nominal
    assert 100 < off.std() < 300
    for exposure in seen:
        angle_rad = 1.1 + 2 * np.pi * exposure.encoder / table.counts_per_turn
        np.testing.assert_array_equal(table.samples(exposure), table.specimen.range_column(angle_rad))


def test_the_seed_decides_the_jitter() -> None:
    encoders = [[e.encoder for e in sweep(Turntable(specimen(), jitter_counts=50.0, seed=seed))] for seed in (1, 1, 2)]
    assert encoders[0] == encoders[1] != encoders[2]


def test_wild_jitter_never_makes_columns_change_places() -> None:
    seen = sweep(Turntable(specimen(), jitter_counts=1e6))
    assert [e.column for e in seen if e.channel is Channel.TEXTURE] == list(range(WT))


def test_after_a_halt_the_next_sweep_begins_at_the_home_mark() -> None:
    table = Turntable(specimen(), home_encoder=700)
    table.begin(Channel.BOTH, 1)
    table.step(0.3, ROOMY)
    table.halt()
    assert not table.is_moving and table.step(1.0, ROOMY) == []
    again = sweep(table)
    assert len(again) == W + WT
    assert again[0].encoder > 700
    for exposure in again:
        if exposure.channel is Channel.RANGE:
            np.testing.assert_array_equal(table.samples(exposure), table.specimen.grid.range_steps[:, exposure.column])


def test_homing_goes_to_the_home_mark() -> None:
    table = Turntable(specimen(), home_encoder=700)
    table.begin(Channel.RANGE, 1)
    table.step(0.3, ROOMY)
    table.home()
    assert table.is_moving
    assert table.step(2.0, ROOMY) == []
    assert table.encoder == 700 and not table.is_moving


def test_more_turns_than_the_encoder_counts_are_refused() -> None:
    with pytest.raises(ValueError, match="overrun the encoder"):
        Turntable(specimen(16384, 16383)).begin(Channel.BOTH, 64)
