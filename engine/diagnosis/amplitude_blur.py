"""The blur of a lens, by what it takes away from the strength of a signal whose direction changes.

A lens with a Gaussian point spread of variance b^2, pixels^2, averages a signal s u of strength s and unit
direction u: fringes of a phase, or light in proportion to normals. To second order it shows s u + (b^2 / 2)
laplace(s u), whose strength is s (1 - (b^2 / 2) |grad u|^2), and whose direction is wrong by (b^2 / 2) times
the part of laplace(u) across it. The one determines b, the other is its error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import CLEAR_Z_SCORE, fit_clipped

GRID_LINES = 48
"""Lines of pixels along a side that are used."""
MIN_PIXELS = 400
"""Least number of pixels that determine a blur."""
MIN_BLUR = 0.4
"""Least standard deviation of a point spread that is reported, pixels."""

_SIDE_Z_SCORE = 2.0  # standard errors from which on the blur of a side of the picture is one


def with_blur(
    sigma: NDArray[np.float32], vectors: Sequence[NDArray[np.floating]], strength: NDArray[np.floating]
) -> NDArray[np.float32]:
    """Return standard deviations of directions, (H, W) radians, with that because of blur.

    ``vectors`` are the components of a signal, (H, W) each and of any length, NaN where unknown; ``strength``
    is that of the signal, (H, W).
    """
    variance = find_blur(vectors, strength)
    if variance == 0:
        return sigma
    reach = max(1, round(2 * math.sqrt(variance)))
    length = np.sqrt(np.sum([part * part for part in vectors], axis=0))
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = [np.asarray(part / length, np.float32) for part in vectors]
    kernel = np.zeros((2 * reach + 1, 2 * reach + 1), np.float32)
    kernel[[0, reach, reach, -1], [reach, 0, -1, reach]] = 1 / reach**2
    kernel[reach, reach] = -4 / reach**2
    bent = [cv2.filter2D(part, -1, kernel, borderType=cv2.BORDER_REPLICATE) for part in direction]
    along = np.sum([part * other for part, other in zip(bent, direction, strict=True)], axis=0)
    square = np.sum([part**2 for part in bent], axis=0) - along**2
    square = np.maximum(square, 0)
    finite = np.isfinite(square)
    size = 2 * reach + 1, 2 * reach + 1
    total, coverage = (
        cv2.blur(part.astype(np.float32), size) for part in (np.where(finite, square, 0), finite)
    )
    mean = np.divide(total, coverage, out=np.zeros_like(total), where=coverage > 0)
    return np.asarray(np.hypot(sigma, np.float32(variance / 2) * np.sqrt(mean)), np.float32)


def find_blur(vectors: Sequence[NDArray[np.floating]], strength: NDArray[np.floating]) -> float:
    """Return the variance of the point spread, pixels^2; 0 if it is not significant.

    The logarithm of the strength is fitted by a quadratic of the place, as of uneven light, and the square
    of the gradient of the direction.
    """
    rows, columns = strength.shape
    if min(rows, columns) < 3:
        return 0.0
    thin = max(1, math.isqrt(rows * columns) // GRID_LINES)
    down, right = np.arange(1, rows - 1, thin), np.arange(1, columns - 1, thin)

    def look(by_rows: int, by_columns: int) -> Doubles:
        at = np.ix_(down + by_rows, right + by_columns)
        components = np.stack([part[at] for part in vectors]).astype(np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(components / np.sqrt(np.sum(components**2, axis=0)))

    across, upright = (
        look(*first) - look(*second) for first, second in (((0, 1), (0, -1)), ((1, 0), (-1, 0)))
    )
    turning = np.sum(across**2 + upright**2, axis=0) / 4
    level = strength[np.ix_(down, right)].astype(np.float64)
    usable = np.isfinite(turning) & (level > 0) & np.isfinite(level)
    if np.count_nonzero(usable) < MIN_PIXELS:
        return 0.0
    y, x = (
        np.broadcast_to(positions, usable.shape)[usable]
        for positions in np.ix_(2 * down / (rows - 1) - 1, 2 * right / (columns - 1) - 1)
    )
    turning, values = turning[usable], np.log(level[usable])
    terms = np.stack([turning, np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    variance, error = _fit(terms, values)
    if not variance > max(CLEAR_Z_SCORE * error, MIN_BLUR**2):
        return 0.0
    # Reflectance that changes with the place may look like blur somewhere, but not on all sides.
    sides = (_fit(terms[half], values[half]) for half in (x < 0, x >= 0, y < 0, y >= 0))
    clear = all(side > max(variance / 2, _SIDE_Z_SCORE * its_error) for side, its_error in sides)
    return variance if clear else 0.0


def _fit(terms: Doubles, values: Doubles) -> tuple[float, float]:
    """Return the variance of the point spread by the first of some terms, and its standard error."""
    result = fit_clipped(terms, values)
    if result is None:
        return 0.0, math.inf
    fit, inverse, residual, kept = result
    return -2 * float(fit[0]), 2 * math.sqrt(inverse[0, 0] * float(np.mean(residual[kept] ** 2)))
