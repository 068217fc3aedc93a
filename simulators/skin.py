"""Skin as two pigments, melanin and blood, under an even light; hair is melanin in strands.

A texel's colour is `PAPER * exp(light - MELANIN * melanin - BLOOD * blood)` per channel: pigments add and colours
multiply, so freckles darken and lips redden as they do on skin.
"""

from __future__ import annotations

import cv2
import numpy as np

from protocol.grid import ImageArray
from simulators.marks import MOUTH, Marks, hair_cover, lip_cover
from simulators.noise import Plane, fractal_noise, lattice_noise
from simulators.sheet import Point, Sheet, add_bump, add_curve, add_spot, smooth_step

PAPER = 246.0, 232.0, 220.0
MELANIN = 0.58, 0.82, 1.06
BLOOD = 0.10, 0.52, 0.42
FINE_TEXELS = 4096
FRECKLES = 1400
RED_SPOTS = 60
BROW_HAIRS = 520
LASHES = 70
# centre (s, z), sigma [mm], how much more blood: cheeks, nose, ears, chin, lids.
FLUSHES: tuple[tuple[Point, Point, float], ...] = (
    ((45, -18), (16, 12), 0.22),
    ((0, -22), (9, 8), 0.20),
    ((13, -25), (5, 5), 0.12),
    ((150, -4), (20, 28), 0.22),
    ((0, -78), (14, 8), 0.08),
    ((33, 8), (13, 7), 0.10),
    ((33, -5), (11, 4), 0.06),
)
# centre (s, z), sigma [mm]: where a shaved beard shows.
BEARD: tuple[tuple[Point, Point], ...] = (
    ((0, -84), (30, 11)),
    ((52, -72), (26, 15)),
    ((88, -48), (15, 24)),
    ((11, -37), (11, 4.5)),
)


def paint(sheet: Sheet, smooth_mm: Plane, found: Marks, seed: int) -> ImageArray:
    """Colour of every texel. smooth_mm : (H, W) range without relief, for its shadows. Returns (Ht, Wt, 3) uint8 RGB"""
    times = FINE_TEXELS // sheet.shape[1]
    if times > 1:  # hairs are finer than these texels: draw them where they can be seen, and average
        fine = paint(Sheet(_denser(sheet.s, times), _denser(sheet.z, times)), smooth_mm, found, seed)
        return np.asarray(cv2.resize(fine, sheet.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    melanin, blood = _pigments(sheet, found, seed)
    return _developed(melanin, blood, _shadow(smooth_mm, sheet.shape))


def _denser(axis: Plane, times: int) -> Plane:
    """The same axis with `times` as many samples. (n,) -> (n * times,)"""
    offsets = (np.arange(times) + 0.5) / times - 0.5
    return np.asarray((axis[:, None] + (axis[1] - axis[0]) * offsets).ravel(), np.float32)


def _pigments(sheet: Sheet, found: Marks, seed: int) -> tuple[Plane, Plane]:
    """Melanin and blood. Two (m, n)"""
    rng = np.random.default_rng((seed, 5))
    melanin = np.float32(0.34) + 0.05 * fractal_noise(rng, (10, 16), sheet.shape, 4, 0.6)
    blood = np.float32(0.22) + 0.06 * fractal_noise(rng, (10, 24), sheet.shape, 6, 0.7)
    melanin += 0.022 * lattice_noise(rng, (700, 1312), sheet.shape)
    for centre, sigma, amount in FLUSHES:
        _add_on_both_sides(blood, sheet, centre, sigma, amount)
    _add_lips(melanin, blood, sheet, rng)
    _add_marks(melanin, blood, sheet, found)
    _add_spots(melanin, blood, sheet, rng)
    _add_stubble(melanin, sheet, rng)
    _add_hair(melanin, sheet, hair_cover(sheet, seed, 9.0), rng)
    return melanin, blood


def _add_on_both_sides(plane: Plane, sheet: Sheet, centre: Point, sigma: Point, amount: float) -> None:
    for s in {centre[0], -centre[0]}:
        add_bump(plane, sheet, (s, centre[1]), sigma, amount)


def _add_lips(melanin: Plane, blood: Plane, sheet: Sheet, rng: np.random.Generator) -> None:
    upper, lower = lip_cover(sheet)
    lips = smooth_step((upper + lower) / 0.4)
    blood += lips * (np.float32(0.52) + 0.08 * lattice_noise(rng, (48, 608), sheet.shape))
    melanin += np.float32(0.1) * lips
    add_curve(melanin, sheet, MOUTH, 0.6, 0.9)


def _add_marks(melanin: Plane, blood: Plane, sheet: Sheet, found: Marks) -> None:
    for mole in found.moles:
        add_spot(melanin, sheet, mole.centre, mole.radius_mm, mole.melanin, mole.phase)
    for wrinkle in found.wrinkles:
        add_curve(melanin, sheet, wrinkle.points, wrinkle.sigma_mm, 0.22 * wrinkle.depth_mm)
        add_curve(blood, sheet, wrinkle.points, 1.6 * wrinkle.sigma_mm, 0.12 * wrinkle.depth_mm)


def _add_spots(melanin: Plane, blood: Plane, sheet: Sheet, rng: np.random.Generator) -> None:
    """Freckles, thickest over the cheeks and the nose, and small red spots."""
    s, z = rng.normal(0, 48, FRECKLES), rng.normal(2, 34, FRECKLES)
    radius, strength = 0.2 + rng.gamma(2.0, 0.12, FRECKLES), rng.gamma(2.0, 0.06, FRECKLES)
    for freckle in zip(s.tolist(), z.tolist(), radius.tolist(), strength.tolist(), strict=True):
        add_spot(melanin, sheet, freckle[:2], freckle[2], freckle[3], 9 * freckle[0])
    for _ in range(RED_SPOTS):
        centre = rng.uniform(-110, 110), rng.uniform(-150, 60)
        add_spot(blood, sheet, centre, rng.uniform(0.5, 1.6), rng.uniform(0.15, 0.6), centre[0])


def _add_stubble(melanin: Plane, sheet: Sheet, rng: np.random.Generator) -> None:
    cover = np.zeros(sheet.shape, np.float32)
    for centre, sigma in BEARD:
        _add_on_both_sides(cover, sheet, centre, sigma, 0.8)
    dots = np.clip(lattice_noise(rng, (400, 1200), sheet.shape) - np.float32(0.35), 0, 3)
    melanin += np.float32(0.26) * np.minimum(cover, 1) * dots


def _add_hair(melanin: Plane, sheet: Sheet, hair: Plane, rng: np.random.Generator) -> None:
    """Cropped hair on the scalp, brows and lashes in strands."""
    fringe = lattice_noise(rng, (160, 1400), sheet.shape)
    hair = smooth_step(hair * (2 - hair) + np.float32(0.9) * fringe * hair * (1 - hair))
    strands = 0.5 * lattice_noise(rng, (110, 1400), sheet.shape) + 0.35 * lattice_noise(rng, (60, 320), sheet.shape)
    melanin += hair * (np.float32(1.75) + np.float32(0.30) * strands - np.float32(0.5) * melanin)
    melanin += _strokes(sheet, rng)


def _strokes(sheet: Sheet, rng: np.random.Generator) -> Plane:
    """Brow hairs and lashes, drawn one by one. (m, n), about 0 to 1"""
    canvas = np.zeros(sheet.shape, np.uint8)
    scale = np.array([1 / (sheet.s[1] - sheet.s[0]), 1 / (sheet.z[1] - sheet.z[0])])
    lines = (np.concatenate([_brow_hairs(rng), _lashes(rng)]) - [sheet.s[0], sheet.z[0]]) * scale
    thick = max(1, round(0.16 * scale[0]))
    for line in np.rint(lines * 16).astype(np.int32):
        cv2.polylines(canvas, [line], False, int(rng.integers(90, 230)), thick, cv2.LINE_AA, 4)
    return cv2.GaussianBlur(canvas, (3, 3), 0.7).astype(np.float32) / np.float32(200)


def _brow_hairs(rng: np.random.Generator) -> Plane:
    """Hairs that lean outwards along both brows. (2 BROW_HAIRS, 3, 2) points (s, z) [mm]"""
    along = rng.uniform(0, 1, (2 * BROW_HAIRS, 1))
    side = np.repeat([-1.0, 1.0], BROW_HAIRS)[:, None]
    width = rng.normal(0, 1.7, along.shape) * (1.15 - 0.75 * along)
    s = 12 + 38 * along
    z = 21.5 + 7.5 * np.sin(np.pi * (0.12 + 0.78 * along)) - 4 * along + width
    t = np.array([[0, 0.5, 1.0]])
    lean = np.pi / 2 - 1.25 * along + rng.normal(0, 0.2, s.shape) - 0.5 * t
    reach = rng.uniform(3.0, 6.5, s.shape) * t
    return np.stack([side * (s + reach * np.cos(lean)), z + 0.75 * reach * np.sin(lean)], -1).astype(np.float32)


def _lashes(rng: np.random.Generator) -> Plane:
    """Upper lashes where the lids meet. (2 LASHES, 3, 2) points (s, z) [mm]"""
    across = rng.uniform(-13, 13, (2 * LASHES, 1))
    side = np.repeat([-1.0, 1.0], LASHES)[:, None]
    root = 1.8 + 3.4 * (across / 13) ** 2
    t = np.array([[0, 0.5, 1.0]])
    length = rng.uniform(1.2, 3.2, across.shape)
    s = 33 + across + t * length * (across / 16)
    return np.stack([side * s, root - length * (t - 0.35 * t * t)], -1).astype(np.float32)


def _shadow(smooth_mm: Plane, shape: tuple[int, int]) -> Plane:
    """Light lost in hollows, as a logarithm; black above the crown. (Ht, Wt)"""
    filled = np.nan_to_num(smooth_mm, nan=0.0)
    edge = smooth_mm.shape[1] // 8
    wrapped = np.pad(filled, ((0, 0), (edge, edge)), mode="wrap")
    around = cv2.GaussianBlur(wrapped, (0, 0), 2.2 * smooth_mm.shape[1] / 360)[:, edge:-edge]
    light = np.clip(0.045 * (filled - around), -0.55, 0.10).astype(np.float32)
    light[np.isnan(smooth_mm)] = -30
    return np.asarray(cv2.resize(light, shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)


def _developed(melanin: Plane, blood: Plane, light: Plane) -> ImageArray:
    """Pigments and light to colour. (m, n) each -> (m, n, 3) uint8 RGB"""
    image = np.empty((*melanin.shape, 3), np.uint8)
    for channel, (paper, dark, red) in enumerate(zip(PAPER, MELANIN, BLOOD, strict=True)):
        density = np.float32(dark) * melanin + np.float32(red) * blood
        image[..., channel] = np.minimum(np.float32(paper) * np.exp(light - density) + np.float32(0.5), 255)
    return image
