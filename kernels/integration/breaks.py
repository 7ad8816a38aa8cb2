"""Removal of links where the surface is discontinuous: ``breaks.cl`` in NumPy with float64.

The confidence of a link depends on how well its two pixels determine its slope. With s the slopes, a the
cosines of the normals to the line of sight, and t the evidence of a tear next to it, the variance of the
slope of the link is about ::

    v = n^2 (1 / a_i^4 + 1 / a_j^4) / 2 + (bend (s_i - s_j))^2 + (tear t)^2

with n the noise of the normals. Slopes of a surface seen obliquely are uncertain; where they differ, there is
a bend or a cliff between them; if the sum of four links around a corner is not zero, one of them crosses a
cliff. The heights u minimise ::

    sum of (n^2 / v) w f(r),      f' = 2 r / (1 + k m^2)^2,      r = (u_j - u_i) / p - s

with w the weight of the link without all this, p the pixel size, k the sharpness, and m the excess of |r|
over slack |s_i - s_j|, because a bend may be anywhere between the pixels; without slack f = r^2 / (1 + k
r^2). For fixed weights (n^2 / v) w / (1 + k m^2)^2, this is a least-squares problem that bounds the sum from
above and touches it, since f is concave in r^2; so its solution decreases the sum.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Array = NDArray[Any]
Floats = NDArray[np.float32]
Flags = NDArray[np.uint8]

RIGHT, DOWN = 1, 2
"""Flags of a pixel: it has a link to the right, or down."""


def breaks_curl(flags: Flags, slope_x: Floats, slope_y: Floats, width: float, height: float) -> Doubles:
    """Return the sum of the four links around a corner of pixels, as a slope.

    The corner is at the lower right of each pixel; 0 if a link is missing. Slopes are to the right and *down*
    the picture; ``width`` and ``height`` of a pixel are relative to their geometric mean.
    """
    curl = np.zeros(flags.shape)
    across = (slope_x[:, 1:].astype(np.float64) + slope_x[:, :-1]) / 2
    along = (slope_y[1:].astype(np.float64) + slope_y[:-1]) / 2
    right, down = flags[:, :-1] & RIGHT != 0, flags[:-1] & DOWN != 0
    closed = right[:-1] & right[1:] & down[:, 1:] & down[:, :-1]
    loop = width * (across[:-1] - across[1:]) + height * (along[:, 1:] - along[:, :-1])
    curl[:-1, :-1] = np.where(closed, loop, 0.0)
    return curl


def breaks_sum(values: Floats, reach: int, downwards: bool) -> Doubles:
    """Return sums over 2 reach + 1 pixels centred on each pixel, along rows or columns."""
    columns = values.astype(np.float64) if downwards else values.T.astype(np.float64)
    ring = np.pad(columns, ((reach, reach), (0, 0)))
    sums = sum((ring[i : i + len(columns)] for i in range(2 * reach + 1)), np.zeros(columns.shape))
    return sums if downwards else sums.T


def breaks_spread(curl: Floats, sums: Floats, reach: int, noise: float, wide: bool) -> Doubles:
    """Return the evidence of a tear at each corner, in excess of the noise.

    ``sums`` are sums of the curl over squares with sides of 2 reach + 1 corners. They are near zero where the
    curl alternates along a slanted crease. If ``wide``, the evidence is |sum| / (2 reach + 1); otherwise it
    is the geometric mean of that and |curl|, which is better localised.
    """
    mean = np.abs(sums.astype(np.float64)) / (2 * reach + 1)
    tears = np.zeros(curl.shape)
    tears[:-1, :-1] = np.maximum((mean if wide else np.sqrt(np.abs(curl) * mean)) - noise, 0.0)[:-1, :-1]
    return tears


def breaks_trust(right: Floats, down: Floats, slope_x: Floats, slope_y: Floats, facing: Floats, tears: Floats,
                 noise: float, bend: float, tear: float,
                 min_trust: float) -> tuple[Doubles, ...]:  # fmt: skip
    """Return weights of the links to the right and down, and their slopes.

    ``facing`` are the cosines a, ``right`` and ``down`` the weights w, ``noise`` is n^2, and n^2 / v is at
    least ``min_trust``. A link's slope is the mean of both: a crease may be anywhere between the pixels.
    """
    along_x = _trust(right, slope_x, facing, tears, noise, bend, tear, min_trust)
    along_y = _trust(down.T, slope_y.T, facing.T, tears.T, noise, bend, tear, min_trust)
    return along_x[0], along_y[0].T, along_x[1], along_y[1].T


def _trust(
    link: Floats,
    slope: Floats,
    facing: Floats,
    tears: Floats,
    noise: float,
    bend: float,
    tear: float,
    min_trust: float,
) -> tuple[Doubles, Doubles]:
    w, s, a, t = (map_.astype(np.float64) for map_ in (link, slope, facing, tears))
    s_next, a_next = np.roll(s, -1, 1), np.roll(a, -1, 1)
    torn = np.maximum(t, np.roll(t, 1, 0))
    v = noise * (a**-4 + a_next**-4) / 2 + (bend * (s - s_next)) ** 2 + (tear * torn) ** 2
    return w * np.maximum(noise / v, min_trust), (s + s_next) / 2


def breaks_links(weight_x: Floats, weight_y: Floats, rise_x: Floats, rise_y: Floats, slope_x: Floats,
                 slope_y: Floats, held: Floats, heights: Floats, width: float, height: float, slack: float,
                 sharpness: float, max_square: float) -> tuple[Doubles, Doubles, Doubles, float]:  # fmt: skip
    """Return links to the right and down, the right-hand side of the equations, and the broken links.

    Links whose k m^2 exceeds ``max_square`` are cut. ``held`` is the right-hand side of known heights. Each
    link adds k m^2 / (1 + k m^2) to the number of broken links; the kernel writes one sum per work-item.
    """
    u = heights.astype(np.float64)
    x = _links(weight_x, rise_x, slope_x, u, width, slack, sharpness, max_square)
    y = _links(weight_y.T, rise_y.T, slope_y.T, u.T, height, slack, sharpness, max_square)
    return x[0], y[0].T, x[1] + y[1].T + held, x[2] + y[2]


def _links(
    weight: Floats,
    rise: Floats,
    slope: Floats,
    u: Doubles,
    size: float,
    slack: float,
    k: float,
    max_square: float,
) -> tuple[Doubles, Doubles, float]:
    bend = np.abs(np.roll(slope, -1, 1) - slope)
    miss = np.maximum(np.abs((np.roll(u, -1, 1) - u) / size - rise) - slack * bend, 0.0)
    square = k * miss**2
    link = np.where(square > max_square, 0.0, weight / (1 + square) ** 2)
    pull = size * link * rise
    return link, np.roll(pull, 1, 1) - pull, float(np.sum(np.where(weight > 0, square / (1 + square), 0.0)))
