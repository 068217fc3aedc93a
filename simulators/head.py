"""A human head with known truth: skull and neck, features, skin relief, and the places a scanner does not see.

All landmarks are (s, z) in mm on the unrolled sheet; the left and the right side are drawn from the same table.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from protocol.grid import Grid, mm_to_steps
from simulators.ear import add_ears
from simulators.marks import MOUTH, Marks, hair_cover, lip_cover, marks
from simulators.noise import Plane, fractal_noise, lattice_noise
from simulators.shapes import Shape, spec_for
from simulators.sheet import Point, Sheet, add_bump, add_curve, add_spot, range_sheet, smooth_step, texture_sheet
from simulators.skin import paint
from simulators.skull import Profile, curve, skull_mm

Z_MIN_MM, Z_MAX_MM = -160.0, 125.0
EYE: Point = (33.0, 8.0)
SURFACE_CELLS = 80, 152
UNSEEN = 0.62

# centre (s, z), sigma (s, z), height: soft masses, drawn on both sides unless they lie in the middle. [mm]
MASSES: tuple[tuple[Point, Point, float], ...] = (
    ((30, 27), (14, 6), 3.0),  # brow
    ((0, 25), (8, 8), 1.5),  # glabella
    ((32, 9), (14, 9.5), -8.5),  # eye socket
    ((13, 10), (6, 9), -5.0),  # inner corner of the eye
    ((52, -10), (15, 12), 4.0),  # cheekbone
    ((40, -32), (16, 16), 2.0),  # cheek
    ((62, -48), (18, 16), -3.0),  # hollow of the cheek
    ((88, 36), (20, 18), -2.5),  # temple
    ((28, 62), (16, 14), 1.8),  # forehead
    ((0, -77), (12, 8), 3.5),  # chin
    ((11, -80), (8, 7), 1.5),
    ((0, -62), (17, 4), -2.5),  # under the lower lip
    ((0, -42), (22, 12), 4.5),  # the muzzle that carries the lips
    ((0, -124), (7, 8), 4.0),  # larynx
    ((105, -55), (14, 14), 2.5),  # angle of the jaw
    ((62, -128), (13, 18), 3.5),  # neck muscle
    ((85, -105), (13, 18), 3.5),
    ((38, -145), (10, 10), -3.0),
)
# Height and half breadth of the ridge of the nose along z. [mm]
RIDGE: Profile = (
    (-39, 0), (-34, 3.5), (-30, 10.5), (-26, 17), (-21, 19.5), (-16, 18), (-8, 14), (0, 10), (8, 6.5), (16, 4), (26, 0),
)  # fmt: skip
BREADTH: Profile = ((-34, 7.5), (-26, 8.2), (-20, 8.0), (-10, 7.2), (0, 6.5), (10, 6.2), (24, 7))
LOBES: tuple[tuple[Point, Point, float], ...] = (
    ((0, -22), (5.5, 5), 2.5),  # tip
    ((12.5, -25), (4.0, 4.6), 7.0),  # wing
    ((6, -32.5), (2.9, 2.4), -5.0),  # nostril
    ((3, -40), (1.4, 4), 0.7),  # rims of the philtrum
    ((0, -40), (1.5, 4), -0.8),
)
# points (s, z), sigma, height: folds. [mm]
FOLDS: tuple[tuple[tuple[Point, ...], float, float], ...] = (
    (((17, -21), (22, -29), (27, -39), (31, -50)), 1.7, -1.3),  # from the nose to the mouth
    (((17.5, -19), (18, -24), (15.5, -29), (12, -31)), 0.9, -1.6),  # round the wing of the nose
    (((19, 4.2), (25, 2.2), (33, 1.6), (41, 3.6), (46, 6)), 0.55, -0.9),  # where the lids meet
    (((20, 8), (26, 13.5), (34, 15), (42, 12.5), (48, 7)), 1.0, -0.6),  # crease of the upper lid
    (((21, -1), (28, -5.5), (36, -6.5), (44, -4)), 2.4, -0.5),  # under the eye
    (((29, -51), (33, -57), (34, -64)), 1.2, -0.7),
)
# centre (s, z), sigma [mm], share of lost answers: behind the ears, under the chin, in the nostrils.
DOUBTS: tuple[tuple[Point, Point, float], ...] = (
    ((178, 2), (9, 28), 0.68),
    ((0, -98), (32, 6.5), 0.66),
    ((50, -90), (20, 6.5), 0.52),
    ((7, -32), (3, 1.6), 0.4),
)


def head(shape: Shape, seed: int) -> Grid:
    """A head at any size: the same person for the same seed. shape : (W, H, Wt, Ht)"""
    spec = spec_for(shape, Z_MIN_MM, Z_MAX_MM)
    sheet = range_sheet(spec)
    found = marks(seed)
    smooth_mm = skull_mm(sheet)
    add_features(smooth_mm, sheet)
    add_ears(smooth_mm, sheet)
    range_mm = smooth_mm + relief_mm(sheet, found, seed)
    unseen = unseen_cells(range_mm, sheet, seed)
    range_mm[unseen] = np.nan
    return Grid(spec, mm_to_steps(range_mm, spec.step_mm), paint(texture_sheet(spec), smooth_mm, found, seed))


def add_features(plane: Plane, sheet: Sheet) -> None:
    """Brow to larynx, both sides. Changes plane in place."""
    for centre, sigma, amount in MASSES:
        for side in _sides(centre):
            add_bump(plane, sheet, side, sigma, amount)
    _add_eyes(plane, sheet)
    _add_nose(plane, sheet)
    _add_lips(plane, sheet)
    for points, sigma_mm, amount in FOLDS:
        for sign in (-1, 1):
            add_curve(plane, sheet, [(sign * s, z) for s, z in points], sigma_mm, amount)


def relief_mm(sheet: Sheet, found: Marks, seed: int) -> Plane:
    """Wrinkles, pores, raised moles, cropped hair and the skin's own unevenness. (m, n) [mm]"""
    rng = np.random.default_rng((seed, 1))
    hair = hair_cover(sheet, seed, 14.0)
    relief = 0.9 * fractal_noise(rng, (8, 16), sheet.shape, 3, 0.5)
    skin = 0.035 * fractal_noise(rng, SURFACE_CELLS, sheet.shape, 3, 0.7)
    pits = lattice_noise(rng, (320, 608), sheet.shape)
    skin -= np.float32(0.07) * np.clip(pits - np.float32(0.9), 0, 2)
    strands = 0.10 * lattice_noise(rng, (96, 640), sheet.shape) + 0.22 * fractal_noise(rng, (32, 80), sheet.shape, 2)
    relief += skin + hair * (np.float32(2.6) + strands - skin)
    for wrinkle in found.wrinkles:
        add_curve(relief, sheet, wrinkle.points, wrinkle.sigma_mm, -wrinkle.depth_mm)
    for mole in found.moles:
        add_spot(relief, sheet, mole.centre, mole.radius_mm, mole.height_mm, mole.phase)
    return relief


def unseen_cells(range_mm: Plane, sheet: Sheet, seed: int) -> NDArray[np.bool_]:
    """Where the scanner gets no answer: grazing light, deep folds, dark hair, above the crown. (m, n) bool"""
    rng = np.random.default_rng((seed, 2))
    filled = np.nan_to_num(range_mm)
    slope = np.hypot(*np.gradient(filled, -sheet.z, sheet.s))
    doubt = 0.42 * smooth_step((slope - 1.5) / 4) + 0.20 * hair_cover(sheet, seed, 14.0)
    for centre, sigma, amount in DOUBTS:
        for side in _sides(centre):
            add_bump(doubt, sheet, side, sigma, amount)
    ragged = 0.17 * fractal_noise(rng, (24, 48), sheet.shape, 5, 0.75)
    return _without_specks(np.asarray((doubt + ragged > UNSEEN) | np.isnan(range_mm)))


def _without_specks(unseen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Only what 2 x 2 cells fit into: a node would take less for a flaw of the camera, and repair it. (m, n) bool"""
    padded = cv2.copyMakeBorder(unseen.astype(np.uint8), 0, 0, 1, 1, cv2.BORDER_WRAP)
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    return np.asarray(opened[:, 1:-1], np.bool_)


def _sides(centre: Point) -> tuple[Point, ...]:
    return (centre,) if centre[0] == 0 else (centre, (-centre[0], centre[1]))


def _add_eyes(plane: Plane, sheet: Sheet) -> None:
    """Closed lids over the ball of the eye."""
    for sign in (-1, 1):
        window = sheet.window((sign * EYE[0] - 19, EYE[1] - 14), (sign * EYE[0] + 19, EYE[1] + 14))
        s, z = sheet.within(window)
        square = ((s - sign * EYE[0]) / 18) ** 2 + ((z - EYE[1]) / 13) ** 2
        plane[window] += np.float32(6.5) * smooth_step(1 - square)


def _add_nose(plane: Plane, sheet: Sheet) -> None:
    window = sheet.window((-32, -54), (32, 42))
    s, z = sheet.within(window)
    height, half = (curve(table, z.astype(np.float64)).astype(np.float32) for table in (RIDGE, BREADTH))
    plane[window] += np.maximum(height, 0) * np.exp(-((np.abs(s) / (1.2 * half)) ** np.float32(2.1)))
    for centre, sigma, amount in LOBES:
        for side in _sides(centre):
            add_bump(plane, sheet, side, sigma, amount)


def _add_lips(plane: Plane, sheet: Sheet) -> None:
    upper, lower = lip_cover(sheet)
    plane += 5.6 * upper * (1 - upper) + 7.6 * lower * (1 - lower)
    add_curve(plane, sheet, MOUTH, 0.9, -1.2)
