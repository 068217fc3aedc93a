"""The smooth shape of a head: sections of a skull and of a neck, joined under the jaw.

Every horizontal section is a superellipse, |x/a|^n + |y/b|^n = 1, whose front and back half-axes, half-width and
exponent follow the tables below along z. Millimetres; z = 0 at the bridge of the nose, the crown at 122.
"""

from __future__ import annotations

import numpy as np

from protocol.grid import FloatArray
from simulators.noise import Plane
from simulators.sheet import ROUND_MM, Sheet, smooth_step

CROWN_MM = 122.0
DOME_MM = 38.0
DOME_POWER = 2.35
KNOT_MM = 6.0

Profile = tuple[tuple[float, float], ...]

FRONT: Profile = (
    (-115, 84), (-96, 88), (-84, 93), (-75, 95), (-62, 91), (-48, 94), (-32, 92), (-15, 90),
    (2, 88), (14, 89), (26, 95), (34, 96.5), (52, 96), (70, 94),
)  # fmt: skip
BACK: Profile = ((-70, 62), (-46, 74), (-25, 87), (0, 95), (25, 98), (50, 97))
WIDTH: Profile = ((-110, 44), (-90, 48), (-75, 53), (-58, 59.5), (-35, 66), (-12, 70.5), (10, 73), (32, 74.5), (60, 76))
POWER_FRONT: Profile = ((-100, 1.9), (-75, 1.92), (-45, 2.02), (-10, 2.15), (30, 2.3), (70, 2.15))
NECK_FRONT: Profile = ((-170, 64), (-150, 55), (-128, 51), (-112, 50), (-92, 44), (-60, 30), (0, 8), (20, 1))
NECK_BACK: Profile = ((-170, 88), (-150, 76), (-125, 68), (-100, 65), (-70, 66), (-40, 58), (0, 20), (20, 1))
NECK_WIDTH: Profile = ((-170, 80), (-152, 66), (-130, 58), (-100, 55), (-70, 46), (-40, 32), (0, 12), (20, 1))


def skull_mm(sheet: Sheet) -> Plane:
    """Range of the head without its features. (m, n) [mm]; NaN above the crown"""
    theta = sheet.s.astype(np.float64) / ROUND_MM
    z = sheet.z.astype(np.float64)
    head = _section(theta, curve(FRONT, z), curve(BACK, z), curve(WIDTH, z), curve(POWER_FRONT, z))
    head *= (_dome(z)[:, None] * _jaw(theta, z)).astype(np.float32)
    neck = _section(theta, curve(NECK_FRONT, z), curve(NECK_BACK, z), curve(NECK_WIDTH, z), np.full(len(z), 2.0))
    return smooth_max(head, neck, 18.0)


def curve(profile: Profile, z: FloatArray) -> FloatArray:
    """A table smoothed by a uniform cubic B-spline through its sampled values. (m,) -> (m,)"""
    # Beyond its ends a table goes on unchanged: the spline must reach that far to be flat there.
    low, high = profile[0][0] - 4 * KNOT_MM, profile[-1][0] + 5 * KNOT_MM
    knots = np.arange(low, high, KNOT_MM)
    values = np.interp(knots, *np.array(profile).T)
    position = np.clip((z - low) / KNOT_MM, 1, len(knots) - 3 - 1e-9)
    i = position.astype(np.int64)
    t = position - i
    weights = (1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3
    return np.asarray(sum(w * values[i + k - 1] for k, w in enumerate(weights)) / 6)


def smooth_max(one: Plane, other: Plane, blend_mm: float) -> Plane:
    """The larger of two ranges, rounded where they meet."""
    share = np.clip(0.5 + 0.5 * (one - other) / np.float32(blend_mm), 0, 1)
    return np.asarray(other + (one - other) * share + blend_mm * share * (1 - share), np.float32)


def _section(theta: FloatArray, front: FloatArray, back: FloatArray, width: FloatArray, power: FloatArray) -> Plane:
    """Range of stacked superellipses at every angle. (m, n) [mm]"""
    forward = np.cos(theta)[None, :]
    depth = np.where(forward > 0, front[:, None], back[:, None]).astype(np.float32)
    # The exponent is the face's in front and a round skull's behind, joined over the ears where width alone counts.
    n = (2.1 + (power[:, None] - 2.1) * smooth_step((forward + 0.35) / 0.9)).astype(np.float32)
    along = (np.abs(forward).astype(np.float32) + np.float32(1e-6)) / depth
    across = (np.abs(np.sin(theta))[None, :] + 1e-6).astype(np.float32) / width[:, None].astype(np.float32)
    return np.asarray((along**n + across**n) ** (-1 / n), np.float32)


def _dome(z: FloatArray) -> FloatArray:
    """How far a section has closed towards the crown: 1 below the dome, NaN above the crown. (m,)"""
    rise = np.clip((z - DOME_MM) / (CROWN_MM - DOME_MM), 0, None)
    return np.where(rise < 1, np.clip(1 - rise**DOME_POWER, 0, 1) ** (1 / DOME_POWER), np.nan)


def _jaw(theta: FloatArray, z: FloatArray) -> FloatArray:
    """Closes the head below the jaw line, which climbs from the chin to the nape. (m, n)"""
    back = 0.5 - 0.5 * np.cos(theta)
    line = -93.5 + 62 * back**0.9
    depth = 10 + 36 * back
    fall = np.clip((line[None, :] + depth[None, :] - z[:, None]) / (1.7 * depth[None, :]), 0, 1)
    return np.sqrt(np.clip(1 - fall**3, 0, 1)) * 0.75 + 0.25
