"""One refinement on the wire: a generator's name and parameters, and the values it puts in order.

Everything that improves a client's model travels like this. Positions never travel: both ends compute them from the
parameters and what the client holds. Layout: PROTOCOL.md, "Refinement".
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import lru_cache

from protocol.classic import ClassicParameters
from protocol.errors import LocalWireError, RemoteWireError
from protocol.lattice import STRIDE_SETS, Channel, Parameters
from protocol.sphere_fovea import SphereParameters

MAGIC = 0x5246
VERSION = 1
HEADER = struct.Struct("<HBBBBBBHHIIIHHII")
CRC = struct.Struct("<I")
PARAMETERS = struct.Struct("<BHHHHII")
PARAMETERS_MAX = 4096
MASK_MAX = 8 << 20
PAYLOAD_MAX = 256 << 20
HALF = 15  # of a byte, at most
HALVES_MAX = 8  # of a step, behind the first
SPACING_BITS = 5  # of the byte that half spacing and the largest stride share
POLAR = 7  # in its other bits, where others number STRIDE_SETS
AnyParameters = Parameters | ClassicParameters | SphereParameters


class Generator(IntEnum):
    """How a refinement's samples are found; the number is the one on the wire."""

    COARSE = 0
    FOVEA = 1
    CLASSIC = 2
    SPHERE = 3


@dataclass(frozen=True, slots=True)
class Refinement:
    """One refinement of one channel.

    epoch : which opening of a scan it belongs to.      seq : counts refinements in an epoch, from 0.
    look : the request it answers, 0 for none.          codec : id of the payload's codec.
    quality : range: quantum in steps; texture: 0..255, CLASSIC: the JPEG's Q. samples : values in the payload.
    self_contained : planned over the first view alone, not over the client's holdings.
    parameters : of the lattice; None for the first view.
    mask : range only, which cells are void; empty when none is.
    """

    generator: Generator
    channel: Channel
    epoch: int
    seq: int
    look: int
    codec: int
    quality: int
    samples: int
    payload: bytes = field(repr=False)
    mask: bytes = field(default=b"", repr=False)
    parameters: AnyParameters | None = None
    self_contained: bool = False

    def to_bytes(self) -> bytes:
        """Wire form. Raises LocalWireError when a part does not fit it."""
        parameters = _packed(self.parameters)
        sizes = (len(parameters), len(self.mask), len(self.payload))
        if sizes[0] > PARAMETERS_MAX or sizes[1] > MASK_MAX or sizes[2] > PAYLOAD_MAX:
            raise LocalWireError(f"refinement too long: parameters, mask, payload of {sizes} bytes")
        try:
            header = HEADER.pack(
                MAGIC, VERSION, self.generator, self.channel, self.codec, int(self.self_contained), 0,
                self.epoch, self.quality, self.seq, self.look, self.samples, sizes[0], 0, sizes[1], sizes[2],
            )  # fmt: skip
        except struct.error as error:
            raise LocalWireError(f"refinement out of bounds: {error}") from None
        body = b"".join((header, parameters, self.mask, self.payload))
        return body + CRC.pack(zlib.crc32(body))

    @classmethod
    def from_bytes(cls, data: bytes) -> Refinement:
        """Inverse of to_bytes. Raises RemoteWireError when the bytes are not one whole, intact refinement."""
        generator, channel, codec, flags, epoch, quality, seq, look, samples, sizes = _read_header(data)
        ends = [HEADER.size, *_running(HEADER.size, sizes)]
        if len(data) != ends[-1] + CRC.size:
            raise RemoteWireError(f"refinement of {len(data)} bytes announces {ends[-1] + CRC.size}")
        if CRC.unpack_from(data, ends[-1])[0] != zlib.crc32(memoryview(data)[: ends[-1]]):
            raise RemoteWireError("refinement fails its checksum")
        parameters = _unpacked(generator, data[ends[0] : ends[1]])
        mask, payload = data[ends[1] : ends[2]], data[ends[2] : ends[3]]
        return cls(
            generator, channel, epoch, seq, look, codec, quality, samples, payload, mask, parameters, bool(flags & 1)
        )


def _packed(parameters: AnyParameters | None) -> bytes:
    if isinstance(parameters, (ClassicParameters, SphereParameters)):
        return parameters.to_bytes()
    return b"" if parameters is None else pack_parameters(parameters)


def _unpacked(generator: Generator, data: bytes) -> AnyParameters | None:
    if bool(data) != (generator is not Generator.COARSE):
        raise RemoteWireError("a first view carries no lattice; everything else does")
    if generator is Generator.CLASSIC:
        return ClassicParameters.from_bytes(data)
    if generator is Generator.SPHERE:
        return SphereParameters.from_bytes(data)
    return unpack_parameters(data) if data else None


@lru_cache(maxsize=16)
def pack_parameters(p: Parameters) -> bytes:
    """Lattice parameters as they travel: 17 bytes, then the listed runs when there are any.

    Raises LocalWireError when they do not fit.
    """
    if p.listed is not None and not p.listed:
        raise LocalWireError("a list of blocks needs at least one run")
    try:
        head = PARAMETERS.pack(spacing_byte(p), p.block_x, p.block_y, p.blocks_wide, p.blocks_high, p.rho_x, p.rho_y)
    except struct.error as error:
        raise LocalWireError(f"lattice parameters out of bounds: {error}") from None
    return head + _pack_runs(p.listed or ())


def unpack_parameters(data: bytes) -> Parameters:
    """Inverse of pack_parameters. Raises RemoteWireError when the bytes are not whole."""
    if len(data) < PARAMETERS.size:
        raise RemoteWireError("lattice parameters are cut short")
    runs = _unpack_runs(data[PARAMETERS.size :])
    spacing, x, y, wide, high, rho_x, rho_y = PARAMETERS.unpack_from(data)
    return from_spacing_byte(spacing, Parameters(0, x, y, wide, high, rho_x, rho_y, runs or None))


def spacing_byte(p: Parameters) -> int:
    """Half spacing, and in the upper three bits which of STRIDE_SETS strips may have, or that there is one image."""
    if p.half_spacing >> SPACING_BITS:
        raise LocalWireError(f"a spacing of {p.spacing} does not travel")
    if p.strides not in STRIDE_SETS:
        raise LocalWireError(f"strides of {p.strides} do not travel")
    return p.half_spacing | (POLAR if p.polar else STRIDE_SETS.index(p.strides)) << SPACING_BITS


def from_spacing_byte(spacing: int, others: Parameters) -> Parameters:
    """Inverse of spacing_byte: others with what it says; without strides where their number means nothing."""
    half_spacing, number = spacing % (1 << SPACING_BITS), spacing >> SPACING_BITS
    if number == POLAR:
        return replace(others, half_spacing=half_spacing, polar=True)
    strides = STRIDE_SETS[number] if number < len(STRIDE_SETS) else ()
    return replace(others, half_spacing=half_spacing, strides=strides)


def _read_header(data: bytes) -> tuple[Generator, Channel, int, int, int, int, int, int, int, tuple[int, int, int]]:
    if len(data) < HEADER.size + CRC.size:
        raise RemoteWireError("refinement is cut short")
    fields = HEADER.unpack_from(data)
    magic, version, generator, channel, codec, flags, _, epoch, quality, seq, look, samples, *sizes = fields
    if magic != MAGIC or version != VERSION:
        raise RemoteWireError(f"not a refinement of version {VERSION}")
    parameters_size, _, mask_size, payload_size = sizes
    if parameters_size > PARAMETERS_MAX or mask_size > MASK_MAX or payload_size > PAYLOAD_MAX:
        raise RemoteWireError("refinement announces more than is allowed")
    try:
        kind = Generator(generator), Channel(channel)
    except ValueError as error:
        raise RemoteWireError(f"refinement of unknown kind: {error}") from None
    return *kind, codec, flags, epoch, quality, seq, look, samples, (parameters_size, mask_size, payload_size)


def _running(start: int, sizes: tuple[int, ...]) -> list[int]:
    ends = []
    for size in sizes:
        start += size
        ends.append(start)
    return ends


def _pack_runs(runs: tuple[int, ...]) -> bytes:
    """Run lengths in half bytes, as steps from the run before the last: rows of a round window differ by little.

    A step is 2 d or, below 0, -2 d - 1: one half byte up to 14, else 15 and what is beyond in halves of three bits, low
    first, their fourth bit where more follow. A last half byte that is left over is 15.
    """
    halves: list[int] = []
    for run, before in zip(runs, (0, 0, *runs), strict=False):
        step = run - before
        beyond = (2 * step if step >= 0 else -2 * step - 1) - HALF
        if not (0 <= run and beyond < 1 << 3 * HALVES_MAX):
            raise LocalWireError(f"run length {run} out of bounds")
        if beyond < 0:
            halves.append(beyond + HALF)
            continue
        halves.append(HALF)
        while beyond > 7:
            halves.append(beyond & 7 | 8)
            beyond >>= 3
        halves.append(beyond)
    if len(halves) % 2:
        halves.append(HALF)
    return bytes(low | high << 4 for low, high in zip(halves[::2], halves[1::2], strict=True))


def _unpack_runs(data: bytes) -> tuple[int, ...]:
    """Inverse of _pack_runs. Raises RemoteWireError."""
    halves = [half for byte in data for half in (byte & 15, byte >> 4)]
    runs, at = [0, 0], 0
    while at < len(halves):
        step, shift, at = halves[at], 0, at + 1
        if step == HALF and at == len(halves):
            break
        more = step == HALF
        while more:
            if at == len(halves) or shift == 3 * HALVES_MAX:
                raise RemoteWireError("run lengths are cut short or out of bounds")
            step, more, shift, at = step + ((halves[at] & 7) << shift), halves[at] > 7, shift + 3, at + 1
        runs.append(runs[-2] + (-(step + 1) // 2 if step % 2 else step // 2))
        if runs[-1] < 0:
            raise RemoteWireError("run length below nought")
    return tuple(runs[2:])
