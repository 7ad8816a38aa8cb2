"""How bright a mirror inside a lit cylinder looks: the formula of `mirrorskin.io.WallResponse`.

A line of sight s is mirrored at the normal n and goes on to the wall of radius R, which it meets at height h;
P is the place on the mirror and room what is left to the wall there ::

    r = s - 2 (s . n) n    A = Px rx + Py ry    c = sqrt(A^2 + (rx^2 + ry^2) room)    way = room / (A + c)
    m = (P + way r) / R across the axis    h = z + way rz    q = h / (R + sqrt(h^2 + R^2))

q is the tangent of half the elevation at which the centre sees that height: 0 at the horizon, and the zenith
of a mirror at the centre that shows it is pi/4 - atan(q). The light is what the wall gives there ::

    light = (1 + lamp_x mx + lamp_y my) (curve[0] + curve[1] q + curve[2] q^2 ...)

`mirrorskin.kernels.normals` uses the same formula.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]
Doubles = NDArray[np.float64]


class _Ray(NamedTuple):
    """Where a mirrored line of sight goes, each of the samples' shape.

    ``sight`` and ``ray`` are unit vectors in three parts; ``at`` is where it meets the wall, mm across the
    axis, after ``way`` mm; ``cosine`` is its cosine to the wall's normal times the radius.
    """

    sight: Doubles
    ray: Doubles
    at: Doubles
    cosine: Doubles
    way: Doubles
    height: Doubles
    q: Doubles


def wall_light(place: ArrayLike, normals: ArrayLike, geometry: Sequence[float], lamps: Sequence[float],
               curve: ArrayLike, reach: Sequence[float]) -> tuple[Doubles, NDArray[np.bool_]]:  # fmt: skip
    """Return how bright mirrors look, (N, n), in shares of full light, and where that is known.

    It is known where q is within reach and the two rays meet the wall that the scatter turns up and down
    most. Out of reach the curve goes on straight.

    Parameters
    ----------
    place : (5, n) or (5, N, n), x and y on the rest plane from the body's axis, mm; height z of the mirror,
        mm; by how much the line of sight moves along x and y for each millimetre of z
    normals : (N, n, 3), unit vectors in the body's frame
    geometry : radius of the body and height of the wall, mm; half-angle of the scatter, radians
    lamps : by what share of the mean the lamps light the side at x and at y more
    curve : polynomial in q, from the lowest power on
    reach : lowest and highest q at which the curve is known
    """
    ray = _follow(place, normals, geometry[0])
    lamp = 1 + (lamps[0] * ray.at[0] + lamps[1] * ray.at[1]) / geometry[0]
    light = lamp * _level(ray.q, curve, reach)[0]
    return light, _within(ray, np.asarray(place, np.float64)[2], geometry, reach)


def light_slopes(place: ArrayLike, normals: ArrayLike, geometry: Sequence[float], lamps: Sequence[float],
                 curve: ArrayLike, reach: Sequence[float] = (-np.inf, np.inf)) -> Doubles:  # fmt: skip
    """Return how the light of `wall_light` changes with the normals' three parts, (N, n, 3).

    By the formula as it stands, which takes the normals for unit vectors: only the parts across a normal
    have a meaning.
    """
    ray = _follow(place, normals, geometry[0])
    level, steepness = _level(ray.q, curve, reach)
    lamp = 1 + (lamps[0] * ray.at[0] + lamps[1] * ray.at[1]) / geometry[0]
    by_height = (1 - ray.q**2) ** 2 / (2 * geometry[0] * (1 + ray.q**2))
    by_height *= lamp * steepness
    # A ray that turns by dr meets the wall way (dr - r (at . dr) / c) further on.
    towards = lamps[0] * ray.ray[0] + lamps[1] * ray.ray[1]
    along = (level / geometry[0] * towards + by_height * ray.ray[2]) / ray.cosine
    by_ray = ray.way * np.stack(
        [
            level / geometry[0] * lamps[0] - along * ray.at[0],
            level / geometry[0] * lamps[1] - along * ray.at[1],
            by_height,
        ]
    )
    normal = np.moveaxis(np.asarray(normals, np.float64), -1, 0)
    facing, pull = (ray.sight * normal).sum(axis=0), (by_ray * normal).sum(axis=0)
    return np.asarray(np.moveaxis(-2 * (facing * by_ray + pull * ray.sight), 0, -1))


def reflect(sight: Doubles, normal: Doubles) -> Doubles:
    """Return where lines of sight go from mirrors: r of unit vectors s and n, each (3, ...)."""
    return np.asarray(sight - 2 * (sight * normal).sum(axis=0) * normal)


def way_to_wall(along: Doubles, across: Doubles, room: Doubles) -> tuple[Doubles, Doubles]:
    """Return how far it is to the wall, and the ray's cosine to the wall's normal times the radius.

    ``along`` is A, ``across`` the square of the ray's part across the axis, ``room`` the radius squared less
    the place squared.
    """
    cosine = np.sqrt(along**2 + across * room)
    return room / (along + cosine), cosine


def _follow(place: ArrayLike, normals: ArrayLike, radius: float) -> _Ray:
    """Follow lines of sight by way of mirrors to the wall."""
    x, y, z, slope_x, slope_y = np.asarray(place, np.float64)
    normal = np.moveaxis(np.asarray(normals, np.float64), -1, 0)
    x, y = x + z * slope_x, y + z * slope_y
    sight = np.stack([-slope_x, -slope_y, -np.ones_like(slope_x)]) / np.sqrt(slope_x**2 + slope_y**2 + 1)
    sight = np.broadcast_to(sight.reshape(3, -1, x.shape[-1]), normal.shape)
    ray = reflect(sight, normal)
    room, along = radius**2 - x**2 - y**2, x * ray[0] + y * ray[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        way, cosine = way_to_wall(along, ray[0] ** 2 + ray[1] ** 2, room)
        at, height = np.stack([x + way * ray[0], y + way * ray[1]]), z + way * ray[2]
        return _Ray(sight, ray, at, cosine, way, height, height / (radius + np.hypot(height, radius)))


def _level(q: Doubles, curve: ArrayLike, reach: Sequence[float]) -> tuple[Doubles, Doubles]:
    """Return the curve's value and slope, which stays out of reach what it is at the end of it."""
    polynomial = np.polynomial.polynomial
    powers = np.append(np.asarray(curve, np.float64), 0.0)  # of which even a constant has a slope
    held = np.asarray(np.clip(q, reach[0], reach[1]), np.float64)
    slope = np.asarray(polynomial.polyval(held, polynomial.polyder(powers)), np.float64)
    return polynomial.polyval(held, powers) + slope * (q - held), slope


def _within(ray: _Ray, z: Doubles, geometry: Sequence[float], reach: Sequence[float]) -> NDArray[np.bool_]:
    """Tell which samples lie within the range in which the light is known."""
    turned = np.tan(geometry[2])
    out = np.hypot(ray.ray[0], ray.ray[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = ray.ray[2] / out
        upper = z + ray.way * out * (rise + turned) / (1 - rise * turned)
        lower = z + ray.way * out * (rise - turned) / (1 + rise * turned)
        meets = (rise * turned < 1) & (rise * turned > -1) & (upper <= geometry[1]) & (lower >= 0)
        return np.asarray(meets & (ray.q >= reach[0]) & (ray.q <= reach[1]))
