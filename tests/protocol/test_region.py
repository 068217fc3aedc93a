"""Regions of a click, and the blocks that they touch."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from protocol.region import Region, blocks_touched
from protocol.sphere import cap_region


@given(st.data())
def test_a_run_touches_the_blocks_that_its_columns_lie_in(data: st.DataObject) -> None:
    turn, side = data.draw(st.integers(1, 200)), data.draw(st.sampled_from([8, 16, 32]))
    left, width = data.draw(st.integers(-turn, 2 * turn)), data.draw(st.integers(1, turn))
    ((first,), (wide,)) = blocks_touched(np.array([left]), np.array([width]), side, turn)
    columns = -(-turn // side)
    touched = {column % turn // side for column in range(left, left + width)}
    assert {(first + step) % columns for step in range(wide)} == touched and wide == len(touched)
    assert first == 0 or wide < columns  # all round has no beginning


@given(st.data())
def test_blocks_count_the_samples_of_a_region_that_lie_in_them(data: st.DataObject) -> None:
    width, height = data.draw(st.integers(9, 200)), data.draw(st.integers(9, 100))
    side = data.draw(st.sampled_from([8, 16]))
    u, v, share = (data.draw(st.floats(0, 1, exclude_max=True)) for _ in range(3))
    wide, high = data.draw(st.integers(1, width)), data.draw(st.integers(1, height))
    left, top = data.draw(st.integers(-width, width)), data.draw(st.integers(0, height - high))
    for region in (Region(left, top, wide, high, width), cap_region(u, v, share, width, height)):
        left, top, columns, rows = region.blocks(side)
        counted = np.zeros((-(-height // side), -(-width // side)), np.int64)
        row, column = np.nonzero(region.inside(np.arange(height), range(width)))
        np.add.at(counted, (row // side, column // side), 1)
        around = counted[top : top + rows][:, np.arange(left, left + columns) % counted.shape[1]]
        assert np.array_equal(region.counts(side), around) and around.sum() == counted.sum()
        assert np.array_equal(region.touched(side), around > 0)
