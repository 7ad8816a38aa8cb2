"""The brightness of a mirror inside a lit cylinder: the formula of `mirrorskin.io.WallResponse`.

A line of sight s is reflected at the normal n and meets the wall of radius R at height h; P is the position
of the mirror and power = R^2 - P^2 the power of this point ::

    r = s - 2 (s . n) n    A = Px rx + Py ry    c = sqrt(A^2 + (rx^2 + ry^2) power)    d = power / (A + c)
    m = (P + d r) / R across the axis    h = z + d rz    q = h / (R + sqrt(h^2 + R^2))

q is the tangent of half the elevation at which the centre sees that height: 0 at the horizon, and the zenith
of a mirror at the centre that shows it is pi/4 - atan(q). The light is ::

    light = (1 + lamp_x mx + lamp_y my) (curve[0] + curve[1] q + curve[2] q^2 ...)

``normals_wall.cl`` computes the same; all other code calls the functions here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.kernels.array_types import Doubles

Array = NDArray[Any]

_LEVEL = 1e-24  # added to the squared horizontal component of rays, which is 0 for vertical ones


class Ray(NamedTuple):
    """A reflected line of sight."""

    direction: Doubles  # (3, ...): a unit vector, away from the mirror
    at: Doubles  # (2, ...): its intersection with the wall, across the axis, as a share of the radius
    distance: Doubles  # from the mirror to the wall, mm
    cosine: Doubles  # to the wall's normal, times the radius
    height: Doubles  # of the intersection, mm


def wall_light(place: ArrayLike, normals: ArrayLike, geometry: Sequence[float], lamps: Sequence[float],
               curve: ArrayLike, reach: Sequence[float]) -> tuple[Doubles, NDArray[np.bool_]]:  # fmt: skip
    """Return the brightness of mirrors, (N, n), in shares of full light, and where it is valid.

    It is valid where q is within reach and the two rays that are deflected up and down most by the scatter
    meet the wall. Out of reach the curve is extrapolated linearly.

    Parameters
    ----------
    place : (5, n) or (5, N, n), x and y on the rest plane from the body's axis, mm; height z of the mirror,
        mm; shift of the line of sight along x and y per mm of z
    normals : (N, n, 3), unit vectors in the body's frame
    geometry : radius of the body and height of the wall, mm; half-angle of the scatter, radians
    lamps : relative increase of the wall's brightness towards x and y
    curve : polynomial in q, from the lowest power on
    reach : range of q in which the curve is valid
    """
    _, _, ray = _follow(place, normals, geometry[0])
    q = half_tangent(ray.height, geometry[0])
    light = lamp_light(ray, lamps) * level(q, curve, reach)[0]
    within = _meets_wall(ray, np.asarray(place, np.float64)[2], geometry) & (q >= reach[0]) & (q <= reach[1])
    return light, within


def light_slopes(place: ArrayLike, normals: ArrayLike, geometry: Sequence[float], lamps: Sequence[float],
                 curve: ArrayLike, reach: Sequence[float] = (-np.inf, np.inf)) -> Doubles:  # fmt: skip
    """Return the derivatives of the light of `wall_light` by the normals' components, (N, n, 3).

    The formula assumes unit vectors: only the components across a normal are meaningful.
    """
    sight, normal, ray = _follow(place, normals, geometry[0])
    q = half_tangent(ray.height, geometry[0])
    light, steepness = level(q, curve, reach)
    by_height = (1 - q**2) ** 2 / (2 * geometry[0] * (1 + q**2))
    by_height *= lamp_light(ray, lamps) * steepness
    by_lamps = light * np.reshape(np.asarray(lamps, np.float64) / geometry[0], (2, *[1] * q.ndim))
    # The intersection of a ray that turns by dr moves by distance (dr - r (R at . dr) / c).
    along = ((by_lamps * ray.direction[:2]).sum(axis=0) + by_height * ray.direction[2]) / ray.cosine
    by_ray = ray.distance * np.stack([*(by_lamps - along * geometry[0] * ray.at), by_height])
    facing, pull = (sight * normal).sum(axis=0), (by_ray * normal).sum(axis=0)
    return np.asarray(np.moveaxis(-2 * (facing * by_ray + pull * sight), 0, -1))


def sight_slopes(from_axis: Doubles, sight: Sequence[float]) -> Doubles:
    """Return the shift of lines of sight along x and y per mm of z, (2, ...).

    ``from_axis`` are positions on the rest plane, mm from the body's axis; ``sight`` is the slope per mm of
    distance, and its growth with the square of the distance.
    """
    return np.asarray(-(sight[0] + sight[1] * (from_axis**2).sum(axis=0)) * from_axis, np.float64)


def sight_of(slopes: Doubles) -> Doubles:
    """Return unit vectors down the lines of sight, (3, ...), from their slopes along x and y, (2, ...)."""
    return np.asarray(-np.stack([*slopes, np.ones_like(slopes[0])]) / np.sqrt((slopes**2).sum(axis=0) + 1))


def lamp_light(ray: Ray, lamps: Sequence[float]) -> Doubles:
    """Return the light of the lamps as a share of their mean, at the intersections of rays with the wall."""
    return np.asarray(1 + lamps[0] * ray.at[0] + lamps[1] * ray.at[1])


def shade_terms(x: ArrayLike, y: ArrayLike) -> Doubles:
    """Return the basis functions of the shading, (5, ...); x and y are shares of the radius."""
    u, v = np.asarray(x, np.float64), np.asarray(y, np.float64)
    return np.stack([u, v, u * u, u * v, v * v])


def follow(point: Doubles, sight: Doubles, normal: Doubles, radius: float, closest: float = -np.inf) -> Ray:
    """Return lines of sight from points of mirrors to the wall.

    Points, (3, ...), are mm from the body's axis and above the rest plane; ``sight`` and ``normal`` are unit
    vectors. Outside the wall the result is undefined, unless ``closest`` is given: the lower limit of the
    squared radius minus the squared distance from the axis.
    """
    x, y, z = point
    ray = sight - 2 * (sight * normal).sum(axis=0) * normal
    power, along = np.maximum(radius**2 - x**2 - y**2, closest), x * ray[0] + y * ray[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.sqrt(along**2 + (ray[0] ** 2 + ray[1] ** 2 + _LEVEL) * power)
        distance = power / (along + cosine)
        at, height = np.stack([x + distance * ray[0], y + distance * ray[1]]) / radius, z + distance * ray[2]
        return Ray(ray, at, distance, cosine, height)


def half_tangent(height: Doubles, radius: float) -> Doubles:
    """Return q: the tangent of half the elevation at which the centre sees a height of the wall, mm."""
    return np.asarray(height / (radius + np.hypot(height, radius)))


def level(q: Doubles, curve: ArrayLike, reach: Sequence[float]) -> tuple[Doubles, Doubles]:
    """Return the curve's value and slope; the slope is constant out of reach."""
    polynomial = np.polynomial.polynomial
    powers = np.append(np.asarray(curve, np.float64), 0.0)  # so that a constant curve has a derivative
    held = np.asarray(np.clip(q, reach[0], reach[1]), np.float64)
    slope = np.asarray(polynomial.polyval(held, polynomial.polyder(powers)), np.float64)
    return polynomial.polyval(held, powers) + slope * (q - held), slope


def _follow(place: ArrayLike, normals: ArrayLike, radius: float) -> tuple[Doubles, Doubles, Ray]:
    """Return sights and normals, (3, N, n), and the rays for `wall_light`'s arguments."""
    x, y, z, slope_x, slope_y = np.asarray(place, np.float64)
    normal = np.moveaxis(np.asarray(normals, np.float64), -1, 0)
    sight = sight_of(np.stack([slope_x, slope_y]))
    sight = np.broadcast_to(sight.reshape(3, -1, x.shape[-1]), normal.shape)
    point = np.stack([x + z * slope_x, y + z * slope_y, z])
    return sight, normal, follow(point, sight, normal, radius)


def _meets_wall(ray: Ray, z: Doubles, geometry: Sequence[float]) -> NDArray[np.bool_]:
    """Return whether the two rays that are deflected up and down most by the scatter meet the wall."""
    turned = np.tan(geometry[2])
    out = np.hypot(ray.direction[0], ray.direction[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = ray.direction[2] / out
        upper = z + ray.distance * out * (rise + turned) / (1 - rise * turned)
        lower = z + ray.distance * out * (rise - turned) / (1 + rise * turned)
        meets = (rise * turned < 1) & (rise * turned > -1)
        return np.asarray(meets & (upper <= geometry[1]) & (lower >= 0))
