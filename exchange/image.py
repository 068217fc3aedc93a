"""Textures as image files: bounded before they are decoded, PNG where we write them (nothing of the colour is lost)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from exchange.errors import ExchangeError
from protocol.grid import HEIGHT_MAX, WIDTH_MAX, ImageArray

IMAGE_BYTES_MAX = 1 << 30
NO_IMAGE = "is no image we read, or damaged, or far too large: save it anew as PNG or JPEG"
PNG_LEVEL = 1  # twice as fast as the default for a few percent more bytes


def encode_png(texture: ImageArray) -> bytes:
    """A texture, (Ht, Wt, 3) uint8 RGB, as a PNG file."""
    bgr = cv2.cvtColor(texture, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])
    assert done  # OpenCV encodes every uint8 image with three channels
    return data.tobytes()


def read_image(path: Path) -> ImageArray:
    """An image of any format OpenCV reads. (Ht, Wt, 3) uint8 RGB

    Raises ExchangeError for one that is none or too large, OSError when it cannot be opened.
    """
    if path.stat().st_size > IMAGE_BYTES_MAX:
        raise ExchangeError(f"texture: {path} is larger than {IMAGE_BYTES_MAX} bytes")
    _check_size(path)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    try:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB) if data.size else None
    except cv2.error as problem:  # a size beyond its own bound
        raise ExchangeError(f"texture: {path} {NO_IMAGE}") from problem
    if image is None:
        raise ExchangeError(f"texture: {path} {NO_IMAGE}")
    return np.asarray(image, np.uint8)


def _check_size(path: Path) -> None:
    """Bound what decoding would allocate. What Pillow does not know is left to OpenCV, which has a bound of its own."""
    from PIL import Image, UnidentifiedImageError

    with open(path, "rb") as file:
        try:
            with Image.open(file) as image:
                width, height = image.size
        except UnidentifiedImageError:
            return
        except (Image.DecompressionBombError, OSError, ValueError) as problem:  # the last two: chunks that are damaged
            raise ExchangeError(f"texture: {path} {NO_IMAGE}") from problem
    if width > WIDTH_MAX or height > HEIGHT_MAX:
        raise ExchangeError(f"texture: {path} has {width} x {height} texels, at most {WIDTH_MAX} x {HEIGHT_MAX}")
