"""`bench roi`: bytes for full detail in 5% of the area, ours against what a user would pick instead (DESIGN 8).

Every click starts from the first view alone. Ours are counted on the WebSocket of a running node and verified in the
client's model; rivals are verified by decoding. Means are geometric.
"""

from __future__ import annotations

import asyncio
import math
import tempfile
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tqdm import tqdm

from tests.bench.cache import Cache
from tests.bench.ours import Looked, look, node_with
from tests.bench.rivals.contestants import RIVALS, bytes_for
from tests.bench.rivals.exact_crop import crop_bytes
from tests.bench.rivals.offer import Unreachable
from tests.bench.scans import BenchScan, Skipped
from tests.bench.target import Target, Window

ASKED = {
    "full Draco + JPEG": ">= 40", "Draco + JPEG tiles": ">= 3", "JPEG tile pyramid": ">= 1.5, each >= 1.15",
    "HTJ2K tile pyramid": ">= 1.3", "JPIP": ">= 1.5", "ours / exact crop": "<= 1.10",
}  # fmt: skip
ASKED_AT = {"S": {"full Draco + JPEG": ">= 12"}}
LINKS_BYTES_S = {"1 Mbit/s": 125e3, "10 Mbit/s": 1.25e6, "100 Mbit/s": 12.5e6}


def run(
    scans: list[BenchScan], size: str, clicks: int, cache: Cache, rivals: Iterable[str] = tuple(RIVALS)
) -> dict[str, Any]:
    """Every scan, every click, every rival that can run."""
    target = Target()
    ours = asyncio.run(_ours(scans, clicks, target))
    rows, missing = [], dict[str, str]()
    total = sum(len(looks) for looks in ours.values())
    with tqdm(total=total, desc="rivals", disable=None) as bar:
        for scan in scans:
            crops = _crop_bytes(scan, clicks, target, ours[scan.key])
            for click, mine, floor in zip(scan.clicks(clicks), ours[scan.key], crops, strict=True):
                row: dict[str, Any] = {"scan": scan.name, "click": click, "ours": asdict(mine), "rivals": {}}
                row["crop_bytes"] = floor
                for rival in rivals:
                    try:
                        row["rivals"][rival] = asdict(bytes_for(rival, scan, click, target, cache))
                    except (Skipped, Unreachable) as reason:
                        missing[rival] = str(reason)
                rows.append(row)
                bar.update()
    return {
        "size": size, "target": asdict(target), "clicks": clicks, "missing": missing,
        "rows": rows, "ratios": ratios(rows), "verified": all(row["ours"]["reached"] for row in rows),
    }  # fmt: skip


def ratios(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Rival's bytes / ours: geometric mean of each scan, of all, and the same for ours / exact crop."""
    names = list(dict.fromkeys(row["scan"] for row in rows))
    table: dict[str, dict[str, float]] = {}
    for rival in dict.fromkeys(name for row in rows for name in row["rivals"]):
        by_scan = {
            name: geometric_mean(
                row["rivals"][rival]["size_bytes"] / row["ours"]["size_bytes"]
                for row in rows
                if row["scan"] == name and rival in row["rivals"]
            )
            for name in names
        }
        table[rival] = {**by_scan, "mean": geometric_mean(by_scan.values())}
    crops = {
        name: geometric_mean(row["ours"]["size_bytes"] / row["crop_bytes"] for row in rows if row["scan"] == name)
        for name in names
    }
    table["ours / exact crop"] = {**crops, "mean": geometric_mean(crops.values())}
    return table


def geometric_mean(values: Iterable[float]) -> float:
    """Of positive values; NaN of none."""
    logs = [math.log(max(value, 1e-9)) for value in values]
    return math.exp(sum(logs) / len(logs)) if logs else math.nan


def told(record: dict[str, Any]) -> str:
    """The ratios as a table, then ours click by click."""
    scans = list(dict.fromkeys(row["scan"] for row in record["rows"]))
    lines = [f"{record['size']}, {record['clicks']} foveae a scan, rival's bytes / ours", ""]
    lines.append("| rival | " + " | ".join(scans) + " | mean | asked |")
    lines.append("|---" * (len(scans) + 3) + "|")
    for rival, by_scan in record["ratios"].items():
        asked = {**ASKED, **ASKED_AT.get(record["size"], {})}.get(rival, "")
        figures = " | ".join(f"{by_scan[name]:.2f}" for name in [*scans, "mean"])
        lines.append(f"| {rival} | {figures} | {asked} |")
    lines += [
        "",
        "| ours | bytes | range mm | texture dB | node ms | encodes | 1, 10, 100 Mbit/s: ms to detail |",
        "|---" * 7 + "|",
    ]
    for row in record["rows"]:
        ours = row["ours"]
        times = ", ".join(
            f"{ours['node_ms'] + 1000 * ours['size_bytes'] / rate:.0f}" for rate in LINKS_BYTES_S.values()
        )
        lines.append(
            f"| {row['scan']} {row['click'][0]:.3f},{row['click'][1]:.3f} | {ours['size_bytes']} |"
            f" {ours['range_error_mm']:.3f} | {ours['texture_db']:.2f}{'' if ours['reached'] else ' MISSED'} |"
            f" {ours['node_ms']:.0f} | {ours['encodes']} | {times} |"
        )
    lines += [f"skipped: {name}: {why}" for name, why in record["missing"].items()]
    return "\n".join(lines)


async def _ours(scans: list[BenchScan], clicks: int, target: Target) -> dict[str, list[Looked]]:
    """Every click on a model that holds the first view alone."""
    found: dict[str, list[Looked]] = {}
    async with node_with(scans) as (session, ids):
        for scan in scans:
            looks = []
            for click in scan.clicks(clicks):
                model = await session.open(ids[scan.key])
                looks.append(await look(session, model, scan, click, target))
            found[scan.key] = looks
    return found


def _crop_bytes(scan: BenchScan, clicks: int, target: Target, ours: list[Looked]) -> list[int]:
    """What the rectangles of our refinements would take as exact crops, click by click."""
    with tempfile.TemporaryDirectory(prefix="foveascan-bench-") as folder:
        published = scan.published(Path(folder))
        places = zip(scan.clicks(clicks), ours, strict=True)
        return [crop_bytes(published, Window.round(scan.grid, click, target), mine.parts) for click, mine in places]
