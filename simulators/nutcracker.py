"""A wooden nutcracker, turned on a lathe and painted: hard edges, flat colours, arms and a nose that stand out.

The paper behind this project showed such a toy at size S; ours is drawn from scratch. z = 0 at the foot, millimetres.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol.grid import Grid, ImageArray, mm_to_steps
from simulators.noise import Plane, lattice_noise
from simulators.shapes import Shape, spec_for
from simulators.sheet import ROUND_MM, Sheet, range_sheet, smooth_step, texture_sheet

HEIGHT_MM = 262.0
TOP_MM = 256.0
EDGE_MM = 0.35

Colour = tuple[int, int, int]
Cells = tuple[NDArray[np.intp], ...]
WOOD: Colour = (196, 150, 98)
RED: Colour = (176, 28, 34)
BLUE: Colour = (28, 48, 112)
GOLD: Colour = (214, 170, 62)
BLACK: Colour = (30, 27, 28)
SKIN: Colour = (232, 188, 158)
WHITE: Colour = (238, 234, 224)

# The turned profile from the foot up: (z, range), both in mm. Equal z twice is a step.
PROFILE = (
    (0, 46), (14, 46), (14, 43), (20, 43), (20, 27), (62, 25), (64, 27), (96, 28), (100, 33), (104, 37), (112, 37),
    (112, 38.5), (119, 38.5), (119, 36), (140, 39), (156, 41), (164, 36), (168, 22), (171, 22), (174, 28), (184, 31),
    (206, 31), (214, 29), (214, 35), (219, 35), (219, 31), (246, 34), (249, 34), (256, 30),
)  # fmt: skip
# Rings of paint from the foot up: (upper edge z, colour).
RINGS: tuple[tuple[float, Colour], ...] = (
    (14, WOOD), (20, GOLD), (62, BLACK), (104, BLUE), (112, RED), (119, GOLD), (164, RED), (171, WHITE), (214, SKIN),
    (219, GOLD), (249, BLUE), (270, GOLD),
)  # fmt: skip


class Part(NamedTuple):
    """A thing glued on: where, half its size, how far it stands out [mm], its colour."""

    degrees: float
    z: float
    half_width: float
    half_height: float
    out_mm: float
    colour: Colour


PARTS = (
    Part(90, 135, 13, 30, 13, RED),  # arms, cuffs, hands
    Part(-90, 135, 13, 30, 13, RED),
    Part(90, 104, 13, 4, 14, GOLD),
    Part(-90, 104, 13, 4, 14, GOLD),
    Part(90, 95, 10, 8, 11, SKIN),
    Part(-90, 95, 10, 8, 11, SKIN),
    Part(0, 195, 5, 8, 9, SKIN),  # nose
    Part(-24, 202, 4.5, 3.5, 0.8, WHITE),  # eyes
    Part(24, 202, 4.5, 3.5, 0.8, WHITE),
    Part(-24, 202, 2, 2.4, 0.7, BLACK),
    Part(24, 202, 2, 2.4, 0.7, BLACK),
    Part(-24, 209, 7, 1.6, 1.2, BLACK),  # brows
    Part(24, 209, 7, 1.6, 1.2, BLACK),
    Part(-17, 186, 10, 2.6, 3.0, BLACK),  # moustache
    Part(17, 186, 10, 2.6, 3.0, BLACK),
    Part(0, 178, 14, 4.5, 2.2, WHITE),  # teeth
    Part(0, 166, 13, 8, 4.0, WHITE),  # beard
    Part(0, 152, 3, 3, 2.0, GOLD),  # buttons
    Part(0, 140, 3, 3, 2.0, GOLD),
    Part(0, 128, 3, 3, 2.0, GOLD),
    Part(0, 115.5, 6, 4.5, 2.0, WHITE),  # buckle
    Part(0, 234, 8, 9, 2.0, GOLD),  # badge on the hat
    Part(0, 17, 26, 6, 9, BLACK),  # tips of the boots
    Part(0, 60, 2.2, 34, -5, BLACK),  # between the legs
    Part(180, 60, 2.2, 34, -5, BLACK),
    Part(180, 190, 30, 20, 3.5, WHITE),  # hair
    Part(180, 150, 6, 26, 6, WOOD),  # the lever at the back
)


def nutcracker(shape: Shape, seed: int) -> Grid:
    """The toy at any size. shape : (W, H, Wt, Ht)"""
    spec = spec_for(shape, 0.0, HEIGHT_MM)
    sheet = range_sheet(spec)
    heights, ranges = np.array(PROFILE, np.float64).T
    profile = np.interp(sheet.z, heights + 1e-6 * np.arange(len(heights)), ranges)
    profile[sheet.z > TOP_MM] = np.nan
    range_mm = np.repeat(profile[:, None], spec.width, 1).astype(np.float32)
    for part in PARTS:
        cells, cover = _part_cover(sheet, part, soft=0.35)
        range_mm[cells] += np.float32(part.out_mm) * np.sqrt(cover)
    return Grid(spec, mm_to_steps(range_mm, spec.step_mm), _painted(texture_sheet(spec), seed))


def _part_cover(sheet: Sheet, part: Part, soft: float) -> tuple[Cells, Plane]:
    """A rounded rectangle: the cells it reaches, across the seam too, and its cover, 1 inside, its rim `soft` of it."""
    turn = sheet.s / np.float32(ROUND_MM) - np.float32(np.radians(part.degrees))
    across = 32 * np.abs((turn + np.pi) % (2 * np.pi) - np.pi) / np.float32(part.half_width)
    up = np.abs(sheet.z - np.float32(part.z)) / np.float32(part.half_height)
    rows, columns = np.flatnonzero(up < 1), np.flatnonzero(across < 1)
    radius = (across[None, columns] ** 4 + up[rows, None] ** 4) ** np.float32(0.25)
    return np.ix_(rows, columns), smooth_step((1 - radius) / np.float32(soft))


def _painted(sheet: Sheet, seed: int) -> ImageArray:
    """Flat paint over the grain of the wood. (m, n, 3)"""
    rng = np.random.default_rng((seed, 6))
    grain = 3.0 * lattice_noise(rng, (16, 720), sheet.shape) + 1.6 * lattice_noise(rng, (220, 400), sheet.shape)
    covers = [_part_cover(sheet, part, soft=0.06) for part in PARTS]
    image = np.empty((*sheet.shape, 3), np.uint8)
    for channel in range(3):
        plane = np.repeat(_ring_paint(sheet.z, channel)[:, None], sheet.shape[1], 1)
        for (cells, cover), part in zip(covers, PARTS, strict=True):
            plane[cells] += cover * (part.colour[channel] - plane[cells])
        plane += grain
        plane[sheet.z > TOP_MM] = 0
        image[..., channel] = np.clip(plane + 0.5, 0, 255)
    return image


def _ring_paint(z: Plane, channel: int) -> Plane:
    """One channel of the rings' colours at every height, edges softened over EDGE_MM. (m,)"""
    paint = np.full(z.shape, RINGS[0][1][channel], np.float32)
    for (edge, _), (_, colour) in zip(RINGS[:-1], RINGS[1:], strict=True):
        paint += smooth_step((z - np.float32(edge)) / EDGE_MM + 0.5) * (colour[channel] - paint)
    return paint
