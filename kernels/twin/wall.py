"""The lit wall in the mirror sheet: ``wall.cl`` in plain NumPy with float64.

The body is a cylinder about the z axis; z = 0 is the sheet's rest plane, and the wall surrounds it from there
to its rim. A line of sight is reflected at the sheet's normal n, and spread slightly by the sheet's flakes;
each of its rays meets the wall or misses it ::

    mirrored = d - 2 (d . n) n          |place + t ray| = radius across the axis

With a = x ray_x + y ray_y (across the axis), the ray's cosine to the wall's normal is c / radius, and the
inverse of its length t is q, both without cancellation and without division by the ray ::

    c = sqrt(a^2 + (ray_x^2 + ray_y^2) room)      q = 1 / t = (a + c) / room      room = radius^2 - x^2 - y^2

so that it passes below the rim where ray_z <= (rim - z) q, and above the rest plane where ray_z >= -z q.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Floats = NDArray[np.float64]

_TINY = 1e-20
_MIN_INVERSE = 1e-6  # inverse of a distance that no ray travels, mm
_HARD = 1e30


def wall_light(sheet: Array, places: Array, rays: Array, table: Array, radius: float, rim: float,
               gap: float, index: float, scatter: float, fade: float, asymmetry_x: float,
               asymmetry_y: float) -> Array:  # fmt: skip
    """Return the share of the light, relative to radiance 1 where lamps are brightest, seen in the sheet.

    Light from beyond the rim or below the rest plane, light that is totally reflected at the body's side, and
    pixels outside the body are dark.

    Parameters
    ----------
    sheet : (3, P), height of the sheet, mm, and its slopes along x and y, at the points that the pixels see
    places : (2, P) or (4, P), x and y of each pixel on the rest plane, mm; for oblique lines of sight also
        their shift along x and y per mm of z
    rays : (S, 3), spread of a reflected ray by the sheet: components of unit vectors along that ray, along
        the direction in which its height at the wall changes fastest, and across both
    table : (rows + 2, columns + 2), radiance of the wall, unrolled as seen from inside: rows from the rim
        down to the rest plane, columns counter-clockwise from azimuth -pi to pi. Samples are in the middle of
        ``rows`` x ``columns`` equal tiles, with one more beyond each edge for the interpolation
    radius, rim, gap : radius of the body, height of the rim above the rest plane, and width of the gap
        between body and wall, mm
    index : refractive index of the body
    scatter : largest angle between a ray and the reflected one, radians; the kernel uses it to skip dark
        pixels
    fade : angle over which a ray fades at the rim and at the rest plane, radians, which avoids visible steps
        if there are few rays; 0 for hard edges
    asymmetry_x, asymmetry_y : relative increase of the wall's brightness towards x and y
    """
    z, slope_x, slope_y = sheet.astype(np.float64)
    view_x, view_y = places[2:].astype(np.float64) if len(places) == 4 else np.zeros((2, z.size))
    x, y = places[0] + z * view_x, places[1] + z * view_y
    inside = x * x + y * y < radius * radius
    x, y = np.where(inside, x, 0.0), np.where(inside, y, 0.0)

    normal = _unit(np.stack([-slope_x, -slope_y, np.ones_like(z)]))
    sight = _unit(np.stack([-view_x, -view_y, -np.ones_like(z)]))
    mirrored = sight - 2 * (sight * normal).sum(axis=0) * normal
    upwards = _steepest(x, y, mirrored, radius)
    aside = np.cross(mirrored, upwards, axis=0)

    total = np.zeros_like(z)
    for along, up, across in rays.astype(np.float64):
        ray = along * mirrored + up * upwards + across * aside
        cosine, per_way = _leave(x, y, ray, radius)
        at_x, at_y, per_way, transmitted = _cross_gap(x, y, ray, cosine, per_way, radius, gap, index)
        transmitted = transmitted * _seen(z, ray, cosine, per_way, radius, rim, fade)
        height = np.clip(z + ray[2] / np.maximum(per_way, _MIN_INVERSE), 0, rim)
        transmitted = transmitted * _look_up(table, height / rim, np.arctan2(at_y, at_x))
        total += transmitted * (1 + (asymmetry_x * at_x + asymmetry_y * at_y) / (radius + gap))
    total /= len(rays) * (1 + np.hypot(asymmetry_x, asymmetry_y))
    return np.where(inside, total, 0).astype(np.float32)


def _leave(x: Floats, y: Floats, ray: Floats, radius: float) -> tuple[Floats, Floats]:
    """Return a ray's cosine to the cylinder that it leaves, times the radius, and its inverse length."""
    square = radius * radius - x * x - y * y
    along = x * ray[0] + y * ray[1]
    cosine = np.sqrt(along * along + (ray[0] ** 2 + ray[1] ** 2) * square + _TINY)
    return cosine, (along + cosine) / square


def _steepest(x: Floats, y: Floats, ray: Floats, radius: float) -> Floats:
    """Return the unit vector across a ray along which its height at the wall rises fastest.

    A rotation of the ray moves the point where it meets the wall, of normal m, by t turn - t (m . turn / m .
    ray) ray: its height rises fastest along (m . ray) z - ray_z m. If there is no such direction, any
    direction is returned.
    """
    cosine, per_way = _leave(x, y, ray, radius)
    distance = 1 / np.maximum(per_way, _MIN_INVERSE)
    m_x, m_y = (x + distance * ray[0]) / radius, (y + distance * ray[1]) / radius
    steepest = np.stack([-ray[2] * m_x, -ray[2] * m_y, cosine / radius])
    determined = (steepest**2).sum(axis=0) > 1e-12
    return _unit(np.where(determined, steepest, np.array([[1.0], [0.0], [0.0]])))


def _cross_gap(x: Floats, y: Floats, ray: Floats, cosine: Floats, per_way: Floats, radius: float,
               gap: float, index: float) -> tuple[Floats, Floats, Floats, Floats]:  # fmt: skip
    """Return the intersection of a ray with the wall, an equivalent inverse length, and the transmission.

    A straight ray of the equivalent length has the same rise. Without a gap the transmission is 1. With a
    gap, the ray is refracted at the side of the body (Snell) and partly reflected there (Fresnel,
    unpolarised), and crosses the gap.
    """
    distance = 1 / np.maximum(per_way, _MIN_INVERSE)
    at_x, at_y = x + distance * ray[0], y + distance * ray[1]
    if gap == 0:
        return at_x, at_y, per_way, np.ones_like(x)
    cos_in = cosine / radius
    cos_out = np.sqrt(np.maximum(1 - index**2 * (1 - cos_in**2), 0))
    across, within = (index * cos_in + cos_out) ** 2, (cos_in + index * cos_out) ** 2
    transmitted = 2 * index * cos_in * cos_out * (1 / across + 1 / within)
    bend = (cos_out - index * cos_in) / radius
    air_x, air_y = index * ray[0] + bend * at_x, index * ray[1] + bend * at_y
    outer = (radius + gap) ** 2 - radius**2
    towards = radius * cos_out
    more = outer / (towards + np.sqrt(towards**2 + (air_x**2 + air_y**2) * outer + _TINY))
    return at_x + more * air_x, at_y + more * air_y, 1 / (distance + index * more), transmitted


def _seen(
    z: Floats, ray: Floats, cosine: Floats, per_way: Floats, radius: float, rim: float, fade: float
) -> Floats:
    """Return 1 for a ray below the rim and above the rest plane, 0 beyond, with a fade in between."""
    edge = (rim - z) * per_way
    below = (edge - ray[2]) * cosine / np.hypot(cosine, radius * edge)  # the angle to the rim
    above = ray[2] + z * per_way  # and to the rest plane
    sharpness = 1 / fade if fade > 0 else _HARD
    return np.asarray(np.clip(0.5 + sharpness * np.minimum(below, above), 0, 1))


def _look_up(table: Array, height: Floats, azimuth: Floats) -> Floats:
    """Return the wall's radiance, bilinear between the table's samples; height is a share of the rim's."""
    rows, columns = table.shape[0] - 2, table.shape[1] - 2
    row = rows * (1 - height) + 0.5
    column = columns * (azimuth / (2 * np.pi) + 0.5) + 0.5
    top, west = row.astype(np.intp), column.astype(np.intp)
    down, east = row - top, column - west
    upper = (1 - east) * table[top, west] + east * table[top, west + 1]
    lower = (1 - east) * table[top + 1, west] + east * table[top + 1, west + 1]
    return np.asarray((1 - down) * upper + down * lower)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.sqrt((vectors**2).sum(axis=0)))
