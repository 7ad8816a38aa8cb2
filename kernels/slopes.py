"""Slopes and their weights from normals: what ``slopes.cl`` computes, in NumPy with float64.

`mirrorskin.engine.rotation.normals_to_height.find_slopes` says why; this is the same for one turn of a known
tilt, in two steps as kernels take them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Doubles = NDArray[np.float64]

_STEEPEST = math.cos(math.radians(80.0))
_WIDEST = 0.5**2
_AROUND = 2
_LEAST = float(np.finfo(np.float32).tiny)


def slopes_find(least: float, vectors: Array, sigma: Array, contact: Array) -> tuple[Doubles, ...]:
    """Return the slopes, NaN where nothing is known, and the squares of the normal's parts, 0 there.

    ``least`` is the squared sine of the tilt.
    """
    x, y, z = np.moveaxis(vectors.astype(np.float64), -1, 0)
    with np.errstate(invalid="ignore"):
        known = (contact != 0) & (z > 0) & (sigma > 0) & (sigma < np.inf)
    x, y, z = (np.where(known, one, other) for one, other in ((x, 0), (y, 0), (np.maximum(z, _STEEPEST), 1)))
    _, turned = _unsure(least, x * x + y * y, np.where(known, sigma, 0.0) ** 2)
    slopes = (np.where(known, -np.exp(turned / 2) * n / z, np.nan) for n in (x, y))
    return (*slopes, x * x, y * y)


def slopes_weigh(least: float, lowest: float, highest: float, sigma: Array, dz_dx: Doubles,
                 squares_x: Doubles, squares_y: Doubles) -> tuple[Doubles, Doubles]:  # fmt: skip
    """Return inverse variances of the slopes along x and y, within bounds; 0 where nothing is known."""
    known = np.isfinite(dz_dx)
    variance = np.where(known, sigma.astype(np.float64), 1.0) ** 2
    flat = squares_x + squares_y
    steep = 1 / np.maximum(1 - flat, _STEEPEST**2)
    share, turned = _unsure(least, flat, variance)
    along = share * variance * steep**2 + flat * steep * turned**2 / 2
    across = (1 - share) * variance * steep
    x, y = (_sum_around(one) + _LEAST for one in (squares_x, squares_y))
    east = np.clip(0.5 + (x / (x + y) - 0.5) * np.exp(2 * turned), 0, 1)
    variances = east * along + (1 - east) * across, (1 - east) * along + east * across
    weight_x, weight_y = (np.where(known, np.clip(1 / one, lowest, highest), 0) for one in variances)
    return weight_x, weight_y


def _unsure(least: float, flat: Doubles, variance: Doubles) -> tuple[Doubles, Doubles]:
    """Return the share of an angular error's variance along the meridian, and the azimuth's variance."""
    outside = np.maximum(flat, least)
    share = 0.5 * least / outside
    return share, np.minimum((1 - share) * variance / outside, _WIDEST)


def _sum_around(values: Doubles) -> Doubles:
    """Return the sums over squares of 5 x 5 pixels, 0 beyond the picture."""
    rows, columns = values.shape
    wide = np.pad(values, _AROUND)
    size = 2 * _AROUND + 1
    return np.asarray(sum(wide[r : r + rows, c : c + columns] for r in range(size) for c in range(size)))
