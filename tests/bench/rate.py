"""`bench rate`: what the rate control makes of a byte limit: encodes an update, how full it fills it, never over.

Limits are shares of what the update takes without one. A limit below 1 binds before the quality is reached, and what
counts then is the fill; overshoot is counted on the WebSocket, where the closing message alone takes some 130 bytes.
At the end what the joint choice gains over a fixed quality (joint.py).
"""

from __future__ import annotations

import asyncio
from statistics import mean
from typing import Any

from tests.bench import joint
from tests.bench.ours import look, node_with
from tests.bench.scans import BenchScan
from tests.bench.target import Target

SHARES = (0.1, 0.25, 0.5, 0.75, 0.9)


def run(scans: list[BenchScan], size: str, clicks: int) -> dict[str, Any]:
    """Every scan, every click, every limit, each on a model that holds the first view alone."""
    rows = asyncio.run(_looks(scans, clicks))
    limited = [row for row in rows if row["limit"] is not None]
    binding = [row for row in limited if not row["reached"]]
    return {
        "size": size, "clicks": clicks, "rows": rows,
        "encodes_mean": mean(row["encodes"] for row in rows),
        "encodes_mean_limited": mean(row["encodes"] for row in limited),
        "encodes_most": max(row["encodes"] for row in rows),
        "fill_mean": mean(row["fill"] for row in binding) if binding else None,
        "fill_least": min((row["fill"] for row in binding), default=None),
        "over": sum(row["bytes"] > row["limit"] and row["refinements"] > 0 for row in limited),
        "below_the_reply": sum(row["bytes"] > row["limit"] and row["refinements"] == 0 for row in limited),
        "joint": joint.run(scans, clicks),
    }  # fmt: skip


async def _looks(scans: list[BenchScan], clicks: int) -> list[dict[str, Any]]:
    target, rows = Target(), []
    async with node_with(scans) as (session, ids):
        for scan in scans:
            for click in scan.clicks(clicks):
                model = await session.open(ids[scan.key])
                free = await look(session, model, scan, click, target)
                limits = [None, *(round(share * free.size_bytes) for share in SHARES)]
                for limit in limits:
                    model = await session.open(ids[scan.key])
                    got = await look(session, model, scan, click, target, max_bytes=limit)
                    rows.append({
                        "scan": scan.name, "click": click, "limit": limit, "bytes": got.size_bytes,
                        "fill": got.size_bytes / limit if limit else None, "reached": got.reached,
                        "encodes": got.encodes, "refinements": len(got.parts), "texture_db": got.texture_db,
                        "range_error_mm": got.range_error_mm,
                    })  # fmt: skip
    return rows


def told(record: dict[str, Any]) -> str:
    """The summary, then each limit."""
    fill = (
        "no limit bound"
        if record["fill_mean"] is None
        else (f"fill {record['fill_mean']:.1%} in the mean, {record['fill_least']:.1%} at least")
    )
    lines = [
        f"{record['size']}: encodes an update {record['encodes_mean']:.2f} in the mean"
        f" ({record['encodes_mean_limited']:.2f} under a limit), {record['encodes_most']} at most; {fill};"
        f" over the limit {record['over']} times (and {record['below_the_reply']} limits were below an empty reply)",
        joint.told(record["joint"]), "",
        "| scan | limit | bytes | fill | encodes | texture dB | range mm |", "|---" * 7 + "|",
    ]  # fmt: skip
    for row in record["rows"]:
        limit, full = (row["limit"], f"{row['fill']:.1%}") if row["limit"] else ("none", "")
        lines.append(
            f"| {row['scan']} {row['click'][0]:.3f},{row['click'][1]:.3f} | {limit} | {row['bytes']} | {full} |"
            f" {row['encodes']} | {row['texture_db']:.2f} | {row['range_error_mm']:.3f} |"
        )
    return "\n".join(lines)
