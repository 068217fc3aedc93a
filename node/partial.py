"""What there is of an interrupted sweep, as a file that nobody can take for a scan.

An .npz whose keys are not those of a grid: partial_range_steps (H, W) uint16 and partial_texture (Ht, Wt, 3) uint8,
0 where nothing came; range_column_is_whole (W,) and texture_column_is_whole (Wt,) bool; step_mm, pitch_mm, z_max_mm,
theta0_rad; is_complete False; note. Columns stand at their nominal angles, and where several passes came, the last.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import BinaryIO

import numpy as np

from node.journal import Interrupted
from protocol.grid import BoolArray, ImageArray, StepArray
from protocol.scanner_messages import Column, RangeColumn

NOTE = "interrupted sweep, not a scan: {held} of {expected} pieces of columns; {why}"


def write_partial(sweep: Interrupted, columns: Iterable[Column], file: BinaryIO) -> None:
    """Write the columns of an interrupted sweep. columns : each piece once (Journals.columns). Raises OSError."""
    s = sweep.header.spec
    range_steps = np.zeros((s.width, s.height), np.uint16)
    texture = np.zeros((s.texture_width, s.texture_height, 3), np.uint8)
    range_came, texture_came = np.zeros(range_steps.shape, np.bool_), np.zeros(texture.shape[:2], np.bool_)
    for column in columns:
        if isinstance(column, RangeColumn):
            _place(column, range_steps, range_came)
        else:
            _place(column, texture, texture_came)
    np.savez(
        file,
        partial_range_steps=range_steps.T,
        partial_texture=texture.transpose(1, 0, 2),
        range_column_is_whole=range_came.all(axis=1),
        texture_column_is_whole=texture_came.all(axis=1),
        step_mm=np.float64(s.step_mm),
        pitch_mm=np.float64(s.pitch_mm),
        z_max_mm=np.float64(s.z_max_mm),
        theta0_rad=np.float64(s.theta0_rad),
        is_complete=np.False_,
        note=np.str_(NOTE.format(held=sweep.held, expected=sweep.expected, why=sweep.why)),
    )


def _place(column: Column, samples: StepArray | ImageArray, came: BoolArray) -> None:
    rows = slice(column.row0, column.row0 + column.rows)
    samples[column.column, rows] = column.samples
    came[column.column, rows] = True
