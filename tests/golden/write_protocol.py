"""Golden vectors of lattice, holdings, reconstruction, refinements and messages, for this project's every language.

`python tests/golden/write_protocol.py` writes tests/golden/protocol anew; tests only read it. Scans are made by a rule
instead of being stored: range(row, column) = 1 + mix32(row W + column) mod 65535, texel value i = mix32(i) mod 256
(i counts bytes of the payload), coarse cell i = mix32(i) mod 65536, void where that is below 20000.
Arrays in JSON are in row order; dense results lie beside it as .bin (uint16 little-endian, or RGB bytes). A texture
patch is the selection's rectangle, 0 where nothing is adopted; texture may differ by the stated tolerance.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages as m
from protocol.errors import FoveascanError
from protocol.grid import dequantise, quantise
from protocol.holdings import ChannelHoldings, Holdings, hash_blocks, mix32, range_rank, texture_rank
from protocol.lattice import (
    RHO_MAX,
    RHO_ONE,
    Axis,
    Channel,
    ChannelShape,
    Parameters,
    build_lattice,
    level_of_gap,
    skirt_steps,
)
from protocol.reconstruct import (
    Selection,
    coarse_to_range,
    coarse_to_texture,
    content_hashes,
    paste,
    range_patch,
    select,
    texture_patch,
)
from protocol.refinement import Generator, Refinement

FOLDER = Path(__file__).with_name("protocol")
RHO_E = 178145  # round(65536 e), S' = 1

RANGE_S = ChannelShape(Channel.RANGE, 360, 100, 45, 13)
TEXTURE_S = ChannelShape(Channel.TEXTURE, 1024, 256, 128, 32)
RANGE_ODD = ChannelShape(Channel.RANGE, 36, 17, 3, 2)
TEXTURE_ODD = ChannelShape(Channel.TEXTURE, 50, 33, 5, 3)
RANGE_NARROW = ChannelShape(Channel.RANGE, 8, 30, 1, 1)
RANGE_FLAT = ChannelShape(Channel.RANGE, 40, 1, 5, 1)
TEXTURE_FLAT = ChannelShape(Channel.TEXTURE, 49, 1, 3, 1)

LATTICES: list[tuple[ChannelShape, Parameters]] = [
    (RANGE_S, Parameters(2, 10, 4, 3, 2, RHO_E, RHO_E)),
    (RANGE_S, Parameters(2, 10, 4, 3, 2)),
    (RANGE_S, Parameters(4, 43, 0, 5, 3, RHO_E, RHO_E)),
    (RANGE_S, Parameters(8, 44, 10, 2, 3, RHO_ONE, 91234)),
    (RANGE_S, Parameters(16, 0, 11, 1, 2, RHO_MAX, RHO_ONE)),
    (RANGE_S, Parameters(8, 0, 3, 45, 2, RHO_ONE, RHO_E)),
    (RANGE_S, Parameters(2, 40, 5, 10, 2, RHO_E, RHO_E, (3, 2, 7, 1, 7))),
    (RANGE_S, Parameters(2, 7, 5, 44, 1, 70000, 70000)),
    (RANGE_ODD, Parameters(4, 4, 2, 1, 1, 80000, 80000)),
    (RANGE_ODD, Parameters(2, 3, 0, 3, 2, 70000, 0)),
    (RANGE_NARROW, Parameters(8, 0, 1, 1, 1, RHO_ONE, 70000)),
    (RANGE_FLAT, Parameters(4, 4, 0, 2, 1, 70000, 70000)),
    (TEXTURE_S, Parameters(2, 20, 6, 4, 3, RHO_E, RHO_E)),
    (TEXTURE_S, Parameters(3, 62, 0, 5, 4, RHO_E, RHO_E)),
    (TEXTURE_S, Parameters(4, 20, 12, 4, 4, 0, 0)),
    (TEXTURE_S, Parameters(6, 63, 14, 2, 2, 70000, 70000)),
    (TEXTURE_S, Parameters(8, 3, 3, 1, 2, RHO_ONE, RHO_ONE)),
    (TEXTURE_S, Parameters(12, 33, 0, 3, 3, RHO_E, RHO_E, (0, 2, 3, 4))),
    (TEXTURE_S, Parameters(16, 0, 7, 64, 2, RHO_E, RHO_E)),
    (TEXTURE_ODD, Parameters(3, 3, 1, 2, 2, 70000, 300000)),
    (TEXTURE_ODD, Parameters(2, 2, 0, 1, 1, 6 * RHO_ONE, 6 * RHO_ONE)),
    (TEXTURE_ODD, Parameters(2, 0, 1, 4, 1, 0, 6 * RHO_ONE)),
    (TEXTURE_FLAT, Parameters(6, 3, 0, 2, 1, 70000, 0)),
]

RANGE_SERIES: list[tuple[ChannelShape, list[tuple[Parameters, int]]]] = [
    (
        ChannelShape(Channel.RANGE, 80, 33, 5, 3),
        [
            (Parameters(4, 8, 2, 4, 2, RHO_E, RHO_E), 3),
            (Parameters(2, 9, 2, 2, 1, 70000, 70000), 2),
            (Parameters(2, 9, 2, 2, 1, 70000, 70000), 2),
            (Parameters(8, 0, 0, 10, 5, RHO_ONE, RHO_ONE), 1),
            (Parameters(2, 8, 1, 4, 3, RHO_E, RHO_E, (1, 2, 2, 3, 4)), 1),
            (Parameters(2, 3, 3, 2, 2, 0, 0), 7),
        ],
    ),
    (
        RANGE_ODD,
        [
            (Parameters(4, 4, 2, 1, 1, 80000, 80000), 65534),
            (Parameters(8, 0, 0, 5, 1, 0, 70000), 5),
            (Parameters(2, 3, 0, 3, 3, 70000, 70000), 1),
            (Parameters(2, 0, 0, 5, 3, 0, 0), 1),
        ],
    ),
]

TEXTURES: list[tuple[ChannelShape, Parameters]] = [
    (ChannelShape(Channel.TEXTURE, 96, 49, 6, 3), Parameters(half, 5, 1, 2, 1, RHO_E, RHO_E))
    for half in (2, 3, 4, 6, 8, 12, 16)
] + [(TEXTURE_ODD, Parameters(3, 3, 1, 2, 2, 70000, 300000)), (TEXTURE_ODD, Parameters(2, 0, 0, 4, 1, 0, 6 * RHO_ONE))]


def vectors() -> dict[str, bytes]:
    """Every file of tests/golden/protocol by name."""
    files: dict[str, bytes] = {}
    files["lattice.json"] = _json(_lattices())
    files["range.json"] = _json([_range_series(files, i, *case) for i, case in enumerate(RANGE_SERIES)])
    files["texture.json"] = _json([_texture(files, i, *case) for i, case in enumerate(TEXTURES)])
    files["first_view.json"] = _json(_first_views(files))
    files["holdings.json"] = _json(_holdings())
    files["refinement.json"] = _json(_refinements())
    files["messages.json"] = _json(_messages())
    return files


def _lattices() -> dict[str, Any]:
    gaps = [0, 4, 5, 6, 8, 9, 11, 12, 16, 17, 23, 24, 32, 33, 48, 64, 65, 1000, 65536]
    steps = [
        (half, rho, coarse) for half in (2, 3, 16) for rho in (0, RHO_ONE, 70000, RHO_E, RHO_MAX) for coarse in (7, 90)
    ]
    return {
        "levels": [[gap, int(level_of_gap(np.array([gap]))[0])] for gap in gaps],
        "skirts": [
            {
                "halfSpacing": half,
                "rho": rho,
                "coarseSpacing": coarse,
                "reach": 200,
                "steps": skirt_steps(half, rho, coarse, 200),
            }
            for half, rho, coarse in steps
        ],
        "lattices": [_lattice(*case) for case in LATTICES],
        "refused": [_parameters(p) for p in _refused_parameters()],
        "refusedShape": _shape(RANGE_S),
    }


def _lattice(shape: ChannelShape, parameters: Parameters) -> dict[str, Any]:
    lattice = build_lattice(shape, parameters)
    return {
        "shape": _shape(shape),
        "coarseLevel": shape.coarse_level,
        "parameters": _parameters(parameters),
        "x": _axis(lattice.x),
        "y": _axis(lattice.y),
        "level": lattice.level.ravel().tolist(),
        "listed": lattice.listed.ravel().astype(int).tolist(),
    }


def _refused_parameters() -> Iterable[Parameters]:
    for change in (
        {"half_spacing": 3}, {"block_x": 45}, {"block_y": 13}, {"blocks_wide": 0}, {"blocks_high": 0},
        {"blocks_wide": 46}, {"blocks_high": 14}, {"blocks_wide": 45, "block_x": 1},
        {"rho_x": 1}, {"rho_x": RHO_ONE - 1}, {"rho_y": RHO_MAX + 1},
        {"listed": (3,)}, {"listed": (2, 3)}, {"listed": (1 << 34, 1 << 34)},
    ):  # fmt: skip
        fields: dict[str, Any] = {"half_spacing": 2, "block_x": 0, "block_y": 0, "blocks_wide": 2, "blocks_high": 2}
        yield Parameters(**(fields | change))


def _range_series(
    files: dict[str, bytes], number: int, shape: ChannelShape, series: list[tuple[Parameters, int]]
) -> dict[str, Any]:
    texture = ChannelShape(Channel.TEXTURE, 64, 32, 8, 4)
    holdings = Holdings.coarse({Channel.RANGE: shape, Channel.TEXTURE: texture})
    held = holdings.channels[Channel.RANGE]
    scan = _scan(shape)
    dense = np.full(scan.shape, 1, np.uint16)
    steps = []
    for parameters, quantum in series:
        steps.append(_range_step(holdings, held, scan, dense, parameters, quantum))
    files[f"range_{number}.bin"] = dense.astype("<u2").tobytes()
    return {
        "shape": _shape(shape),
        "textureShape": _shape(texture),
        "denseBefore": 1,
        "digestBefore": Holdings.coarse({Channel.RANGE: shape, Channel.TEXTURE: texture}).digest(),
        "steps": steps,
        "denseAfter": f"range_{number}.bin",
    }


def _range_step(
    holdings: Holdings, held: ChannelHoldings, scan: NDArray[np.uint16], dense: NDArray[np.uint16],
    parameters: Parameters, quantum: int,
) -> dict[str, Any]:  # fmt: skip
    step: dict[str, Any] = {"parameters": _parameters(parameters), "quantum": quantum, "rank": range_rank(quantum)}
    chosen = select(build_lattice(held.shape, parameters), held, range_rank(quantum))
    if chosen is None:
        return step | {"rows": 0, "columns": 0, "adopted": [], "digest": holdings.digest()}
    selection, adopted = chosen
    lattice = selection.lattice
    rows = lattice.y.border[selection.y.sample] // 2
    columns = lattice.x.border[selection.x.sample] // 2 % held.shape.width
    values = quantise(scan[np.ix_(rows, columns)], quantum)
    patch = range_patch(selection, dequantise(values, quantum))
    paste(dense, patch, selection)
    held.adopt(lattice, adopted, range_rank(quantum))
    holdings.add_content(selection.adopted_blocks(), content_hashes(patch, selection))
    return step | _selected(selection) | {
        "values": values.ravel().tolist() if values.size <= 400 else None,
        "valuesCrc": _crc(values),
        "patchCrc": _crc(patch),
        "hashes": content_hashes(patch, selection).tolist(),
        "denseCrc": _crc(dense),
        "runs": held.to_runs(),
        "content": holdings.content,
        "digest": holdings.digest(),
    }  # fmt: skip


def _texture(files: dict[str, bytes], number: int, shape: ChannelShape, parameters: Parameters) -> dict[str, Any]:
    chosen = select(build_lattice(shape, parameters), ChannelHoldings.coarse(shape), texture_rank(60))
    assert chosen is not None
    selection, _ = chosen
    size = selection.samples * 3
    texels = (mix32(np.arange(size, dtype=np.uint32)) % np.uint32(256)).astype(np.uint8)
    patch = texture_patch(selection, texels.reshape(*selection.sample_shape, 3))
    patch[~selection.adopted_cells()] = 0
    files[f"texture_{number}.bin"] = patch.tobytes()
    return {"shape": _shape(shape), "parameters": _parameters(parameters), "quality": 60} | _selected(selection) | {
        "tolerance": 2,
        "patch": f"texture_{number}.bin",
    }  # fmt: skip


def _first_views(files: dict[str, bytes]) -> dict[str, Any]:
    ranges, textures = [], []
    for number, shape in enumerate((RANGE_ODD, RANGE_NARROW, RANGE_FLAT, ChannelShape(Channel.RANGE, 60, 21, 7, 5))):
        size = shape.coarse_width * shape.coarse_height
        coarse = (mix32(np.arange(size, dtype=np.uint32)) % np.uint32(65536)).astype(np.uint16)
        coarse[coarse < 20000] = 0
        dense = coarse_to_range(coarse.reshape(shape.coarse_height, shape.coarse_width), shape)
        files[f"first_range_{number}.bin"] = dense.astype("<u2").tobytes()
        ranges.append({"shape": _shape(shape), "coarse": coarse.tolist(), "dense": f"first_range_{number}.bin"})
    for number, shape in enumerate((TEXTURE_ODD, TEXTURE_FLAT, ChannelShape(Channel.TEXTURE, 64, 32, 8, 4))):
        size = shape.coarse_width * shape.coarse_height * 3
        texels = (mix32(np.arange(size, dtype=np.uint32)) % np.uint32(256)).astype(np.uint8)
        image = coarse_to_texture(texels.reshape(shape.coarse_height, shape.coarse_width, 3), shape)
        files[f"first_texture_{number}.bin"] = image.tobytes()
        textures.append({"shape": _shape(shape), "tolerance": 2, "dense": f"first_texture_{number}.bin"})
    return {"range": ranges, "texture": textures}


def _holdings() -> dict[str, Any]:
    shape = RANGE_S
    cells = (mix32(np.arange(128, dtype=np.uint32)) % np.uint32(65536)).astype(np.uint16).reshape(2, 8, 8)
    holdings = Holdings.coarse({Channel.RANGE: shape, Channel.TEXTURE: TEXTURE_S})
    holdings.add_content(np.array([0, 584]), hash_blocks(cells))
    refused = [
        [],
        [[584, 8, 0]],
        [[585, shape.coarse_level + 1, 0]],
        [[585, 0, 65535]],
        [[0, 0, 0], [585, 0, 0]],
        [[585, 0]],
    ]
    return {
        "mix32": [
            [value, int(mix32(np.array([value], np.uint32))[0])] for value in (0, 1, 2, 65535, 0xDEADBEEF, 0xFFFFFFFF)
        ],
        "hashes": {"cells": cells.ravel().tolist(), "hash": hash_blocks(cells).tolist(), "blocks": [0, 584]},
        "contentOfHashes": holdings.content,
        "shape": _shape(shape),
        "coarseRuns": ChannelHoldings.coarse(shape).to_runs(),
        "accepted": [[585, 0, 65534]],
        "refused": refused,
        "adoption": [
            [channel.name.lower(), *held, *offered, int(_adopts(channel, held, offered))]
            for channel, qualities in ((Channel.RANGE, (0, 65530, 65534)), (Channel.TEXTURE, (0, 61, 63, 64)))
            for held in [(level, rank) for level in (0, 2, 4) for rank in qualities]
            for offered in [(level, rank) for level in (0, 2, 4) for rank in qualities if rank]
        ],
    }


def _adopts(channel: Channel, held: tuple[int, int], offered: tuple[int, int]) -> bool:
    """Whether one block at (level, rank) takes what is offered, the coarse level being 4."""
    shape = ChannelShape(channel, 64, 64, 16, 16)
    half = {0: 2, 2: 4, 4: 8}[offered[0]]
    lattice = build_lattice(shape, Parameters(half, 1, 1, 1, 1))
    rows, columns = shape.blocks
    state = ChannelHoldings(
        shape, np.full((rows, columns), held[0], np.uint8), np.full((rows, columns), held[1], np.uint16)
    )
    row, column = lattice.y.block.tolist().index(1), lattice.x.block.tolist().index(1)
    assert lattice.level[row, column] == offered[0]
    return bool(state.adoptable(lattice, offered[1])[row, column])


def _refinements() -> dict[str, Any]:
    p = Parameters(4, 44, 5, 2, 2, RHO_E, 0, (1, 300))
    whole = [
        Refinement(Generator.COARSE, Channel.RANGE, 1, 0, 0, 2, 1, 585, b"\x01\x02\x03", b"\x09"),
        Refinement(Generator.COARSE, Channel.TEXTURE, 1, 1, 0, 2, 60, 4096, b"\xff" * 7),
        Refinement(Generator.FOVEA, Channel.RANGE, 65535, 0xFFFFFFFF, 7, 2, 65534, 289, b"payload", b"mask", p, True),
        Refinement(Generator.FOVEA, Channel.TEXTURE, 2, 3, 4, 1, 40, 100, b"", b"", Parameters(3, 1, 2, 3, 4)),
    ]
    good = whole[3].to_bytes()
    refused = [good[:-1], good + b"\0", good[:10] + b"\1" + good[11:], b"", b"RF"]
    return {
        "whole": [
            {
                "hex": refinement.to_bytes().hex(),
                "generator": int(refinement.generator),
                "channel": int(refinement.channel),
                "epoch": refinement.epoch,
                "seq": refinement.seq,
                "look": refinement.look,
                "codec": refinement.codec,
                "quality": refinement.quality,
                "samples": refinement.samples,
                "selfContained": refinement.self_contained,
                "parameters": _parameters(sent) if isinstance(sent := refinement.parameters, Parameters) else None,
                "mask": refinement.mask.hex(),
                "payload": refinement.payload.hex(),
            }
            for refinement in whole
        ],
        "refused": [data.hex() for data in refused],
    }


def _messages() -> dict[str, Any]:
    scan = m.ScanInfo("ab12", 360, 100, 1024, 256, 45, 13, 128, 32, 0.01, 1.5, 150.0, 0.25)
    statement = m.Statement([[585, 7, 0]], [[1000, 6, 0], [24, 0, 61]])
    accepted: list[m.Message] = [
        m.ServerInfo("foveascan.v1", "n1", "node", "0.1.0"),
        m.Hello("foveascan.v1", "a viewer"),
        m.Welcome("view"),
        m.Open(1, "latest"),
        m.Open(2, "ab12", statement),
        m.Opened(1, 2, scan),
        m.Look(3, 0.5, 0.25, window=0.05, max_wait_s=0.5),
        m.Look(4, 0.0, 0.0, parameters=m.LookParameters(m.RangeParameters(2, 1), m.TextureParameters(1.5, 60, "jpeg"))),
        m.Updated(3, 5, "complete"),
        m.Ack(2, 5, "0123456789abcdef", 1.5),
        m.Resync(2, "digest differs"),
        m.State(2, 5, statement),
        m.Cancel(4),
        m.Published("ab12"),
        m.Refused(3, "not found", "no such scan"),
        m.Goodbye("shutting down"),
    ]
    refused = [
        "", "[]", "{}", '{"type":"shout"}',
        '{"type":"cancel"}', '{"type":"cancel","request":-1}', '{"type":"cancel","request":1.5}',
        '{"type":"look","request":1,"u":1,"v":0}', '{"type":"look","request":1,"u":0,"v":0,"window":0}',
        '{"type":"ack","epoch":65536,"nextSeq":0,"digest":"0123456789abcdef"}',
        '{"type":"ack","epoch":1,"nextSeq":0,"digest":"0123456789ABCDEF"}',
    ]  # fmt: skip
    for text in refused:
        try:
            m.decode_message(text)
        except FoveascanError:
            continue
        raise AssertionError(f"{text} is understood")
    return {"accepted": [json.loads(m.encode_message(message)) for message in accepted], "refused": refused}


def _selected(selection: Selection) -> dict[str, Any]:
    return {
        "rows": selection.y.sample.size,
        "columns": selection.x.sample.size,
        "ySample": selection.y.sample.tolist(),
        "xSample": selection.x.sample.tolist(),
        "yStart": selection.y.start,
        "xStart": selection.x.start,
        "height": selection.y.low.size,
        "width": selection.x.low.size,
        "adopted": selection.adopted_blocks().tolist(),
    }


def _axis(axis: Axis) -> dict[str, Any]:
    names = ("at", "sample", "border", "block", "start", "stop", "gap", "first", "last")
    return {"count": axis.count} | {name: getattr(axis, name).tolist() for name in names}


def _shape(shape: ChannelShape) -> dict[str, Any]:
    return {
        "channel": shape.channel.name.lower(),
        "width": shape.width,
        "height": shape.height,
        "coarseWidth": shape.coarse_width,
        "coarseHeight": shape.coarse_height,
    }


def _parameters(p: Parameters) -> dict[str, Any]:
    return {
        "halfSpacing": p.half_spacing,
        "blockX": p.block_x,
        "blockY": p.block_y,
        "blocksWide": p.blocks_wide,
        "blocksHigh": p.blocks_high,
        "rhoX": p.rho_x,
        "rhoY": p.rho_y,
        "listed": None if p.listed is None else list(p.listed),
    }


def _scan(shape: ChannelShape) -> NDArray[np.uint16]:
    index = np.arange(shape.width * shape.height, dtype=np.uint32)
    values = np.uint32(1) + mix32(index) % np.uint32(65535)
    return values.astype(np.uint16).reshape(shape.height, shape.width)


def _crc(array: NDArray[np.uint16]) -> str:
    return f"{zlib.crc32(array.astype('<u2').tobytes()):08x}"


def _json(value: Any) -> bytes:
    """One vector a line, so that a change shows where it is."""
    if isinstance(value, list):
        lines = ",\n".join(json.dumps(item, separators=(",", ":")) for item in value)
        return f"[\n{lines}\n]\n".encode()
    parts = []
    for key, item in value.items():
        body = _json(item).decode().rstrip() if isinstance(item, list) else json.dumps(item, separators=(",", ":"))
        parts.append(f"{json.dumps(key)}: {body}")
    return ("{\n" + ",\n".join(parts) + "\n}\n").encode()


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for old in FOLDER.iterdir():
        old.unlink()
    for name, content in vectors().items():
        (FOLDER / name).write_bytes(content)
