"""Bytes against quality, one picture a scan: what a click takes as the PSNR asked for rises, ours and the rivals'."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from pathlib import Path

from tests.bench.cache import Cache
from tests.bench.ours import look, node_with
from tests.bench.rivals.contestants import bytes_for
from tests.bench.rivals.offer import Unreachable
from tests.bench.scans import BenchScan, Skipped
from tests.bench.target import Target

TARGETS = tuple(Target(texture_db=db) for db in (34.0, 37.0, 40.0, 43.0))
RIVALS = ("Draco + JPEG tiles", "JPEG tile pyramid", "HTJ2K tile pyramid", "JPIP")

Curve = list[tuple[int, float]]


def draw(scans: Iterable[BenchScan], size: str, folder: Path, cache: Cache) -> list[Path]:
    """A PNG for each scan, at its first fovea; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    return [_draw(scan, size, folder, cache) for scan in scans]


def _draw(scan: BenchScan, size: str, folder: Path, cache: Cache) -> Path:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    curves = {"foveascan": asyncio.run(_ours(scan)), **{rival: _rival(rival, scan, cache) for rival in RIVALS}}
    figure, axes = pyplot.subplots(figsize=(7, 5), layout="constrained")
    for name, curve in curves.items():
        axes.plot(
            [b for b, _ in curve],
            [db for _, db in curve],
            marker="o",
            linewidth=3 if name == "foveascan" else 1.5,
            label=name,
        )
    axes.set(
        xscale="log", xlabel="bytes for one click beyond the first view", ylabel="texture PSNR asked for [dB]",
        title=f"{scan.name} {size}, 5% of the area, range within 0.1 mm",
    )  # fmt: skip
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    path = folder / f"roi-{scan.name}-{size}.png"
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
    return path


async def _ours(scan: BenchScan) -> Curve:
    click = scan.clicks(1)[0]
    async with node_with([scan]) as (session, ids):
        curve = []
        for target in TARGETS:
            model = await session.open(ids[scan.key])
            curve.append(((await look(session, model, scan, click, target)).size_bytes, target.texture_db))
        return curve


def _rival(rival: str, scan: BenchScan, cache: Cache) -> Curve:
    curve: Curve = []
    for target in TARGETS:
        try:
            offer = bytes_for(rival, scan, scan.clicks(1)[0], target, cache)
        except (Skipped, Unreachable):
            continue
        curve.append((offer.size_bytes, target.texture_db))
    return curve
