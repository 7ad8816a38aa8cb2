"""The light of balls under the lit wall, and its derivatives by the parameters of a fit.

A printed pattern is a monotone curve of light, blurred by scatter: a ray is spread evenly over the angles by
which the sheet's flakes deflect it, and rays above the rim or below the rest plane are dark. Otherwise the
formula is the same as in `mirrorskin.kernels.rotation.response`. The position on the wall is a share u: 0 at
the rim and 1 at the rest plane, linear in the elevation seen from the centre of the sheet.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.calibration.ball import rotations
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.response import Ray, follow, lamp_light, shade_terms, sight_of, sight_slopes

_PIECES = 8  # pieces of the curve, which represent a gamma of 2.2 within 2e-4 of full light
_CUBIC = 3  # degree of the curve
CURVE_COEFFICIENTS = _PIECES + _CUBIC
"""Number of coefficients of the curve, a cubic spline with evenly spaced knots on 0 to 1, and 0 outside."""

_KNOTS = np.pad(np.linspace(0, 1, _PIECES + 1), _CUBIC, "edge")
_WIDTHS = (_KNOTS[_CUBIC + 1 :] - _KNOTS[: -_CUBIC - 1]) / (_CUBIC + 1)  # integrals of the basis functions


def curve_values(coefficients: ArrayLike, fraction: ArrayLike) -> Doubles:
    """Return the curve at shares u, (n,); 0 outside 0 to 1."""
    from scipy.interpolate import BSpline

    fraction = np.asarray(fraction, np.float64)
    spline = BSpline(_KNOTS, np.asarray(coefficients, np.float64), _CUBIC)
    return np.where((fraction >= 0) & (fraction <= 1), spline(np.clip(fraction, 0, 1)), 0.0)


def curve_means(low: ArrayLike, high: ArrayLike) -> Doubles:
    """Return the matrix from coefficients to the curve's means over intervals, (n, CURVE_COEFFICIENTS).

    With the antiderivative G it is ``(G(high) - G(low)) / (high - low)``: the light of a mirror that spreads
    each ray evenly over the interval.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    grown = _antiderivatives(np.clip(high, 0, 1)) - _antiderivatives(np.clip(low, 0, 1))
    return np.asarray(grown / (high - low)[:, np.newaxis])


def curve_mean(coefficients: Doubles, low: Doubles, high: Doubles) -> Doubles:
    """Return the curve's means over intervals, (n,): ``curve_means(low, high) @ coefficients``."""
    from scipy.interpolate import BSpline

    sums = np.append(0.0, np.cumsum(_WIDTHS * coefficients))
    integral = BSpline(np.pad(_KNOTS, 1, "edge"), sums, _CUBIC + 1)
    grown = integral(np.clip(high, 0, 1)) - integral(np.clip(low, 0, 1))
    return np.asarray(grown / (high - low))


def curve_from_steps(rising: bool) -> Doubles:
    """Return the square matrix from steps to coefficients.

    The first step is the lower end of the curve. If the others are not negative, the coefficients are
    monotone, and so is the curve.
    """
    matrix = np.tril(np.ones((CURVE_COEFFICIENTS, CURVE_COEFFICIENTS)))
    return matrix if rising else matrix[::-1]


def even_curve() -> Doubles:
    """Return the coefficients of the curve whose light is the share u (Greville's abscissae)."""
    return np.convolve(_KNOTS[1:-1], np.full(_CUBIC, 1 / _CUBIC), "valid")


def curve_roughness() -> Doubles:
    """Return the matrix of the coefficients' third differences, which are 0 for a parabola."""
    return np.diff(np.eye(CURVE_COEFFICIENTS), 3, axis=0)


def _antiderivatives(fraction: Doubles) -> Doubles:
    """Return the antiderivative of each basis function, (n, CURVE_COEFFICIENTS).

    The antiderivative of a cubic spline with coefficients c is a spline of fourth degree with the cumulative
    sums of c_i (t[i+4] - t[i]) / 4 as coefficients (de Boor, A Practical Guide to Splines, chapter X).
    """
    from scipy.interpolate import BSpline

    sums = np.vstack([np.zeros(CURVE_COEFFICIENTS), np.tril(np.tile(_WIDTHS, (CURVE_COEFFICIENTS, 1)))])
    basis = BSpline.design_matrix(fraction, np.pad(_KNOTS, 1, "edge"), _CUBIC + 1)
    return np.asarray(basis @ sums)


SENSOR = (
    *("radius", "rim", "axis_x", "axis_y", "sight_0", "sight_2", "scatter"),
    *("pivot_x", "pivot_y", "pivot_z", "phase_offset"),
    *("lamp_x", "lamp_y", "shade_0", "shade_1", "shade_2", "shade_3", "shade_4"),
)
"""Names of the sensor's parameters in the order of a fit; the curve's steps and the balls' centres follow."""

STEP_NAMES = tuple(f"step_{number}" for number in range(CURVE_COEFFICIENTS))
"""Names of the curve's steps; see `curve_from_steps`."""

STEPS = slice(len(SENSOR), len(SENSOR) + CURVE_COEFFICIENTS)
"""The curve's steps among the parameters; the balls' centres, x, y and z each, follow."""

GEOMETRIC = len(SENSOR) - 7
"""Number of parameters of the sensor that change the path of rays; the others change their light."""

OF_THE_WALL = ("radius", "rim", "scatter")
"""Parameters without influence on where rays are reflected."""

SCATTER_MARGIN = 1.05
"""Factor of the scatter in a response: edges are not sharp, and off the centre it is wider."""

MAX_RAY_ELEVATION = np.radians(89.0)
"""Maximum elevation of a ray that is followed to the wall."""
_CLOSEST = 1e-6  # mm^2: minimum difference to the wall; see `follow`
_SMALL = 1e-5  # step of numerical derivatives, relative to a parameter's scale
SCALES = dict(zip(SENSOR, (1, 1, 1, 1, 1e-3, 1e-6, 1e-2, 1, 1, 1, 1e-2, *[0.1] * 7), strict=True))
"""Order of magnitude of the error of each parameter of the sensor."""


@dataclass(frozen=True, slots=True, eq=False)
class LightSamples:
    """The light of N pixels that see balls in axial rotations."""

    light: Doubles  # (N,): share of the pixel's full light
    place: Doubles  # (2, N): x and y of the pixel on the rest plane, mm
    pose: NDArray[np.intp]  # (N,): number of the frame, counted through all presses
    press: NDArray[np.intp]  # (poses,): press that each frame belongs to
    lean: Doubles  # (poses, 2): lean of the body in each frame, radians; see `rotations`
    ball: float  # radius of the ball, mm

    def __getitem__(self, some: NDArray[np.bool_] | NDArray[np.intp] | slice) -> LightSamples:
        """Return some of the samples."""
        chosen = self.light[some], self.place[:, some], self.pose[some]
        return LightSamples(*chosen, self.press, self.lean, self.ball)


class SheetPoints(NamedTuple):
    """Points of the sheet on lines of sight, mm from the body's axis; sight and normal are unit vectors."""

    x: Doubles
    y: Doubles
    z: Doubles
    sight: Doubles
    normal: Doubles


class WallHit(NamedTuple):
    """The part of the wall that reflected rays see."""

    low: Doubles  # (N,): first share that a ray is spread over
    high: Doubles  # (N,): last share
    ray: Ray  # without scatter


def meet_balls(samples: LightSamples, named: Mapping[str, float], centres: Doubles) -> SheetPoints:
    """Return the points that pixels see on balls with these centres in the mean pose, (presses, 3), mm.

    A line of sight that misses its ball is followed to the point closest to it.
    """
    pivot = np.array([named["pivot_x"], named["pivot_y"], named["pivot_z"]])
    cos, sin = np.cos(named["phase_offset"]), np.sin(named["phase_offset"])
    turns = rotations(samples.lean @ np.array([[cos, sin], [-sin, cos]]))
    in_frames = np.asarray(pivot + np.einsum("pij,pj->pi", turns, centres[samples.press] - pivot))
    middle = in_frames[samples.pose].T
    (x, y), slope = look(samples.place, named)
    slope_x, slope_y = slope
    start_x, start_y, start_z = samples.place[0] - middle[0], samples.place[1] - middle[1], -middle[2]
    square = slope_x * slope_x + slope_y * slope_y + 1
    linear = start_x * slope_x + start_y * slope_y + start_z
    discriminant = linear**2 - square * (start_x**2 + start_y**2 + start_z**2 - samples.ball**2)
    z = (np.sqrt(np.maximum(discriminant, 0)) - linear) / square
    normal = np.stack([start_x + z * slope_x, start_y + z * slope_y, start_z + z]) / samples.ball
    return SheetPoints(x + z * slope_x, y + z * slope_y, z, sight_of(slope), normal)


def look(place: Doubles, named: Mapping[str, float]) -> tuple[Doubles, Doubles]:
    """Return positions relative to the axis, mm, and slopes of lines of sight, for places on the rest plane.

    All are (2, N): the lines pass ``position + z slope``.
    """
    from_axis = place - np.array([[named["axis_x"]], [named["axis_y"]]])
    return from_axis, sight_slopes(from_axis, (named["sight_0"], named["sight_2"]))


def reach_wall(met: SheetPoints, named: Mapping[str, float]) -> WallHit:
    """Return where reflected rays meet the wall, spread along the direction that changes the height most.

    A rotation of the ray by da changes its height on the wall by up to ``d da sqrt(c^2 + rz^2) / c``, with
    the distance d and the cosine c to the wall's normal; a vertical rotation changes it by
    ``d da / (rx^2 + ry^2)``.
    """
    radius = named["radius"]
    # An iteration of the fit may put points outside the wall.
    ray = follow(np.stack([met.x, met.y, met.z]), met.sight, met.normal, radius, _CLOSEST)
    out, rise = np.sqrt(ray.direction[0] ** 2 + ray.direction[1] ** 2), ray.direction[2]
    elevation = np.arctan2(rise, out)
    spread = named["scatter"] * np.sqrt(out**2 + (rise * radius * out / ray.cosine) ** 2)
    whole = np.arctan2(named["rim"], radius)
    high, low = (
        1
        - np.arctan2(
            met.z + ray.distance * out * np.tan(np.clip(angle, -MAX_RAY_ELEVATION, MAX_RAY_ELEVATION)), radius
        )
        / whole
        for angle in (elevation - spread, elevation + spread)
    )
    return WallHit(low, high, ray)


def shading(met: SheetPoints, radius: float) -> Doubles:
    """Return the basis functions of the shading at positions on the rest plane, (5, N)."""
    back = met.z / met.sight[2]
    return shade_terms((met.x - back * met.sight[0]) / radius, (met.y - back * met.sight[1]) / radius)


def split(parameters: Doubles) -> tuple[dict[str, float], Doubles, Doubles]:
    """Return the sensor's parameters by name, the curve's steps, and the balls' centres, (presses, 3)."""
    named = dict(zip(SENSOR, parameters[: len(SENSOR)].tolist(), strict=True))
    return named, parameters[STEPS], parameters[STEPS.stop :].reshape(-1, 3)


def light_of(met: SheetPoints, named: Mapping[str, float], coefficients: Doubles) -> Doubles:
    """Return the light of mirrors, (N,): shares of each pixel's full light."""
    wall = reach_wall(met, named)
    level = curve_mean(coefficients, wall.low, wall.high)
    return np.asarray(lamps_and_shade(met, wall, named) * level)


def predict(samples: LightSamples, parameters: Doubles, rising: bool) -> Doubles:
    """Return the light of samples by the model, (N,)."""
    named, steps, centres = split(parameters)
    return light_of(meet_balls(samples, named, centres), named, curve_from_steps(rising) @ steps)


def linearise(samples: LightSamples, parameters: Doubles, rising: bool) -> tuple[Doubles, Doubles]:
    """Return the light of samples by the model, (N,), and its derivatives by the parameters, (N, P).

    Derivatives of the geometry are numerical, all others analytical.
    """
    named, steps, centres = split(parameters)
    met = meet_balls(samples, named, centres)
    wall = reach_wall(met, named)
    basis, coefficients = curve_means(wall.low, wall.high), curve_from_steps(rising) @ steps
    level, factor = np.einsum("nk,k->n", basis, coefficients), lamps_and_shade(met, wall, named)
    per_width = factor / (wall.high - wall.low)
    by_high = per_width * (curve_values(coefficients, wall.high) - level)
    by_low = per_width * (level - curve_values(coefficients, wall.low))

    def change(step: float, changed: Mapping[str, float], points: SheetPoints) -> Doubles:
        other = reach_wall(points, changed)
        by_ends = by_high * (other.high - wall.high) + by_low * (other.low - wall.low)
        return np.asarray((by_ends + level * (lamps_and_shade(points, other, changed) - factor)) / step)

    slopes = np.zeros((len(level), len(parameters)))
    for number, name in enumerate(SENSOR[:GEOMETRIC]):
        step = _SMALL * SCALES[name]
        changed = {**named, name: named[name] + step}
        points = met if name in OF_THE_WALL else meet_balls(samples, changed, centres)
        slopes[:, number] = change(step, changed, points)
    lamp = lamp_light(wall.ray, (named["lamp_x"], named["lamp_y"]))
    slopes[:, GEOMETRIC : GEOMETRIC + 2] = (factor * level / lamp * wall.ray.at).T
    slopes[:, GEOMETRIC + 2 : STEPS.start] = (lamp * level * shading(met, named["radius"])).T
    slopes[:, STEPS] = factor[:, np.newaxis] * np.einsum("nk,ks->ns", basis, curve_from_steps(rising))
    centre = STEPS.stop + 3 * samples.press[samples.pose]
    for axis, shift in enumerate(_SMALL * np.eye(3)):
        points = meet_balls(samples, named, centres + shift)
        slopes[np.arange(len(level)), centre + axis] = change(_SMALL, named, points)
    return factor * level, slopes


def lamps_and_shade(met: SheetPoints, wall: WallHit, named: Mapping[str, float]) -> Doubles:
    """Return the factor of lamps and shading."""
    lamp = lamp_light(wall.ray, (named["lamp_x"], named["lamp_y"]))
    shade = np.array([named[f"shade_{number}"] for number in range(5)])
    return np.asarray(lamp * (1 + shade @ shading(met, named["radius"])))
