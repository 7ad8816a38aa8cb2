"""Areal roughness: Sa, Sq and Sz of ISO 25178-2, and the Gaussian filter of ISO 16610-61."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mirrorskin.engine.metrology.fitting import find_uncertain
from mirrorskin.engine.metrology.quantity import Quantity, micrometres
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles

_ALPHA = math.sqrt(math.log(2) / math.pi)  # constant of the Gaussian filter, which halves waves at the cutoff
_COVERED = 0.95  # smallest share of the filter's weight on known pixels
_TAIL = 4.0  # half-width of the filter, in standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class Roughness:
    """Height parameters of ISO 25178-2 over the definition area: the known pixels.

    Attributes
    ----------
    sa, sq : Quantity
        Arithmetical mean and root mean square of the heights, µm.
    sz : Quantity
        Sum of highest peak and deepest pit, µm.
    noise : Quantity
        Sq of a perfect surface: the root mean square of the standard deviations, µm.
    pixels, left_out, uncertain : int
        Numbers of known pixels that count, that are too near to an end or a hole for the filter, and that are
        ignored because their standard deviation is much larger than that of others.
    """

    sa: Quantity
    sq: Quantity
    sz: Quantity
    noise: Quantity
    pixels: int
    left_out: int
    uncertain: int

    def quantities(self) -> dict[str, Quantity]:
        """Return its quantities by name."""
        quantities = {"Sa": self.sa, "Sq": self.sq, "Sz": self.sz}
        return quantities | {"Sq of noise": self.noise} if math.isfinite(self.noise.value) else quantities


def roughness(
    residual: ArrayLike,
    pixel_size: tuple[float, float],
    *,
    cutoff: float | None = None,
    sigma: ArrayLike | None = None,
) -> Roughness:
    """Return the roughness of a surface from its residual, (H, W) mm with NaN where undefined.

    ``pixel_size`` is along x and y, mm. ``cutoff``, mm, is the nesting index of the L-filter: longer waves
    are removed, and pixels with more than a twentieth of the filter's weight on holes or outside the picture
    do not count. ``sigma``, (H, W) mm, are the heights' standard deviations.

    Values include noise: Sq^2 is the sum of the squares of surface and noise if these are uncorrelated. In
    any case noise changes Sq by at most its root mean square, and Sa by at most its mean magnitude: these are
    the uncertainties. Noise increases Sz by at most the range of the noise; the errors of the highest and the
    lowest pixel are added.

    Pixels that are far more uncertain than others (see `find_uncertain`) are excluded, because their errors
    would determine Sz. Outliers of a form's fit are included, because they may be texture.

    Examples
    --------
    >>> roughness([[0.001, -0.001], [-0.001, 0.001]], pixel_size=(0.1, 0.1)).sq.value
    1.0
    """
    height = np.asarray(residual, np.float64)
    known = np.isfinite(height)
    if not known.any():
        raise InputError("there is no height to measure the roughness of")
    spread = np.full_like(height, np.nan) if sigma is None else np.asarray(sigma, np.float64)
    uncertain = find_uncertain(spread, known)
    height = np.where(uncertain, np.nan, height)
    if cutoff is not None:
        height = height - long_waves(height, pixel_size, cutoff)
    kept = np.isfinite(height)
    if not kept.any():
        raise InputError(f"a cutoff of {cutoff:g} mm is too long for this surface: choose a shorter one")
    values, errors = height[kept] - np.mean(height[kept]), spread[kept]
    noise = float(np.sqrt(np.mean(errors**2)))
    span = 2 * noise * math.sqrt(2 * math.log(values.size))
    ends = math.hypot(errors[np.argmax(values)], errors[np.argmin(values)])
    return Roughness(
        micrometres(float(np.mean(abs(values))), noise * math.sqrt(2 / math.pi)),
        micrometres(float(np.sqrt(np.mean(values**2))), noise),
        micrometres(float(np.ptp(values)), math.hypot(span / math.sqrt(3), ends)),
        micrometres(noise, np.nan),
        values.size,
        int(np.count_nonzero(known & ~uncertain & ~kept)),
        int(np.count_nonzero(uncertain)),
    )


def long_waves(height: Doubles, pixel_size: tuple[float, float], cutoff: float) -> Doubles:
    """Smooth a height map by the areal Gaussian filter of ISO 16610-61, which halves waves at the cutoff, mm.

    Values are weighted means over known pixels; NaN if these have less than 95 % of the weight.
    """
    if not cutoff >= 2 * max(pixel_size):
        raise InputError(f"a cutoff of {cutoff:g} mm is shorter than two pixels: choose a longer one")
    # exp(-pi (r / (alpha cutoff))^2) as a normal distribution.
    spread = _ALPHA * cutoff / math.sqrt(2 * math.pi)
    known = np.isfinite(height)
    if min(count * size for count, size in zip(height.shape[::-1], pixel_size, strict=True)) < 2 * spread:
        return np.full(height.shape, np.nan)  # too little weight everywhere
    weight = _blur(known.astype(np.float64), spread, pixel_size)
    blurred = _blur(np.where(known, height, 0.0), spread, pixel_size)
    covered = known & (weight >= _COVERED)
    return np.where(covered, blurred / np.where(covered, weight, 1), np.nan)


def _blur(values: Doubles, spread: float, pixel_size: tuple[float, float]) -> Doubles:
    """Convolve with a normal distribution of a standard deviation in mm; values outside are 0."""
    from scipy import fft

    for axis, size in zip((1, 0), pixel_size, strict=True):
        reach, count = math.ceil(_TAIL * (spread / size)), values.shape[axis]
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / (spread / size)) ** 2)
        weights /= weights.sum()
        length = fft.next_fast_len(count + 2 * reach, real=True)
        wave = fft.rfft(values, length, axis=axis) * np.expand_dims(fft.rfft(weights, length), 1 - axis)
        values = np.asarray(fft.irfft(wave, length, axis=axis).take(range(reach, reach + count), axis))
    return values
