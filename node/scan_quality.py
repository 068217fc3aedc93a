"""What a scan is worth: how much was measured, how noisy it is, what was repaired, and whether something moved."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from node.axis import Axis
from protocol import quality as said
from protocol.grid import VOID, BoolArray, FloatArray, Grid, ImageArray, StepArray

_SATURATED = 255
_SATURATED_SHARE = 0.95
_ROWS_LOOKED_AT = 64
_SLIP_MATTERS_COLUMNS = 0.5


@dataclass(frozen=True, slots=True)
class ScanQuality:
    """A scan's quality report.

    coverage : share of range cells measured.  passes : looks that were averaged.  noise_mm : standard deviation of a
    single range sample, None where nothing was seen twice.  spikes : samples taken out.  rejected : samples that
    disagreed with the other passes.  filled : cells of small holes that were made up.  holes : void cells left that lie
    between measured ones of their column.  dead_rows : void rows between measured ones.  saturated_columns : texture
    columns without any drawing.  slip_deg : how far the object had moved when it was seen again, None if it cannot be
    told.  set_aside : passes left out because of that.  requested_columns, dropped_bytes : what the line lost.
    axis : where the table's axis is, if the grid was corrected for that.  axis_trouble : why it was not, and should be.
    """

    coverage: float
    passes: int = 1
    noise_mm: float | None = None
    spikes: int = 0
    rejected: int = 0
    filled: int = 0
    holes: int = 0
    dead_rows: int = 0
    saturated_columns: int = 0
    slip_deg: float | None = None
    has_slipped: bool = False
    set_aside: int = 0
    requested_columns: int = 0
    dropped_bytes: int = 0
    axis: Axis | None = None
    axis_trouble: str = ""

    @property
    def complaints(self) -> tuple[str, ...]:
        """What a person should know before trusting the scan, in words; nothing when all is well."""
        found = [
            (self.axis_trouble, self.axis_trouble),
            (self.has_slipped, f"something moved by {self.slip_deg or 0.0:.2f} degrees during the sweep"),
            (self.set_aside, f"{self.set_aside} passes do not fit the first one and were left out"),
            (self.spikes, f"{self.spikes} spikes were taken out"),
            (self.rejected, f"{self.rejected} samples disagreed between passes and were left out"),
            (self.filled, f"{self.filled} cells in small holes were filled"),
            (self.dead_rows, f"{self.dead_rows} rows of the range camera measure nothing"),
            (self.saturated_columns, f"{self.saturated_columns} texture columns are saturated"),
        ]
        return tuple(words for holds, words in found if holds)


def told(quality: ScanQuality) -> said.ScanQuality:
    """The same, as clients are told."""
    axis = quality.axis and said.AxisOffset(**asdict(quality.axis))
    return said.ScanQuality(**{**asdict(quality), "axis": axis}, complaints=quality.complaints)


def coverage_of(steps: StepArray) -> float:
    """Share of (H, W) cells that are measured."""
    return float(np.count_nonzero(steps)) / steps.size


def dead_rows_in(steps: StepArray) -> BoolArray:
    """(H,) rows that measured nothing although rows above and below them did."""
    seen: BoolArray = np.asarray(steps.any(axis=1))
    reached = np.logical_or.accumulate(seen) & np.logical_or.accumulate(seen[::-1])[::-1]
    dead: BoolArray = reached & ~seen
    return dead


def holes_in(steps: StepArray) -> int:
    """Void cells with measured ones above and below them in the same column."""
    seen = steps != VOID
    from_first = len(seen) - seen.argmax(axis=0)
    behind_last = seen[::-1].argmax(axis=0)
    measured = np.count_nonzero(seen, axis=0)
    return int((from_first - behind_last - measured)[measured > 0].sum())


def saturated_columns_in(texture: ImageArray) -> BoolArray:
    """(Wt,) texture columns that are white almost from top to bottom; a look at some rows settles most."""
    saturated = _white_share(texture[:: max(1, len(texture) // _ROWS_LOOKED_AT)]) >= _SATURATED_SHARE
    columns = np.flatnonzero(saturated)
    saturated[columns] = _white_share(texture[:, columns]) >= _SATURATED_SHARE
    return saturated


def _white_share(texture: ImageArray) -> FloatArray:
    """(Wt,) share of white texels in each column."""
    return np.asarray(np.count_nonzero((texture == _SATURATED).all(axis=2), axis=0) / len(texture))


def slip_matters(slip_columns: float | None) -> bool:
    """Whether a slip, in columns of the finer channel, is more than the estimate's own error."""
    return slip_columns is not None and abs(slip_columns) >= _SLIP_MATTERS_COLUMNS


def survey(grid: Grid) -> ScanQuality:
    """What one look at a finished grid tells."""
    return ScanQuality(
        coverage_of(grid.range_steps),
        holes=holes_in(grid.range_steps),
        dead_rows=int(dead_rows_in(grid.range_steps).sum()),
        saturated_columns=int(saturated_columns_in(grid.texture).sum()),
    )
