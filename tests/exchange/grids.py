"""Grids with all that matters to a file: slopes, a seam, holes of any shape, a texture that tells where it is."""

import numpy as np
from hypothesis import strategies as st

from protocol.grid import VOID, Grid, GridSpec, ImageArray

SPEC = GridSpec(48, 30, 160, 80, step_mm=0.01, pitch_mm=1.5, z_max_mm=31.0, theta0_rad=0.4)


def texture(width: int, height: int) -> ImageArray:
    """Smooth all round: red and green tell the angle, blue the height."""
    turn = 2 * np.pi * (np.arange(width) + 0.5) / width
    down = (np.arange(height) + 0.5) / height
    planes = np.broadcast_arrays(128 + 100 * np.cos(turn), 128 + 100 * np.sin(turn), 20 + 200 * down[:, None])
    image: ImageArray = np.rint(np.stack(planes, axis=-1)).astype(np.uint8)
    return image


def vase(holes: bool = False, spec: GridSpec = SPEC) -> Grid:
    """A wavy vase; with holes: a large one across the seam, a pinhole, a lone sample in a void."""
    turn = 2 * np.pi * (np.arange(spec.width) + 0.5) / spec.width
    height = np.linspace(0, 3, spec.height)[:, None]
    steps = np.rint(4000 + 300 * np.cos(3 * turn) + 500 * np.sin(height)).astype(np.uint16)
    if holes:
        steps[8:14, :5] = steps[8:14, -4:] = VOID
        steps[20, 20] = VOID
        steps[2:7, 30:35] = VOID
        steps[4, 32] = 4000
    return Grid(spec, steps, texture(spec.texture_width, spec.texture_height))


@st.composite
def grids(draw: st.DrawFn) -> Grid:
    """Small grids of any shape with voids anywhere; at least one face."""
    width, height = draw(st.integers(3, 12)), draw(st.integers(2, 8))
    spec = GridSpec(
        width,
        height,
        draw(st.integers(1, 20)),
        draw(st.integers(1, 20)),
        step_mm=draw(st.sampled_from([0.001, 0.01, 0.0137])),
        pitch_mm=draw(st.floats(0.1, 5)),
        z_max_mm=draw(st.floats(-50, 50)),
        theta0_rad=draw(st.floats(-3, 3)),
    )
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    steps = rng.integers(2000, 9000, (height, width)).astype(np.uint16)
    steps[rng.random((height, width)) < draw(st.sampled_from([0.0, 0.2, 0.6]))] = VOID
    steps[:2, :2] = 5000
    shape = spec.texture_height, spec.texture_width, 3
    return Grid(spec, steps, rng.integers(0, 256, shape).astype(np.uint8))
