"""Areal roughness: Sa, Sq and Sz of ISO 25178-2, and the Gaussian filter of ISO 16610-61."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.metrology.fitting import find_uncertain
from mirrorskin.engine.metrology.quantity import Quantity, micrometres
from mirrorskin.io import InputError

Doubles = NDArray[np.float64]

_ALPHA = math.sqrt(math.log(2) / math.pi)  # of the Gaussian filter: it halves waves as long as the cutoff
_COVERED = 0.95  # of the filter's weight that must lie on known pixels
_TAIL = 4.0  # standard deviations to which the filter's weights reach


@dataclass(frozen=True, slots=True, eq=False)
class Roughness:
    """Height parameters of ISO 25178-2 over the definition area: the known pixels.

    Attributes
    ----------
    sa, sq : Quantity
        Arithmetical mean and root mean square of the heights, µm.
    sz : Quantity
        Highest peak and deepest pit together, µm.
    noise : Quantity
        What Sq would be of a perfect surface: the root mean square of the standard deviations, µm.
    pixels, left_out, uncertain : int
        Known pixels that count, that lie too near to an end or a hole for the filter, and whose standard
        deviation is so much larger than others' that they count as not measured.
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
        found = {"Sa": self.sa, "Sq": self.sq, "Sz": self.sz}
        return found | {"Sq of noise": self.noise} if math.isfinite(self.noise.value) else found


def roughness(
    residual: ArrayLike,
    pixel_size: tuple[float, float],
    *,
    cutoff: float | None = None,
    sigma: ArrayLike | None = None,
) -> Roughness:
    """Return the roughness of a surface from its residual, (H, W) mm with NaN where there is none.

    ``pixel_size`` is that along x and y, mm. ``cutoff``, mm, is the nesting index of the L-filter: longer
    waves are taken out, and pixels with more than a twentieth of the filter's weight on holes or outside the
    picture do not count. ``sigma``, (H, W) mm, are the heights' standard deviations.

    Values include the noise: the square of Sq is the sum of that of the surface and that of the noise, where
    these are uncorrelated. In any case noise changes Sq by no more than its own root mean square, and Sa by
    no more than its mean magnitude: these are the uncertainties. Noise makes Sz larger by something between
    nothing and all that noise spans; the errors of the highest and of the lowest pixel add to that.

    Pixels that are far more uncertain than others (see `find_uncertain`) are not part of the definition area:
    Sz would be their error. What a form's fit left out as outliers is: it may be the texture.

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
    """Smooth a height map by the areal Gaussian filter of ISO 16610-61, which halves waves of the cutoff, mm.

    Return weighted means over known pixels; NaN where more than a twentieth of the weight lies elsewhere.
    """
    if not cutoff >= 2 * max(pixel_size):
        raise InputError(f"a cutoff of {cutoff:g} mm is shorter than two pixels: choose a longer one")
    # exp(-pi (r / (alpha cutoff))^2) as a normal distribution.
    spread = _ALPHA * cutoff / math.sqrt(2 * math.pi)
    known = np.isfinite(height)
    if min(count * size for count, size in zip(height.shape[::-1], pixel_size, strict=True)) < 2 * spread:
        return np.full(height.shape, np.nan)  # nowhere would enough weight lie on pixels
    weight = _blur(known.astype(np.float64), spread, pixel_size)
    blurred = _blur(np.where(known, height, 0.0), spread, pixel_size)
    covered = known & (weight >= _COVERED)
    return np.where(covered, blurred / np.where(covered, weight, 1), np.nan)


def _blur(values: Doubles, spread: float, pixel_size: tuple[float, float]) -> Doubles:
    """Convolve with a normal distribution, in the standard deviation of millimetres; nothing lies outside."""
    for axis, size in zip((1, 0), pixel_size, strict=True):
        values = _convolve(values, _bell(spread / size), axis)
    return values


def _convolve(values: Doubles, weights: Doubles, axis: int) -> Doubles:
    """Convolve along an axis with weights whose middle is where the result goes; zeros lie outside."""
    from scipy import fft

    count, reach = values.shape[axis], weights.size // 2
    length = fft.next_fast_len(count + 2 * reach, real=True)
    wave = fft.rfft(values, length, axis=axis) * np.expand_dims(fft.rfft(weights, length), 1 - axis)
    return np.asarray(fft.irfft(wave, length, axis=axis).take(range(reach, reach + count), axis))


def _bell(spread: float) -> Doubles:
    """Return the weights of a normal distribution, its standard deviation in pixels."""
    reach = math.ceil(_TAIL * spread)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / spread) ** 2)
    return np.asarray(weights / weights.sum())
