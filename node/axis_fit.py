"""Where a scanner's axis is, from one sweep of a round body of known diameter that stands off the middle of the table.

Unknown are the axis (node.axis: lateral, radial, lean, side) and the body: where its own axis passes the middle height
of what was seen (b_x, b_y), and how that leans (t_x, t_y). A sample's place p follows from Eq. (1) and (2) of
node.axis; it is outside the body by its distance from the body's axis, less the radius R. What is made least is the
error of the range, along the ray, since that is what is measured; distances from the surface would be least for a
lateral offset that noise has shifted. Gauss-Newton on all samples at once, those that do not fit weighted down by
Tukey's biweight.

What is observable from what: a body whose middle is B off the axis is seen, to second order, at

    r(u) = R - radial - B^2/4R + B cos(u - lateral/R) + (B^2/4R) cos 2u,    u = the column's angle from the body's

Its mean gives the radial offset, since R is known; its first harmonic gives B and where the body stands; and only how
the second harmonic is turned against the first, by lateral/R, gives the lateral offset. That falls with (B/R)^2: of a
body in the middle nothing can be told, so it is refused. The leans are the same at every height: the body must be high.

Nothing else in a sweep tells the axis. An overlap sees the same place by the same ray again, and an object that is
turned about the axis gives the same columns later: both fit every axis alike. One that is moved sideways would tell it,
if its shape were matched to itself; that is this, with a worse body.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from node.axis import LEAN_MAX_RAD, Axis, true_to_seen
from protocol.errors import FoveascanError
from protocol.grid import VOID, BoolArray, FloatArray, Grid

SAMPLES_MIN = 2000
SAMPLES_USED = 60_000  # more tell no more
TURN_SEEN_MIN = 0.5  # share of the turn
FITTING_MIN = 0.7  # share of the samples
OFF_CENTRE_MIN = 0.15  # of the body's radius, like all that follow
OFFSET_MAX = 0.5
SPREAD_MAX = 0.01
UNEVEN_MAX = 0.002
UNSURE_MAX = 0.001
GRAZING = 0.3  # cosine of the steepest incidence that counts
_ROUNDS = 60
_STEP_MAX = 0.2  # of the radius, in one round
_SETTLED = 1e-9
_TUKEY = 4.685
_SIGMA_OF_MAD = 1.4826
_PATCHES_ROUND, _PATCHES_UP = 24, 6
_PATCH_SAMPLES_MIN = 8
_UNKNOWNS = 8
_WIDE = 3.0  # errors that grow by so much are not those of samples
_LATERAL, _RADIAL, _LEAN, _SIDE = range(4)


class NotCalibrated(FoveascanError):
    """A sweep that does not tell where the axis is; says why, and what to do."""


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where the axis is, and how well that is known.

    lateral_error_mm and the like : standard errors, of the offsets at axis.height_mm.  noise_mm : spread of single
    samples about the body.  uneven_mm : by how much it is no cylinder, as far as that shows.  off_centre_mm : how far
    off the axis it stands.  samples : that were used.  fitting : the share of them that lies on the body.
    """

    axis: Axis
    lateral_error_mm: float
    radial_error_mm: float
    lean_error_rad: float
    side_error_rad: float
    noise_mm: float
    uneven_mm: float
    off_centre_mm: float
    samples: int
    fitting: float


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What the sensor saw: (n,) range and height above the middle [mm], cosine and sine of the column's angle."""

    range_mm: FloatArray
    height_mm: FloatArray
    cos: FloatArray
    sin: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """unknowns : as off_surface has them, normal : their (8, 8).  error_mm, on_body : (n,).  spread_mm : of errors."""

    unknowns: FloatArray
    normal: FloatArray
    error_mm: FloatArray
    on_body: BoolArray
    spread_mm: float


def estimate(grid: Grid, diameter_mm: float, corrected_by: Axis | None = None) -> Estimate:
    """The axis, from a sweep of a round body of that diameter. corrected_by : what the grid was corrected for already.

    Raises NotCalibrated where the sweep does not tell it well enough.
    """
    radius_mm = diameter_mm / 2
    samples, middle_mm = _samples_of(grid, corrected_by)
    fit = _fitted(samples, radius_mm)
    off_mm, fitting = math.hypot(*fit.unknowns[4:6]), float(fit.on_body.mean())
    _check_body(fit, fitting, off_mm, radius_mm)
    uneven_mm, widening = _patches(samples, fit)
    if uneven_mm > UNEVEN_MAX * radius_mm:
        raise NotCalibrated(
            f"what was seen is no round cylinder of {diameter_mm:g} mm: whole parts of it differ by {uneven_mm:.3f} mm;"
            " use a true one, and measure its diameter again"
        )
    covariance = _covariance(fit, widening)
    ends_mm = grid.spec.height_mm(np.array([0, grid.spec.height - 1])) - middle_mm
    _check_sure(covariance, ends_mm, radius_mm, widening)
    lateral, radial, lean, side = fit.unknowns[:4].tolist()
    axis = Axis(lateral, radial, lean, side, middle_mm)
    lateral, radial, lean, side = np.sqrt(np.diag(covariance))[:4].tolist()
    spread_mm, samples_used = fit.spread_mm, len(fit.error_mm)
    return Estimate(axis, lateral, radial, lean, side, spread_mm, uneven_mm, off_mm, samples_used, fitting)


def off_surface(
    samples: Samples, range_mm: FloatArray, unknowns: FloatArray, radius_mm: float
) -> tuple[FloatArray, FloatArray]:
    """How far places on the samples' rays are outside the body, (n,) [mm], and how that changes with each unknown.

    range_mm : (n,) where on the rays; it counts as the second unknown does.  Returns the slopes as (n, 8).
    unknowns : lateral, radial, lean, side, b_x, b_y, t_x, t_y, those of offsets at the height 0 of the samples.
    """
    lateral, radial, lean, side, b_x, b_y, t_x, t_y = unknowns
    height_mm, cos, sin = samples.height_mm, samples.cos, samples.sin
    cos_lean, sin_lean, cos_side, sin_side = math.cos(lean), math.sin(lean), math.cos(side), math.sin(side)
    x = range_mm + radial
    p_x = x * cos_lean + height_mm * sin_lean
    level = height_mm * cos_lean - x * sin_lean
    p_y = level * sin_side + lateral * cos_side
    p_z = level * cos_side - lateral * sin_side
    away_x = p_x * cos - p_y * sin - b_x - p_z * t_x
    away_y = p_x * sin + p_y * cos - b_y - p_z * t_y
    along = (away_x * t_x + away_y * t_y) / (1 + t_x * t_x + t_y * t_y)
    from_x, from_y = away_x - t_x * along, away_y - t_y * along
    distance = np.sqrt(np.maximum(from_x * from_x + from_y * from_y + along * along, 1e-12))
    g_x, g_y, g_z = from_x / distance, from_y / distance, along / distance  # out of the surface
    by_x, by_y, by_z = g_x * cos + g_y * sin, g_y * cos - g_x * sin, -(g_x * t_x + g_y * t_y)
    by_level = by_y * sin_side + by_z * cos_side
    slopes = np.stack([
        by_y * cos_side - by_z * sin_side,
        by_x * cos_lean - by_level * sin_lean,
        by_x * level - by_level * p_x,
        by_y * p_z - by_z * p_y,
        -g_x,
        -g_y,
        -p_z * g_x - g_z * from_x,
        -p_z * g_y - g_z * from_y,
    ], axis=1)  # fmt: skip
    return distance - radius_mm, slopes


def _samples_of(grid: Grid, corrected_by: Axis | None) -> tuple[Samples, float]:
    """What was measured of a grid, thinned, as the sensor saw it; and the middle of the heights. [mm]"""
    spec = grid.spec
    every = max(1, spec.height * spec.width // (4 * SAMPLES_USED))  # of the rows: indices take more than samples do
    measured = grid.range_steps[::every] != VOID
    repaired = grid.repairs[grid.repairs[:, 0] % every == 0]
    measured[repaired[:, 0] // every, repaired[:, 1]] = False
    rows, columns = np.nonzero(measured)
    rows *= every
    if rows.size < SAMPLES_MIN:
        raise NotCalibrated(f"only {rows.size} samples of range, {SAMPLES_MIN} are needed: is the body in view?")
    seen = measured.any(axis=0).mean()
    if seen < TURN_SEEN_MIN:
        raise NotCalibrated(f"the body was seen in {100 * seen:.0f} % of the turn only: move it nearer to the middle")
    chosen = np.linspace(0, rows.size - 1, min(rows.size, SAMPLES_USED)).astype(np.int64)
    rows, columns = rows[chosen], columns[chosen]
    range_mm, height_mm = grid.range_steps[rows, columns] * spec.step_mm, spec.height_mm(rows)
    angle_rad = spec.angle_rad(columns)
    if corrected_by is not None:
        found = np.array(true_to_seen(corrected_by, range_mm, height_mm))
        has = np.isfinite(found[0])
        range_mm, ahead_rad, height_mm = found[:, has]
        angle_rad = angle_rad[has] - ahead_rad
    middle_mm = float(np.median(height_mm))
    above_mm = height_mm - middle_mm
    return Samples(np.asarray(range_mm, np.float64), above_mm, np.cos(angle_rad), np.sin(angle_rad)), middle_mm


def _fitted(samples: Samples, radius_mm: float) -> _Fit:
    """The unknowns for which the samples' errors are least. Raises NotCalibrated where there are none."""
    unknowns = np.concatenate([np.zeros(4), _about(samples), np.zeros(2)])
    scale = np.array([radius_mm, radius_mm, 1, 1, radius_mm, radius_mm, 1, 1])
    for _ in range(_ROUNDS):
        error_mm, slopes = _range_errors(samples, unknowns, radius_mm)
        spread_mm = max(_SIGMA_OF_MAD * float(np.median(np.abs(error_mm))), 1e-6)
        if not math.isfinite(spread_mm):
            break
        weight = np.maximum(1 - (error_mm / (_TUKEY * spread_mm)) ** 2, 0) ** 2
        error_mm = np.where(weight > 0, error_mm, 0)
        weighted = slopes * weight[:, None]
        normal = weighted.T @ slopes
        step = np.linalg.lstsq(normal * np.outer(scale, scale), -scale * (weighted.T @ error_mm), rcond=1e-14)[0]
        unknowns = unknowns + scale * np.clip(step, -_STEP_MAX, _STEP_MAX)
        if np.abs(step).max() < _SETTLED:
            return _Fit(unknowns, normal, error_mm, weight > 0, spread_mm)
    raise NotCalibrated("what was seen fits no round body: take away what else stands in view, and sweep again")


def _range_errors(samples: Samples, unknowns: FloatArray, radius_mm: float) -> tuple[FloatArray, FloatArray]:
    """By how much ranges are too long, (n,) [mm], and how that changes with the unknowns where the rays meet the body.

    inf where a ray only grazes the body, or misses it.
    """
    off_mm, slopes = off_surface(samples, samples.range_mm, unknowns, radius_mm)
    met_mm = samples.range_mm - off_mm / np.maximum(slopes[:, _RADIAL], GRAZING)  # but for a square of the error
    off_mm, slopes = off_surface(samples, met_mm, unknowns, radius_mm)
    grazes, steep = slopes[:, _RADIAL] < GRAZING, np.maximum(slopes[:, _RADIAL], GRAZING)
    slopes[grazes] = 0
    return np.where(grazes, np.inf, samples.range_mm - met_mm + off_mm / steep), slopes / steep[:, None]


def _about(samples: Samples) -> FloatArray:
    """Where the body stands, about: the first harmonic of the range, by least absolute differences. (2,) [mm]"""
    terms = np.stack([samples.cos, samples.sin, np.ones_like(samples.cos)], axis=1)
    weight = np.ones_like(samples.cos)
    for _ in range(10):
        weighted = terms * weight[:, None]
        harmonic = np.linalg.lstsq(weighted.T @ terms, weighted.T @ samples.range_mm, rcond=None)[0]
        off_mm = np.abs(samples.range_mm - terms @ harmonic)
        weight = 1 / np.maximum(off_mm, 0.1 * np.median(off_mm) + 1e-9)
    return np.asarray(harmonic[:2], np.float64)


def _check_body(fit: _Fit, fitting: float, off_mm: float, radius_mm: float) -> None:
    """Raises NotCalibrated for a body that is not as it was said, or stands where it tells little."""
    body = f"a cylinder of {2 * radius_mm:g} mm"
    if fitting < FITTING_MIN:
        raise NotCalibrated(
            f"only {100 * fitting:.0f} % of what was seen lies on {body}: take away what else stands in view, or"
            " measure its diameter again"
        )
    if fit.spread_mm > SPREAD_MAX * radius_mm:
        raise NotCalibrated(
            f"samples lie {fit.spread_mm:.3f} mm off {body}, at most {SPREAD_MAX * radius_mm:.3f} are taken: is it"
            " round, matt, and its diameter right?"
        )
    lateral, radial, lean, side = fit.unknowns[:4]
    if max(abs(lateral), abs(radial)) > OFFSET_MAX * radius_mm:
        raise NotCalibrated(
            f"the axis would be {lateral:.1f} mm and {radial:.1f} mm off, too far to be believed: is the diameter"
            f" {2 * radius_mm:g} mm?"
        )
    if max(abs(lean), abs(side)) > LEAN_MAX_RAD:
        raise NotCalibrated("the axis would lean by over 5 degrees: is the body round, and does it stand upright?")
    if off_mm < OFF_CENTRE_MIN * radius_mm:
        raise NotCalibrated(
            f"the body stands {off_mm:.1f} mm off the axis, too near to tell where that is: move it until it stands"
            f" about {radius_mm / 2:.0f} mm off"
        )


def _patches(samples: Samples, fit: _Fit) -> tuple[float, float]:
    """By how much whole patches of the body lie off it [mm], and how many times as much as by chance, at least 1.

    Errors of neighbouring samples may hang together: what that adds to the scatter of patches, it adds to the errors.
    """
    turn = (np.arctan2(samples.sin, samples.cos) / (2 * np.pi)) % 1
    low, high = samples.height_mm.min(), samples.height_mm.max()
    up = (samples.height_mm - low) / max(high - low, 1e-9)
    index = np.minimum((turn * _PATCHES_ROUND).astype(np.int64), _PATCHES_ROUND - 1) * _PATCHES_UP
    index += np.minimum((up * _PATCHES_UP).astype(np.int64), _PATCHES_UP - 1)
    count = np.bincount(index[fit.on_body])
    total = np.bincount(index[fit.on_body], fit.error_mm[fit.on_body])
    has = count >= _PATCH_SAMPLES_MIN
    square, chance = (total[has] / count[has]) ** 2, fit.spread_mm**2 / count[has]
    uneven_mm = math.sqrt(max(0.0, float(np.mean(square - chance))))
    return uneven_mm, math.sqrt(max(1.0, float((square / chance).sum()) / max(1, int(has.sum()) - _UNKNOWNS)))


def _covariance(fit: _Fit, widening: float) -> FloatArray:
    """(8, 8) of the unknowns. Raises NotCalibrated where they cannot be told apart."""
    try:
        return np.asarray(np.linalg.inv(fit.normal) * (fit.spread_mm * widening) ** 2, np.float64)
    except np.linalg.LinAlgError:
        raise NotCalibrated("the axis cannot be told from this body: use a higher one, further off centre") from None


def _check_sure(covariance: FloatArray, heights_mm: FloatArray, radius_mm: float, widening: float) -> None:
    """Raises NotCalibrated where the offsets are not known well enough from the lowest row to the highest."""
    squares = []
    for offset, lean in ((_LATERAL, _SIDE), (_RADIAL, _LEAN)):
        both = covariance[np.ix_([offset, lean], [offset, lean])]
        squares += [np.array([1.0, height_mm]) @ both @ np.array([1.0, height_mm]) for height_mm in heights_mm]
    error_mm = math.sqrt(max(0.0, *(float(square) for square in squares)))
    if not error_mm <= UNSURE_MAX * radius_mm:
        higher = "use a higher body further off centre, or average several passes"
        truer = "it is not quite a cylinder of that diameter: use a true one, and measure its diameter again"
        raise NotCalibrated(
            f"the axis is known to {error_mm:.3f} mm only, at most {UNSURE_MAX * radius_mm:.3f} are taken:"
            f" {truer if widening > _WIDE else higher}"
        )
