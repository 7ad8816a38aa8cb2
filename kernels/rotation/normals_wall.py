"""Surface normals with a cylindrical wall: ``normals_wall.cl`` in NumPy.

Like `mirrorskin.kernels.rotation.normals.normals_exact`, but samples are lights
(`mirrorskin.kernels.rotation.response`), not zeniths, and depend on the position. In the body's frame a
normal n at phase alpha is Rz(alpha) Ry(tilt) Rz(-alpha) n, and the point p of the object is at pivot +
Rz(alpha) Ry(tilt) Rz(-alpha) (p - pivot).

The initial value is the height on the wall that shows the mean light to the centre, and the wave's azimuth,
which is wrong by degrees. Gauss-Newton steps lead from there to the maximum-likelihood normal.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.rotation.normals import (
    MORE,
    Answer,
    Limits,
    Samples,
    Sums,
    Variance,
    conclude,
    likelihood,
    normalise,
    step,
    tangents,
)
from mirrorskin.kernels.rotation.response import light_slopes, sight_slopes, wall_light

Array = NDArray[Any]

STEPS = 3
"""Gauss-Newton steps of all pixels: one more changes the result by less than 0.1 standard errors."""

_LEAST = 3  # minimum number of valid samples within their range


class Wall(NamedTuple):
    """The model of the light; see `mirrorskin.io.WallResponse`.

    Attributes
    ----------
    geometry : (float, float, float)
        Radius of the body and height of the wall, mm; half-angle of the scatter, radians.
    sight, lamps : (float, float)
    curve : ndarray, (n,), float64
        The light as a polynomial in q.
    reach : (float, float)
        Range of q in which the curve is valid.
    ends : (float, float)
        Minimum and maximum light in this range.
    inverse : ndarray, (m,), float64
        Approximation of q by a polynomial in the light, which is clipped to ``ends``.
    sense : float
        1 if a steeper mirror is brighter, -1 if it is darker.
    pivot : (float, float, float)
        From the wall's axis, mm.
    follows : bool
        Whether each pixel keeps seeing one point of the object, which moves in the picture. Otherwise it sees
        one place, where the object rises and falls.
    """

    geometry: tuple[float, float, float]
    sight: tuple[float, float]
    lamps: tuple[float, float]
    curve: Doubles
    reach: tuple[float, float]
    ends: tuple[float, float]
    inverse: Doubles
    sense: float
    pivot: tuple[float, float, float]
    follows: bool


def normals_wall(
    frames: Array, turn: Doubles, scale: Doubles, wall: Wall, tilt: float, noise: Variance, limits: Limits
) -> Answer:
    """Return the maximum-likelihood normals; samples expected out of range carry no information.

    Arguments as for ``normals_exact``, except ``scale``, (5, n): counts without light; light per count; x and
    y from the wall's axis on the rest plane, and z of the object in the mean pose, mm. As there, the error of
    the model is an angle along the meridian.
    """
    ends = np.broadcast_to(np.array(wall.ends)[:, np.newaxis], (2, scale.shape[1]))
    samples = Samples(frames, turn, np.concatenate([scale[:2], ends]), noise)
    beginning = _start(samples, scale, wall)
    normal, irregular = beginning, samples.irregular
    sums, within = _look(normal, samples, turn, scale, wall, tilt, closely=False)
    for _ in range(1, STEPS):
        normal = step(normal, sums)
        sums, within = _look(normal, samples, turn, scale, wall, tilt, closely=False)
    normal = step(normal, sums)
    irregular = (irregular | (within.sum(axis=0) < len(frames))) & (samples.usable >= _LEAST)
    at = beginning
    for _ in range(MORE if irregular.any() else 0):
        closer, closer_within = _look(at, samples, turn, scale, wall, tilt, closely=True)
        sums, within = closer.where(irregular, sums), np.where(irregular, closer_within, within)
        at = step(at, closer)
    normal = np.where(irregular[:, np.newaxis], at, normal)
    whole = ~(samples.missing | samples.under | samples.over)
    usable = np.minimum(samples.usable, (within & whole).sum(axis=0))
    steepness = sums.m11 / len(frames)
    rest = np.hypot(normal[:, 0], normal[:, 1]) < limits.rest
    return conclude(normal, sums, samples, usable, tilt, limits, limits.model * steepness, rest)


def light_of_turn(
    normal: Doubles, phase: Doubles, scale: Doubles, wall: Wall, tilt: float
) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return the light of normals, (n, 3), at phases, (N,), and whether it is in range: each (N, n).

    ``scale`` is that of `normals_wall`.
    """
    turning, _ = _rotations(np.stack([np.cos(phase), np.sin(phase)]), tilt)
    facing = np.einsum("kij,nj->kni", turning, normal)
    places = _places(scale, turning, wall)
    return wall_light(places, facing, wall.geometry, wall.lamps, wall.curve, wall.reach)


def _start(samples: Samples, scale: Doubles, wall: Wall) -> Doubles:
    """Return the directions given by the mean light and the wave, (n, 3)."""
    present = np.maximum((~samples.missing).sum(axis=0), 1)
    zeniths = np.where(samples.missing, 0.0, samples.zenith)
    mean = zeniths.sum(axis=0) / present
    q = np.polynomial.polynomial.polyval(np.clip(mean, *wall.ends), wall.inverse)
    q = np.clip(q, *wall.reach)
    deviation = np.where(samples.missing, 0.0, samples.zenith - mean)
    cosine, sine = wall.sense * (samples.turn[4:] @ deviation)
    amplitude = np.hypot(cosine, sine)
    east, north = np.where(
        amplitude > 0, np.stack([cosine, sine]) / np.where(amplitude > 0, amplitude, 1), [[1.0], [0.0]]
    )
    _, _, x, y, z = scale
    radius = wall.geometry[0]
    slope_x, slope_y = sight_slopes(np.stack([x, y]), wall.sight)
    x, y = x + z * slope_x, y + z * slope_y
    with np.errstate(invalid="ignore"):
        along = x * east + y * north
        out = np.sqrt(along**2 + radius**2 - x**2 - y**2) - along
        ray = normalise(np.stack([out * east, out * north, 2 * radius * q / (1 - q**2) - z], axis=1))
        return normalise(ray + normalise(np.stack([slope_x, slope_y, np.ones_like(z)], axis=1)))


def _look(
    normal: Doubles, samples: Samples, turn: Doubles, scale: Doubles, wall: Wall, tilt: float, closely: bool
) -> tuple[Sums, NDArray[np.bool_]]:
    """Return the normal equations at a direction, and which samples are expected within range."""
    turning, tilting = _rotations(turn, tilt)
    facing = np.einsum("kij,nj->kni", turning, normal)
    place = _places(scale, turning, wall)
    level, within = wall_light(place, facing, wall.geometry, wall.lamps, wall.curve, wall.reach)
    slopes = light_slopes(place, facing, wall.geometry, wall.lamps, wall.curve, wall.reach)
    back = np.einsum("kni,kij->knj", slopes, turning)
    along, across = tangents(normal)
    root = turn[2][:, np.newaxis]
    u1, u2 = root * (back * along).sum(axis=2), root * (back * across).sum(axis=2)
    u3 = root * np.einsum("kni,kij,nj->kn", slopes, tilting, normal)
    error = samples.zenith - level
    information, pull, misfit = np.ones_like(error), error, error**2
    if closely:
        information, pull, misfit = likelihood(samples, level, within)
        misfit = np.where(within, misfit, 0.0)
    return Sums.of(u1, u2, u3, information, root * pull, root**2 * misfit), within


def _rotations(turn: Doubles, tilt: float) -> tuple[Doubles, Doubles]:
    """Return rotations to the body's frame at each phase, (N, 3, 3), and their derivatives by the tilt."""
    cosine, sine = turn[:2]
    zeros, ones = np.zeros_like(cosine), np.ones_like(cosine)
    out = np.stack([cosine, sine, zeros], axis=1)
    up = np.stack([zeros, zeros, ones], axis=1)
    flat, steep = (np.einsum("ki,kj->kij", axis, axis) for axis in (out, up))
    swap = np.einsum("ki,kj->kij", out, up) - np.einsum("ki,kj->kij", up, out)
    turning = np.eye(3) + (math.cos(tilt) - 1) * (flat + steep) + math.sin(tilt) * swap
    return turning, math.cos(tilt) * swap - math.sin(tilt) * (flat + steep)


def _places(scale: Doubles, turning: Doubles, wall: Wall) -> Doubles:
    """Return the positions of each sample's point, as used by `wall_light`, (5, N, n)."""
    x, y, z = scale[2:]
    slope_x, slope_y = sight_slopes(np.stack([x, y]), wall.sight)
    point = np.stack([x + z * slope_x, y + z * slope_y, z])
    pivot = np.array(wall.pivot)[:, np.newaxis]
    moved = pivot[:, np.newaxis] + np.einsum("kij,jn->ikn", turning, point - pivot)
    each = np.ones((len(turning), 1))
    if not wall.follows:
        return np.stack([x * each, y * each, moved[2], slope_x * each, slope_y * each])
    bend = wall.sight[0] + wall.sight[1] * (x**2 + y**2)
    slope_x, slope_y = slope_x - bend * (moved[0] - point[0]), slope_y - bend * (moved[1] - point[1])
    return np.stack(
        [moved[0] - moved[2] * slope_x, moved[1] - moved[2] * slope_y, moved[2], slope_x, slope_y]
    )
