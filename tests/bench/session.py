"""`bench session`: ten clicks, a random walk in steps of one window, against rivals that keep what they got."""

from __future__ import annotations

import asyncio
import math
from dataclasses import asdict
from typing import Any

import numpy as np
from tqdm import tqdm

from tests.bench.cache import Cache
from tests.bench.ours import Looked, look, node_with
from tests.bench.rivals.caching import (
    Windows,
    jpip_session,
    range_session,
    texture_sessions,
    windows_of,
    with_replies,
)  # fmt: skip
from tests.bench.rivals.contestants import as_coarse_as_ours, as_large_as_ours
from tests.bench.rivals.offer import Unreachable, straight
from tests.bench.roi import geometric_mean
from tests.bench.scans import SEED, BenchScan, Click, Skipped
from tests.bench.target import Target

CLICKS = 10
ASKED = 1.1
RIVALS = ("JPEG tiles, caching", "HTJ2K tiles, caching", "JPIP, caching", "JPIP, caching, as large a first view")


def run(scans: list[BenchScan], size: str, cache: Cache) -> dict[str, Any]:
    """Every scan; it is turned so that its walk stays away from the seam."""
    target = Target()
    starts = [straight(scan, scan.clicks(1)[0]) for scan in scans]
    walks = [(scan, random_walk(start, target.window)) for scan, start in starts]
    ours = asyncio.run(_ours(walks, target))
    rows, missing = [], dict[str, str]()
    with tqdm(total=len(walks) * len(RIVALS), desc="rivals", disable=None) as bar:
        for scan, clicks in walks:
            looks = ours[scan.key]
            row: dict[str, Any] = {
                "scan": scan.name, "clicks": clicks, "ours": [asdict(looked) for looked in looks],
                "our_bytes": sum(looked.size_bytes for looked in looks), "rivals": {},
            }  # fmt: skip
            for rival in RIVALS:
                try:
                    row["rivals"][rival] = _rival_bytes(rival, scan, clicks, target, cache)
                except (Skipped, Unreachable) as reason:
                    missing[rival] = str(reason)
                bar.update()
            rows.append(row)
    return {"size": size, "missing": missing, "rows": rows, "ratios": ratios(rows)}


def random_walk(start: Click, window: float) -> list[Click]:
    """Ten clicks, each one window's side from the last in a random direction, turned back at the edges."""
    side = math.sqrt(window)
    rng = np.random.default_rng(SEED)
    (u, v), clicks = start, [start]
    while len(clicks) < CLICKS:
        angle = rng.uniform(0, 2 * math.pi)
        u, v = _inside(u + side * math.cos(angle), side), _inside(v + side * math.sin(angle), side)
        clicks.append((u, v))
    return clicks


def ratios(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Each rival's bytes / ours over a session, geometric mean; and the best rival's of each scan."""
    table = {
        rival: geometric_mean(sum(row["rivals"][rival]) / row["our_bytes"] for row in rows if rival in row["rivals"])
        for rival in RIVALS
    }
    best = [min(map(sum, row["rivals"].values())) / row["our_bytes"] for row in rows if row["rivals"]]
    return {**table, "best rival": geometric_mean(best)}


def told(record: dict[str, Any]) -> str:
    """Bytes of each session, and the ratios."""
    names = list(RIVALS)
    lines = [f"{record['size']}, ten clicks a session: bytes", "", "| scan | ours | " + " | ".join(names) + " |"]
    lines.append("|---" * (len(names) + 2) + "|")
    for row in record["rows"]:
        missed = sum(not looked["reached"] for looked in row["ours"])
        figures = " | ".join(str(sum(row["rivals"][name])) if name in row["rivals"] else "-" for name in names)
        lines.append(f"| {row['scan']} | {row['our_bytes']}{f', {missed} MISSED' if missed else ''} | {figures} |")
    figures = " | ".join(f"{record['ratios'][name]:.2f}" for name in names)
    lines += [
        f"| rival / ours | | {figures} |",
        "",
        f"best rival / ours {record['ratios']['best rival']:.2f}, asked >= {ASKED}",
    ]
    lines += [f"skipped: {name}: {why}" for name, why in record["missing"].items()]
    return "\n".join(lines)


def _inside(place: float, side: float) -> float:
    """A place turned back at half a window from the edges."""
    low, high = side / 2, 1 - side / 2
    if place < low:
        return 2 * low - place
    return 2 * high - place if place > high else place


def _rival_bytes(rival: str, scan: BenchScan, clicks: list[Click], target: Target, cache: Cache) -> list[int]:
    def make() -> list[int]:
        return _sent(rival, scan, windows_of(scan, clicks, target), cache)

    return [int(size) for size in cache.value("rivals.caching", f"{rival} {scan.key} {clicks} {target}", make)]


def _sent(rival: str, scan: BenchScan, windows: Windows, cache: Cache) -> list[int]:
    if rival.startswith("JPIP"):
        free = as_large_as_ours if rival.endswith("first view") else as_coarse_as_ours
        return with_replies(jpip_session(scan, windows, cache, free(scan)))
    return with_replies(range_session(scan, windows), texture_sessions(scan, windows, rival.split()[0].lower()))


async def _ours(walks: list[tuple[BenchScan, list[Click]]], target: Target) -> dict[str, list[Looked]]:
    found: dict[str, list[Looked]] = {}
    async with node_with([scan for scan, _ in walks]) as (session, ids):
        for scan, clicks in walks:
            model = await session.open(ids[scan.key])
            found[scan.key] = [await look(session, model, scan, click, target) for click in clicks]
    return found
