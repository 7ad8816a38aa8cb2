"""The noise of a rotation's samples, from the residuals of a fit of waves to one turn."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.frames import QUANTUM
from mirrorskin.engine.correlation.design_matrix import basis
from mirrorskin.io import InputError
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import huber

_FLOAT_NOISE = 1e-6  # minimum noise of float frames, as a share of the maximum count
_FRAMES_OF_TWO = 7  # minimum number of frames for a fit with the second harmonic
_MAX_CONDITION = 100.0  # maximum condition of this fit
_BINS, _BIN_PIXELS = 16, 200  # maximum number of bins of brightness, and minimum number of pixels per bin
_AT_ONCE = 4096  # pixels per block, which fits into the cache
_LINE_ITERATIONS = 10  # of the line's robust fit
_OUTLYING = 0.2  # limit of its relative residuals
_OUTLIER_PROBABILITY = 1e-3  # significance level of outliers


@dataclass(frozen=True, slots=True)
class CountNoise:
    """The noise of a sample as a function of its brightness: read noise and shot noise."""

    base: float  # variance at 0 counts, extrapolated
    slope: float  # variance per count
    floor: float  # lower limit of the variance

    def at(self, level: ArrayLike) -> Doubles:
        """Return the standard deviation of samples around a level, counts."""
        return np.sqrt(np.maximum(self.base + self.slope * np.asarray(level, np.float64), self.floor))


def residual_noise(
    samples: NDArray[Any], phase: Doubles, weights: Doubles, waves: Doubles | None = None
) -> CountNoise:
    """Estimate the noise of samples of weight 1 from the residuals of a fit of the first two harmonics.

    The second harmonic occurs on level surfaces; with fewer than 7 frames it counts as noise. Pixels are
    sorted into bins by brightness. The initial variance of a bin is from the median of the sums of squares;
    then sums beyond the 99.9 % quantile of chi-square, such as those of pixels that lose contact, are
    excluded iteratively. A non-decreasing line is fitted to the bins' variances.

    Samples are (N, n), of n pixels; weights are above 0. Frames with less than half as many valid samples as
    others are excluded, and then pixels with a sample that is clipped or not finite. If the frames are not a
    turn, ``waves``, (N, n), is a basis of the samples of all normals, times the roots of the weights; phases
    are not used.
    """
    coefficients = 3 if waves is None else waves.shape[1]
    if len(samples) <= coefficients:
        raise InputError(
            f"{len(samples)} frames a turn leave no residual to estimate the noise from:"
            " give its standard deviation"
        )
    good = valid(samples)
    quantum = QUANTUM if samples.dtype.kind == "u" else _FLOAT_NOISE
    if not (good.sum(axis=0) >= 3).any():  # no pixel has a normal
        return CountNoise(quantum**2, 0.0, quantum**2)
    valid_fraction = good.mean(axis=1)
    frames = valid_fraction > valid_fraction.max() / 2
    pixels = good[frames].all(axis=0)
    if np.count_nonzero(frames) <= coefficients or not pixels.any():
        raise InputError(
            "too few samples are valid to estimate the noise: give a sample's standard deviation, in counts"
        )
    integer = samples.dtype.kind == "u"
    counts, phase, weights = samples[frames].compress(pixels, axis=1), phase[frames], weights[frames]
    total = counts.sum(axis=0, dtype=np.uint32 if integer else np.float64)
    level = total / len(counts)
    floor = quantum * (1.0 if integer else float(np.max(np.abs(counts))))
    root = np.sqrt(weights)[:, np.newaxis]
    if waves is None:
        first = basis(phase)
        both = np.concatenate([first, basis(2 * phase)[:, 1:]], axis=1)
        separable = len(phase) >= _FRAMES_OF_TWO and np.linalg.cond(both) < _MAX_CONDITION
        waves = root * (both if separable else first)
    else:
        waves = waves[frames]
    freedom = len(counts) - waves.shape[1]
    residual_basis = np.linalg.qr(waves, mode="complete").Q[:, waves.shape[1] :]
    squares = np.empty(len(level))
    for start in range(0, len(level), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        residual = residual_basis.T @ (root * counts[:, part])
        np.einsum("ij,ij->j", residual, residual, out=squares[part])
    # 16-bit integers are sorted in one pass.
    order = np.argsort(total.astype(np.uint16) if integer and total.max() < 2**16 else total, kind="stable")
    bins = np.array_split(order, max(1, min(_BINS, len(order) // _BIN_PIXELS)))
    variances = np.array([_variance(squares[pixels], freedom) for pixels in bins])
    levels = np.array([level[pixels].mean() for pixels in bins])
    return _line(levels, np.maximum(variances, floor**2), floor**2)


def valid(samples: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which samples, of any shape, are neither clipped by their type nor NaN or infinite."""
    if samples.dtype.kind == "f":
        return np.asarray(np.isfinite(samples))
    return np.asarray((samples > 0) & (samples < np.iinfo(samples.dtype).max))


def _variance(squares: Doubles, freedom: int) -> float:
    """Return the variance of normally distributed samples from sums of squares with outliers."""
    furthest = _chi_square_beyond(freedom, _OUTLIER_PROBABILITY)
    kept_share = (1 - _share_beyond(freedom + 2, furthest)) / (1 - _share_beyond(freedom, furthest))
    variance = float(np.median(squares)) / _chi_square_beyond(freedom, 0.5)
    for _ in range(10):
        kept = squares[squares <= furthest * variance]
        if kept.size == 0 or variance == (variance := float(np.mean(kept)) / (freedom * kept_share)):
            break
    return variance


def _share_beyond(freedom: int, square: float) -> float:
    """Return the probability that chi^2 exceeds a value, for integer degrees of freedom.

    Loading SciPy's function would increase the time of a rotation's command by a tenth.
    """
    half = square / 2
    powers = np.arange(1 if freedom % 2 == 0 else 1.5, freedom / 2, dtype=np.float64)
    if freedom % 2 == 0:
        first = term = math.exp(-half)
    else:
        first, term = math.erfc(math.sqrt(half)), math.sqrt(2 * square / math.pi) * math.exp(-half)
        first += term if freedom > 1 else 0.0
    return float(first + np.sum(term * np.cumprod(half / powers)))


@functools.cache
def _chi_square_beyond(freedom: int, probability: float) -> float:
    """Return the value that chi^2 exceeds with a probability, to double precision, by bisection."""
    low, high = 0.0, 1.0
    while _share_beyond(freedom, high) > probability:
        low, high = high, 2 * high
    while low < (middle := (low + high) / 2) < high:
        low, high = (middle, high) if _share_beyond(freedom, middle) > probability else (low, middle)
    return high


def _line(levels: Doubles, variances: Doubles, floor: float) -> CountNoise:
    """Fit a non-decreasing line to variances by iteratively reweighted least squares."""
    weights = 1 / variances
    base, slope = float(np.median(variances)), 0.0
    for _ in range(_LINE_ITERATIONS if np.ptp(levels) > 0 else 0):
        centre = np.average(levels, weights=weights**2)
        mean = np.average(variances, weights=weights**2)
        off_centre = levels - centre
        rise = np.sum(weights**2 * off_centre * (variances - mean)) / np.sum(weights**2 * off_centre**2)
        slope = max(0.0, float(rise))
        base = float(mean - slope * centre)
        fitted = np.maximum(base + slope * levels, floor)
        weights = np.sqrt(huber(_OUTLYING).weights((variances - fitted) / fitted)) / fitted
    return CountNoise(base, slope, floor)
