"""The node's side of the `classic` profile on a sphere: radial values of one fovea's directions, and its texture.

Nothing is searched for: the lattice is the one asked for, else rings over the window, over less of it where that does
not fit. Source: Cheng, Basu, Pan 2003, section 4, with REQUIREMENTS F-17.
"""

from __future__ import annotations

import math

import numpy as np

from node.classic import ClassicCoded, ClassicState, replicate_edges
from node.coded import rho_of
from node.library import Scan
from protocol import codec_jpeg
from protocol.classic import bounds, single
from protocol.codec import RangeCodec, TextureCodec
from protocol.errors import LatticeError
from protocol.grid import BoolArray
from protocol.lattice import Channel, ChannelShape
from protocol.messages import ClassicLookParameters, ClassicSphere, Look
from protocol.sphere_fovea import (
    POLAR_MAX,
    TURN,
    Kind,
    SphereLattice,
    SphereParameters,
    build_sphere_lattice,
    claim,
    kept_samples,
)

SKIRT_S = 1.0
SPREAD_S = 20.0
KINDS = {"rings": Kind.RINGS, "literal": Kind.LITERAL, "rotated": Kind.ROTATED}


def code_sphere(scan: Scan, state: ClassicState, look: Look, wanted: ClassicLookParameters) -> tuple[ClassicCoded, ...]:
    """Both channels of a fovea, each as far as it is asked for and owns anything.

    Raises LatticeError for parameters that describe no lattice, and for a cylinder's.
    """
    for one in (wanted.range, wanted.texture):
        if one is not None and not (one.s is None and one.sigma is None):
            raise LatticeError("s and sigma are a cylinder's: on a sphere `sphere` says where samples stand")
    sphere = wanted.sphere or window_rings(look)
    coded = []
    if wanted.range is not None:
        coded.append(_code_range(scan, state, _lattice(state, Channel.RANGE, look, sphere)))
    if wanted.texture is not None:
        coded.append(_code_texture(scan, state, _lattice(state, Channel.TEXTURE, look, sphere), wanted.texture.q))
    return tuple(one for one in coded if one is not None)


def window_rings(look: Look, share: float = 1.0) -> ClassicSphere:
    """Rings over a share of a look's window."""
    window = share * (look.window if look.scale is None else look.scale**2)
    return ClassicSphere(cap_rad=math.acos(max(1 - 2 * window, -1.0)), s=SKIRT_S)


def _lattice(state: ClassicState, channel: Channel, look: Look, wanted: ClassicSphere) -> SphereLattice:
    shape = state.shapes[channel]
    return build_sphere_lattice(shape, sphere_parameters(state.looks, shape, look, wanted))


def sphere_parameters(fovea: int, shape: ChannelShape, look: Look, wanted: ClassicSphere) -> SphereParameters:
    """What travels of a lattice that is asked for; rings as far apart as the channel's rows where that is left open."""
    kind = KINDS[wanted.lattice]
    polar, turned = round(look.v * POLAR_MAX), round(look.u * TURN) % TURN
    if kind is Kind.RINGS:
        spacing = math.pi / shape.height if wanted.spacing_rad is None else wanted.spacing_rad
        lengths = single(wanted.cap_rad), single(spacing)
        return SphereParameters(fovea, kind, polar, turned, *lengths, rho=rho_of(wanted.s))
    lengths = single(wanted.alpha), single(SPREAD_S if wanted.s is None else wanted.s)
    return SphereParameters(fovea, kind, polar, turned, *lengths, wanted.m, wanted.n)


def _code_range(scan: Scan, state: ClassicState, lattice: SphereLattice) -> ClassicCoded | None:
    """The kept radial values, in the lattice's order, raw: n times two bytes."""
    claimed, kept = _owned(state, lattice)
    values = scan.range_steps.ravel()[lattice.sample[kept]]
    if not values.size:
        return None
    return ClassicCoded(lattice, claimed, values.size, RangeCodec.RAW, 1, values.astype("<u2").tobytes())


def _code_texture(scan: Scan, state: ClassicState, lattice: SphereLattice, jpeg_q: int) -> ClassicCoded | None:
    """The kept texels, the lattice as an image, as JPEG."""
    claimed, kept = _owned(state, lattice)
    if not kept.any():
        return None
    rows, columns = bounds(kept[lattice.node])
    node = lattice.node[rows, columns]
    patch = replicate_edges(scan.texture.reshape(-1, 3)[lattice.sample[node]], kept[node])
    payload = codec_jpeg.encode(patch, jpeg_q)
    return ClassicCoded(lattice, claimed, int(np.count_nonzero(kept)), TextureCodec.JPEG, jpeg_q, payload)


def _owned(state: ClassicState, lattice: SphereLattice) -> tuple[BoolArray, BoolArray]:
    """What of a lattice becomes its own, and which samples that takes."""
    claimed = claim(lattice, state.holdings.on_sphere(lattice.shape.channel))
    return claimed, kept_samples(lattice, claimed)
