"""The zenith at which a mirror turns light: it depends on the place and the azimuth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import WallResponse

Doubles = NDArray[np.float64]

_STEPS = 16  # of zenith, in which the first light is looked for
_HALVINGS = 16
_STEEPEST = math.radians(89.0)  # elevation up to which rays are followed


def threshold_zenith(
    response: WallResponse,
    x: ArrayLike,
    y: ArrayLike,
    azimuth: ArrayLike,
    threshold: float = 0.5,
    *,
    z: ArrayLike = 0.0,
) -> Doubles:
    """Return the least zenith at which a pixel gets so much light, radians.

    Parameters
    ----------
    response : WallResponse
    x, y : array_like
        Where the pixel looks on the rest plane, mm.
    azimuth : array_like
        Of the mirror's normal, radians.
    threshold : float
        Share of the pixel's own full light.
    z : array_like
        Height of the mirror above the rest plane, mm.

    Returns
    -------
    ndarray, float64
        Shaped as the arguments broadcast; NaN where no zenith up to 45 degrees gets so much light.
    """
    given = np.broadcast_arrays(*(np.asarray(value, np.float64) for value in (x, y, z, azimuth)))
    shape = given[0].shape
    *place, turn = (value.ravel() for value in given)
    places = np.stack(place)
    dark, light = np.zeros(turn.shape), np.full(turn.shape, np.nan)
    for zenith in np.linspace(0, math.pi / 4, _STEPS + 1)[1:]:
        lit = full_light(response, places, np.full(turn.shape, zenith), turn) >= threshold
        light = np.where(np.isnan(light) & lit, zenith, light)
        dark = np.where(np.isnan(light), zenith, dark)
    for _ in range(_HALVINGS):
        middle = (dark + light) / 2
        lit = full_light(response, places, middle, turn) >= threshold
        dark, light = np.where(lit, dark, middle), np.where(lit, middle, light)
    return np.asarray(((dark + light) / 2).reshape(shape))


def full_light(response: WallResponse, places: Doubles, zenith: Doubles, azimuth: Doubles) -> Doubles:
    """Return shares of the pixels' own full light, (n,), also where part of a ray misses the wall.

    ``places`` are x and y on the rest plane and the mirror's height, (3, n), mm; zenith and azimuth are those
    of its normal. Beyond what is known of the wall it is as bright as at the end of that.
    """
    z = places[2]
    from_axis = places[:2] - np.array(response.axis)[:, np.newaxis]
    lean = -(response.sight[0] + response.sight[1] * (from_axis**2).sum(axis=0)) * from_axis
    sight = -np.stack([*lean, np.ones_like(z)]) / np.sqrt((lean**2).sum(axis=0) + 1)
    across = np.sin(zenith)
    normal = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(zenith)])
    ray = sight - 2 * (sight * normal).sum(axis=0) * normal
    at = from_axis + z * lean
    out = np.sqrt(ray[0] ** 2 + ray[1] ** 2) + 1e-12
    with np.errstate(invalid="ignore"):
        room = response.radius**2 - (at**2).sum(axis=0)
        room = np.where(room > 0, room, np.nan)
        along = (at * ray[:2]).sum(axis=0)
        way = room / (along + np.sqrt(along**2 + out**2 * room))
        share = _share_of_wall(response, z, way * out, np.arctan2(ray[2], out))
        height = z + way * ray[2]
        q = np.clip(height / (response.radius + np.hypot(height, response.radius)), *response.reach)
        lamp = 1 + np.array(response.lamps) @ (at + way * ray[:2]) / response.radius
    level = np.polynomial.polynomial.polyval(q, response.curve)
    return np.asarray(_shade(response, from_axis) * lamp * share * level)


def _share_of_wall(response: WallResponse, z: Doubles, level: Doubles, elevation: Doubles) -> Doubles:
    """Return which share of a ray, spread evenly over its scatter, meets the wall."""
    top = np.minimum(np.arctan2(response.rim - z, level), _STEEPEST)
    bottom = np.arctan2(-z, level)
    spread = max(response.scatter, 1e-9)
    lit = np.minimum(elevation + spread, top) - np.maximum(elevation - spread, bottom)
    return np.asarray(np.clip(lit / (2 * spread), 0, 1))


def _shade(response: WallResponse, from_axis: Doubles) -> Doubles:
    x, y = from_axis / response.radius
    return np.asarray(1 + response.shade @ np.stack([x, y, x * x, x * y, y * y]))
