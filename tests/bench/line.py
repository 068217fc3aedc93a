"""`bench line`: how fast a byte of the scanner becomes a frame, a sweep becomes a scan, a click becomes pixels.

Each figure is a ratio to something that the same machine did in the same run: copying the bytes, copying the arrays,
`cv2.imencode` and `cv2.imdecode` of the same patch.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from client.model import Model
from exchange.formats import SIZES
from node.assemble import Assembler
from node.coarse import build_coarse, build_pyramid, fill_voids
from node.first_view import FirstView, build_first_view
from node.foveate import Update, plan_update
from node.library import Scan
from node.refine_texture import texture_lattice
from node.resampling import Encoder
from node.sample import texture_samples
from node.texture_model import TextureModel
from node.wanted import Models, Wanted
from protocol.codec import JPEG_QUALITY_MIN, jpeg_q
from protocol.framing import USB_PAYLOAD_MAX, Frame, FrameReader, encode_frame
from protocol.grid import Grid, ImageArray
from protocol.holdings import ChannelHoldings, texture_rank
from protocol.lattice import Channel, build_lattice
from protocol.messages import (
    CodecName,
    Look,
    LookParameters,
    Opened,
    RangeParameters,
    TextureParameters,
    encode_message,
)
from protocol.reconstruct import select
from protocol.refinement import Refinement
from protocol.region import region_round
from simulators.specimen import GENERATORS
from tests.bench.scans import REAL, BenchScan, Skipped, load
from tests.bench.timing import MEGABYTE, medians_s

PAYLOAD_BYTES = 4096
READ_BYTES = 65536
STREAM_FRAMES = 4096
WINDOW = 0.05
QUALITY = 42  # reaches 40 dB on a skin-like texture
FIRST_VIEW_BYTES = 32768
CODECS: tuple[CodecName, ...] = ("jpeg", "htj2k")
THREADS = ThreadPoolExecutor(1, "encode")  # that a node has beside the one that plans


@dataclass(frozen=True)
class Case:
    """One kind of update with explicit parameters."""

    codec: CodecName
    texture_p: float
    quick: bool = False

    @property
    def name(self) -> str:
        return f"{self.codec}{', quick' if self.quick else ''}, texture p {self.texture_p:g}, range p 2"

    def look(self, u: float, v: float) -> Look:
        texture = TextureParameters(p=self.texture_p, quality=QUALITY, codec=self.codec)
        range_ = RangeParameters(p=2, quantum=8)
        return Look(1, u, v, WINDOW, parameters=LookParameters(range_, texture))


CASES = (
    *(Case(codec, p) for codec in CODECS for p in (1, 2)),
    Case("jpeg", 1, quick=True),
    Case("jpeg", 2, quick=True),
)


def run(scan: BenchScan, clicks: int, repeats: int, sizes: Iterable[str] = tuple(SIZES)) -> dict[str, Any]:
    """Everything, on one scan; its first view at every size that it has."""
    with tempfile.TemporaryDirectory(prefix="foveascan-bench-") as folder:
        published = scan.published(Path(folder))
        return {
            "scan": scan.name, "size": scan.size, "repeats": repeats,
            "deframing": deframing(repeats),
            "after_last_column": after_last_column(scan.grid, repeats),
            "updates": [update(published, case, scan.clicks(1)[0], repeats) for case in CASES],
            "searched": searched(published, scan, clicks),
            "first_view_bytes": first_views(scan, sizes),
        }  # fmt: skip


def deframing(repeats: int) -> dict[str, float]:
    """Frames of 4 KiB payload fed in 64 KiB reads, against copying the same reads."""
    stream = _frames(STREAM_FRAMES)
    reads = [stream[at : at + READ_BYTES] for at in range(0, len(stream), READ_BYTES)]
    target = bytearray(READ_BYTES)

    def deframe() -> None:
        reader = FrameReader(USB_PAYLOAD_MAX)
        frames = 0
        for read in reads:
            reader.receive_data(read)
            while isinstance(reader.next_event(), Frame):
                frames += 1
        assert frames == STREAM_FRAMES

    def copy() -> None:
        for read in reads:
            target[: len(read)] = read

    taken_s = medians_s({"deframe": deframe, "copy": copy}, repeats)
    return {
        "mb_s": len(stream) / MEGABYTE / taken_s["deframe"],
        "copy_mb_s": len(stream) / MEGABYTE / taken_s["copy"],
        "times_copy": taken_s["deframe"] / taken_s["copy"],
    }


def after_last_column(grid: Grid, repeats: int) -> dict[str, float]:
    """Grid, coarse model, filled range and pyramid, each in ms, and their sum against copying the arrays."""
    assembler = _all_columns(grid)

    def copy() -> None:
        grid.range_steps.copy(), grid.texture.copy()

    coarse = build_coarse(grid)
    spacing = int(min(coarse.texture_spacing))
    jobs: dict[str, Callable[[], Any]] = {
        "grid": assembler.finish,
        "coarse": lambda: build_coarse(grid),
        "filled": lambda: fill_voids(grid.range_steps),
        "pyramid": lambda: build_pyramid(grid.texture, spacing),
        "copy": copy,
    }
    taken_s = medians_s(jobs, repeats)
    total_s = sum(taken_s.values()) - taken_s["copy"]
    in_ms = {f"{name}_ms": 1000 * seconds for name, seconds in taken_s.items()}
    return {**in_ms, "total_ms": 1000 * total_s, "times_copy": total_s / taken_s["copy"]}


def update(scan: Scan, case: Case, click: tuple[float, float], repeats: int) -> dict[str, Any]:
    """Planning, encoding and packing one update, in two threads as in a node, and applying it, against OpenCV's JPEG of
    the same patch."""
    view = build_first_view(scan, case.codec, FIRST_VIEW_BYTES)
    look = case.look(*click)
    patch = texture_patch_sent(scan, view, look)
    whole_look = LookParameters(texture=look.parameters.texture if look.parameters else None)
    texture_look = Look(1, *click, WINDOW, parameters=whole_look)
    refinements = _plan(scan, view, look, case)[1]
    flags = [cv2.IMWRITE_JPEG_QUALITY, jpeg_q(max(QUALITY, JPEG_QUALITY_MIN)), cv2.IMWRITE_JPEG_SAMPLING_FACTOR]
    flags.append(cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
    encoded = cv2.imencode(".jpg", patch, flags)[1]
    model = opened_model(view)
    jobs: dict[str, Callable[[], Any]] = {
        "imencode": lambda: cv2.imencode(".jpg", patch, flags),
        "node": lambda: _plan(scan, view, look, case),
        "node_texture": lambda: _plan(scan, view, texture_look, case),
        "imdecode": lambda: cv2.imdecode(encoded, cv2.IMREAD_COLOR),
        "client": lambda: [_fresh(model).apply(refinement) for refinement in refinements],
        "client_fresh": lambda: [_fresh(model) for _ in refinements],
    }
    taken_s = medians_s(jobs, repeats)
    client_s = taken_s["client"] - taken_s["client_fresh"]
    return {
        "case": case.name,
        "patch": list(patch.shape[:2]),
        "wire_bytes": sum(len(refinement.to_bytes()) for refinement in refinements),
        "imencode_ms": 1000 * taken_s["imencode"],
        "node_ms": 1000 * taken_s["node"],
        "node_times_imencode": taken_s["node"] / taken_s["imencode"],
        "texture_only_times_imencode": taken_s["node_texture"] / taken_s["imencode"],
        "client_ms": 1000 * client_s,
        "client_times_imdecode": client_s / taken_s["imdecode"],
    }


def searched(published: Scan, scan: BenchScan, clicks: int) -> dict[str, Any]:
    """How many images the node encodes when it chooses the parameters itself."""
    encodes: dict[str, list[int]] = {}
    model = Models(texture=TextureModel(published.texture))
    for codec in CODECS:
        view = build_first_view(published, codec, FIRST_VIEW_BYTES)
        looks = [Look(1, u, v, WINDOW) for u, v in scan.clicks(clicks)]
        wanted = [Wanted(look, (codec,)) for look in looks]
        encodes[codec] = [plan_update(published, view.state, each, model).encodes for each in wanted]
    return {f"encodes_{codec}": counts for codec, counts in encodes.items()}


def first_views(scan: BenchScan, among: Iterable[str]) -> dict[str, dict[str, int] | str]:
    """First view at every size: bytes of its three messages, by codec."""
    sizes: dict[str, dict[str, int] | str] = {}
    for size in among if scan.name in (*GENERATORS, *REAL) else (scan.size,):
        try:
            sized = scan if size == scan.size else load(scan.name, size)
        except Skipped as reason:
            sizes[size] = str(reason)
            continue
        with tempfile.TemporaryDirectory(prefix="foveascan-bench-") as folder:
            published = sized.published(Path(folder))
            sizes[size] = {codec: _view_bytes(published, codec) for codec in CODECS}
    return sizes


def told(record: dict[str, Any]) -> str:
    """The figures as text."""
    frames, ready = record["deframing"], record["after_last_column"]
    lines = [
        f"{record['scan']} {record['size']}, medians of {record['repeats']} interleaved repeats",
        f"deframing: {frames['mb_s']:.0f} MB/s, {frames['times_copy']:.1f} x copying",
        f"after the last column: {ready['total_ms']:.0f} ms, {ready['times_copy']:.1f} x copying the arrays (grid"
        f" {ready['grid_ms']:.0f}, coarse {ready['coarse_ms']:.0f}, filled {ready['filled_ms']:.0f},"
        f" pyramid {ready['pyramid_ms']:.0f})",
    ]
    for case in record["updates"]:
        lines.append(
            f"{case['case']}: node {case['node_ms']:.1f} ms = {case['node_times_imencode']:.2f} x imencode of"
            f" {case['patch'][1]} x {case['patch'][0]} texels (texture alone"
            f" {case['texture_only_times_imencode']:.2f}), client {case['client_ms']:.1f} ms ="
            f" {case['client_times_imdecode']:.2f} x imdecode"
        )
    lines.append(f"encodes with the search: {record['searched']}")
    lines.append(f"first view bytes: {record['first_view_bytes']}")
    return "\n".join(lines)


def texture_patch_sent(scan: Scan, view: FirstView, look: Look) -> ImageArray:
    """The image that an update with explicit parameters encodes."""
    shape = view.state.shapes[Channel.TEXTURE]
    assert look.parameters is not None and look.parameters.texture is not None
    region = region_round(look.u, look.v, look.window, shape.width, shape.height)
    lattice = build_lattice(shape, texture_lattice(view.state, region, look.parameters.texture))
    found = select(lattice, ChannelHoldings.coarse(shape), texture_rank(QUALITY))
    assert found is not None
    return texture_samples(scan, found[0])


def opened_model(view: FirstView) -> Model:
    """A client's model that holds a first view and nothing else."""
    model = Model(view.info)
    for data in view.refinements(1):
        model.apply(Refinement.from_bytes(data))
    return model


def _fresh(model: Model) -> Model:
    """The same model as if it held the first view alone; its dense arrays stay, since cells do not matter."""
    model.holdings = type(model.holdings).coarse(model.shapes)
    return model


def _plan(scan: Scan, view: FirstView, look: Look, case: Case) -> tuple[Update, list[Refinement]]:
    planned = plan_update(scan, view.state, Wanted(look, (case.codec,), quick=case.quick), pool=THREADS)
    refinements = [coded.refinement(1, seq + 2, look.request) for seq, coded in enumerate(planned.coded)]
    for refinement in refinements:
        refinement.to_bytes()
    return planned, refinements


def _view_bytes(scan: Scan, codec: CodecName) -> int:
    view = build_first_view(scan, codec, FIRST_VIEW_BYTES)
    opened = encode_message(Opened(1, 1, view.info))
    return len(opened) + sum(len(refinement) for refinement in view.refinements(1))


def _frames(count: int) -> bytes:
    payload = np.random.default_rng(7).integers(0, 256, PAYLOAD_BYTES, np.uint8).tobytes()
    return b"".join(encode_frame(16, payload, seq=seq, session=1) for seq in range(count))


def _all_columns(grid: Grid) -> Assembler:
    """An assembler to which the last column has just come."""
    s = grid.spec
    counts = 2 * s.width * s.texture_width
    assembler = Assembler(s, Encoder(counts))
    for column in range(s.width):
        count = round((column + 0.5) * counts / s.width)
        assembler.add_range_column(count, 0, np.ascontiguousarray(grid.range_steps[:, column]))
    for column in range(s.texture_width):
        count = round((column + 0.5) * counts / s.texture_width)
        assembler.add_texture_column(count, 0, np.ascontiguousarray(grid.texture[:, column]))
    return assembler
