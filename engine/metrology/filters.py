"""Gaussian filters of ISO 16610-61 (areal) and ISO 16610-21 (profile) on maps with holes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_ALPHA = math.sqrt(math.log(2) / math.pi)  # constant of the Gaussian filter, which halves waves at the cutoff
_COVERED = 0.1  # smallest share of the filter's weight on measured pixels; it is 0.25 in a corner
_COMPLETE = 1e-6  # share of the weight that may be missing where the filter is the plain one
_RIDGE = 1e-9  # of slopes, relative to the weight, where measured pixels are in a line
_TAIL = 4.0  # half-width of the filter, in standard deviations


@dataclass(frozen=True, slots=True)
class Gaussian:
    """The Gaussian filter of one nesting index on the measured pixels of a map or profile.

    At ends and holes it is the linear regression filter of ISO 16610-31 and -71: the value, at a pixel, of
    the plane that fits the measured pixels around it, with the filter's weights. It leaves planes as they
    are, as the moment criterion of ISO 16610-28 demands, and is the plain filter where nothing is missing.
    It is undefined where measured pixels have less than a tenth of the weight.

    Attributes
    ----------
    measured, covered : ndarray of bool
        Known pixels, and those of them where the filter is defined.
    weight : ndarray
        Share of the weight on measured pixels.
    spreads : tuple of float
        Standard deviation of the filter along each axis, in pixels.
    influence : ndarray, (1 + axes, ...)
        Factors of the weighted sum of values, and of those of values times each distance.
    """

    measured: Mask
    covered: Mask
    weight: Doubles
    spreads: tuple[float, ...]
    influence: Doubles

    @classmethod
    def of(cls, measured: Mask, pixel_sizes: tuple[float, ...], cutoff: float) -> Gaussian:
        """Prepare the filter; ``pixel_sizes`` are along the axes of ``measured``, in mm, like the cutoff."""
        if not cutoff >= 2 * max(pixel_sizes):
            raise InputError(f"a cutoff of {cutoff:g} mm is shorter than two pixels: choose a longer one")
        # exp(-pi (r / (alpha cutoff))^2) as a normal distribution.
        spread = _ALPHA * cutoff / math.sqrt(2 * math.pi)
        spreads = tuple(spread / size for size in pixel_sizes)
        influence = np.zeros((1 + measured.ndim, *measured.shape))
        places = np.nonzero(measured)
        extents = [np.ptp(place) + 1 if place.size else 0 for place in places]
        if any(count * size < cutoff for count, size in zip(extents, pixel_sizes, strict=True)):
            nothing = np.zeros(measured.shape)  # less than one wave of the nesting index
            return cls(measured, nothing.astype(bool), nothing, spreads, influence)
        moments = _moments(measured.astype(np.float64), spreads, 2)
        weight = moments[(0,) * measured.ndim]
        covered = measured & (weight >= _COVERED)
        influence[0][covered] = 1 / weight[covered]
        partial = covered & (weight < 1 - _COMPLETE)
        influence[:, partial] = _first_rows(moments, partial)
        return cls(measured, covered, weight, spreads, influence)

    def long_waves(self, values: Doubles, *, level: bool = False) -> Doubles:
        """Return the smoothed values; NaN where the filter is not defined.

        With ``level``, they are weighted means at ends and holes, too, not planes.
        """
        if not self.covered.any():
            return np.full(values.shape, np.nan)
        sums = _moments(np.where(self.measured, values, 0.0), self.spreads, 0 if level else 1)
        if level:
            smooth = sums[(0,) * values.ndim] / np.where(self.covered, self.weight, 1.0)
        else:
            orders = _orders(values.ndim)
            smooth = sum(factors * sums[order] for factors, order in zip(self.influence, orders, strict=True))
        return np.where(self.covered, smooth, np.nan)


def _orders(axes: int) -> list[tuple[int, ...]]:
    """Return the powers of the distances of the constant and of the slopes: (0, 0), (1, 0), (0, 1)."""
    return [tuple(int(axis == number) for axis in range(axes)) for number in range(-1, axes)]


def _first_rows(moments: dict[tuple[int, ...], Doubles], chosen: Mask) -> Doubles:
    """Return the first row of the inverse normal equations of a plane around each chosen pixel."""
    orders = _orders(chosen.ndim)
    normal = np.empty((np.count_nonzero(chosen), len(orders), len(orders)))
    for row, first in enumerate(orders):
        for column, second in enumerate(orders):
            power = tuple(a + b for a, b in zip(first, second, strict=True))
            normal[:, row, column] = moments[power][chosen]
    for slope in range(1, len(orders)):
        normal[:, slope, slope] += _RIDGE * normal[:, 0, 0]
    constant = np.zeros((normal.shape[0], len(orders), 1))
    constant[:, 0] = 1.0
    return np.asarray(np.linalg.solve(normal, constant)[..., 0].T)


def _moments(values: Doubles, spreads: tuple[float, ...], highest: int) -> dict[tuple[int, ...], Doubles]:
    """Return the weighted sums around each pixel of values times powers of distances, by the powers.

    Distances are in standard deviations of the filter; the sum of the powers is at most ``highest``.
    """
    from scipy import fft

    sums: dict[tuple[int, ...], Doubles] = {(): values}
    for axis, spread in enumerate(spreads):
        reach, count = math.ceil(_TAIL * spread), values.shape[axis]
        distance = np.arange(-reach, reach + 1) / spread
        weights = np.exp(-0.5 * distance**2)
        weights /= weights.sum()
        length = fft.next_fast_len(count + 2 * reach, real=True)
        shape = [1] * values.ndim
        shape[axis] = -1
        # Convolution mirrors its kernel, so distances have the opposite sign.
        kernels = [
            fft.rfft(weights * (-distance) ** power, length).reshape(shape) for power in range(highest + 1)
        ]
        following: dict[tuple[int, ...], Doubles] = {}
        for powers, part in sums.items():
            wave = fft.rfft(part, length, axis=axis)
            for power in range(highest + 1 - sum(powers)):
                summed = fft.irfft(wave * kernels[power], length, axis=axis)
                following[(*powers, power)] = summed.take(range(reach, reach + count), axis)
        sums = following
    return sums
