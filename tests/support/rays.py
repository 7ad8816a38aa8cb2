"""The lit wall in a mirror under the camera: rays traced one by one, independent of the code under test.

It shares no code with mirrorskin. All is float64, from first principles, slow, and written to be read:
radians, and vectors of three numbers in the body's frame: mm, z = 0 the sheet's rest plane, z to the camera.

A ray is followed backwards, from the camera to the mirror and on to the wall. The wall is a cylinder round
the z axis from z = 0 to the body's height. What passes below or above it, or starts outside, is dark.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Map = NDArray[np.float64]

# The light that passes the wall, 0 to 1, by height and azimuth on it.
Pattern = Callable[[Map, Map], Map]


@dataclass(frozen=True, slots=True)
class Chamber:
    """The body as rays meet it."""

    radius: float = 17.5
    height: float = 40.0
    index: float = 1.41
    scatter: float = 0.0
    air_gap: float = 0.0
    asymmetry: float = 0.0
    asymmetry_azimuth: float = 0.0


def uniform(height: Map, azimuth: Map) -> Map:
    """Return what passes a wall without a pattern: all."""
    return np.ones(np.broadcast_shapes(height.shape, azimuth.shape))


def linear_in_zenith(radius: float, first: float, last: float) -> Pattern:
    """Return the pattern that a mirror at the floor's centre shows as a brightness linear in its zenith.

    The mirror leaning by t shows what lies 2 t off the axis: 0 where t is ``first``, 1 where it is ``last``.
    """

    def transmittance(height: Map, azimuth: Map) -> Map:
        zenith = 0.5 * np.arctan2(radius, height) + 0.0 * azimuth
        return np.asarray(np.clip((zenith - first) / (last - first), 0.0, 1.0))

    return transmittance


def picture(image: Map, wall_height: float) -> Pattern:
    """Return a picture rolled up: columns from azimuth -pi to pi, the top row at the wall's top.

    Between the centres of picture elements it is linear in height and in azimuth; it closes on itself round
    the wall and stays constant beyond the outermost rows' centres.
    """
    rows, columns = image.shape
    centres = 2 * np.pi * ((np.arange(columns) + 0.5) / columns - 0.5)

    def transmittance(height: Map, azimuth: Map) -> Map:
        row = np.clip((1 - height / wall_height) * rows - 0.5, 0, rows - 1)
        around = [np.interp(azimuth, centres, line, period=2 * np.pi) for line in image]
        # Each row fades in a straight line from its middle to those of the next.
        return np.asarray(sum(line * np.maximum(1 - np.abs(row - r), 0) for r, line in enumerate(around)))

    return transmittance


def reflected(normal: ArrayLike, to_camera: ArrayLike = (0.0, 0.0, 1.0)) -> Map:
    """Return the unit direction whose light a mirror of this normal sends to the camera."""
    facing = _unit(np.asarray(normal, dtype=float))
    coming = -_unit(np.asarray(to_camera, dtype=float))
    return np.asarray(coming - 2 * np.dot(coming, facing) * facing)


def scattered(ray: Map, largest: float, count: int = 10_000) -> Map:
    """Return directions (N, 3), all of the same weight, that flakes of the sheet turn a ray into.

    The offsets (u, v) from the ray, as angles, have the density 1 / (2 pi a sqrt(a^2 - u^2 - v^2)) in a disc
    of radius a: the shadow of an evenly covered sphere, which is a box from any side. Points that cover half
    a sphere evenly lie on a spiral, by steps of the golden angle, at heights w that are evenly spaced; their
    shadows are a sqrt(1 - w^2) off the centre.
    """
    if largest == 0:
        return ray[np.newaxis]
    w = (np.arange(count) + 0.5) / count
    around = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    offset = largest * np.sqrt(1 - w**2)
    helper = np.array([1.0, 0.0, 0.0]) if abs(ray[0]) < 0.5 else np.array([0.0, 1.0, 0.0])
    first = _unit(np.cross(ray, helper))
    second = np.cross(ray, first)
    aside = np.outer(np.cos(around), first) + np.outer(np.sin(around), second)
    return np.asarray(np.cos(offset)[:, np.newaxis] * ray + np.sin(offset)[:, np.newaxis] * aside)


def wall_light(
    chamber: Chamber,
    pattern: Pattern,
    point: ArrayLike,
    normal: ArrayLike,
    view: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
) -> float:
    """Return the light, 0 to 1, that the camera gets from a mirror at a point.

    Parameters
    ----------
    chamber : Chamber
    pattern : Pattern
    point, normal : (3,)
        Of the mirror, in the body's frame.
    view : (number, number)
        The camera lies in the direction (view_x, view_y, 1) of the point.
    """
    ray = reflected(normal, np.array([*view, 1.0], dtype=float))
    rays = scattered(ray, chamber.scatter)
    return float(np.mean(traced(chamber, pattern, np.asarray(point, dtype=float), rays)))


def traced(chamber: Chamber, pattern: Pattern, point: Map, rays: Map) -> Map:
    """Return the light (N,) that comes to a point along unit directions (N, 3) from it."""
    if np.hypot(point[0], point[1]) >= chamber.radius:
        return np.zeros(len(rays))
    light = np.zeros(len(rays))
    # A ray straight up never meets the wall.
    chosen = np.hypot(rays[:, 0], rays[:, 1]) > 1e-12
    place, ray = _to_cylinder(np.broadcast_to(point, (int(chosen.sum()), 3)), rays[chosen], chamber.radius)
    fraction = np.ones(len(place))
    if chamber.air_gap > 0:
        ray, fraction = _into_air(place, ray, chamber.index)
        place, _ = _to_cylinder(place, ray, chamber.radius + chamber.air_gap)
    fraction = np.where((place[:, 2] >= 0) & (place[:, 2] <= chamber.height), fraction, 0.0)
    azimuth = np.arctan2(place[:, 1], place[:, 0])
    lamps = 1 + chamber.asymmetry * np.cos(azimuth - chamber.asymmetry_azimuth)
    shown = pattern(place[:, 2], azimuth) * lamps / (1 + abs(chamber.asymmetry))
    light[chosen] = np.where(fraction > 0, fraction * shown, 0.0)
    return light


def _to_cylinder(start: Map, ray: Map, radius: float) -> tuple[Map, Map]:
    """Return where rays from inside meet a cylinder round the z axis, and the rays."""
    square = ray[:, 0] ** 2 + ray[:, 1] ** 2
    linear = start[:, 0] * ray[:, 0] + start[:, 1] * ray[:, 1]
    constant = start[:, 0] ** 2 + start[:, 1] ** 2 - radius**2
    t = (-linear + np.sqrt(linear**2 - square * constant)) / square
    return start + t[:, np.newaxis] * ray, ray


def _into_air(place: Map, ray: Map, index: float) -> tuple[Map, Map]:
    """Return rays refracted out of the silicone's cylinder, and the share of unpolarised light that passes.

    Snell's law for vectors: the part along the surface grows by the index. Fresnel's for the amplitudes.
    Totally reflected rays are NaN with a share of 0.
    """
    outwards = place * np.array([1.0, 1.0, 0.0])
    outwards = outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
    inside = np.sum(ray * outwards, axis=1)  # cosine of the angle of incidence
    along = index * (ray - inside[:, np.newaxis] * outwards)
    sine_squared = np.sum(along**2, axis=1)
    outside = np.sqrt(np.where(sine_squared < 1, 1 - sine_squared, np.nan))
    across = (index * inside - outside) / (index * inside + outside)
    within = (index * outside - inside) / (index * outside + inside)
    passed = np.nan_to_num(1 - 0.5 * (across**2 + within**2))
    return along + outside[:, np.newaxis] * outwards, passed


def sight_line(
    x: ArrayLike, y: ArrayLike, distance: float, height: float = 40.0, index: float = 1.41
) -> tuple[Map, Map]:
    """Return (view_x, view_y): the line (x, y, 0) + z (view_x, view_y, 1) in the body leads to the pinhole.

    The pinhole is on the axis, so many millimetres above the rest plane; light is refracted where it leaves
    the flat top of the body. Bisection on where: Snell's law says on which side of it light really leaves.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    away = np.hypot(x, y)
    low, high = np.zeros_like(away), away
    for _ in range(100):
        middle = 0.5 * (low + high)
        inside = (away - middle) / np.hypot(away - middle, height)  # sines of the angles with the axis
        outside = middle / np.hypot(middle, distance - height)
        inwards = outside > index * inside
        low, high = np.where(inwards, low, middle), np.where(inwards, middle, high)
    scale = (low - away) / (height * np.where(away > 0, away, 1.0))
    return x * scale, y * scale


def _unit(vector: Map) -> Map:
    return np.asarray(vector / np.linalg.norm(vector))
