"""Regions of a click, and the blocks that they touch."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from protocol.region import blocks_touched


@given(st.data())
def test_a_run_touches_the_blocks_that_its_columns_lie_in(data: st.DataObject) -> None:
    turn, side = data.draw(st.integers(1, 200)), data.draw(st.sampled_from([8, 16, 32]))
    left, width = data.draw(st.integers(-turn, 2 * turn)), data.draw(st.integers(1, turn))
    ((first,), (wide,)) = blocks_touched(np.array([left]), np.array([width]), side, turn)
    columns = -(-turn // side)
    touched = {column % turn // side for column in range(left, left + width)}
    assert {(first + step) % columns for step in range(wide)} == touched and wide == len(touched)
    assert first == 0 or wide < columns  # all round has no beginning
