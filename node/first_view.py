"""The first view of a scan as it travels, and the state of a client that has just received it."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime

from node.coded import FRAME_BYTES
from node.library import Scan
from node.state import ClientState, first_state
from protocol.codec import (
    JPEG_QUALITY_MAX,
    JPEG_QUALITY_MIN,
    RangeCodec,
    TextureCodec,
    decode_range,
    decode_texture,
    encode_mask,
    encode_range,
    encode_texture,
)
from protocol.errors import CodecError
from protocol.grid import VOID, ImageArray
from protocol.lattice import Channel
from protocol.messages import CodecName, ScanInfo
from protocol.reconstruct import coarse_to_texture
from protocol.refinement import CRC, HEADER, Generator, Refinement

QUANTUM_MM = 0.05
QUALITIES = {"htj2k": range(62, 13, -3), "jpeg": range(JPEG_QUALITY_MAX, JPEG_QUALITY_MIN - 1, -3)}
OPENED_BYTES = 600  # the message before it, at most
OVERHEAD_BYTES = HEADER.size + CRC.size + FRAME_BYTES


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class FirstView:
    """What every client of a scan receives first, range then texture, as refinements of epoch 0."""

    info: ScanInfo
    range: Refinement
    texture: Refinement
    state: ClientState

    def __repr__(self) -> str:
        return f"FirstView({self.info.id})"

    def refinements(self, epoch: int) -> tuple[bytes, bytes]:
        """Both refinements on the wire, for one opening."""
        first, second = (_of_epoch(refinement, epoch) for refinement in (self.range, self.texture))
        return first, second


def build_first_view(scan: Scan, codec: CodecName, max_bytes: int) -> FirstView:
    """Encode a scan's first view within max_bytes. Raises CodecError when even the poorest texture is too large.

    Range goes as quantised values, not by prediction: so a scan turned by whole coarse cells has its first view turned.
    """
    coarse = scan.coarse
    quantum = max(1, round(QUANTUM_MM / scan.spec.step_mm))
    mask = encode_mask(~coarse.measured)
    payload = encode_range(coarse.filled, RangeCodec.HTJ2K, quantum)
    view = Refinement(
        Generator.COARSE, Channel.RANGE, 0, 0, 0, RangeCodec.HTJ2K, quantum, coarse.filled.size, payload, mask
    )
    left = max_bytes - OPENED_BYTES - 2 * OVERHEAD_BYTES - len(payload) - len(mask)
    sent = decode_range(payload, RangeCodec.HTJ2K, coarse.filled.shape, quantum)
    sent[~coarse.measured] = VOID
    return FirstView(scan_info(scan), view, _texture(scan, codec, left), first_state(scan, sent))


def texture_as_seen(view: FirstView) -> ImageArray:
    """The dense texture that a client makes of a first view. (Ht, Wt, 3) uint8"""
    shape = view.state.shapes[Channel.TEXTURE]
    coarse_shape = shape.coarse_height, shape.coarse_width
    sent = view.texture
    return coarse_to_texture(
        decode_texture(sent.payload, TextureCodec(sent.codec), sent.quality, coarse_shape), shape
    )


def scan_info(scan: Scan) -> ScanInfo:
    """What a client must know of a scan before its first view."""
    s, coarse = scan.spec, scan.coarse
    return ScanInfo(
        id=scan.id, width=s.width, height=s.height, texture_width=s.texture_width, texture_height=s.texture_height,
        coarse_width=coarse.range_steps.shape[1], coarse_height=coarse.range_steps.shape[0],
        coarse_texture_width=coarse.texture.shape[1], coarse_texture_height=coarse.texture.shape[0],
        step_mm=s.step_mm, pitch_mm=s.pitch_mm, z_max_mm=s.z_max_mm, theta0_rad=s.theta0_rad,
        created=_utc(scan.about.created_unix_s), geometry=s.geometry,
    )  # fmt: skip


def _utc(unix_s: float) -> str:
    """A time as ISO 8601 writes it, to the second; empty where a clock so wrong has no date."""
    try:
        return datetime.fromtimestamp(unix_s, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")
    except (ValueError, OverflowError, OSError):
        return ""


def _texture(scan: Scan, codec: CodecName, max_bytes: int) -> Refinement:
    image = scan.coarse.texture
    kind = TextureCodec.JPEG if codec == "jpeg" else TextureCodec.HTJ2K
    for quality in QUALITIES[codec]:
        payload = encode_texture(image, kind, quality)
        if len(payload) <= max_bytes:
            samples = image.shape[0] * image.shape[1]
            return Refinement(Generator.COARSE, Channel.TEXTURE, 0, 1, 0, kind, quality, samples, payload)
    raise CodecError(f"first view of scan {scan.id} does not fit {max_bytes} bytes: raise first_view.max_bytes")


def _of_epoch(refinement: Refinement, epoch: int) -> bytes:
    r = refinement
    return Refinement(
        r.generator, r.channel, epoch, r.seq, r.look, r.codec, r.quality, r.samples, r.payload, r.mask
    ).to_bytes()
