"""Control messages on the LAN: JSON text, one object each, `type` first. Refinements travel beside them as binary.

Field names are camelCase on the wire. Unknown fields are ignored (a newer minor version may add some); unknown types,
missing fields and values out of bounds are refused. Transcript and table: PROTOCOL.md, "Stream".
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from protocol.errors import LocalWireError, RemoteWireError
from protocol.grid import HEIGHT_MAX, WIDTH_MAX, Geometry, GridSpec
from protocol.lattice import Channel, ChannelShape, channel_shapes

PROTOCOL = "foveascan.v1"
TEXT_MAX = 4 << 20
RUNS_MAX = 300_000
REASON_MAX = 200  # of what a decoder says, which may quote what it was given

Unit = Annotated[float, Meta(ge=0, lt=1)]
Share = Annotated[float, Meta(gt=0, le=1)]
Alpha = Annotated[float, Meta(ge=0.005, le=4)]
Scale = Annotated[float, Meta(ge=0.01, le=10000)]
Decibel = Annotated[float, Meta(ge=10, le=100)]
RangeError = Annotated[float, Meta(ge=0, le=1000)]  # [mm]
Seconds = Annotated[float, Meta(ge=0.05, le=30)]
ByteCount = Annotated[int, Meta(ge=0, le=1 << 40)]
Count = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]
Epoch = Annotated[int, Meta(ge=0, le=0xFFFF)]
ShortText = Annotated[str, Meta(max_length=200)]
Digest = Annotated[str, Meta(pattern="^[0-9a-f]{16}$")]
RunNumber = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]
Run = Annotated[list[RunNumber], Meta(min_length=3, max_length=3)]
Runs = Annotated[list[Run], Meta(max_length=RUNS_MAX)]
Columns = Annotated[int, Meta(ge=1, le=WIDTH_MAX)]
Rows = Annotated[int, Meta(ge=1, le=HEIGHT_MAX)]
CodecName = Literal["jpeg", "htj2k"]
Profile = Literal["default", "classic"]


class _Part(msgspec.Struct, frozen=True, rename="camel", omit_defaults=True):
    """A record inside a message."""


class _Message(_Part, frozen=True, tag_field="type", tag=lambda name: name[0].lower() + name[1:]):
    """Base of all messages."""


class ScanInfo(_Part, frozen=True):
    """What a client must know of a scan before its first view. Lengths in mm, angle in rad.

    geometry : "sphere": rows are directions from a centre, at z_max_mm on the axis (protocol.sphere).
    profile : how it is refined, which decides the first view too.
    """

    id: ShortText
    width: Columns
    height: Rows
    texture_width: Columns
    texture_height: Rows
    coarse_width: Columns
    coarse_height: Rows
    coarse_texture_width: Columns
    coarse_texture_height: Rows
    step_mm: float
    pitch_mm: float
    z_max_mm: float
    theta0_rad: float
    created: ShortText = ""
    geometry: Geometry = "cylinder"
    profile: Profile = "default"

    def spec(self) -> GridSpec:
        """Geometry of the scan. Raises RemoteWireError when it makes no sense."""
        try:
            return GridSpec(
                self.width, self.height, self.texture_width, self.texture_height,
                self.step_mm, self.pitch_mm, self.z_max_mm, self.theta0_rad, self.geometry,
            )  # fmt: skip
        except ValueError as error:
            raise RemoteWireError(f"scan {self.id}: {error}") from None

    def shapes(self) -> dict[Channel, ChannelShape]:
        """Shapes of both channels. Raises RemoteWireError when they make no sense."""
        coarse_range = self.coarse_height, self.coarse_width
        try:
            return channel_shapes(self.spec(), coarse_range, (self.coarse_texture_height, self.coarse_texture_width))
        except ValueError as error:
            raise RemoteWireError(f"scan {self.id}: {error}") from None


class RangeParameters(_Part, frozen=True):
    """Range sampling: p plateau spacing, quantum in steps of the scan, s the skirt's S' (null: no skirt)."""

    p: Literal[1, 2, 4, 8] = 1
    quantum: Annotated[int, Meta(ge=1, le=65534)] = 1
    s: Annotated[float, Meta(ge=0.1, le=1000)] | None = 1.0


class TextureParameters(_Part, frozen=True):
    """Texture sampling: p plateau spacing, quality 0..255 (255 lossless), its codec, s the skirt's S'."""

    p: Annotated[float, Meta(ge=1, le=8)] = 1
    quality: Annotated[int, Meta(ge=0, le=255)] = 60
    codec: CodecName = "htj2k"
    s: Annotated[float, Meta(ge=0.1, le=1000)] | None = 1.0


class LookParameters(_Part, frozen=True):
    """Explicit parameters of a look; a channel left out is not refined."""

    range: RangeParameters | None = None
    texture: TextureParameters | None = None


class ClassicRange(_Part, frozen=True):
    """A classic fovea's range: alpha, its scale as s or sigma (share of an axis kept); neither: the node chooses."""

    alpha: Alpha = 0.1
    s: Scale | None = None
    sigma: Share | None = None


class ClassicTexture(_Part, frozen=True):
    """A classic fovea's texture, likewise; q is the JPEG's Q."""

    alpha: Alpha = 0.03
    s: Scale | None = None
    sigma: Share | None = None
    q: Annotated[int, Meta(ge=10, le=95)] = 75


class ClassicSphere(_Part, frozen=True):
    """Which directions a classic fovea samples on a sphere, the same in range and texture.

    rings : circles spacing_rad apart up to cap_rad, then growing by the skirt's S' = s (null: no skirt).
    literal, rotated : m rings down and n across at f(i) = (exp(i / s) - 1) / alpha. [rad]
    """

    lattice: Literal["rings", "literal", "rotated"] = "rings"
    cap_rad: Annotated[float, Meta(ge=0, le=3.141592653589793)] = 0.45
    spacing_rad: Annotated[float, Meta(ge=1e-5, le=3.141592653589793)] | None = None
    m: Annotated[int, Meta(ge=0, le=1023)] = 8
    n: Annotated[int, Meta(ge=0, le=1023)] = 8
    alpha: Annotated[float, Meta(ge=1e-3, le=1e4)] = 1.0
    s: Scale | None = None


class ClassicLookParameters(_Part, frozen=True):
    """Parameters of a look at a classic scan; a channel left out is not refined.

    On a sphere `sphere` says where samples stand (null: rings over the window); alpha, s and sigma are a cylinder's.
    """

    range: ClassicRange | None = None
    texture: ClassicTexture | None = None
    sphere: ClassicSphere | None = None


# From the node


class ServerInfo(_Message, frozen=True):
    """First message of a stream: who speaks, which version, and whether a login is needed."""

    protocol: ShortText
    id: ShortText
    name: ShortText
    version: ShortText
    login: bool = False


class Welcome(_Message, frozen=True):
    """The client is let in."""

    role: Literal["view", "operate", "admin"]


class Opened(_Message, frozen=True):
    """A scan is bound to this stream; its first view follows as two refinements."""

    request: Count
    epoch: Epoch
    scan: ScanInfo


class Updated(_Message, frozen=True):
    """All refinements of a look are sent, those before next_seq: why it ended and what is left.

    error_max_mm : largest range error left in the window.  texture_db : PSNR reached in it.  (None: not looked at.)
    encodes : images the node coded for it.  node_ms : time it spent.
    """

    request: Count
    next_seq: Count
    reason: Literal["complete", "byte limit", "superseded"]
    error_max_mm: float | None = None
    texture_db: float | None = None
    encodes: int = 0
    node_ms: float = 0.0


class Resync(_Message, frozen=True):
    """The ends disagree: the client must state its holdings."""

    epoch: Epoch
    reason: ShortText


class Published(_Message, frozen=True):
    """A new scan is in the library.

    sweep : which of the node's finished sweeps it is, counted as `sweeps` of its scanner's status; 0: of no sweep.
    made_from : the scans that it was made of.
    """

    scan: ShortText
    sweep: Count = 0
    made_from: Annotated[tuple[ShortText, ...], Meta(max_length=16)] = ()


class Enveloped(_Message, frozen=True):
    """How far off range still is: the largest error of every 8 x 8 block of what the client holds.

    errors : uint16, little-endian, in steps, in row order, raw deflate; base64 on the wire.
    """

    request: Count
    epoch: Epoch
    errors: bytes


class LiveStarted(_Message, frozen=True):
    """A sweep runs, and this client watches it: columns of its coarse grids follow as they come in.

    sweep : counts the node's sweeps.  grid : the scan to be, without an id; the live view has its coarse shapes.
    """

    sweep: Count
    grid: ScanInfo


class LiveProgress(_Message, frozen=True):
    """How much of the sweep is in, and how long the rest will take; null while nobody can tell."""

    sweep: Count
    percent: Annotated[float, Meta(ge=0, le=100)]
    seconds_left: Annotated[float, Meta(ge=0)] | None = None


class LiveEnded(_Message, frozen=True):
    """The sweep is over: published as a scan, or interrupted, and why."""

    sweep: Count
    reason: Literal["published", "interrupted"]
    scan: ShortText = ""
    why: ShortText = ""


class Refused(_Message, frozen=True):
    """A request failed; the stream goes on. request 0: none in particular."""

    request: Count
    code: Literal["bad request", "not found", "not open", "forbidden", "busy", "internal"]
    message: Annotated[str, Meta(max_length=500)]


class Goodbye(_Message, frozen=True):
    """The node ends the stream."""

    reason: ShortText


# From the client


class Hello(_Message, frozen=True):
    """The client presents itself. codecs: texture codecs it decodes, the one it likes best first.

    geometries : of scans it can show; it may open no other.
    """

    protocol: ShortText
    client: ShortText = ""
    codecs: Annotated[tuple[CodecName, ...], Meta(min_length=1, max_length=8)] = ("htj2k", "jpeg")
    geometries: Annotated[tuple[Geometry, ...], Meta(min_length=1, max_length=8)] = ("cylinder",)


class Statement(_Part, frozen=True):
    """Holdings in run lengths: [count, level, rank] over the blocks in row order."""

    range: Runs
    texture: Runs


class Open(_Message, frozen=True):
    """Bind a scan ("latest" or an id). With holdings (not classic), no first view is sent: go on from there."""

    request: Count
    scan: ShortText
    holdings: Statement | None = None
    profile: Profile = "default"


class Look(_Message, frozen=True):
    """Refine round a click, until the quality is reached or the budget is spent. Newer looks supersede older ones.

    window : share of the area.  texture_db, range_mm : quality to stop at.  fill : spend what is left on the periphery.
    alpha : how fast detail falls off outside the window (S' = 1 / (alpha p)); null: the node's choice.
    scale : the window as a share of each axis, instead of `window`.
    profile : the one the scan was opened with. A classic look takes alpha, scale (as sigma), `classic` parameters
    instead of both, and the budget, nothing else.
    """

    request: Count
    u: Unit
    v: Unit
    window: Share = 0.05
    texture_db: Decibel = 40.0
    range_mm: RangeError = 0.1
    max_wait_s: Seconds | None = None
    max_bytes: ByteCount | None = None
    fill: bool = False
    alpha: Alpha | None = None
    scale: Share | None = None
    profile: Profile = "default"
    parameters: LookParameters | None = None
    classic: ClassicLookParameters | None = None


class Ack(_Message, frozen=True):
    """Every refinement before next_seq is applied; digest of what the client then holds."""

    epoch: Epoch
    next_seq: Count
    digest: Digest
    apply_ms: Annotated[float, Meta(ge=0, le=1e6)] = 0.0


class State(_Message, frozen=True):
    """What the client holds, in answer to Resync."""

    epoch: Epoch
    next_seq: Count
    holdings: Statement


class Cancel(_Message, frozen=True):
    """Forget a look that is not answered yet."""

    request: Count


class Envelope(_Message, frozen=True):
    """Ask how far off range still is, block by block."""

    request: Count


class Watch(_Message, frozen=True):
    """Show me sweeps while they run (the one that runs now from its beginning), or show them no more."""

    live: bool


FromNode = (
    ServerInfo | Welcome | Opened | Updated | Resync | Published | Refused | Goodbye
    | Enveloped | LiveStarted | LiveProgress | LiveEnded
)  # fmt: skip
FromClient = Hello | Open | Look | Ack | State | Cancel | Envelope | Watch
Message = FromNode | FromClient

_encoder = msgspec.json.Encoder()
_decoder = msgspec.json.Decoder(Message)


def encode_message(message: Message) -> str:
    """JSON text. Raises LocalWireError when it is too long."""
    text = _encoder.encode(message)
    if len(text) > TEXT_MAX:
        raise LocalWireError(f"message of {len(text)} bytes is longer than {TEXT_MAX}")
    return text.decode()


def decode_message(text: str | bytes) -> Message:
    """Inverse of encode_message. Raises RemoteWireError naming what is wrong with it."""
    if len(text) > TEXT_MAX:
        raise RemoteWireError(f"message of {len(text)} bytes is longer than {TEXT_MAX}")
    try:
        message: Message = _decoder.decode(text)
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise RemoteWireError(f"bad message: {str(error)[:REASON_MAX]}") from None
    return message
