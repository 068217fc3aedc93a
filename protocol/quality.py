"""What a node says of a scan and of its scanner over plain HTTP: what the scan is worth, and where the axis is.

camelCase on the wire, and unknown fields ignored, as in protocol.messages.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

ByteCount = Annotated[int, Meta(ge=0, le=1 << 40)]
Count = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]
ShortText = Annotated[str, Meta(max_length=200)]


class _Part(msgspec.Struct, frozen=True, rename="camel", omit_defaults=True):
    """A record inside an answer."""


class AxisOffset(_Part, frozen=True):
    """Where a scanner's true axis is, beside the one that it believes in.

    lateral_mm : its line of sight passes it by, on the side that columns go to.  radial_mm : its range is too short by.
    lean_rad, side_rad : by how much radial and lateral grow with height.  height_mm : the height at which they are so.
    """

    lateral_mm: float
    radial_mm: float
    lean_rad: float = 0.0
    side_rad: float = 0.0
    height_mm: float = 0.0

    @property
    def in_words(self) -> str:
        """For a person, in one line."""
        lean, side = (f"{57.29577951308232 * rad:.2f}" for rad in (self.lean_rad, self.side_rad))
        return f"{self.lateral_mm:.3f} mm sideways, {self.radial_mm:.3f} mm in range, leaning {lean} and {side} degrees"


class FoundAxis(_Part, frozen=True):
    """An axis and how it was found. scanner : its serial number.  lateral_error_mm and the like : standard errors.

    noise_mm : spread of samples about the body.  uneven_mm : by how much that is no cylinder.  off_centre_mm : how far
    off the axis it stood.  scan, diameter_mm : the sweep of it, and its diameter.  calibrated : Unix time [s].
    """

    scanner: ShortText
    axis: AxisOffset
    lateral_error_mm: float
    radial_error_mm: float
    lean_error_rad: float
    side_error_rad: float
    noise_mm: float
    uneven_mm: float
    off_centre_mm: float
    scan: ShortText
    diameter_mm: float
    calibrated: float


class ScanQuality(_Part, frozen=True):
    """What a scan is worth, beside GET /v1/scans/{id}; no part of the stream.

    coverage : share of range cells measured.  passes : looks that were averaged.  noise_mm : standard deviation of a
    single range sample, None where nothing was seen twice.  spikes : samples taken out.  rejected : samples that
    disagreed with other passes.  filled : cells of small holes that were made up.  holes : void cells between measured
    ones of their column.  dead_rows, saturated_columns : rows of range that measured nothing, columns of texture
    without drawing.  slip_deg : how far the object had moved when it was seen again, None where it was not.
    set_aside : passes left out because of that.  requested_columns, dropped_bytes : what the scanner's line lost.
    axis : where the scanner's axis is, if the scan was corrected for that, and axis_trouble why it was not but should.
    complaints : what of this a person should know, in words; nothing when all is well.
    """

    coverage: Annotated[float, Meta(ge=0, le=1)]
    passes: Count = 1
    noise_mm: float | None = None
    spikes: Count = 0
    rejected: Count = 0
    filled: Count = 0
    holes: Count = 0
    dead_rows: Count = 0
    saturated_columns: Count = 0
    slip_deg: float | None = None
    has_slipped: bool = False
    set_aside: Count = 0
    requested_columns: Count = 0
    dropped_bytes: ByteCount = 0
    axis: AxisOffset | None = None
    axis_trouble: ShortText = ""
    complaints: Annotated[tuple[ShortText, ...], Meta(max_length=32)] = ()
