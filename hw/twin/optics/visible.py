"""Which mirrors show the wall: the zenith that turns a pixel light depends on its place and its azimuth."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.hw.twin.body import Body
from mirrorskin.io.types import Floats

_HALVINGS = 60
_TINY = 1e-30  # a ray that is totally reflected never gets across


def visible_zenith(body: Body, x: ArrayLike, y: ArrayLike, azimuth: ArrayLike) -> tuple[Floats, Floats]:
    """Return the zeniths between which a mirror shows the wall to a camera that looks straight down.

    The mirror lies on the rest plane, and nothing scatters. Towards the azimuth the body's side is ::

        way = c - b,    b = x cos(azimuth) + y sin(azimuth),    c = sqrt(b^2 + radius^2 - x^2 - y^2)

    away, and the ray leans by twice the zenith t: it passes below the rim from ``t = atan2(way, height) / 2``
    on, and above the horizon up to 45 degrees. With an air gap it must also leave the body: it meets the side
    at an angle of cosine sin(2t) c / radius, and is totally reflected unless ::

        sin(2t) > sqrt(1 - 1 / index^2) radius / c

    Just beyond that it leaves steeply and climbs over the rim within the gap, by an angle that is found by
    halving.

    Parameters
    ----------
    body : Body
    x, y : array_like
        Place of the mirror, mm.
    azimuth : array_like
        Of its normal, radians.

    Returns
    -------
    lower, upper : ndarray, float64
        Radians, shaped as the arguments broadcast; NaN where no mirror shows the wall, and outside the body.
    """
    x, y, azimuth = np.broadcast_arrays(
        np.asarray(x, float), np.asarray(y, float), np.asarray(azimuth, float)
    )
    room = body.radius**2 - x * x - y * y
    along = x * np.cos(azimuth) + y * np.sin(azimuth)
    # Outside the body there is no room: NaN from here on.
    cosine = np.sqrt(along * along + np.where(room > 0, room, np.nan))
    way = room / (cosine + along)
    lower = np.arctan2(way, body.height) / 2
    if body.air_gap > 0:
        lower = _leaves(body, way, cosine / body.radius, lower)
    return lower, np.where(np.isnan(lower), np.nan, math.pi / 4)


def _leaves(body: Body, way: Floats, cosine: Floats, lower: Floats) -> Floats:
    """Return the least zenith at which a ray leaves the body below the rim and meets the wall below it, too.

    ``cosine`` is that of a level ray to the side's normal. A higher zenith only takes the ray lower.
    """
    least = math.sqrt(1 - 1 / body.index**2) / cosine
    dark = np.maximum(lower, np.arcsin(np.minimum(least, 1)) / 2)
    light = np.full_like(dark, math.pi / 4)
    for _ in range(_HALVINGS):
        middle = (dark + light) / 2
        below = _height_at_wall(body, way, cosine, middle) <= body.height
        dark, light = np.where(below, dark, middle), np.where(below, middle, light)
    return np.where(least < 1, light, np.nan)


def _height_at_wall(body: Body, way: Floats, cosine: Floats, zenith: Floats) -> Floats:
    """Return how high a ray meets the wall across the gap."""
    level, rise = np.sin(2 * zenith), np.cos(2 * zenith)
    out = np.sqrt(np.maximum(1 - body.index**2 * (1 - (level * cosine) ** 2), 0))
    spread = np.maximum(1 - (body.index * rise) ** 2, 0)  # square of the refracted ray's level part
    room = (body.radius + body.air_gap) ** 2 - body.radius**2
    towards = body.radius * out
    across = room / (towards + np.sqrt(towards**2 + spread * room + _TINY))
    return np.asarray(rise * (way / level + body.index * across))
