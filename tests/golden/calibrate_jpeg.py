"""Print the table JPEG_Q of protocol/codec.py: the JPEG Q whose PSNR equals that of HTJ2K, for each texture quality.

    python tests/golden/calibrate_jpeg.py TEXTURE.jpg ...

Run it on textures 4096 wide. Patches of 448 x 896 texels, at the full and at half the resolution, are coded both ways.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

import cv2
import numpy as np

from protocol import codec_htj2k, codec_jpeg
from protocol.grid import FloatArray, ImageArray

QS = np.array([*range(10, 30, 2), *range(30, 96)])
QUALITIES = np.arange(8, 90)
PATCH = (448, 896)


def main(paths: list[str]) -> None:
    """Measure every patch of every file, print the table and how well it fits."""
    curves = [_psnr_curves(patch) for path in paths for patch in _patches(path)]
    typical = np.median([np.interp(jpeg, htj2k, QUALITIES) for jpeg, htj2k in curves], axis=0)
    qualities = np.arange(np.ceil(typical[0]), np.floor(typical[-1]) + 1).astype(int)
    table = np.rint(np.interp(qualities, typical, QS)).astype(int)
    misses = [np.interp(table, QS, jpeg) - np.interp(qualities, QUALITIES, htj2k) for jpeg, htj2k in curves]
    print(f"JPEG_QUALITY_MIN = {qualities[0]}")
    print(f"JPEG_Q = {tuple(table.tolist())}")
    print(f"{len(curves)} patches; PSNR of JPEG less that of HTJ2K at one quality: mean {np.mean(misses):+.2f} dB, "
          f"mean size {np.abs(misses).mean():.2f} dB, 90% within {np.quantile(np.abs(misses), 0.9):.2f} dB")


def _patches(path: str) -> Iterator[ImageArray]:
    texture = cv2.imread(path, cv2.IMREAD_COLOR_RGB)
    if texture is None:
        raise SystemExit(f"{path}: not an image")
    for scale in (1, 2):
        level = cv2.resize(texture, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        rows, columns = ((have - want) // 2 for have, want in zip(level.shape[:2], PATCH, strict=True))
        for x in (0, columns, 2 * columns):
            yield np.ascontiguousarray(level[rows : rows + PATCH[0], x : x + PATCH[1]])


def _psnr_curves(patch: ImageArray) -> tuple[FloatArray, FloatArray]:
    """PSNR of JPEG at each of QS and of HTJ2K at each of QUALITIES. [dB]"""
    jpeg = [cv2.PSNR(patch, codec_jpeg.decode(codec_jpeg.encode(patch, q), PATCH, q)) for q in QS.tolist()]
    htj2k = [
        cv2.PSNR(patch, codec_htj2k.decode(codec_htj2k.encode(patch, n), patch.shape, n)) for n in QUALITIES.tolist()
    ]
    return np.maximum.accumulate(jpeg), np.maximum.accumulate(htj2k)


if __name__ == "__main__":
    main(sys.argv[1:])
