"""`bench codec`: bytes and time of the codecs on the patches that updates carry, as ratios to OpenCV's JPEG.

Texture: the window round one fovea at spacing 1, each codec at the lowest quality that has 40 dB. Range: the window's
samples at the quantum that 0.1 mm allows, in ns a vertex, and bits a vertex.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import DracoPy
import imagecodecs
import numpy as np

from node.coarse import fill_voids
from protocol.codec import (
    JPEG_QUALITY_MAX,
    JPEG_QUALITY_MIN,
    LOSSY_MAX,
    RangeCodec,
    TextureCodec,
    decode_range,
    decode_texture,
    encode_mask,
    encode_range,
    encode_texture,
    jpeg_q,
)  # fmt: skip
from protocol.grid import VOID, ImageArray, StepArray
from tests.bench.rivals.draco_range import SPEED_BEST, encode_mesh, faces, positions
from tests.bench.rivals.jpeg_texture import least
from tests.bench.scans import BenchScan
from tests.bench.target import Target, Window, crop, psnr_db
from tests.bench.timing import medians_s

QUANTUM_MM = 0.2  # the largest that keeps every sample within 0.1 mm
DRACO_BITS = (9, 10, 11, 12)


def run(scans: list[BenchScan], size: str, repeats: int) -> dict[str, Any]:
    """Each scan at its first fovea."""
    target = Target()
    rows = []
    for scan in scans:
        window = Window.round(scan.grid, scan.clicks(1)[0], target)
        filled = np.ascontiguousarray(crop(fill_voids(scan.grid.range_steps), window.range))
        rows.append({
            "scan": scan.name,
            "texture": texture_codecs(np.ascontiguousarray(window.texels), target.texture_db, repeats),
            "range": range_codecs(filled, scan.grid.spec.step_mm, repeats),
            "mask": mask_codec(window.range_steps == VOID, repeats),
            "threefold": threefold(scan),
        })  # fmt: skip
    return {"size": size, "repeats": repeats, "rows": rows}


def texture_codecs(image: ImageArray, target_db: float, repeats: int) -> dict[str, dict[str, float]]:
    """Each codec at the lowest quality that has target_db: bytes, dB, times of cv2.imencode and cv2.imdecode."""
    found: dict[str, tuple[TextureCodec, int, bool]] = {}
    for codec, bounds in (
        (TextureCodec.JPEG, (JPEG_QUALITY_MIN, JPEG_QUALITY_MAX)),
        (TextureCodec.HTJ2K, (0, LOSSY_MAX)),
    ):
        quality = least(partial(_reaches, image, codec, target_db), *bounds)
        if quality is not None:
            found[codec.name] = codec, quality, False
            if codec is TextureCodec.JPEG:
                found["JPEG, quick"] = codec, quality, True
    if "JPEG" not in found:
        return {}
    flags = [cv2.IMWRITE_JPEG_QUALITY, jpeg_q(found["JPEG"][1])]
    flags += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    reference = cv2.imencode(".jpg", image, flags)[1]
    jobs: dict[str, Callable[[], Any]] = {
        "imencode": lambda: cv2.imencode(".jpg", image, flags),
        "imdecode": lambda: cv2.imdecode(reference, cv2.IMREAD_COLOR),
    }
    payloads = {name: encode_texture(image, codec, q, quick=quick) for name, (codec, q, quick) in found.items()}
    for name, (codec, quality, quick) in found.items():
        jobs[f"encode {name}"] = partial(encode_texture, image, codec, quality, quick=quick)
        jobs[f"decode {name}"] = partial(decode_texture, payloads[name], codec, quality, image.shape[:2])
    taken_s = medians_s(jobs, repeats)
    return {
        name: {
            "quality": quality,
            "bytes": len(payloads[name]),
            "db": psnr_db(decode_texture(payloads[name], codec, quality, image.shape[:2]), image),
            "encode_times_imencode": taken_s[f"encode {name}"] / taken_s["imencode"],
            "decode_times_imdecode": taken_s[f"decode {name}"] / taken_s["imdecode"],
        }
        for name, (codec, quality, _) in found.items()
    }


def range_codecs(steps: StepArray, step_mm: float, repeats: int) -> dict[str, dict[str, float]]:
    """Every range codec of ours, and JPEG-LS: bits and ns a vertex."""
    quantum = max(round(QUANTUM_MM / step_mm), 1)
    values = ((steps.astype(np.uint32) + quantum // 2) // quantum).astype(np.uint16)
    encoders: dict[str, Callable[[], bytes]] = {
        codec.name: partial(encode_range, steps, codec, quantum) for codec in RangeCodec
    }
    encoders["LIFT, quick"] = partial(encode_range, steps, RangeCodec.LIFT, quantum, quick=True)
    encoders["JPEG-LS"] = lambda: bytes(imagecodecs.jpegls_encode(values, out=4 * values.nbytes + 1024))
    payloads = {name: encode() for name, encode in encoders.items()}
    decoders: dict[str, Callable[[], Any]] = {
        f"decode {codec.name}": partial(decode_range, payloads[codec.name], codec, steps.shape, quantum)
        for codec in RangeCodec
    }
    decoders["decode LIFT, quick"] = partial(
        decode_range, payloads["LIFT, quick"], RangeCodec.LIFT, steps.shape, quantum
    )
    decoders["decode JPEG-LS"] = lambda: imagecodecs.jpegls_decode(payloads["JPEG-LS"])
    taken_s = medians_s({**encoders, **decoders}, repeats)
    return {
        name: {
            "bytes": len(payload),
            "bits_a_vertex": 8 * len(payload) / steps.size,
            "encode_ns_a_vertex": 1e9 * taken_s[name] / steps.size,
            "decode_ns_a_vertex": 1e9 * taken_s[f"decode {name}"] / steps.size,
        }
        for name, payload in payloads.items()
    }


def mask_codec(void: np.ndarray, repeats: int) -> dict[str, float]:
    """The window's void mask."""
    taken_s = medians_s({"mask": lambda: encode_mask(void)}, repeats)["mask"]
    return {"share": float(void.mean()), "bytes": len(encode_mask(void)), "ns_a_vertex": 1e9 * taken_s / void.size}


def threefold(scan: BenchScan) -> dict[str, dict[str, float]]:
    """The paper's claim that sending Z only is a third of XYZ, at equal precision, over the middle quarter of a scan.

    Draco on XYZ, Draco on lattice coordinates (column, row, Z quantised), HTJ2K on Z: bits a vertex. Z is quantised to
    the step that Draco's bits give XYZ.
    """
    s = scan.grid.spec
    rows = np.arange(s.height // 4, 3 * s.height // 4)
    columns = np.arange(s.width // 4, 3 * s.width // 4)
    steps = fill_voids(scan.grid.range_steps)[np.ix_(rows, columns)]
    row, column = (axis.ravel() for axis in np.meshgrid(rows, columns, indexing="ij"))
    xyz = positions(scan, row, column, steps.ravel())
    triangles = faces(np.ones(steps.shape, np.bool_), cyclic=False)
    extent_mm = float(np.ptp(xyz, axis=0).max())
    figures = {}
    for bits in DRACO_BITS:
        step_mm = extent_mm / (2**bits - 1)
        quantum = max(round(step_mm / s.step_mm), 1)
        z = np.round(steps.ravel() / quantum)
        lattice = np.stack([column - columns[0], row - rows[0], z - z.min()], axis=1).astype(np.float32)
        started_s = time.perf_counter()
        draco_xyz = len(encode_mesh(xyz, triangles, bits))
        draco_ns = 1e9 * (time.perf_counter() - started_s) / len(xyz)
        draco_lattice = len(_draco_exactly(lattice, triangles))
        ours = len(encode_range(steps, RangeCodec.HTJ2K, quantum))
        figures[f"{bits} bits, step {step_mm:.3f} mm"] = {
            "draco_xyz_bits": 8 * draco_xyz / len(xyz),
            "draco_lattice_bits": 8 * draco_lattice / len(xyz),
            "z_only_bits": 8 * ours / len(xyz),
            "raw_ratio": 3.0,
            "draco_xyz_times_z_only": draco_xyz / ours,
            "draco_lattice_times_z_only": draco_lattice / ours,
            "draco_ns_a_vertex": draco_ns,
        }
    return figures


def told(record: dict[str, Any]) -> str:
    """The figures as tables."""
    lines = [f"{record['size']}, medians of {record['repeats']} interleaved repeats", ""]
    lines += ["| texture | bytes | dB | encode / imencode | decode / imdecode |", "|---|---|---|---|---|"]
    for row in record["rows"]:
        lines += [
            f"| {row['scan']} {name} | {f['bytes']} | {f['db']:.2f} | {f['encode_times_imencode']:.2f} |"
            f" {f['decode_times_imdecode']:.2f} |"
            for name, f in row["texture"].items()
        ]
    lines += ["", "| range | bytes | bits a vertex | encode ns | decode ns |", "|---|---|---|---|---|"]
    for row in record["rows"]:
        lines += [
            f"| {row['scan']} {name} | {f['bytes']} | {f['bits_a_vertex']:.2f} | {f['encode_ns_a_vertex']:.1f} |"
            f" {f['decode_ns_a_vertex']:.1f} |"
            for name, f in row["range"].items()
        ]
        mask = row["mask"]
        lines.append(
            f"| {row['scan']} mask, {mask['share']:.0%} void | {mask['bytes']} | | {mask['ns_a_vertex']:.1f} | |"
        )
    lines += [
        "",
        "| Z only | Draco XYZ bits | Draco lattice bits | HTJ2K Z bits | XYZ / Z | lattice / Z |",
        "|---" * 6 + "|",
    ]
    for row in record["rows"]:
        lines += [
            f"| {row['scan']} {step} | {f['draco_xyz_bits']:.2f} | {f['draco_lattice_bits']:.2f} |"
            f" {f['z_only_bits']:.2f} | {f['draco_xyz_times_z_only']:.2f} | {f['draco_lattice_times_z_only']:.2f} |"
            for step, f in row["threefold"].items()
        ]
    return "\n".join(lines)


def _reaches(image: ImageArray, codec: TextureCodec, target_db: float, quality: int) -> bool:
    payload = encode_texture(image, codec, quality)
    return psnr_db(decode_texture(payload, codec, quality, (image.shape[0], image.shape[1])), image) >= target_db


def _draco_exactly(points: np.ndarray, triangles: np.ndarray) -> bytes:
    """A Draco mesh whose whole coordinates stay whole."""
    bits = int(points.max()).bit_length()
    return bytes(
        DracoPy.encode(
            points, triangles, bits, SPEED_BEST, quantization_range=2.0**bits - 1, quantization_origin=[0.0, 0.0, 0.0]
        )
    )
