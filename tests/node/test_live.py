"""What streams see of a running sweep. The simulated scanner sweeps in a time of its own: no test here waits."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.scanner import Scanner, ScannerConfig, SweepInterrupted, SweepProgress, SweepReport, SweepStarted
from node.coarse import build_coarse
from node.live import COLUMNS_BYTES_MAX, TELL_S, Live, LiveSaid, Place
from protocol import messages as m
from protocol.grid import Grid, GridSpec, ImageArray, IntArray, StepArray
from protocol.lattice import Channel
from protocol.live import LiveColumns
from protocol.scanner_messages import RangeColumn, SweepHeader, SweepRequest, TextureColumn
from simulators.carriers import MemoryPort
from simulators.scanner import SimulatedScanner
from simulators.specimen import Specimen
from simulators.turntable import Turntable

SPEC = GridSpec(96, 600, 128, 400, 0.01, 1.0, theta0_rad=0.3)


def noise(spec: GridSpec = SPEC) -> Grid:
    rng = np.random.default_rng(5)
    steps = rng.integers(1, 60000, (spec.height, spec.width)).astype(np.uint16)
    return Grid(spec, steps, rng.integers(0, 256, (spec.texture_height, spec.texture_width, 3)).astype(np.uint8))


def centres(size: int, cells: int) -> IntArray:
    return (2 * np.arange(cells) + 1) * size // (2 * cells)


class Viewer:
    """A stream's end: it paints what it is told."""

    def __init__(self, live: Live) -> None:
        self.live, self.place = live, Place()
        self.said: list[LiveSaid] = []

    def look(self) -> list[LiveSaid]:
        new: list[LiveSaid] = []
        while some := self.live.next(self.place):
            new += some
        self.said += new
        for message in new:
            self._paint(message)
        return new

    def _paint(self, message: LiveSaid) -> None:
        if isinstance(message, m.LiveStarted):
            shapes = message.grid.shapes()
            range_shape, texture_shape = shapes[Channel.RANGE], shapes[Channel.TEXTURE]
            self.range: StepArray = np.zeros((range_shape.coarse_width, range_shape.coarse_height), np.uint16)
            self.texture: ImageArray = np.zeros((texture_shape.coarse_width, texture_shape.coarse_height, 3), np.uint8)
        elif isinstance(message, LiveColumns):
            (self.range if message.channel is Channel.RANGE else self.texture)[list(message.columns)] = message.samples

    def kinds(self) -> list[type]:
        return [type(message) for message in self.said]


def sweep(
    live: Live,
    grid: Grid,
    at_event: Callable[[int], object] = lambda count: None,
    passes: int = 1,
    jitter_counts: float = 0.0,
) -> None:
    """A whole sweep of the simulated scanner, as the capture thread would pass it on."""
    port = MemoryPort(SimulatedScanner(Turntable(Specimen("noise", grid), turn_s=1.0, jitter_counts=jitter_counts)))
    scanner = Scanner(port, ScannerConfig(progress_s=0.05), clock=port.clock)
    scanner.hello()
    for count, event in enumerate(scanner.sweep(SweepRequest(passes=passes))):
        live.watch(event)
        at_event(count)


def quiet() -> Live:
    return Live(lambda: None)


def test_a_viewer_from_the_start_sees_each_cells_centre_column() -> None:
    live, grid = quiet(), noise()
    viewer = Viewer(live)
    sweep(live, grid, lambda count: viewer.look())
    viewer.look()
    rows, columns = build_coarse(grid).range_steps.shape
    assert viewer.range.shape == (columns, rows)
    taken = grid.range_steps[centres(SPEC.height, rows)]
    near = [set(map(tuple, taken.T[[c - 1, c, (c + 1) % SPEC.width]])) for c in centres(SPEC.width, columns)]
    assert all(tuple(shown) in candidates for shown, candidates in zip(viewer.range, near, strict=True))
    assert (viewer.texture != 0).any(axis=(1, 2)).all()


@pytest.mark.parametrize("at", [0.0, 0.3, 0.9])
def test_a_late_viewer_sees_what_an_early_one_does(at: float) -> None:
    live, grid = quiet(), noise()
    early, late = Viewer(live), Viewer(live)
    total = SPEC.width * 2 + SPEC.texture_width * 2
    sweep(live, grid, lambda count: (early.look(), count < at * total or late.look()))
    early.look()
    late.look()
    assert np.array_equal(early.range, late.range) and np.array_equal(early.texture, late.texture)
    assert late.kinds()[0] is m.LiveStarted


def test_jitter_leaves_no_cell_empty() -> None:
    live = quiet()
    viewer = Viewer(live)
    sweep(live, noise(), jitter_counts=200.0)
    viewer.look()
    assert (viewer.range != 0).all()


def test_the_picture_has_the_first_views_shapes_and_size() -> None:
    spec = GridSpec(1440, 1024, 4096, 2048, 0.01, 0.2)
    live = quiet()
    live.watch(SweepStarted(SweepHeader(1, spec, 1 << 20, 400, 300)))
    started = live.next(Place())[0]
    assert isinstance(started, m.LiveStarted)
    coarse = build_coarse(noise(spec))
    assert (started.grid.coarse_height, started.grid.coarse_width) == coarse.range_steps.shape
    assert (started.grid.coarse_texture_height, started.grid.coarse_texture_width) == coarse.texture.shape[:2]
    assert started.grid.coarse_height * started.grid.coarse_width <= 8192
    assert started.grid.spec() == spec


def test_messages_stay_short_enough_for_a_click_to_overtake() -> None:
    live = quiet()
    grid = noise(GridSpec(1440, 256, 4096, 512, 0.01, 0.2))
    viewer = Viewer(live)
    sweep(live, grid)
    sizes = [len(said.to_bytes()) for said in viewer.look() if isinstance(said, LiveColumns)]
    assert len(sizes) > 2 and max(sizes) <= COLUMNS_BYTES_MAX + 2048


def header(spec: GridSpec = SPEC) -> SweepHeader:
    return SweepHeader(1, spec, 96 * 128, 600, 400)


def progress_of(live: Live, share: float) -> m.LiveProgress:
    place = Place()
    live.watch(SweepProgress(share, 0))
    said = [*live.next(place), *live.next(place)]
    assert isinstance(said[-1], m.LiveProgress)
    return said[-1]


def test_progress_in_percent_and_seconds_left() -> None:
    now = [100.0]
    live = Live(lambda: None, clock=lambda: now[0])
    live.watch(SweepStarted(header()))
    assert progress_of(live, 0.0) == m.LiveProgress(1, 0.0, None)
    now[0] += 3
    assert progress_of(live, 0.25) == m.LiveProgress(1, 25.0, 9.0)
    assert progress_of(live, 1.0) == m.LiveProgress(1, 100.0, 0.0)


def test_no_more_is_shown_than_is_there() -> None:
    live = quiet()
    live.watch(SweepStarted(header()))
    assert (progress_of(live, 566 / 1384).percent, progress_of(live, 1383 / 1384).percent) == (40.8, 99.9)


def test_what_was_kept_of_a_sweep_does_not_make_it_faster() -> None:
    now = [100.0]
    live = Live(lambda: None, clock=lambda: now[0])
    live.watch(SweepStarted(header()))
    progress_of(live, 0.5)
    now[0] += 3
    assert progress_of(live, 0.75) == m.LiveProgress(1, 75.0, 3.0)


def publish(live: Live) -> None:
    live.published("ab")


def interrupt(live: Live) -> None:
    live.watch(SweepInterrupted("x" * 900, None, SweepReport()))


ENDS = [(publish, m.LiveEnded(1, "published", "ab")), (interrupt, m.LiveEnded(1, "interrupted", why="x" * 200))]


@pytest.mark.parametrize(("end", "told"), ENDS)
def test_the_end_comes_last_and_once(end: Callable[[Live], None], told: m.LiveEnded) -> None:
    live = quiet()
    viewer = Viewer(live)
    sweep(live, noise(), lambda count: viewer.look() if count == 5 else None)
    end(live)
    viewer.look()
    assert viewer.said[-1] == told and viewer.kinds().count(m.LiveEnded) == 1
    assert (viewer.range != 0).all()  # what was in when it ended
    assert viewer.look() == live.next(Place()) == []  # nobody joins a sweep that is over


def test_a_viewer_that_missed_the_end_hears_it_before_the_next_start() -> None:
    live = quiet()
    viewer = Viewer(live)
    live.watch(SweepStarted(header()))
    viewer.look()
    interrupt(live)
    live.watch(SweepStarted(header()))
    viewer.look()
    assert viewer.kinds() == [m.LiveStarted, m.LiveProgress, m.LiveEnded, m.LiveStarted, m.LiveProgress]


def test_only_the_first_of_several_passes_is_shown() -> None:
    live = quiet()
    viewer = Viewer(live)
    sweep(live, noise(), passes=2)
    shown = [column for said in viewer.look() if isinstance(said, LiveColumns) for column in said.columns]
    assert len(shown) == 96 // 8 + 128 // 4


def piece(column: int, row0: int, samples: StepArray, encoder: int) -> RangeColumn:
    return RangeColumn(1, 0, column, row0, encoder, 0, samples.tobytes())


@given(st.permutations([(row0, column) for row0 in (0, 200, 400) for column in range(0, 96, 5)]))
def test_pieces_in_any_order_make_the_same_columns(order: list[tuple[int, int]]) -> None:
    live, steps = quiet(), noise().range_steps
    live.watch(SweepStarted(header()))
    viewer = Viewer(live)
    for row0, column in order:
        live.watch(piece(column, row0, steps[row0 : row0 + 200, column].astype("<u2"), 128 * column + 64))
    viewer.look()
    by_row = steps[centres(600, 75)]
    shown = {tuple(column) for column in viewer.range}
    assert shown <= {tuple(column) for column in by_row.T} | {(0,) * 75}


def test_streams_are_told_at_most_every_tenth_of_a_second() -> None:
    now, told = [0.0], list[float]()
    live = Live(lambda: told.append(now[0]), clock=lambda: now[0])
    sweep(live, noise(), lambda count: now.__setitem__(0, now[0] + 0.001))
    gaps = np.diff(told[1:])
    assert len(told) > 3 and (gaps > 0).all()
    texture = TextureColumn(1, 0, 2, 0, 2 * 96 + 48, 0, b"\0" * 1200)
    count = len(told)
    live.watch(SweepStarted(header()))
    live.watch(texture)
    assert len(told) == count + 1  # the start alone
    now[0] += TELL_S
    live.watch(texture)
    assert len(told) == count + 2
