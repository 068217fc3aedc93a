"""Images that codecs are tried on."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from protocol.grid import BoolArray, ImageArray, StepArray

shapes = st.tuples(st.integers(1, 40), st.integers(1, 40))


def texture(shape: tuple[int, int]) -> ImageArray:
    y, x = np.mgrid[: shape[0], : shape[1]]
    wave = 127 + 60 * np.sin(x / 9) + 50 * np.cos(y / 7)
    return np.stack([wave, 0.8 * wave, 255 - wave], axis=2).astype(np.uint8)


def ranges(shape: tuple[int, int]) -> StepArray:
    return (texture(shape)[..., 0].astype(np.uint16) * 200 + 1).astype(np.uint16)


def discs(shape: tuple[int, int]) -> BoolArray:
    return texture(shape)[..., 0] > 150
