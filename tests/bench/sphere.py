"""`bench sphere`: a click on a closed object, on a pole, beside it and on the equator, against a cylinder and Draco.

One object, known by direction, is scanned upright and tipped over, so that all four poles show other places of it. The
cylinder is the upright scan's grid taken for one. Its window there is a rectangle round the equator of the same solid
angle as a cap, so the same area of the object in as many samples. Every kind of place is looked at several times, at
places drawn by a seed, and its median told, with the worst. Every look is measured at the client: bytes on the
WebSocket, and the cap it leaves, each sample weighed by its solid angle. Bytes at equal parameters are not at equal
quality, so the decibels reached stand beside them. The rival sends the whole closed mesh by Draco and the whole texture
as one JPEG, each as coarse as the cap allows.
"""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from statistics import median
from typing import Any

import cv2
import DracoPy
import numpy as np

from client.model import Model
from client.session import Session
from protocol.grid import FloatArray, Grid, GridSpec, IntArray
from protocol.rings import thin_grid
from protocol.sphere import DirectionGrid, click_of, sphere_faces, vectors
from tests.bench.ours import looked, node_with, wire_bytes
from tests.bench.scans import BenchScan
from tests.bench.target import PERCENTILE, Target, Window

SIZES = {"S": (360, 184, 1024, 512), "M": (1440, 1024, 4096, 2048)}
DRACO_LEVEL = 7
STEP_MM, MEAN_MM = 0.02, 70.0
UPRIGHT = np.eye(3)
TIPPED = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # what faced along x looks straight up
EQUAL_AREA = 2 / math.pi  # of the cylinder's grid, as many samples as a share of the sphere has
SEED, ACROSS = 7, 4  # places a kind
ROUNDS_OF = 3  # so many repeats are one round of all places


def places() -> dict[str, list[tuple[str, float, float]]]:
    """The places looked at by kind: scan, theta_v, theta_h."""
    random = np.random.default_rng(SEED)
    round_it = [0.0, math.pi, *random.uniform(0, 2 * math.pi, ACROSS - 2).tolist()]  # tipping makes the first two poles
    beside = [(scan, end) for scan in ("upright", "tipped") for end in (False, True)]
    found = {
        "cylinder": [("cylinder", math.pi / 2, theta_h) for theta_h in round_it],
        "equator": [("upright", math.pi / 2, theta_h) for theta_h in round_it],
    }
    for away in (0.8, 0.3, 0.0):
        name = f"{away} rad" if away else "pole"
        turned = random.uniform(0, 2 * math.pi, len(beside)).tolist() if away else [0.0] * len(beside)
        found[name] = [
            (scan, math.pi - away if below else away, theta_h)
            for (scan, below), theta_h in zip(beside, turned, strict=True)
        ]
    return found


Cells = tuple[IntArray, IntArray]
ASKED = {"bytes": "<= 1.2", "node time": "<= 1.2", "Draco + JPEG / ours": ">= 15"}


def run(size: str, repeats: int, *, rival: bool = True) -> dict[str, Any]:
    """Every place, `repeats` times on a fresh model, a target's look and one with explicit parameters."""
    target = Target()
    scans = {name: BenchScan(name, size, grid) for name, grid in _grids(SIZES[size]).items()}
    rows = asyncio.run(_looks(scans, target, repeats))
    record = {"size": size, "rows": rows, "verified": all(row["reached"] for row in rows if row["kind"] == "target")}
    if rival:
        record["rival_bytes"] = _rival_bytes(scans["tipped"].grid, target)
    return record


def told(record: dict[str, Any]) -> str:
    """The record as a table; ratios to the cylinder's look of the same kind, of medians and of the worst place."""
    lines = [f"closed object at {record['size']}, 5% of all directions; asked {ASKED}", ""]
    head = f"{'look':9} {'at':9} {'places':>6} {'bytes':>7} {'ratio':>6} {'worst':>6}"
    lines.append(f"{head} {'node ms':>8} {'ratio':>6} {'mm':>6} {'dB':>6}")
    base = {row["kind"]: row for row in record["rows"] if row["place"] == "cylinder"}
    for row in record["rows"]:
        first = base[row["kind"]]
        size, most = row["bytes"] / first["bytes"], row["most_bytes"] / first["bytes"]
        took = row["node_ms"] / first["node_ms"]
        lines.append(
            f"{row['kind']:9} {row['place']:9} {row['places']:6d} {row['bytes']:7.0f} {size:6.2f} {most:6.2f} "
            f"{row['node_ms']:8.1f} {took:6.2f} {row['range_mm']:6.3f} {row['texture_db']:6.2f}"
        )
    if "rival_bytes" in record:
        ours = max(row["most_bytes"] for row in record["rows"] if row["kind"] == "target")
        parts = ", ".join(f"{name} {size}" for name, size in record["rival_bytes"].items())
        lines += ["", f"all of it by {parts} bytes: {sum(record['rival_bytes'].values()) / ours:.0f} times our largest"]
    return "\n".join(lines)


async def _looks(scans: dict[str, BenchScan], target: Target, repeats: int) -> list[dict[str, Any]]:
    explicit = {"range": {"p": 1, "quantum": 5}, "texture": {"p": 1, "quality": 40}}
    rows = []
    async with node_with(scans.values()) as (session, ids):
        for kind, more in (("target", {}), ("explicit", {"parameters": explicit})):
            looks: dict[str, list[dict[str, Any]]] = {name: [] for name in places()}
            for again in range(max(repeats // ROUNDS_OF, 1)):
                for turn in range(ACROSS):  # in turns, so that what else the machine does hits all alike
                    for name, found in places().items():
                        scan, *direction = found[turn]
                        where = scans[scan], ids[scans[scan].key], direction
                        looks[name].append(await _look(session, *where, target, more, again == 0))
            rows += [_row(kind, name, found) for name, found in looks.items()]
    return rows


def _row(kind: str, place: str, looks: list[dict[str, Any]]) -> dict[str, Any]:
    """What looks at one kind of place came to: medians, and the worst of what they left."""
    first = looks[:ACROSS]
    return {
        "kind": kind, "place": place, "places": ACROSS, "bytes": median(look["bytes"] for look in looks),
        "most_bytes": max(look["bytes"] for look in looks), "node_ms": median(look["node_ms"] for look in looks),
        "encodes": median(look["encodes"] for look in looks), "range_mm": max(look["range_mm"] for look in first),
        "texture_db": min(look["texture_db"] for look in first), "reached": all(look["reached"] for look in first),
    }  # fmt: skip


async def _look(
    session: Session,
    scan: BenchScan,
    scan_id: str,
    direction: list[float],
    target: Target,
    more: dict[str, Any],
    checked: bool,
) -> dict[str, Any]:
    model = await session.open(scan_id)
    is_sphere = scan.grid.spec.geometry == "sphere"
    update = await session.look(
        *click_of(*direction), window=target.window * (1 if is_sphere else EQUAL_AREA),
        texture_db=target.texture_db, range_mm=target.range_mm, **more,
    )  # fmt: skip
    found = {"bytes": wire_bytes(update), "node_ms": update.node_ms, "encodes": update.encodes}
    if not checked:
        return found
    if is_sphere:
        range_mm, texture_db = _left(model, scan.grid, direction, target)
    else:
        of_area = replace(target, window=target.window * EQUAL_AREA)
        left = looked(update, model, Window.round(scan.grid, click_of(*direction), of_area))
        range_mm, texture_db = left.range_error_mm, left.texture_db
    reached = range_mm <= target.range_mm and texture_db >= target.texture_db
    return found | {"range_mm": range_mm, "texture_db": texture_db, "reached": reached}


def _left(model: Model, truth: Grid, direction: list[float], target: Target) -> tuple[float, float]:
    """99th percentile of the range error and PSNR of the texture in the cap, by solid angle."""
    inside, weight = _cap(truth.range_steps.shape, direction, target)
    error = np.abs(model.range_steps[inside].astype(int) - truth.range_steps[inside]) * STEP_MM
    order = np.argsort(error)
    beyond = np.searchsorted(np.cumsum(weight[order]), PERCENTILE / 100 * weight.sum())
    inside, weight = _cap(truth.texture.shape, direction, target)
    squared = ((model.texture[inside].astype(np.float32) - truth.texture[inside]) ** 2).mean(axis=1)
    mse = float(squared @ weight / weight.sum())
    return float(error[order][min(beyond, error.size - 1)]), 10 * math.log10(255**2 / max(mse, 1e-9))


def _cap(shape: tuple[int, ...], direction: list[float], target: Target) -> tuple[Cells, FloatArray]:
    """Rows and columns of the directions of a dense grid that lie in the window, and their solid angles. (n,) each"""
    height, width = shape[:2]
    grid = DirectionGrid(width, height)
    every_row = grid.theta_v(np.arange(height))
    near = np.flatnonzero(np.abs(every_row - direction[0]) <= math.acos(1 - 2 * target.window))
    row, column = np.meshgrid(near, np.arange(width), indexing="ij")
    inside = vectors(grid.theta_v(row), grid.theta_h(column)) @ vectors(*direction) >= 1 - 2 * target.window
    row, column = row[inside], column[inside]
    return (row, column), np.sin(grid.theta_v(row))


def _rival_bytes(grid: Grid, target: Target) -> dict[str, int]:
    """The whole mesh and the whole texture, as coarse as the cap on the pole allows."""
    height, width = grid.range_steps.shape
    lines = DirectionGrid.of(grid.spec)
    row, column = np.mgrid[:height, :width]
    towards = vectors(lines.theta_v(row), lines.theta_h(column))
    surface = grid.range_mm[..., None] * towards
    inside, _ = _cap((height, width), [0.0, 0.0], target)
    ends = grid.range_mm[[0, -1]].mean(axis=1)
    points = np.concatenate([[[0, 0, ends[0]]], surface.reshape(-1, 3), [[0, 0, -ends[1]]]]).astype(np.float32)
    extent = float(np.ptp(points, axis=0).max())
    bits = next(bits for bits in range(6, 20) if _radial_error(surface, inside, extent, bits) <= target.range_mm)
    faces = sphere_faces(height, width).astype(np.uint32)
    mesh = DracoPy.encode(points, faces, quantization_bits=bits, compression_level=DRACO_LEVEL)
    return {f"Draco, {bits} bits": len(mesh), "JPEG": _jpeg_bytes(grid, target)}


def _radial_error(surface: FloatArray, inside: Cells, extent_mm: float, bits: int) -> float:
    """99th percentile of how far quantised vertices of a cap lie above or below where they were. [mm]"""
    points = surface[inside]
    unit = extent_mm / ((1 << bits) - 1)
    moved = np.linalg.norm(np.rint(points / unit) * unit, axis=1) - np.linalg.norm(points, axis=1)
    return float(np.percentile(np.abs(moved), PERCENTILE))


def _jpeg_bytes(grid: Grid, target: Target) -> int:
    inside, weight = _cap(grid.texture.shape, [0.0, 0.0], target)
    for q in range(10, 100, 3):
        flags = (cv2.IMWRITE_JPEG_QUALITY, q, cv2.IMWRITE_JPEG_OPTIMIZE, 1)
        file = cv2.imencode(".jpg", grid.texture[..., ::-1], flags)[1]
        made = np.asarray(cv2.imdecode(file, cv2.IMREAD_COLOR_RGB), np.float32)
        mse = float(((made[inside] - grid.texture[inside]) ** 2).mean(axis=1) @ weight / weight.sum())
        if 10 * math.log10(255**2 / max(mse, 1e-9)) >= target.texture_db:
            return int(file.size)
    raise ValueError("no JPEG is good enough")


def _grids(size: tuple[int, int, int, int]) -> dict[str, Grid]:
    upright, tipped = _object(size, UPRIGHT), _object(size, TIPPED)
    cylinder = replace(upright, spec=replace(upright.spec, geometry="cylinder"))
    return {"cylinder": cylinder, "upright": thin_grid(upright), "tipped": thin_grid(tipped)}


def _object(size: tuple[int, int, int, int], turn: FloatArray) -> Grid:
    """A rough coloured stone, a function of direction alone, as it is seen when it stands turned."""
    width, height, texture_width, texture_height = size
    relief = _waves(_dense(width, height) @ turn, (2, 4, 8, 16, 32, 64, 128), 3.0, 1.0, 5)
    light = _waves(_dense(texture_width, texture_height) @ turn, (4, 16, 60, 150, 300), 30.0, 0.5, 7)
    colours = np.stack([light + 140, 0.8 * light + 130, 0.7 * light + 110], axis=-1)
    spec = GridSpec(*size, STEP_MM, math.pi * MEAN_MM / height, 40.0, 0.0, "sphere")
    steps = np.rint((MEAN_MM + relief) / STEP_MM).astype(np.uint16)
    return Grid(spec, steps, np.clip(colours, 0, 255).astype(np.uint8))


def _dense(width: int, height: int) -> FloatArray:
    grid = DirectionGrid(width, height)
    row, column = np.mgrid[:height, :width]
    return vectors(grid.theta_v(row), grid.theta_h(column))


def _waves(towards: FloatArray, numbers: tuple[int, ...], largest: float, fall: float, seed: int) -> FloatArray:
    """Waves from everywhere, shorter ones lower. (H, W)"""
    random = np.random.default_rng(seed)
    total, towards = np.zeros(towards.shape[:-1], np.float32), towards.astype(np.float32)
    for number in numbers:
        for along in random.normal(size=(5, 3)):
            total += np.float32(largest / number**fall) * np.sin(towards @ (number * along).astype(np.float32))
    return np.asarray(total, np.float64)
