"""Slopes and their weights from normals: ``slopes.cl`` in NumPy with float64.

See `mirrorskin.engine.integration.normals_to_height.find_slopes` for the variances and the bias.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Array = NDArray[Any]

_MIN_COSINE = math.cos(math.radians(80.0))  # cosine of the largest zenith whose slope is used
_MAX_AZIMUTH_VARIANCE = 0.5**2  # radians^2: limit of the variance of an azimuth
_WINDOW_REACH = 2  # pixels on each side, in the window for the direction of the meridian
_TINY = float(np.finfo(np.float32).tiny)


def slopes_find(flat_limit: float, vectors: Array, sigma: Array, contact: Array) -> tuple[Doubles, ...]:
    """Return the slopes, NaN without a normal, and the squares of the normal's components, 0 there.

    ``flat_limit`` is the squared sine of the tilt; if it is infinite (unknown), errors are isotropic.
    """
    return find(flat_limit, vectors.astype(np.float64), sigma.astype(np.float64), contact)


def slopes_weigh(flat_limit: float, lowest: float, highest: float, sigma: Array, dz_dx: Doubles,
                 squares_x: Doubles, squares_y: Doubles) -> tuple[Doubles, Doubles]:  # fmt: skip
    """Return inverse variances of the slopes along x and y, within bounds; 0 without a normal."""
    return weigh(flat_limit, (lowest, highest), sigma.astype(np.float64), dz_dx, squares_x, squares_y)


def find(
    flat_limit: float, vectors: Array, sigma: Array, contact: Array
) -> tuple[Array, Array, Array, Array]:
    """Return the result of `slopes_find` in the precision of the arguments."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    with np.errstate(invalid="ignore"):
        valid = (contact != 0) & (z > 0) & (sigma > 0) & (sigma < np.inf)
    x, y, z = (
        np.where(valid, component, other)
        for component, other in ((x, 0), (y, 0), (np.maximum(z, _MIN_COSINE), 1))
    )
    _, turned = _unsure(flat_limit, x * x + y * y, np.where(valid, sigma, 0) ** 2)
    longer = np.where(valid, -np.exp(turned / 2) / z, np.nan)
    return longer * x, longer * y, x * x, y * y


def weigh(
    flat_limit: float,
    bounds: tuple[float, float],
    sigma: Array,
    dz_dx: Array,
    squares_x: Array,
    squares_y: Array,
) -> tuple[Array, Array]:
    """Return the result of `slopes_weigh` in the precision of the arguments.

    The direction of the meridian is averaged over the surroundings: if it depended on the noise of the pixel
    itself, slopes shortened and lengthened by noise would get different weights, and the weighted mean would
    be biased. Squares of components are averaged, because they are equal on both sides of a ridge; noise of
    the azimuth reduces the contrast of their means by exp(-2 variance). An error e of the azimuth also
    shortens the slope by e^2 / 2.
    """
    valid = np.isfinite(dz_dx)
    variance = np.where(valid, sigma, 1) ** 2
    flat = squares_x + squares_y
    steep = 1 / np.maximum(1 - flat, _MIN_COSINE**2)
    fraction, turned = _unsure(flat_limit, flat, variance)
    along = fraction * variance * steep**2 + flat * steep * turned**2 / 2
    across = (1 - fraction) * variance * steep
    x, y = (sum_around(values) + _TINY for values in (squares_x, squares_y))
    east = np.clip(0.5 + (x / (x + y) - 0.5) * np.exp(2 * turned), 0, 1)
    variances = east * along + (1 - east) * across, (1 - east) * along + east * across
    weight_x, weight_y = (np.where(valid, np.clip(1 / values, *bounds), 0) for values in variances)
    return weight_x, weight_y


def _unsure(flat_limit: float, flat: Array, variance: Array) -> tuple[Array, Array]:
    """Return the share of the angular variance along the meridian, and the azimuth's variance."""
    fraction = 0.5 * np.minimum(flat_limit / np.maximum(flat, _TINY), 1)
    return fraction, np.minimum(
        (1 - fraction) * variance / np.maximum(flat, flat_limit), _MAX_AZIMUTH_VARIANCE
    )


def sum_around(values: Array) -> Array:
    """Return the sums over squares of 5 x 5 pixels, 0 beyond the picture."""
    import cv2

    size = 2 * _WINDOW_REACH + 1
    return cv2.boxFilter(values, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)
