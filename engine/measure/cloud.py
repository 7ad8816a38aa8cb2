"""What forms are fitted to, and what is told of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.measure.quantity import Quantity

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_UNSURE = 5.0  # times the median standard deviation, beyond which a height tells of its error alone
_FEW = 0.15  # of the pixels: if more are that unsure, they are part of the surface


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """The known points of a height map.

    Attributes
    ----------
    points : ndarray, (3, n), float64
        Millimetres.
    sigma : ndarray, (n,), float64
        Standard deviations of their heights, mm; all NaN where there are none.
    where : ndarray, (H, W), bool
        Which pixels they are.
    """

    points: Doubles
    sigma: Doubles
    where: Mask

    @classmethod
    def of(cls, height: ArrayLike, x: ArrayLike, y: ArrayLike, sigma: ArrayLike | None) -> Cloud:
        """Take a height map, with NaN where there is none, and where its pixels are; see `fit_plane`."""
        z = np.asarray(height, np.float64)
        where = np.isfinite(z)
        if sigma is not None:
            where &= np.isfinite(sigma)
        across, up = np.meshgrid(np.asarray(x, np.float64), np.asarray(y, np.float64))
        points = np.stack([across[where], up[where], z[where]])
        known = np.full(points.shape[1], np.nan) if sigma is None else np.asarray(sigma, np.float64)[where]
        return cls(points, known, where)

    @property
    def common(self) -> float:
        """Mean standard deviation, mm: by so much heights may be wrong together; 0 where it is not known."""
        return float(np.nan_to_num(np.mean(self.sigma)))

    def residual(self, distance: Doubles) -> tuple[Doubles, Quantity]:
        """Return the points' distances from a form, (n,), mm, as a map, and their root mean square."""
        residual = np.full(self.where.shape, np.nan)
        residual[self.where] = distance
        noise = np.sqrt(np.mean(self.sigma**2))
        return residual, micrometres(float(np.sqrt(np.mean(distance**2))), float(noise))


def far_less_sure(sigma: Doubles, known: Mask) -> Mask:
    """Return the known pixels, (H, W), of more than five times the median sigma, if at most 15 % are.

    What is highest and lowest of all would be their errors. If more are that unsure, all count.
    """
    unsure = known & (sigma > _UNSURE * np.median(sigma[known]))
    return np.asarray(unsure & (np.count_nonzero(unsure) <= _FEW * np.count_nonzero(known)))


def micrometres(value: float, sigma: float) -> Quantity:
    """Return a quantity in micrometres of numbers in millimetres."""
    return Quantity(1e3 * value, 1e3 * sigma, "µm")


def degrees(value: float, sigma: float) -> Quantity:
    """Return a quantity in degrees of numbers in radians."""
    return Quantity(math.degrees(value), math.degrees(sigma), "deg")


def spread(covariance: Doubles, *direction: float) -> float:
    """Return the standard deviation of a linear combination of parameters."""
    along = np.asarray(direction)
    # Of parameters that nearly cancel, rounding may leave less than nothing.
    return float(np.sqrt(np.maximum(along @ covariance @ along, 0)))
