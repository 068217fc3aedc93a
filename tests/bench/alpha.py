"""`bench alpha`: what the distortion factor buys: PSNR and MS-SSIM near the click and further out, at equal bytes.

The assessment that Cheng, Basu and Pan leave to future work. Every alpha gets the same byte limit, which binds, so that
a wider skirt is paid for by the window. Ours (default profile) and the paper's letter (classic) side by side.
"""

from __future__ import annotations

import asyncio
from statistics import mean
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from client.model import Model
from client.session import Session
from protocol.grid import ImageArray
from protocol.region import region_round
from tests.bench.ours import node_with, wire_bytes
from tests.bench.scans import BenchScan, Click

ALPHAS = (None, 4.0, 1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
CLASSIC_ALPHAS = (0.5, 0.1, 0.05, 0.03, 0.01)
LIMIT_BYTES = {"S": 4000, "M": 16000, "L": 48000}
SHARES = {"window": 0.05, "around": 0.2, "everywhere": 1.0}
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)  # Wang, Simoncelli, Bovik 2003
SSIM_SIGMA = 1.5
C1, C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
OUT_OF_REACH = {"texture_db": 60}

LightArray = NDArray[np.float32]


def run(scans: list[BenchScan], size: str, clicks: int) -> dict[str, Any]:
    """Every alpha on every scan, each click on a model that holds the first view alone."""
    rows = asyncio.run(_looks(scans, size, clicks))
    return {"size": size, "clicks": clicks, "limit_bytes": LIMIT_BYTES[size], "rows": rows}


async def _looks(scans: list[BenchScan], size: str, clicks: int) -> list[dict[str, Any]]:
    rows = []
    profiles = [("default", alpha) for alpha in ALPHAS] + [("classic", alpha) for alpha in CLASSIC_ALPHAS]
    async with node_with(scans) as (session, ids):
        for scan in scans:
            for profile, alpha in profiles:
                got = [
                    await _look(session, scan, ids[scan.key], click, profile, alpha, LIMIT_BYTES[size])
                    for click in scan.clicks(clicks)
                ]
                means = {key: mean(one[key] for one in got) for key in got[0]}
                rows.append({"scan": scan.name, "profile": profile, "alpha": alpha, **means})
    return rows


async def _look(
    session: Session, scan: BenchScan, scan_id: str, click: Click, profile: Any, alpha: float | None, limit: int
) -> dict[str, float]:
    model = await session.open(scan_id, profile=profile)
    wanted: dict[str, Any] = {"alpha": alpha, **OUT_OF_REACH}
    if profile == "classic":
        wanted = {"parameters": {"range": {"alpha": alpha}, "texture": {"alpha": alpha}}}
    update = await session.look(*click, max_bytes=limit, profile=profile, **wanted)
    return {"bytes": wire_bytes(update), **_quality(model, scan, click)}


def _quality(model: Model, scan: BenchScan, click: Click) -> dict[str, float]:
    """PSNR and MS-SSIM of the texture in regions of growing size round a click."""
    spec, figures = scan.grid.spec, {}
    for name, share in SHARES.items():
        region = region_round(*click, share, spec.texture_width, spec.texture_height)
        held, true = (image[region.rows][:, region.columns] for image in (model.texture, scan.grid.texture))
        figures[f"{name}_db"] = cv2.PSNR(np.ascontiguousarray(held), np.ascontiguousarray(true))
        figures[f"{name}_ms_ssim"] = ms_ssim(_grey(held), _grey(true))
    return figures


def ms_ssim(held: LightArray, true: LightArray) -> float:
    """Multi-scale structural similarity of two grey images, 0..1; fewer scales where they are small."""
    parts, weights = [], []
    for index, weight in enumerate(MS_SSIM_WEIGHTS):
        luminance, structure = _ssim(held, true)
        last = index == len(MS_SSIM_WEIGHTS) - 1 or min(held.shape) < 32
        parts.append(max(luminance * structure if last else structure, 0.0))
        weights.append(weight)
        if last:
            break
        held, true = _halved(held), _halved(true)
    return float(np.prod(np.power(parts, np.array(weights) / sum(weights))))


def _halved(image: LightArray) -> LightArray:
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32)


def _ssim(a: LightArray, b: LightArray) -> tuple[float, float]:
    """Means of the luminance term, and of contrast times structure."""

    def blurred(image: LightArray) -> LightArray:
        return np.asarray(cv2.GaussianBlur(image, (11, 11), SSIM_SIGMA), np.float32)

    mean_a, mean_b = blurred(a), blurred(b)
    variance_a, variance_b = blurred(a * a) - mean_a**2, blurred(b * b) - mean_b**2
    both = blurred(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    return float(luminance.mean()), float(((2 * both + C2) / (variance_a + variance_b + C2)).mean())


def _grey(image: ImageArray) -> LightArray:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.float32)


def told(record: dict[str, Any]) -> str:
    """A table a scan."""
    head = "| scan | profile | alpha | bytes |" + "".join(f" {name} dB, MS-SSIM |" for name in SHARES)
    lines = [f"{record['size']}, at most {record['limit_bytes']} bytes, {record['clicks']} foveae a scan", "", head]
    lines.append("|---" * (4 + len(SHARES)) + "|")
    for row in record["rows"]:
        quality = "".join(f" {row[f'{name}_db']:.2f}, {row[f'{name}_ms_ssim']:.4f} |" for name in SHARES)
        alpha = "thin skirt" if row["alpha"] is None else f"{row['alpha']:g}"
        lines.append(f"| {row['scan']} | {row['profile']} | {alpha} | {row['bytes']:.0f} |{quality}")
    return "\n".join(lines)
