"""What shape and colour of a face share: moles, wrinkles, lips and hair. Landmarks are (s, z) in mm on the sheet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.grid import FloatArray
from simulators.noise import Plane, fractal_noise
from simulators.sheet import Point, Sheet, smooth_step

Curve = tuple[Point, ...]

RAISED = 8
FLAT = 38
MOUTH_MM = -48.5
MOUTH: Curve = ((-27, -48.5), (-14, -48), (0, -48.8), (14, -48), (27, -48.5))
HAIRLINE = (
    (0, 76), (30, 78), (55, 73), (72, 58), (84, 50), (95, 40), (108, 32), (114, 10), (119, -12), (128, -14), (131, 20),
    (150, 38), (168, 28), (178, -10), (190, -38), (215, -58), (250, -68), (283, -70),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Mole:
    """A mole. radius, height [mm]; melanin of its middle; phase of its outline [rad]"""

    centre: Point
    radius_mm: float
    height_mm: float
    melanin: float
    phase: float


@dataclass(frozen=True, slots=True)
class Wrinkle:
    """A groove of Gaussian section along a curve. [mm]"""

    points: Curve
    sigma_mm: float
    depth_mm: float


@dataclass(frozen=True, slots=True)
class Marks:
    """What tells one skin from another."""

    moles: tuple[Mole, ...]
    wrinkles: tuple[Wrinkle, ...]


def marks(seed: int) -> Marks:
    """Moles and wrinkles of one person."""
    rng = np.random.default_rng((seed, 3))
    raised = [
        Mole(_clear_place(rng, 55), rng.uniform(1.2, 2.8), rng.uniform(0.4, 1.3), *_tone(rng)) for _ in range(RAISED)
    ]
    flat = [Mole(_clear_place(rng, 90), 0.4 + rng.gamma(2, 0.25), 0.0, *_tone(rng)) for _ in range(FLAT)]
    return Marks((*raised, *flat), (*_forehead_lines(rng), *_eye_lines(rng), *_neck_lines(rng)))


def lip_cover(sheet: Sheet) -> tuple[Plane, Plane]:
    """Upper and lower lip: 1 where they meet, falling to 0 at their outer borders. Two (m, n)"""
    s, z = sheet.s[None, :], sheet.z[:, None] - np.float32(MOUTH_MM)
    taper = np.sqrt(np.clip(1 - (s / 27) ** 2, 0, 1))
    bow = 5.6 * taper**1.4 + taper * (1.4 * np.exp(-(((np.abs(s) - 5) / 4) ** 2)) - 0.9 * np.exp(-((s / 2.5) ** 2)))
    upper = np.where(z >= 0, np.clip(1 - z / (bow + 1e-3), 0, 1), 0)
    lower = np.where(z < 0, np.clip(1 + z / (8.0 * taper**1.5 + 1e-3), 0, 1), 0)
    return upper.astype(np.float32), lower.astype(np.float32)


def hair_cover(sheet: Sheet, seed: int, edge_mm: float) -> Plane:
    """How much of the surface is cropped hair, growing in over `edge_mm`. (m, n), 0 to 1"""
    rng = np.random.default_rng((seed, 4))
    line = np.interp(np.abs(sheet.s), *np.array(HAIRLINE).T).astype(np.float32)
    uneven = 1.6 * fractal_noise(rng, (32, 64), sheet.shape, 3, 0.8)
    return smooth_step((sheet.z[:, None] - line[None, :] + uneven) / np.float32(edge_mm) + np.float32(0.5))


def _clear_place(rng: np.random.Generator, spread_mm: float) -> Point:
    """Somewhere on the skin, off the eyes."""
    while True:
        s, z = rng.normal(0, spread_mm), rng.uniform(-145, 65)
        if abs(abs(s) - 33) > 18 or abs(z - 8) > 14:
            return s, z


def _tone(rng: np.random.Generator) -> tuple[float, float]:
    return rng.uniform(0.35, 1.3), rng.uniform(0, 2 * np.pi)


def _forehead_lines(rng: np.random.Generator) -> list[Wrinkle]:
    s = np.linspace(-52, 52, 17)
    bow = 1.2 * np.cos(s / 17) - (s / 30) ** 2
    return [
        Wrinkle(_points(s, z + bow + np.cumsum(rng.normal(0, 0.25, 17))), 0.55, rng.uniform(0.15, 0.35))
        for z in (44, 52, 61)
    ]


def _eye_lines(rng: np.random.Generator) -> list[Wrinkle]:
    """Crow's feet, and the frown between the brows."""
    found = []
    for sign in (-1, 1):
        for slope in (0.5, 0.12, -0.25, -0.6):
            t = np.linspace(0, rng.uniform(10, 20), 7)
            z = 7 + slope * t + rng.normal(0, 0.2, 7)
            found.append(Wrinkle(_points(sign * (52 + t), z), 0.4, rng.uniform(0.12, 0.3)))
        for s in (5.5, 9.0):
            t = np.linspace(0, 1, 6)
            z = 21 + 14 * t + rng.normal(0, 0.2, 6)
            found.append(Wrinkle(_points(sign * (s + 1.5 * t), z), 0.5, rng.uniform(0.15, 0.35)))
    return found


def _neck_lines(rng: np.random.Generator) -> list[Wrinkle]:
    s = np.linspace(-95, 95, 19)
    sag = 3 * (s / 42) ** 2
    return [
        Wrinkle(_points(s, z + sag + np.cumsum(rng.normal(0, 0.6, 19))), 0.8, 0.28) for z in (-112, -121, -138)
    ]


def _points(s: FloatArray, z: FloatArray) -> Curve:
    return tuple(zip(s.tolist(), z.tolist(), strict=True))
