"""Part of `bench rate`: the joint choice of spacing, quality and quantum, held against a fixed quality at equal bytes.

The rival follows the paper: its quality never changes, and it takes the finest sampling that fits the bytes there are
(REQUIREMENTS F-14, E-01), here the closest spacing of the same plateau. It has the same range as we chose, so that only
texture differs; and for every codec the quality that serves it best in the mean over all clicks and limits.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np

from node.coded import Coded
from node.first_view import FirstView, build_first_view, texture_as_seen
from node.foveate import plan_update
from node.library import Scan
from node.refine_texture import code_texture, measured
from node.texture_model import TextureModel
from node.wanted import Models, Wanted
from protocol.grid import ImageArray
from protocol.lattice import Channel
from protocol.messages import CodecName, Look, TextureParameters
from protocol.reconstruct import paste
from tests.bench.scans import BenchScan, Click
from tests.bench.target import Target, Window, crop, psnr_db

SHARES = (0.1, 0.25, 0.5, 0.75, 0.9)
CODECS: tuple[CodecName, ...] = ("htj2k", "jpeg")
FIXED = (14, 20, 26, 32, 36, 40, 44, 48)
SPACINGS = (1, 1.5, 2, 3, 4, 6, 8)
FIRST_VIEW_BYTES = 32768

Tries = dict[tuple[int, float], tuple[int, float]]


def run(scans: list[BenchScan], clicks: int) -> list[dict[str, Any]]:
    """PSNR in the window, ours and that of every fixed quality, for every click and limit that binds for texture."""
    rows = []
    for scan in scans:
        with tempfile.TemporaryDirectory(prefix="foveascan-bench-") as folder:
            published = scan.published(Path(folder))
            seen = texture_as_seen(build_first_view(published, "htj2k", FIRST_VIEW_BYTES))
            model = TextureModel(published.texture, seen)
            for codec in CODECS:
                view = build_first_view(published, codec, FIRST_VIEW_BYTES)
                for click in scan.clicks(clicks):
                    rows += _click(scan, published, view, model, codec, click)
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """For each codec the gain over its best fixed quality, in dB, and how often that was better than ours by 0.1 dB."""
    found: dict[str, dict[str, float]] = {}
    for codec in CODECS:
        of_codec = [row for row in rows if row["codec"] == codec]
        if not of_codec:
            continue
        best = max(FIXED, key=lambda quality: mean(row["fixed_db"][quality] for row in of_codec))
        gains = [row["joint_db"] - row["fixed_db"][best] for row in of_codec]
        worse = sum(gain < -0.1 for gain in gains) / len(gains)
        found[codec] = {"fixed_quality": best, "gain_db": mean(gains), "least_db": min(gains), "worse": worse}
    return found


def _click(
    scan: BenchScan, published: Scan, view: FirstView, model: TextureModel, codec: CodecName, click: Click
) -> list[dict[str, Any]]:
    target = Target()
    window = Window.round(scan.grid, click, target)
    seen, models = texture_as_seen(view), Models(texture=model)
    look = Look(1, *click, target.window, texture_db=target.texture_db, range_mm=target.range_mm)
    free = plan_update(published, view.state, Wanted(look, (codec,)), models)
    if all(coded.channel is Channel.RANGE for coded in free.coded):
        return []  # the first view shows enough: no texture to compare
    rows, tries = [], _fixed_tries(published, view, look, codec, window, seen)
    for share in SHARES:
        limit = round(share * free.wire_bytes)
        ours = plan_update(published, view.state, Wanted(look, (codec,), limit), models)
        texture = [coded for coded in ours.coded if coded.channel is Channel.TEXTURE]
        left = limit - ours.wire_bytes + sum(coded.wire_bytes for coded in texture)
        held_db = psnr_db(crop(seen, window.texture), window.texels)
        rows.append({
            "scan": scan.name, "codec": codec, "click": click, "limit": limit, "texture_bytes": left,
            "joint_db": _db(published, texture[0], window, seen) if texture else held_db,
            "fixed_db": {quality: _finest(tries, quality, left, held_db) for quality in FIXED},
        })  # fmt: skip
    return rows


def _fixed_tries(
    published: Scan, view: FirstView, look: Look, codec: CodecName, window: Window, seen: ImageArray
) -> Tries:
    """Bytes and PSNR of every fixed quality at every spacing."""
    found: Tries = {}
    region = window.texture
    for quality in FIXED:
        for p in SPACINGS:
            coded = code_texture(published, view.state, region, TextureParameters(p, quality, codec, 1.0))
            if coded is not None:
                found[quality, p] = coded.wire_bytes, _db(published, coded, window, seen)
    return found


def _finest(tries: Tries, quality: int, limit_bytes: int, held_db: float) -> float:
    """PSNR at a quality and the closest spacing that fits; of the first view where none does."""
    fitting = (tries[quality, p] for p in SPACINGS if (quality, p) in tries)
    return next((db for size_bytes, db in fitting if size_bytes <= limit_bytes), held_db)


def _db(published: Scan, coded: Coded, window: Window, seen: ImageArray) -> float:
    """PSNR in the window once a texture refinement is in."""
    dense = np.array(seen)
    for part in measured(coded).parts:
        paste(dense, part.texture, part.selection)
    return psnr_db(crop(dense, window.texture), window.texels)


def told(rows: list[dict[str, Any]]) -> str:
    """A line a codec."""
    lines = []
    for codec, found in summary(rows).items():
        lines.append(
            f"{codec}: the joint choice beats fixed quality {found['fixed_quality']:.0f}, the best of"
            f" {len(FIXED)}, by {found['gain_db']:.2f} dB in the mean ({found['least_db']:+.2f} at least, worse by"
            f" more than 0.1 dB in {found['worse']:.0%})"
        )
    return "\n".join(lines)
