"""Golden vectors of spheres, for this project's every language.

`python tests/golden/write_sphere.py` writes tests/golden/sphere anew; tests only read it.

strips.json: `strides` by width, height, side of a block and half spacing. `range`: refinements over holdings, one after
the other, as hex of the whole message, with the strips they carry and what they leave: dense range as in
write_protocol.py (a scan by that rule, void where mix32(row W + column) mod 16 is 0, its rings thinned), holdings and
digest. `texture`: texel value i = mix32(i) mod 256, i counting bytes through all images; `polar`: left, top, columns
and rows of that of a pole; the dense result, 0 where nothing is adopted, may differ by the stated tolerance.

lattices.json, of the classic profile: angles are radians. rings: grid [W, H], fovea [theta_v, theta_h], plateau [cap,
spacing, rho, coarse]; bearings by ring; row and column of the snapped directions. literal: down and across are [count,
alpha, s]; the lattice as printed and rotated.
"""

from __future__ import annotations

import json
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import codec_lift
from protocol.codec import RangeCodec, TextureCodec, encode_mask
from protocol.grid import VOID
from protocol.holdings import Holdings, mix32, range_rank, texture_rank
from protocol.lattice import STRIDE_SETS, Channel, ChannelShape, Parameters
from protocol.reconstruct import Selection, content_hashes, cut, paste, range_patch
from protocol.refinement import POLAR, Generator, Refinement
from protocol.rings import ring_strides, thin_rings
from protocol.sphere import (
    DirectionGrid,
    Spread,
    literal_lattice,
    plateau_and_skirt,
    ring_lattice,
    rotated_lattice,
)
from protocol.strips import (
    blocks_of,
    build_strips,
    image_shapes,
    join_parts,
    samples_of,
    select_strips,
    texture_patches,
)

FOLDER = Path(__file__).with_name("sphere")
RHO_E = 178145  # round(65536 e), S' = 1
FOVEAE = [(0.0, 0.0), (math.pi, 1.0), (math.pi / 2, 0.0), (0.05, 6.28), (1.1, 3.3)]
GRIDS = [(360, 184), (40, 17)]
PLATEAUS = [(0.1, 0.0175, RHO_E, 0.3), (0.2, 0.05, 0, 0.3)]
SPREADS = [((8, 0.5, 20.0), (8, 0.5, 20.0)), ((3, 2.0, 8.0), (5, 0.1, 30.0))]
Pair = tuple[float, float]

RANGE = ChannelShape(Channel.RANGE, 64, 136, 8, 17, True)
TEXTURE = ChannelShape(Channel.TEXTURE, 64, 136, 8, 17, True)
BESIDE_THE_POLE = (0, 19, 3, 4, 4, 3, 6, 1)  # all round, then less and less, across the seam
STRIDES = [
    (64, 136, 8, 2), (64, 136, 8, 16), (64, 136, 16, 2), (360, 184, 8, 4), (96, 33, 8, 2), (50, 90, 16, 3),
    (4096, 2048, 16, 2), (4096, 2048, 16, 6), (36, 40, 8, 2), (7, 9, 8, 2),
]  # fmt: skip
RANGES = [
    (Parameters(4, 0, 0, 8, 17, strides=(1, 2, 8)), 12),
    (Parameters(4, 0, 0, 8, 6, listed=(*BESIDE_THE_POLE, 8), strides=(1, 2)), 7),
    (Parameters(2, 0, 11, 8, 6, strides=(1,)), 9),
    (Parameters(2, 0, 2, 8, 4, strides=(1, 4, 16)), 9),
    (Parameters(2, 0, 0, 8, 3), 1),
    (Parameters(2, 0, 0, 8, 5, listed=BESIDE_THE_POLE), 1),
    (Parameters(4, 6, 9, 4, 8, listed=4 * (1, 2, 1, 4)), 3),
    (Parameters(4, 6, 9, 4, 8, listed=4 * (1, 2, 1, 4)), 3),
    (Parameters(2, 3, 13, 3, 2, RHO_E, RHO_E), 2),
    (Parameters(16, 0, 0, 8, 17), 5),
    (Parameters(2, 0, 0, 8, 17), 1),
]
TEXTURES = [
    (Parameters(2, 0, 0, 4, 3), 60),
    (Parameters(2, 3, 5, 2, 4, listed=(0, 3, 1, 1, 1, 2)), 60),
    (Parameters(4, 0, 0, 4, 9), 60),
    (Parameters(3, 1, 6, 2, 3, RHO_E, RHO_E), 40),
    (Parameters(2, 3, 0, 2, 5, listed=(0, 3, 1, 1, 1, 2, 2), strides=(1,)), 60),
    (Parameters(4, 0, 0, 4, 9, strides=(1, 2)), 60),
    (Parameters(2, 0, 0, 4, 9, strides=(1, 2, 8)), 60),
    (Parameters(4, 0, 0, 4, 9, strides=(1, 4, 16)), 60),
    (Parameters(4, 0, 0, 4, 3, polar=True), 60),
    (Parameters(8, 3, 5, 2, 4, listed=(0, 3, 1, 1, 1, 2), polar=True), 60),
]


def vectors() -> dict[str, bytes]:
    """Every file of tests/golden/sphere by name."""
    files: dict[str, bytes] = {}
    strips: dict[str, list[Any]] = {
        "strides": [[*case, ring_strides(*case).tolist()] for case in STRIDES],
        "range": _ranges(files),
        "texture": [_texture(files, number, *case) for number, case in enumerate(TEXTURES)],
    }
    lattices: dict[str, list[Any]] = {
        "rings": [rings(grid, fovea, plateau) for grid in GRIDS for fovea in FOVEAE for plateau in PLATEAUS],
        "literal": [literal(GRIDS[0], fovea, *spreads) for fovea in FOVEAE for spreads in SPREADS],
    }
    return files | {"strips.json": _json(strips), "lattices.json": _json(lattices)}


def _ranges(files: dict[str, bytes]) -> list[dict[str, Any]]:
    holdings = Holdings.coarse({Channel.RANGE: RANGE, Channel.TEXTURE: TEXTURE})
    scan = scan_of(RANGE)
    dense = np.full(scan.shape, 1, np.uint16)
    steps = []
    for seq, (parameters, quantum) in enumerate(RANGES):
        steps.append(_range(holdings, scan, dense, seq, parameters, quantum))
    files["range.bin"] = dense.astype("<u2").tobytes()
    return steps


def _range(
    holdings: Holdings,
    scan: NDArray[np.uint16],
    dense: NDArray[np.uint16],
    seq: int,
    parameters: Parameters,
    quantum: int,
) -> dict[str, Any]:
    held, rank = holdings.channels[Channel.RANGE], range_rank(quantum)
    strips = select_strips(build_strips(RANGE, parameters), held, rank)
    images, masks = [], []
    for selection in (strip.selection for strip in strips):
        rows, columns = _places(selection)
        samples = np.maximum(scan[np.ix_(rows, columns)], 1)
        images.append(codec_lift.Survey(samples, quantum))
        void = (np.asarray(cut(scan, selection)) == VOID) & selection.seen_cells()
        patch = range_patch(selection, images[-1].decoded)
        patch[void] = VOID
        paste(dense, patch, selection)
        holdings.add_content(selection.adopted_blocks(), content_hashes(patch, selection))
        masks.append(encode_mask(void))
    for strip in strips:
        held.adopt(strip.selection.lattice, strip.adopted, rank)
    refinement = Refinement(
        Generator.FOVEA, Channel.RANGE, 1, seq, 1, RangeCodec.LIFT, quantum, samples_of(strips),
        codec_lift.encode_surveyed(images) if images else b"", join_parts(masks), parameters,
    )  # fmt: skip
    return {
        "refinement": refinement.to_bytes().hex() if strips else None,
        "parameters": _parameters(parameters),
        "strips": [_strip(strip.selection) for strip in strips],
        "adopted": np.sort(blocks_of(strips)).tolist(),
        "denseCrc": f"{zlib.crc32(dense.astype('<u2').tobytes()):08x}",
        "runs": held.to_runs(),
        "content": holdings.content,
        "digest": holdings.digest(),
    }


def _texture(files: dict[str, bytes], number: int, parameters: Parameters, quality: int) -> dict[str, Any]:
    held = Holdings.coarse({Channel.RANGE: RANGE, Channel.TEXTURE: TEXTURE}).channels[Channel.TEXTURE]
    strips = select_strips(build_strips(TEXTURE, parameters), held, texture_rank(quality))
    values = (mix32(np.arange(3 * samples_of(strips), dtype=np.uint32)) % np.uint32(256)).astype(np.uint8)
    dense, done = np.zeros((TEXTURE.height, TEXTURE.width, 3), np.uint8), 0
    images = []
    for shape in image_shapes(strips, TextureCodec.JPEG):
        size = 3 * math.prod(shape)
        images.append(values[done : done + size].reshape(*shape, 3))
        done += size
    for strip, patch in zip(strips, texture_patches(strips, images), strict=True):
        paste(dense, patch, strip.selection)
    files[f"texture_{number}.bin"] = dense.tobytes()
    return {
        "parameters": _parameters(parameters),
        "quality": quality,
        "strips": [_strip(strip.selection) for strip in strips],
        "polar": (polar := strips[0].polar) and [polar.left, polar.top, polar.columns, polar.rows],
        "tolerance": 2,
        "dense": f"texture_{number}.bin",
    }


def scan_of(shape: ChannelShape) -> NDArray[np.uint16]:
    """The range of a scan by rule."""
    noise = mix32(np.arange(shape.width * shape.height, dtype=np.uint32))
    steps = np.where(noise % 16 == 0, VOID, 1 + noise % np.uint32(65535)).astype(np.uint16)
    return thin_rings(steps.reshape(shape.height, shape.width))


def _places(selection: Selection) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Dense rows and columns of the samples that travel."""
    lattice, shape = selection.lattice, selection.lattice.shape
    columns = lattice.x.border[selection.x.sample] // 2 % shape.own_width * shape.stride
    return lattice.y.border[selection.y.sample] // 2, columns


def _strip(selection: Selection) -> dict[str, Any]:
    lattice = selection.lattice
    return {
        "stride": lattice.shape.stride,
        "xAt": lattice.x.at.tolist(),
        "rows": selection.y.sample.size,
        "columns": selection.x.sample.size,
        "yStart": selection.y.start,
        "xStart": selection.x.start,
        "height": selection.y.low.size,
        "width": selection.x.low.size,
        "adopted": selection.adopted_blocks().tolist(),
        "level": np.unique(lattice.level[np.isin(lattice.y.block, selection.y.block)]).tolist(),
    }


def _parameters(p: Parameters) -> dict[str, Any]:
    return {
        "halfSpacing": p.half_spacing, "blockX": p.block_x, "blockY": p.block_y, "blocksWide": p.blocks_wide,
        "blocksHigh": p.blocks_high, "rhoX": p.rho_x, "rhoY": p.rho_y,
        "listed": None if p.listed is None else list(p.listed),
        "strides": POLAR if p.polar else STRIDE_SETS.index(p.strides),
    }  # fmt: skip


def rings(grid: tuple[int, int], fovea: Pair, plateau: tuple[float, float, int, float]) -> dict[str, Any]:
    """One case of the rings round a direction."""
    circles = plateau_and_skirt(*plateau)
    row, column = ring_lattice(DirectionGrid(*grid), *fovea, circles)
    return {
        "grid": grid, "fovea": fovea, "plateau": plateau, "bearings": circles.bearings.tolist(),
        "row": row.tolist(), "column": column.tolist(),
    }  # fmt: skip


def literal(
    grid: tuple[int, int], fovea: Pair, down: tuple[int, float, float], across: tuple[int, float, float]
) -> dict[str, Any]:
    """One case of the paper's lattice, as printed and rotated."""
    case: dict[str, Any] = {"grid": grid, "fovea": fovea, "down": down, "across": across}
    for name, lattice in (("literal", literal_lattice), ("rotated", rotated_lattice)):
        row, column = DirectionGrid(*grid).snap_unique(*lattice(*fovea, Spread(*down), Spread(*across)))
        case |= {f"{name}_row": row.tolist(), f"{name}_column": column.tolist()}
    return case


def _json(cases: dict[str, list[Any]]) -> bytes:
    lines = {name: ",\n  ".join(json.dumps(case) for case in entries) for name, entries in cases.items()}
    return ("{\n" + ",\n".join(f'"{name}": [\n  {text}\n]' for name, text in lines.items()) + "\n}\n").encode()


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for old in FOLDER.iterdir():
        old.unlink()
    for name, content in vectors().items():
        (FOLDER / name).write_bytes(content)
