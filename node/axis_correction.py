"""A grid measured about an axis that is off centre, laid anew about the true one.

Range: every sample goes where it is (node.axis), and the grid's own places are interpolated between neighbours, first
along each row, then, if the axis leans, along each column; both passes are whole-array work on bands that stay in the
cache. Where two surfaces meet in one place the outer one counts. What the sensor saw in one place and the grid has in
two stays void between them: a step in depth opens a gap that nobody measured, as wide as the offset makes it.

Texture goes with the range sample that it was seen with. That is right where both cameras look along one line, and
where the scanner itself lays one camera's pictures on the other's samples, as the link demands ("the same frame"). An
error of that would be no matter of the axis; a round body of one colour does not show it, and nothing here changes it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from node.axis import Axis, Lengths, seen_to_true, true_height, true_to_seen
from protocol.grid import STEPS_MAX, VOID, Grid, GridSpec, ImageArray, IntArray, StepArray

GAP = 2.0  # neighbours that come to lie further apart, in places of the grid, are none any longer
_BAND = 64
_BEYOND_RAD = math.pi / 2



def correct(grid: Grid, axis: Axis) -> None:
    """Lay a grid without repairs about the true axis, in place: its arrays are nobody else's yet."""
    correct_range(grid.range_steps, grid.spec, axis)
    correct_texture(grid.texture, grid.range_steps, grid.spec, axis)


def correct_range(steps: StepArray, spec: GridSpec, axis: Axis) -> None:
    """Lay range about the true axis, in place. steps : (H, W) uint16 as measured, 0 = void."""
    columns = np.arange(spec.width, dtype=np.float32)
    heights = spec.height_mm(np.arange(spec.height)).astype(np.float32)
    for start in range(0, spec.height, _BAND):
        rows = slice(start, start + _BAND)
        range_mm = steps[rows] * np.float32(spec.step_mm)
        radius_mm, ahead_rad, _ = seen_to_true(axis, range_mm, heights[rows, None])
        values = radius_mm / np.float32(spec.step_mm)
        values[(steps[rows] == VOID) | (np.abs(ahead_rad) >= _BEYOND_RAD)] = VOID
        at = columns + ahead_rad * np.float32(spec.width / (2 * np.pi))
        steps[rows] = laid_out(values, at, is_cyclic=True)
    if not axis.leans:
        return
    for start in range(0, spec.width, _BAND):
        part = slice(start, start + _BAND)
        values = np.ascontiguousarray(steps[:, part].T, np.float32)
        z_mm = true_height(axis, values * np.float32(spec.step_mm), heights)
        at = (np.float32(spec.z_max_mm) - z_mm) / np.float32(spec.pitch_mm) - np.float32(0.5)
        steps[:, part] = laid_out(values, at, is_cyclic=False).T


def laid_out(values: Lengths, at: Lengths, *, is_cyclic: bool) -> StepArray:
    """Samples that stand somewhere, at whole places: (n, L) uint16, linear between neighbours, 0 where there are none.

    values : (n, L) float32 steps, 0 = void.  at : (n, L) float32, the place of each, in samples.  is_cyclic : the last
    is the first one's neighbour. A sample without a neighbour on one side also counts at the place nearest to it.
    """
    n, length = values.shape
    after, after_at = np.roll(values, -1, axis=1), np.roll(at, -1, axis=1)
    after_at[:, -1] += length
    span = after_at - at
    joined = (values != VOID) & (after != VOID) & (span > 0) & (span < GAP)
    if not is_cyclic:
        joined[:, -1] = False
    out = np.zeros(n * length, np.uint16)
    first = np.ceil(at)
    for ahead in (0, 1):
        hit = np.flatnonzero(joined & (first + np.float32(ahead) <= after_at))
        place = first.ravel()[hit] + np.float32(ahead)
        share = (place - at.ravel()[hit]) / span.ravel()[hit]
        mixed = values.ravel()[hit] + share * (after.ravel()[hit] - values.ravel()[hit])
        _put(out, _index(hit, place, length, is_cyclic), mixed)
    alone = np.flatnonzero((values != VOID) & ~(joined & np.roll(joined, 1, axis=1)))
    index = _index(alone, np.rint(at.ravel()[alone]), length, is_cyclic)
    free = (index >= 0) & (out[index] == VOID)
    _put(out, index[free], values.ravel()[alone[free]])
    return out.reshape(n, length)


def _index(samples: IntArray, place: Lengths, length: int, is_cyclic: bool) -> IntArray:
    """Where places lie in the flat output, each in its sample's row; -1 for none."""
    columns = place.astype(np.int64)
    begin = samples - samples % length
    if is_cyclic:
        return begin + columns % length
    return np.where((0 <= columns) & (columns < length), begin + columns, -1)


def _put(out: StepArray, index: IntArray, values: Lengths) -> None:
    """Write values at places; of several at one, or where there is one already, the outermost stays."""
    rounded = np.rint(values)
    fits = (index >= 0) & (1 <= rounded) & (rounded <= STEPS_MAX)
    if not fits.all():
        index, rounded = index[fits], rounded[fits]
    steps = rounded.astype(np.uint16)
    while index.size:
        higher = steps > out[index]
        index, steps = index[higher], steps[higher]
        out[index] = steps  # of several in one place the last stays, until none is higher


def corrected_cells(
    cells: IntArray, values: StepArray, neighbours: StepArray, spec: GridSpec, axis: Axis
) -> tuple[IntArray, StepArray]:
    """Where single samples belong that were taken out of a grid, and their steps there.

    cells : (n, 2) rows and columns.  values : (n,) their steps.  neighbours : (n,) steps of the surface round them,
    which decide where the grid has their cell. Returns the same of those that the grid has, row by row, each cell once.
    """
    heights_mm = spec.height_mm(cells[:, 0])
    step_mm = spec.step_mm
    _, ahead_rad, z_mm = seen_to_true(axis, neighbours * step_mm, heights_mm)
    radius_mm, _, _ = seen_to_true(axis, values * step_mm, heights_mm)
    columns = np.rint(cells[:, 1] + ahead_rad * spec.width / (2 * np.pi)).astype(np.int64) % spec.width
    rows = np.rint((spec.z_max_mm - z_mm) / spec.pitch_mm - 0.5).astype(np.int64)
    kept = (0 <= rows) & (rows < spec.height)
    flat, first = np.unique(rows[kept] * spec.width + columns[kept], return_index=True)
    steps = np.clip(np.rint(radius_mm[kept][first] / step_mm), 1, STEPS_MAX).astype(np.uint16)
    return np.stack(np.divmod(flat, spec.width), axis=1), steps


def correct_texture(texture: ImageArray, steps: StepArray, spec: GridSpec, axis: Axis) -> None:
    """Lay texels where the range samples are now that they were seen with; in place, band by band.

    texture : (Ht, Wt, 3) uint8.  steps : (H, W) uint16, the corrected range. What stands where no range is goes with
    the range before it in its row.
    """
    radii_mm = _usual_radii_mm(steps, spec)
    if radii_mm is None:
        return
    reach = _reach(radii_mm, spec, axis)
    columns = np.arange(spec.texture_width, dtype=np.float32)
    above = texture[:0].copy()
    for start in range(0, spec.texture_height, _BAND):
        stop = min(start + _BAND, spec.texture_height)
        along, down = _shift(steps, radii_mm[1], spec, axis, start, stop)
        top = start - len(above)
        source = np.concatenate([above, texture[start : min(stop + reach, spec.texture_height)]])
        above = source[max(0, stop - top - reach) : stop - top]
        margin = min(math.ceil(float(np.abs(along).max())) + 1, spec.texture_width)
        wide = cv2.copyMakeBorder(source, 0, 0, margin, margin, cv2.BORDER_WRAP)
        along += columns + np.float32(margin)
        down += np.arange(start - top, stop - top, dtype=np.float32)[:, None]
        texture[start:stop] = cv2.remap(wide, along, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _usual_radii_mm(steps: StepArray, spec: GridSpec) -> tuple[float, float, float] | None:
    """The least, the middle and the largest distance from the axis; None where nothing was measured."""
    measured = steps[steps != VOID]
    if not measured.size:
        return None
    low, high = measured.min(), measured.max()
    middle = np.median(measured[:: max(1, measured.size // 65536)])
    return float(low) * spec.step_mm, float(middle) * spec.step_mm, float(high) * spec.step_mm


def _reach(radii_mm: tuple[float, float, float], spec: GridSpec, axis: Axis) -> int:
    """By how many rows at most a texel moves, and one more."""
    if not axis.leans:
        return 0
    ends_mm = spec.height_mm(np.array([0.0, spec.height - 1.0]))
    _, _, z_mm = true_to_seen(axis, np.array(radii_mm)[:, None], ends_mm)
    texel_mm = spec.pitch_mm * spec.height / spec.texture_height
    return int(np.nanmax(np.abs(z_mm - ends_mm), initial=0.0) / texel_mm) + 2


def _shift(
    steps: StepArray, usual_mm: float, spec: GridSpec, axis: Axis, start: int, stop: int
) -> tuple[Lengths, Lengths]:
    """Where texture rows start..stop come from: columns and rows to add to each texel's own. (n, Wt) float32 each"""
    down, across = spec.height / spec.texture_height, spec.width / spec.texture_width
    low = max(0, math.floor((start + 0.5) * down - 0.5))
    high = min(spec.height, math.ceil((stop - 0.5) * down - 0.5) + 2)
    z_mm = spec.height_mm(np.arange(low, high)).astype(np.float32)[:, None]
    radius_mm = _filled(steps[low:high]) * np.float32(spec.step_mm)
    radius_mm[radius_mm == 0] = usual_mm
    range_mm, ahead_rad, row_mm = true_to_seen(axis, radius_mm, z_mm)
    misses = np.isnan(range_mm)
    along = np.where(misses, 0, -ahead_rad * np.float32(spec.texture_width / (2 * np.pi)))
    rise = np.where(misses, 0, (z_mm - row_mm) / np.float32(spec.pitch_mm * down))
    to_range = np.array([[across, 0, 0.5 * across + 0.5], [0, down, (start + 0.5) * down - 0.5 - low]])
    size, flags = (spec.texture_width, stop - start), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP

    def enlarged(shift: Lengths) -> Lengths:
        wide = cv2.copyMakeBorder(shift, 0, 0, 1, 1, cv2.BORDER_WRAP)
        large = cv2.warpAffine(wide, to_range, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(large, np.float32)

    return enlarged(along), enlarged(rise)


def _filled(steps: StepArray) -> Lengths:
    """(n, W) float32 steps, void ones as the last measured one before them in their row; 0 where the row has none."""
    if steps.all():
        return steps.astype(np.float32)
    measured = np.where(steps != VOID, np.arange(steps.shape[1], dtype=np.int32), np.int32(-1))
    last = np.maximum.accumulate(measured, axis=1)
    last = np.where(last < 0, last[:, -1:], last)
    return np.take_along_axis(steps, np.maximum(last, 0), axis=1).astype(np.float32)
