import numpy as np
import pytest

from node.repair import fill, repair, small_holes, spikes_in, undone
from protocol.grid import Grid, GridSpec, StepArray

SPEC = GridSpec(width=64, height=32, texture_width=64, texture_height=32, step_mm=0.01, pitch_mm=1.0)


def _bumpy() -> StepArray:
    u = np.arange(SPEC.width) / SPEC.width
    shape = 5000 + 500 * np.sin(2 * np.pi * 2 * u) + 10 * np.arange(SPEC.height)[:, None]
    return np.rint(shape).astype(np.uint16)


def _grid(steps: StepArray) -> Grid:
    return Grid(SPEC, steps, np.zeros((SPEC.texture_height, SPEC.texture_width, 3), np.uint8))


def test_a_sound_grid_stays_as_it_is() -> None:
    steps = _bumpy()
    steps[:4] = steps[10:20, 60:] = 0  # large voids are not holes to be filled
    grid = _grid(steps)
    repaired = repair(grid)
    assert repaired.grid is grid and (repaired.spikes, repaired.filled) == (0, 0)
    assert not grid.repairs.size and not grid.filled.any()


@pytest.mark.parametrize("row, column", [(0, 0), (31, 63), (15, 63), (15, 0), (12, 30)])
@pytest.mark.parametrize("height", [-3000, 3000])
def test_a_spike_is_taken_out_and_its_place_filled_and_marked(row: int, column: int, height: int) -> None:
    sound, steps = _bumpy(), _bumpy()
    steps[row, column] = int(steps[row, column]) + height
    repaired = repair(_grid(steps))
    assert (repaired.spikes, repaired.filled) == (1, 1)
    assert np.argwhere(repaired.grid.filled).tolist() == [[row, column]]
    assert repaired.grid.repairs.tolist() == [[row, column, steps[row, column]]]
    error = repaired.grid.range_steps.astype(int) - sound
    assert np.abs(error).max() < 60 and np.count_nonzero(error) <= 1


def test_a_ridge_and_a_step_are_no_spikes() -> None:
    steps = _bumpy()
    steps[:, 20] += 2000
    steps[:, 40:] += 3000
    assert not spikes_in(steps, 300).any()


def test_a_lone_sample_in_the_void_is_no_spike() -> None:
    steps = np.zeros_like(_bumpy())
    steps[5, 5] = 4000
    assert not spikes_in(steps, 300).any()


@pytest.mark.parametrize("cells", [[(5, 5)], [(5, 5), (6, 6)], [(5, 63), (5, 0), (6, 0)], [(0, 0), (0, 1), (1, 0)]])
def test_holes_of_up_to_three_cells_are_filled(cells: list[tuple[int, int]]) -> None:
    steps = _bumpy()
    for cell in cells:
        steps[cell] = 0
    repaired = repair(_grid(steps))
    assert {tuple(cell) for cell in np.argwhere(repaired.grid.filled).tolist()} == set(cells)
    assert np.abs(repaired.grid.range_steps.astype(int) - _bumpy()).max() < 80


def test_a_spike_at_the_edge_of_a_large_void_becomes_void_and_is_told() -> None:
    steps = _bumpy()
    steps[10:20, 30:40] = 0
    steps[10, 29] += 3000
    repaired = repair(_grid(steps))
    assert repaired.grid.repairs.tolist() == [[10, 29, int(steps[10, 29])]]
    assert repaired.grid.range_steps[10, 29] == 0 and not repaired.grid.filled.any()


def test_what_was_measured_can_be_had_again() -> None:
    rng = np.random.default_rng(7)
    steps = _bumpy()
    steps[rng.random(steps.shape) < 0.02] = 0
    steps[rng.random(steps.shape) < 0.01] += 3000
    repaired = repair(_grid(steps))
    assert repaired.spikes > 3 and repaired.filled > 20
    np.testing.assert_array_equal(undone(repaired.grid).range_steps, steps)
    again = repair(undone(repaired.grid)).grid
    np.testing.assert_array_equal(again.range_steps, repaired.grid.range_steps)
    np.testing.assert_array_equal(again.repairs, repaired.grid.repairs)


def test_a_hole_of_four_cells_stays_void() -> None:
    void = np.zeros((32, 64), np.bool_)
    void[5, 62:] = void[5, :2] = True
    assert not small_holes(void).any()


def test_a_hole_with_nothing_measured_round_it_stays_void() -> None:
    steps = np.zeros((3, 3), np.uint16)
    cells, values = fill(steps, np.array([[1, 1]]))
    assert cells.shape == (0, 2) and values.shape == (0,)
