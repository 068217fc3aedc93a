"""`bench sphere`: a click on a closed object, on a pole, beside it and on the equator, against a cylinder and Draco.

One object, known by direction, is looked at at four places of it. It is scanned standing, and again turned so that two
of these places lie 0.8 rad from the poles, 0.3 rad, and on them: so every kind of look shows the same four places, and
each is compared with the cylinder's look at its own. The cylinder is the standing scan's grid taken for one; its window
is a rectangle round the equator of the same solid angle as a cap. Every look is measured at the client: bytes on the
WebSocket, and the cap it leaves, each sample weighed by its solid angle. Looks with explicit parameters have, at each
place, the lowest quality of texture that leaves EXPLICIT_DB there: equal parameters leave more of it near a pole, where
texels stand closer. The rival sends the whole closed mesh by Draco and the whole texture as one JPEG, each as coarse as
the cap allows.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, replace
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
EQUAL_AREA = 2 / math.pi  # of the cylinder's grid, as many samples as a share of the sphere has
EXPLICIT_DB = 44.0
FIRST_QUALITY = 38
ROUNDS_OF = 3  # so many repeats are one round of all places
AWAY = {"0.8 rad": 0.8, "0.3 rad": 0.3, "pole": 0.0}  # of a pole
ABOUT = ("y", "x")  # axes that it is turned about, each of which brings two of the four places there


@dataclass(frozen=True)
class Place:
    """Where a scan shows one of the four places."""

    scan: str
    theta_v: float
    theta_h: float


def places(about: tuple[str, ...] = ABOUT) -> dict[str, list[Place]]:
    """The places, along x, away from it, along y, away from it, by the kind of look; only the first two about y."""
    equator = [0.0, math.pi, math.pi / 2, 1.5 * math.pi][: 2 * len(about)]
    found = {
        "cylinder": [Place("cylinder", math.pi / 2, theta_h) for theta_h in equator],
        "equator": [Place("standing", math.pi / 2, theta_h) for theta_h in equator],
    }
    for name, away in AWAY.items():
        found[name] = [
            Place(f"{name} about {about[index // 2]}", math.pi - away if index % 2 else away, theta_h)
            for index, theta_h in enumerate(equator)
        ]
    return found


def turned(about: str, away_rad: float) -> FloatArray:
    """The turn of the object about an axis that carries a place on its equator to so near a pole; rows are its axes
    in the object's own frame."""
    sine, cosine = math.sin(away_rad), math.cos(away_rad)
    if about == "y":
        return np.array([[sine, 0, -cosine], [0, 1, 0], [cosine, 0, sine]])
    return np.array([[1, 0, 0], [0, sine, -cosine], [0, cosine, sine]])


Cells = tuple[IntArray, IntArray]
ASKED = {"bytes": "<= 1.2", "node time": "<= 1.2", "Draco + JPEG / ours": ">= 15"}


def run(
    size: str, repeats: int, *, rival: bool = True, about: tuple[str, ...] = ABOUT
) -> dict[str, Any]:
    """Every place, `repeats` times on a fresh model, a target's look and one with explicit parameters.

    about : axes the object is turned about; two places each.
    """
    target = Target()
    scans = {name: BenchScan(name, size, grid) for name, grid in _grids(SIZES[size], about)}
    rows = asyncio.run(_looks(scans, places(about), target, repeats))
    record = {"size": size, "rows": rows, "verified": all(row["reached"] for row in rows if row["kind"] == "target")}
    if rival:
        record["rival_bytes"] = _rival_bytes(scans["pole about y"].grid, target)
    return record


def told(record: dict[str, Any]) -> str:
    """The record as a table: medians over places, of ratios each to the cylinder's look at the same place."""
    lines = [f"closed object at {record['size']}, 5% of all directions; asked {ASKED}", ""]
    head = f"{'look':9} {'at':9} {'places':>6} {'bytes':>7} {'ratio':>6} {'worst':>6}"
    lines.append(f"{head} {'node ms':>8} {'ratio':>6} {'mm':>6} {'dB':>6}")
    for row in record["rows"]:
        ratios = row["bytes_ratios"]
        lines.append(
            f"{row['kind']:9} {row['place']:9} {len(ratios):6d} {median(row['bytes']):7.0f} {median(ratios):6.2f} "
            f"{max(ratios):6.2f} {median(row['node_ms']):8.1f} {median(row['node_ratios']):6.2f} "
            f"{row['range_mm']:6.3f} {row['texture_db']:6.2f}"
        )
    if "rival_bytes" in record:
        ours = max(max(row["bytes"]) for row in record["rows"] if row["kind"] == "target")
        parts = ", ".join(f"{name} {size}" for name, size in record["rival_bytes"].items())
        lines += ["", f"all of it by {parts} bytes: {sum(record['rival_bytes'].values()) / ours:.0f} times our largest"]
    return "\n".join(lines)


async def _looks(
    scans: dict[str, BenchScan], where: dict[str, list[Place]], target: Target, repeats: int
) -> list[dict[str, Any]]:
    every = [(name, turn, place) for name, found in where.items() for turn, place in enumerate(found)]
    every.sort(key=lambda one: one[1])  # in turns, so that what else the machine does hits all alike
    rows = []
    async with node_with(scans.values()) as (session, ids):

        async def look(place: Place, more: dict[str, Any], checked: bool) -> dict[str, Any]:
            scan = scans[place.scan]
            return await _look(session, scan, ids[scan.key], [place.theta_v, place.theta_h], target, more, checked)

        for kind in ("target", "explicit"):
            more: dict[tuple[str, int], dict[str, Any]] = {(name, turn): {} for name, turn, _ in every}
            if kind == "explicit":
                quality = FIRST_QUALITY
                for name, turn, place in every:
                    quality = await _enough(look, place, quality)
                    more[name, turn] = _parameters(quality)
            looks: dict[tuple[str, int], list[dict[str, Any]]] = {key: [] for key in more}
            for again in range(max(repeats // ROUNDS_OF, 1)):
                for name, turn, place in every:
                    looks[name, turn].append(await look(place, more[name, turn], again == 0))
            rows += _rows(kind, where, looks)
    return rows


async def _enough(look: Callable[..., Awaitable[dict[str, Any]]], place: Place, quality: int) -> int:
    """The lowest quality of texture that leaves EXPLICIT_DB at a place, looked for from one that may be near it."""
    reaches: dict[int, bool] = {}
    while True:
        if quality not in reaches:
            reaches[quality] = (await look(place, _parameters(quality), True))["texture_db"] >= EXPLICIT_DB
        if not reaches[quality]:
            quality += 1
        elif reaches.get(quality - 1) is False:
            return quality
        else:
            quality -= 1


def _parameters(quality: int) -> dict[str, Any]:
    return {"parameters": {"range": {"p": 1, "quantum": 5}, "texture": {"p": 1, "quality": quality}}}


def _rows(
    kind: str, where: dict[str, list[Place]], looks: dict[tuple[str, int], list[dict[str, Any]]]
) -> list[dict[str, Any]]:
    """What looks of one kind came to at each kind of place: medians at each of them, and the worst they left."""

    def medians(name: str, what: str) -> list[float]:
        return [median(look[what] for look in looks[name, turn]) for turn in range(len(where[name]))]

    rows = []
    for name, found in where.items():
        first = [looks[name, turn][0] for turn in range(len(found))]
        row: dict[str, Any] = {"kind": kind, "place": name}
        for what, ratios in (("bytes", "bytes_ratios"), ("node_ms", "node_ratios")):
            row[what] = medians(name, what)
            row[ratios] = [ours / theirs for ours, theirs in zip(row[what], medians("cylinder", what), strict=True)]
        row["encodes"] = median(medians(name, "encodes"))
        row["range_mm"] = max(look["range_mm"] for look in first)
        row["texture_db"] = min(look["texture_db"] for look in first)
        row["reached"] = all(look["reached"] for look in first)
        rows.append(row)
    return rows


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


def _grids(size: tuple[int, int, int, int], turned_about: tuple[str, ...]) -> Iterator[tuple[str, Grid]]:
    """The scans by name."""
    standing = _object(size, np.eye(3))
    yield "cylinder", replace(standing, spec=replace(standing.spec, geometry="cylinder"))
    yield "standing", thin_grid(standing)
    for name, away in AWAY.items():
        for about in turned_about:
            yield f"{name} about {about}", thin_grid(_object(size, turned(about, away)))


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
