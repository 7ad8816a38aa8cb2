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
_COVERED = 0.95  # smallest share of the filter's weight on measured pixels
_TAIL = 4.0  # half-width of the filter, in standard deviations


@dataclass(frozen=True, slots=True)
class Gaussian:
    """The Gaussian filter of one nesting index on the measured pixels of a map or profile.

    Values are weighted means over measured pixels. They are undefined where these have less than 95 % of the
    weight.

    Attributes
    ----------
    measured, covered : ndarray of bool
        Known pixels, and those of them where the filter is defined.
    weight : ndarray
        Share of the weight on measured pixels.
    spreads : tuple of float
        Standard deviation of the filter along each axis, in pixels.
    """

    measured: Mask
    covered: Mask
    weight: Doubles
    spreads: tuple[float, ...]

    @classmethod
    def of(cls, measured: Mask, pixel_sizes: tuple[float, ...], cutoff: float) -> Gaussian:
        """Prepare the filter; ``pixel_sizes`` are along the axes of ``measured``, in mm, like the cutoff."""
        if not cutoff >= 2 * max(pixel_sizes):
            raise InputError(f"a cutoff of {cutoff:g} mm is shorter than two pixels: choose a longer one")
        # exp(-pi (r / (alpha cutoff))^2) as a normal distribution.
        spread = _ALPHA * cutoff / math.sqrt(2 * math.pi)
        spreads = tuple(spread / size for size in pixel_sizes)
        if min(count / width for count, width in zip(measured.shape, spreads, strict=True)) < 2:
            nothing = np.zeros(measured.shape)  # too little weight everywhere
            return cls(measured, nothing.astype(bool), nothing, spreads)
        weight = _blur(measured.astype(np.float64), spreads)
        return cls(measured, measured & (weight >= _COVERED), weight, spreads)

    def long_waves(self, values: Doubles) -> Doubles:
        """Return the smoothed values; NaN where the filter is not defined."""
        if not self.covered.any():
            return np.full(values.shape, np.nan)
        blurred = _blur(np.where(self.measured, values, 0.0), self.spreads)
        return np.where(self.covered, blurred / np.where(self.covered, self.weight, 1), np.nan)


def _blur(values: Doubles, spreads: tuple[float, ...]) -> Doubles:
    """Convolve with a normal distribution of standard deviations in pixels; values outside are 0."""
    from scipy import fft

    for axis, spread in enumerate(spreads):
        reach, count = math.ceil(_TAIL * spread), values.shape[axis]
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / spread) ** 2)
        weights /= weights.sum()
        length = fft.next_fast_len(count + 2 * reach, real=True)
        shape = [1] * values.ndim
        shape[axis] = -1
        wave = fft.rfft(values, length, axis=axis) * fft.rfft(weights, length).reshape(shape)
        values = np.asarray(fft.irfft(wave, length, axis=axis).take(range(reach, reach + count), axis))
    return values
