"""Ears: shells that stand off the head, hard-edged behind, grown into it in front."""

from __future__ import annotations

import numpy as np

from simulators.noise import Plane
from simulators.sheet import Point, Sheet, smooth_step

EAR: Point = (150.0, -2.0)
TILT_RAD = 0.2
HALF_HEIGHT_MM = 32.0
HALF_WIDTH_MM = 21.0


def add_ears(plane: Plane, sheet: Sheet) -> None:
    """Both ears. Changes plane in place."""
    for sign in (-1, 1):
        window = sheet.window((sign * EAR[0] - 36, EAR[1] - 44), (sign * EAR[0] + 36, EAR[1] + 44))
        s, z = sheet.within(window)
        back, up = ear_frame(s, z, sign)
        plane[window] += shell_mm(back, up)


def ear_frame(s: Plane, z: Plane, sign: int) -> tuple[Plane, Plane]:
    """Coordinates in an ear: towards the back and up, along its tilted axis. [mm]"""
    back, up = sign * s - EAR[0], z - EAR[1]
    cosine, sine = np.float32(np.cos(TILT_RAD)), np.float32(np.sin(TILT_RAD))
    return back * cosine - up * sine, up * cosine + back * sine


def ear_radius(back: Plane, up: Plane) -> Plane:
    """1 on the outline, which narrows towards the lobe; 0 in the middle."""
    half = HALF_WIDTH_MM * (1 + 0.22 * np.clip(up / HALF_HEIGHT_MM, -1.4, 1))
    return np.asarray(np.hypot(back / half, up / HALF_HEIGHT_MM), np.float32)


def shell_mm(back: Plane, up: Plane) -> Plane:
    """How far the ear stands off the head. [mm], 0 outside the outline"""
    radius = ear_radius(back, up)
    rear = smooth_step((back / HALF_WIDTH_MM + 1.0) / 1.7)
    rim = np.maximum(rear, smooth_step((up - 14) / 14))
    shell = 2 + 15 * rear + 4.0 * rim * _ring(radius, 0.86, 0.09) - 3.2 * rim * _ring(radius, 0.70, 0.07)
    shell += 3.0 * rear * _ring(radius, 0.50, 0.10)
    shell -= 11.0 * _pit(back, up, (-3, -5), (7.5, 9)) + 3 * _pit(back, up, (0, 16), (6, 4))
    shell += 4.5 * _pit(back, up, (-14, -5), (3.2, 4.5)) + 1.5 * _pit(back, up, (-5, -19), (5, 3))
    grown = smooth_step((back / HALF_WIDTH_MM + 1.05) / 0.35) * smooth_step((1.0 - radius) / 0.06)
    return np.asarray(np.maximum(shell, 0) * grown, np.float32)


def _ring(radius: Plane, at: float, sigma: float) -> Plane:
    return np.asarray(np.exp(-0.5 * ((radius - at) / sigma) ** 2), np.float32)


def _pit(back: Plane, up: Plane, centre: Point, sigma: Point) -> Plane:
    square = ((back - centre[0]) / sigma[0]) ** 2 + ((up - centre[1]) / sigma[1]) ** 2
    return np.asarray(np.exp(-0.5 * square), np.float32)
