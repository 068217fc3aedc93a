"""What is asked for and answered over HTTP, as records, of which `node.openapi` makes its description.

Those of pairing are in `protocol.pairing`, since both ends compute with them; what is said of a scan is in
`node.sidecar`, and a line of the audit log in `node.audit`. Fields are camelCase in JSON.
"""

from __future__ import annotations

from typing import Annotated

from msgspec import UNSET, Meta, Struct, UnsetType

from exchange.sweeps import TIP_DEG
from node.audit import BEGINS_A_TIME
from node.capture import CaptureStatus
from node.health import Status
from node.scan_folder import Problem
from protocol import messages as m
from protocol import pairing
from protocol.grid import Geometry
from protocol.quality import ScanQuality

ScanId = Annotated[str, Meta(pattern="^[0-9a-f]{32}$")]
UnixTime = Annotated[float, Meta(description="[s since 1970, the node's clock]")]


class _Body(Struct, frozen=True, rename="camel"):
    """What is answered."""


class _Asked(Struct, frozen=True, forbid_unknown_fields=True, rename="camel"):
    """What is asked for: a field that we do not know is refused, since it would be left out of account."""


class Error(_Body, frozen=True):
    """What is wrong: HTTP's own phrase, and in words, with the cure where it can be known."""

    code: str
    message: str


# The node


class HealthSaid(_Body, frozen=True):
    """How the node is; reasons and capture for whoever has a login."""

    status: Status
    reasons: tuple[str, ...] | UnsetType = UNSET
    capture: CaptureStatus | UnsetType = UNSET


class NodeStatus(m.ServerInfo, frozen=True, kw_only=True, tag="serverInfo"):
    """Who the node is and what it does. problems : what in the library's folder is no sound scan.

    shared_encodes : foveae coded for many.  surveying : opened scans whose textures are not measured yet.
    """

    capture: CaptureStatus
    problems: tuple[Problem, ...]
    shared_encodes: m.Count
    surveying: m.Count


class Disk(_Body, frozen=True):
    """The disk of the library. [bytes]"""

    free_bytes: int
    size_bytes: int


class Certificate(_Body, frozen=True):
    """What the node shows who it is by. fingerprint : SHA-256.  own : the node made it, and renews it."""

    fingerprint: pairing.Hex256
    ends: UnixTime
    own: bool


class Rules(_Body, frozen=True):
    """When scans are deleted. null: never for that."""

    max_age_days: float | None
    max_gb: float | None


class Upkeep(_Body, frozen=True):
    """What who looks after a node wants to know. certificate : null without logins.  retention : what deletes scans."""

    version: str
    started: UnixTime
    status: Status
    reasons: tuple[str, ...]
    capture: CaptureStatus
    disk: Disk
    certificate: Certificate | None
    retention: Rules
    scans: m.Count
    interrupted: m.Count
    streams: m.Count


class AuditQuery(_Asked, frozen=True):
    """Which entries of the audit log, at most `limit`. since : the beginning of a time.  scan : that of an id."""

    limit: Annotated[int, Meta(ge=1, le=1000)] = 100
    since: Annotated[str, Meta(pattern=BEGINS_A_TIME)] = ""
    scan: str = ""
    by: str = ""
    refused: bool = False


# Scans


class ListedScan(_Body, frozen=True):
    """A scan in the list. name, subject, body_site : "" where nothing is said.  made_from : other scans."""

    id: ScanId
    created: UnixTime
    source: str
    name: str
    width: m.Columns
    height: m.Rows
    texture_width: m.Columns
    texture_height: m.Rows
    geometry: Geometry
    made_from: tuple[str, ...]
    subject: str
    body_site: str


class ScanDetail(m.ScanInfo, frozen=True, kw_only=True):
    """A scan. note : how it was made, where it was not measured so.  made_from : the scans that it was made of."""

    quality: ScanQuality | None
    note: str
    made_from: tuple[str, ...]


class CoarseQuery(Struct, frozen=True):
    """In which codec the first view's texture is."""

    codec: m.CodecName = "htj2k"


class FoveaQuery(Struct, frozen=True, forbid_unknown_fields=True):
    """A look, as in protocol.messages.Look, and the codec of its texture."""

    u: m.Unit
    v: m.Unit
    window: m.Share = 0.05
    texture_db: m.Decibel = 40.0
    range_mm: m.RangeError = 0.1
    max_bytes: m.ByteCount | UnsetType = UNSET
    alpha: m.Alpha | UnsetType = UNSET
    scale: m.Share | UnsetType = UNSET
    codec: m.CodecName = "htj2k"


class Derivation(_Asked, frozen=True):
    """What a scan is to become. caps, centre_height_mm : of a sphere, as exchange.formats.ReadOptions has them.

    top, bottom : ids of scans of the same object, tipped by tip_deg over its front, and over its back.
    """

    geometry: Geometry
    caps: bool = False
    centre_height_mm: Annotated[float, Meta(ge=-1e6, le=1e6)] | None = None
    top: m.ShortText | None = None
    bottom: m.ShortText | None = None
    tip_deg: Annotated[float, Meta(ge=0, le=180)] = TIP_DEG


class Derived(_Body, frozen=True):
    """The scan that was made. note : how."""

    id: ScanId
    geometry: Geometry
    note: str


class Kept(_Body, frozen=True):
    """The scan that was imported."""

    id: ScanId


class Verified(_Body, frozen=True):
    """Whether every sample of a scan is what its id says. reason : what is wrong."""

    id: ScanId
    sound: bool
    reason: str


# Sweeps


class SweepAsked(_Body, frozen=True):
    """What the scanner is doing, as CaptureStatus. sweep : which of the finished ones the new one will be."""

    phase: str
    progress: float
    sweeps: m.Count
    why: str
    sweep: m.Count


class ListedSweep(_Body, frozen=True):
    """A sweep that was interrupted. why : what ended it.  held, expected : pieces of columns."""

    id: str
    started: UnixTime
    ended: UnixTime
    why: str
    held: int
    expected: int
    complete: bool
    damaged_bytes: int
    size_bytes: int
    scanner: str
    width: int
    height: int
    texture_width: int
    texture_height: int


class ResumedSweep(ListedSweep, frozen=True):
    """One that goes on. sweep : which of the finished ones it will be."""

    sweep: m.Count


class AxisWanted(_Asked, frozen=True):
    """The sweep of a round body that tells where the axis is, and the body's diameter. [mm]"""

    scan: m.ShortText
    diameter_mm: Annotated[float, Meta(ge=1, le=2000)]


# Who may come in


class PairingForm(Struct, frozen=True):
    """What the page for pairing sends, with hyphens and blanks or without."""

    code: Annotated[str, Meta(pattern="^[- ]*([A-Za-z2-7][- ]*){16}$")]


class NewCode(_Asked, frozen=True):
    """For whom a pairing code is, and how long."""

    name: pairing.Name
    role: pairing.Role = "view"
    minutes: Annotated[float, Meta(gt=0, le=60)] = 10


class Offered(_Body, frozen=True):
    """A pairing code, good once. fingerprint : SHA-256 of the node's certificate, to be compared."""

    code: str
    fingerprint: pairing.Hex256
    expires: UnixTime


class ListedCode(_Body, frozen=True):
    """A pairing code that waits. The code itself was said once."""

    name: str
    role: pairing.Role
    expires: UnixTime


class ListedToken(_Body, frozen=True):
    """Somebody who is paired. last_used : null where that is not known.  own : the login of whoever asks."""

    name: str
    role: pairing.Role
    created: UnixTime
    last_used: UnixTime | None
    own: bool
