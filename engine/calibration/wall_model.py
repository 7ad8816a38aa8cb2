"""What pixels see of balls under the lit wall, and how that changes with the parameters that are fitted.

A printed pattern is a monotone curve of light, which scatter blurs: here a ray is spread evenly over the
angles that the sheet's flakes turn it by, and what passes over the rim or below the rest plane is dark.
Otherwise the formula is that of `mirrorskin.kernels.response`. The place on the wall is given by a share u:
0 at the rim and 1 at the rest plane, evenly in the elevation at which the sheet's centre sees it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.calibration.ball import rotations
from mirrorskin.kernels.response import reflect, way_to_wall

Doubles = NDArray[np.float64]

_PIECES = 8  # a gamma of 2.2 is met within 2e-4 of full light
_CUBIC = 3
CURVE_COEFFICIENTS = _PIECES + _CUBIC
"""Of a curve, which is a cubic spline with evenly spaced knots on 0 to 1, and 0 beyond."""

_KNOTS = np.pad(np.linspace(0, 1, _PIECES + 1), _CUBIC, "edge")


def curve_values(coefficients: ArrayLike, share: ArrayLike) -> Doubles:
    """Return the curve at shares u, (n,); 0 outside 0 to 1."""
    from scipy.interpolate import BSpline

    share = np.asarray(share, np.float64)
    spline = BSpline(_KNOTS, np.asarray(coefficients, np.float64), _CUBIC)
    return np.where((share >= 0) & (share <= 1), spline(np.clip(share, 0, 1)), 0.0)


def curve_means(low: ArrayLike, high: ArrayLike) -> Doubles:
    """Return the matrix that makes of coefficients the curve's means over intervals, (n, CURVE_COEFFICIENTS).

    With G, the antiderivative, they are ``(G(high) - G(low)) / (high - low)``: what a mirror shows that
    spreads each ray evenly over the interval.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    grown = _antiderivatives(np.clip(high, 0, 1)) - _antiderivatives(np.clip(low, 0, 1))
    return np.asarray(grown / (high - low)[:, np.newaxis])


def curve_from_steps(rising: bool) -> Doubles:
    """Return the square matrix that makes coefficients of steps.

    The first step is the lower end of the curve; if the others are at least 0, the coefficients never turn
    back, and so neither does the curve.
    """
    matrix = np.tril(np.ones((CURVE_COEFFICIENTS, CURVE_COEFFICIENTS)))
    return matrix if rising else matrix[::-1]


def curve_roughness() -> Doubles:
    """Return the matrix of the coefficients' third differences, which are 0 for a parabola."""
    return np.diff(np.eye(CURVE_COEFFICIENTS), 3, axis=0)


def _antiderivatives(share: Doubles) -> Doubles:
    """Return the antiderivative of each basis function, (n, CURVE_COEFFICIENTS).

    That of a cubic spline of coefficients c is a spline of fourth degree, whose coefficients are the running
    sums of c_i (t[i+4] - t[i]) / 4 (de Boor, A Practical Guide to Splines, chapter X).
    """
    from scipy.interpolate import BSpline

    order = _CUBIC + 1
    widths = (_KNOTS[order:] - _KNOTS[:-order]) / order
    sums = np.vstack([np.zeros(CURVE_COEFFICIENTS), np.tril(np.tile(widths, (CURVE_COEFFICIENTS, 1)))])
    basis = BSpline.design_matrix(share, np.pad(_KNOTS, 1, "edge"), order)
    return np.asarray(basis @ sums)


SENSOR = (
    *("radius", "rim", "axis_x", "axis_y", "sight_0", "sight_2", "scatter"),
    *("pivot_x", "pivot_y", "pivot_z", "phase_offset"),
    *("lamp_x", "lamp_y", "shade_0", "shade_1", "shade_2", "shade_3", "shade_4"),
)
"""Parameters of the sensor, in their order in a fit; the curve's steps and the balls' centres follow."""

STEPS = slice(len(SENSOR), len(SENSOR) + CURVE_COEFFICIENTS)
"""Where the curve's steps are among the parameters; the balls' centres, x, y and z each, follow."""

_BENT = len(SENSOR) - 7  # parameters that change which way a ray goes, and not only its light
_OF_THE_WALL = ("radius", "rim", "scatter")  # that do not change where a pixel looks
_STEEPEST = np.radians(89.0)  # elevation up to which a ray is followed to the wall
_SMALL = 1e-5  # step of the differences, as a share of a parameter's scale
SCALES = dict(zip(SENSOR, (1, 1, 1, 1, 1e-3, 1e-6, 1e-2, 1, 1, 1, 1e-2, *[0.1] * 7), strict=True))
"""How far each parameter of the sensor may be expected to be off, about."""


@dataclass(frozen=True, slots=True, eq=False)
class LightSamples:
    """The light of N pixels that see balls in axial rotations."""

    light: Doubles  # (N,): share of the pixel's own full light
    place: Doubles  # (2, N): x and y at which the pixel looks on the rest plane, mm
    pose: NDArray[np.intp]  # (N,): number of the frame, counted through all presses
    press: NDArray[np.intp]  # (poses,): press that each frame belongs to
    lean: Doubles  # (poses, 2): of the body in each frame, radians; see `rotations`
    ball: float  # radius of the ball, mm

    def __getitem__(self, some: NDArray[np.bool_] | NDArray[np.intp] | slice) -> LightSamples:
        """Return some of the samples."""
        chosen = self.light[some], self.place[:, some], self.pose[some]
        return LightSamples(*chosen, self.press, self.lean, self.ball)


class SheetPoints(NamedTuple):
    """Where lines of sight meet the sheet: from the body's axis, mm; sight and normal are unit vectors."""

    x: Doubles
    y: Doubles
    z: Doubles
    sight: Doubles
    normal: Doubles


class WallHit(NamedTuple):
    """What mirrored rays see of the wall."""

    low: Doubles  # (N,): share from which a ray is spread
    high: Doubles  # (N,): and up to which
    azimuth: Doubles  # (2, N): direction of the wall's point, a unit vector


def meet_balls(samples: LightSamples, named: Mapping[str, float], centres: Doubles) -> SheetPoints:
    """Return where pixels see the balls, whose centres in the mean pose are (presses, 3), mm.

    A line of sight that misses its ball is taken to where it is nearest.
    """
    middle = _centres(samples, named, centres)[samples.pose].T
    (x, y), (across, up) = look(samples.place, named)
    start_x, start_y, start_z = samples.place[0] - middle[0], samples.place[1] - middle[1], -middle[2]
    square = across * across + up * up + 1
    linear = start_x * across + start_y * up + start_z
    room = linear**2 - square * (start_x**2 + start_y**2 + start_z**2 - samples.ball**2)
    z = (np.sqrt(np.maximum(room, 0)) - linear) / square
    normal = np.stack([start_x + z * across, start_y + z * up, start_z + z]) / samples.ball
    return SheetPoints(x + z * across, y + z * up, z, down(np.stack([across, up])), normal)


def down(lean: Doubles) -> Doubles:
    """Return the unit vectors along which pixels look, (3, N), whose lines of sight lean so, (2, N)."""
    return np.asarray(-np.stack([*lean, np.ones(lean.shape[1])]) / np.sqrt((lean**2).sum(axis=0) + 1))


def look(place: Doubles, named: Mapping[str, float]) -> tuple[Doubles, Doubles]:
    """Return where pixels at places, (2, N), look on the rest plane from the axis, mm, and how they lean.

    Both are (2, N): the lines pass ``place + z lean``.
    """
    from_axis = place - np.array([[named["axis_x"]], [named["axis_y"]]])
    return from_axis, -(named["sight_0"] + named["sight_2"] * (from_axis**2).sum(axis=0)) * from_axis


def reach_wall(met: SheetPoints, named: Mapping[str, float]) -> WallHit:
    """Return where the mirrored rays meet the wall, spread along the direction in which that matters most.

    A turn of the ray by da moves its height there by up to ``way da sqrt(c^2 + rz^2) / c`` with c the cosine
    to the wall's normal; straight up and down it is ``way da / (rx^2 + ry^2)`` across the axis.
    """
    radius = named["radius"]
    ray = reflect(met.sight, met.normal)
    # A ray that goes straight up, and a place that a trial of the fit puts outside, have an answer, too.
    out = np.sqrt(ray[0] ** 2 + ray[1] ** 2) + 1e-12
    room = np.maximum(radius**2 - met.x**2 - met.y**2, 1e-6)
    way, cosine = way_to_wall(met.x * ray[0] + met.y * ray[1], out**2, room)
    elevation = np.arctan2(ray[2], out)
    turn = named["scatter"] * np.sqrt(out**2 + (ray[2] * radius * out / cosine) ** 2)
    whole = np.arctan2(named["rim"], radius)
    high, low = (
        1 - np.arctan2(met.z + way * out * np.tan(np.clip(angle, -_STEEPEST, _STEEPEST)), radius) / whole
        for angle in (elevation - turn, elevation + turn)
    )
    return WallHit(low, high, np.stack([met.x + way * ray[0], met.y + way * ray[1]]) / radius)


def shade_terms(met: SheetPoints, radius: float) -> Doubles:
    """Return the five functions of the pixels' place on the rest plane that the shade is made of, (5, N)."""
    back = met.z / met.sight[2]
    x, y = (met.x - back * met.sight[0]) / radius, (met.y - back * met.sight[1]) / radius
    return np.stack([x, y, x * x, x * y, y * y])


def split(parameters: Doubles) -> tuple[dict[str, float], Doubles, Doubles]:
    """Return the sensor's parameters by name, the curve's steps, and the balls' centres, (presses, 3)."""
    named = dict(zip(SENSOR, parameters[: len(SENSOR)].tolist(), strict=True))
    return named, parameters[STEPS], parameters[STEPS.stop :].reshape(-1, 3)


def light_of(met: SheetPoints, named: Mapping[str, float], coefficients: Doubles) -> Doubles:
    """Return the light of mirrors, (N,): shares of each pixel's own full light."""
    wall = reach_wall(met, named)
    return np.asarray(
        _factor(met, wall, named) * (np.einsum("nk,k->n", curve_means(wall.low, wall.high), coefficients))
    )


def predict(samples: LightSamples, parameters: Doubles, rising: bool) -> Doubles:
    """Return the light that samples should have, (N,)."""
    named, steps, centres = split(parameters)
    return light_of(meet_balls(samples, named, centres), named, curve_from_steps(rising) @ steps)


def linearise(samples: LightSamples, parameters: Doubles, rising: bool) -> tuple[Doubles, Doubles]:
    """Return the light that samples should have, (N,), and how it changes with the parameters, (N, P).

    The geometry is differenced, and everything else differentiated.
    """
    named, steps, centres = split(parameters)
    met = meet_balls(samples, named, centres)
    wall = reach_wall(met, named)
    basis, coefficients = curve_means(wall.low, wall.high), curve_from_steps(rising) @ steps
    level, factor = np.einsum("nk,k->n", basis, coefficients), _factor(met, wall, named)
    per_width = factor / (wall.high - wall.low)
    by_high = per_width * (curve_values(coefficients, wall.high) - level)
    by_low = per_width * (level - curve_values(coefficients, wall.low))

    def change(step: float, bent: Mapping[str, float], there: SheetPoints) -> Doubles:
        other = reach_wall(there, bent)
        by_ends = by_high * (other.high - wall.high) + by_low * (other.low - wall.low)
        return np.asarray((by_ends + level * (_factor(there, other, bent) - factor)) / step)

    slopes = np.zeros((len(level), len(parameters)))
    for number, name in enumerate(SENSOR[:_BENT]):
        step = _SMALL * SCALES[name]
        bent = {**named, name: named[name] + step}
        slopes[:, number] = change(
            step, bent, met if name in _OF_THE_WALL else meet_balls(samples, bent, centres)
        )
    lamp = 1 + named["lamp_x"] * wall.azimuth[0] + named["lamp_y"] * wall.azimuth[1]
    slopes[:, _BENT : _BENT + 2] = (factor * level / lamp * wall.azimuth).T
    slopes[:, _BENT + 2 : STEPS.start] = (lamp * level * shade_terms(met, named["radius"])).T
    slopes[:, STEPS] = factor[:, np.newaxis] * np.einsum("nk,ks->ns", basis, curve_from_steps(rising))
    own = STEPS.stop + 3 * samples.press[samples.pose]
    for axis, moved in enumerate(_SMALL * np.eye(3)):
        there = meet_balls(samples, named, centres + moved)
        slopes[np.arange(len(level)), own + axis] = change(_SMALL, named, there)
    return factor * level, slopes


def _centres(samples: LightSamples, named: Mapping[str, float], centres: Doubles) -> Doubles:
    """Return where the balls' centres are in each frame, (poses, 3), mm."""
    pivot = np.array([named["pivot_x"], named["pivot_y"], named["pivot_z"]])
    cos, sin = np.cos(named["phase_offset"]), np.sin(named["phase_offset"])
    turned = rotations(samples.lean @ np.array([[cos, sin], [-sin, cos]]))
    return np.asarray(pivot + np.einsum("pij,pj->pi", turned, centres[samples.press] - pivot))


def _factor(met: SheetPoints, wall: WallHit, named: Mapping[str, float]) -> Doubles:
    """Return what lamps and shade make of the light."""
    lamp = 1 + named["lamp_x"] * wall.azimuth[0] + named["lamp_y"] * wall.azimuth[1]
    shade = np.array([named[f"shade_{number}"] for number in range(5)])
    return np.asarray(lamp * (1 + shade @ shade_terms(met, named["radius"])))
