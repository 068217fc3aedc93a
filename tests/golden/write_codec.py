"""Write the codec's golden vectors: payloads that must decode for ever, in Python and in the browser.

    python tests/golden/write_codec.py

codec/vectors.json lists them; NAME.payload is what travels, NAME.samples what it decodes to (row-major; uint16 little-
endian, RGB bytes, or a byte a cell of the mask). Lossy texture may differ by 2 levels between decoders, all else by
nothing. `stream_sha256` is the hash of the payload with its headers rebuilt, `headers` hashes every header there is.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import codec, codec_colours, codec_htj2k, codec_jpeg
from protocol.codec import RangeCodec, TextureCodec
from protocol.grid import BoolArray, ImageArray, StepArray

FOLDER = Path(__file__).parent / "codec"
TEXTURES = (
    ("jpeg_annex_k", TextureCodec.JPEG, 40, (1, 1)),
    ("jpeg_fitted", TextureCodec.JPEG, 46, (64, 48)),
    ("htj2k_one_texel", TextureCodec.HTJ2K, 40, (1, 1)),
    ("htj2k_coarse", TextureCodec.HTJ2K, 36.6875, (33, 40)),
    ("htj2k_fine", TextureCodec.HTJ2K, 61, (64, 72)),
    ("htj2k_black_and_white", TextureCodec.HTJ2K, 40, (40, 48)),
    ("htj2k_lossless", TextureCodec.HTJ2K, codec.LOSSLESS, (16, 48)),
)
RANGES = (
    ("range_raw", RangeCodec.RAW, (3, 5)),
    ("range_row", RangeCodec.HTJ2K, (1, 40)),
    ("range_patch", RangeCodec.HTJ2K, (57, 64)),
)
# Lifted range: quantum, shape; the last one jumps so far that bytes and words of escapes are needed.
LIFTED = (
    ("range_lift_one", 1, (1, 1)),
    ("range_lift_row", 1, (1, 40)),
    ("range_lift_column", 3, (31, 1)),
    ("range_lift_patch", 1, (57, 64)),
    ("range_lift_quantised", 10, (33, 50)),
    ("range_lift_rough", 1, (20, 9)),
)
MASKS = ("mask_none", "mask_all", "mask_edges", "mask_noise")
HEADER_SIDES = (1, 8, 16, 32, 64, 128, 256, 512)


def main() -> None:
    """Write vectors.json and the files it names."""
    FOLDER.mkdir(exist_ok=True)
    vectors = [*_texture_vectors(), *_range_vectors(), *_lift_vectors(), *_mask_vectors()]
    index = {"headers": header_hashes(), "vectors": vectors}
    (FOLDER / "vectors.json").write_text(json.dumps(index, indent=1) + "\n")


def header_hashes() -> dict[str, str]:
    """SHA-256 of all headers in a row: HTJ2K by side, then quality; JPEG by Q 1..100 at 3 rows of 5."""
    qualities = (*np.arange(0, codec.LOSSY_MAX + 1 / 16, 1 / 16).tolist(), codec.LOSSLESS)
    return {
        "htj2k_texture": _sha256(
            *(codec_htj2k.main_header((side, side, 3), quality) for side in HEADER_SIDES for quality in qualities)
        ),
        "htj2k_range": _sha256(*(codec_htj2k.main_header((side, side), codec.LOSSLESS) for side in HEADER_SIDES)),
        "jpeg": _sha256(*(codec_jpeg.frame_header((3, 5), q) for q in range(1, 101))),
    }


def _texture_vectors() -> Iterator[dict[str, Any]]:
    for name, kind, quality, shape in TEXTURES:
        source, whole = _bars(shape) if name.endswith("white") else _texture(shape), int(quality)
        payload = codec.encode_texture(source, kind, quality)
        image = codec.decode_texture(payload, kind, whole, shape)
        if kind == TextureCodec.JPEG:
            stream = codec_jpeg.restore(payload, shape, codec.jpeg_q(whole))
        elif quality == codec.LOSSLESS:
            stream = codec_htj2k.restore(payload, (*shape, 3), whole)
        else:
            stream = codec_colours.restore(payload, shape, whole)
        yield _write(name, "texture", payload, image, codec=int(kind), quality=whole, stream_sha256=_sha256(stream))


def _range_vectors() -> Iterator[dict[str, Any]]:
    for name, kind, shape in RANGES:
        payload = codec.encode_range(_range(shape), kind)
        stream = payload if kind == RangeCodec.RAW else codec_htj2k.restore(payload, shape, codec.LOSSLESS)
        yield _write(name, "range", payload, _range(shape), codec=int(kind), stream_sha256=_sha256(stream))


def _lift_vectors() -> Iterator[dict[str, Any]]:
    for name, quantum, shape in LIFTED:
        values = _rough(shape) if name.endswith("rough") else _range(shape)
        payload = codec.encode_range(values, RangeCodec.LIFT, quantum)
        decoded = codec.decode_range(payload, RangeCodec.LIFT, shape, quantum)
        lift, whole = int(RangeCodec.LIFT), _sha256(payload)
        yield _write(name, "range", payload, decoded, codec=lift, quantum=quantum, stream_sha256=whole)


def _mask_vectors() -> Iterator[dict[str, Any]]:
    for name in MASKS:
        mask = _mask(name)
        yield _write(name, "mask", codec.encode_mask(mask), mask)


def _write(name: str, channel: str, payload: bytes, samples: NDArray[Any], **facts: int | str) -> dict[str, Any]:
    (FOLDER / f"{name}.payload").write_bytes(payload)
    little_endian = samples.astype(samples.dtype.newbyteorder("<"))
    (FOLDER / f"{name}.samples").write_bytes(little_endian.tobytes())
    return {"name": name, "channel": channel, "shape": samples.shape[:2], **facts}


def _texture(shape: tuple[int, int]) -> ImageArray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.stack([90 + x * y % 97, 40 + (3 * x + 2 * y) % 128, 200 - (x ^ y) % 101], axis=2).astype(np.uint8)


def _bars(shape: tuple[int, int]) -> ImageArray:
    """Black on white, which a lossy decoder overshoots on both sides."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    return np.where(((x // 5 + y // 7) % 3 == 0)[..., None], 0, 255).repeat(3, axis=2).astype(np.uint8)


def _range(shape: tuple[int, int]) -> StepArray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    values: StepArray = (40_000 + 3 * (x - 20) ** 2 - 2 * (y - 30) ** 2 + x * y % 7).astype(np.uint16)
    return values


def _rough(shape: tuple[int, int]) -> StepArray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    values: StepArray = np.where((x + 2 * y) % 3 == 0, 1 + x * y % 300, 65535 - 40 * x).astype(np.uint16)
    return values


def _mask(name: str) -> BoolArray:
    y, x = np.mgrid[:48, :56]
    masks: dict[str, BoolArray] = {
        "mask_none": np.zeros((8, 8), np.bool_),
        "mask_all": np.ones((8, 16), np.bool_),
        "mask_edges": ((x - 20) ** 2 + 2 * (y - 25) ** 2 < 300) | (x + y % 5 > 50),
        "mask_noise": (x * 7 + y * 13 + x * y) % 5 == 0,
    }
    return masks[name]


def _sha256(*parts: bytes) -> str:
    return hashlib.sha256(b"".join(parts)).hexdigest()


if __name__ == "__main__":
    main()
