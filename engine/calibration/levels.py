"""The level of a pixel from noisy, rounded and clipped samples, and its standard error."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats

Mask = NDArray[np.bool_]

ROUNDING = 1 / 12
"""Variance of rounding to integers, counts^2, of a uniform distribution of width 1."""

FEWEST = 5
"""Minimum number of samples in full light for a level under a rolled ball."""

_BIN, _BINS = 2048, 32  # minimum number of pixels in a bin of equal levels; maximum number of bins
_RARE = 6.0  # standard deviations beyond which a variance is an outlier
_UNCLIPPED = 0.05  # minimum share of unclipped samples for the estimate of a level
_FAR = 6.0  # standard deviations from the end of the scale beyond which clipping is negligible
_NEWTON_STEPS = 4  # number of iterations; fewer are needed
_TINY = 1e-30  # counts^2: avoids division by 0


class Moments:
    """Running count, mean, variance and extremes of each pixel; samples that are not finite are ignored.

    Differences from the first frame are summed in float64, which is exact for integers.
    """

    def __init__(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        self.integer: bool = dtype.kind == "u"
        self.frames: int = 0
        self.count, self.at_lowest, self.at_highest = np.zeros((3, *shape), np.int32)
        self.lowest: Floats = np.full(shape, np.inf)
        self.highest: Floats = np.full(shape, -np.inf)
        self.sum, self._squares = np.zeros((2, *shape))
        self._first: Floats | None = None

    @property
    def mean(self) -> Floats:
        """Means, counts; NaN without a sample."""
        first = 0.0 if self._first is None else self._first
        return np.asarray(np.where(self.count > 0, first + self.sum / np.maximum(self.count, 1), np.nan))

    @property
    def variance(self) -> Floats:
        """Unbiased variances of a sample, counts^2; NaN of fewer than two samples."""
        squares = np.maximum(self._squares - self.sum**2 / np.maximum(self.count, 1), 0)
        return np.asarray(np.where(self.count > 1, squares / np.maximum(self.count - 1, 1), np.nan))

    def push(self, frames: NDArray[Any]) -> None:
        """Add frames, (n, H, W)."""
        for frame in frames:
            valid = np.isfinite(frame)
            counts = np.where(valid, frame, 0).astype(np.float64)
            if self._first is None:
                self._first = counts
            difference = np.where(valid, counts - self._first, 0.0)
            self.sum += difference
            self._squares += difference * difference
            self.count += valid
            low, high = np.where(valid, counts, np.inf), np.where(valid, counts, -np.inf)
            self.at_lowest = self.at_lowest * (self.lowest <= low) + valid * (low <= self.lowest)
            self.at_highest = self.at_highest * (self.highest >= high) + valid * (high >= self.highest)
            np.minimum(self.lowest, low, out=self.lowest)
            np.maximum(self.highest, high, out=self.highest)
        self.frames += len(frames)


class Level(NamedTuple):
    """A level of each pixel; all (H, W), float64."""

    value: Floats  # counts; NaN if unknown
    sigma: Floats  # standard error of the value, counts
    noise: Floats  # mean standard deviation of a sample at this level, before clipping, counts
    excess: Floats  # ratio of the pixel's variance to the mean variance at its level
    clipped: Floats  # share of the samples at the end of the scale


def level_above(moments: Moments, floor: float | None) -> Level:
    """Estimate the level of samples that may be clipped at a floor, counts.

    The standard error is computed from a variance between the pixel's own and the mean over pixels of this
    level (Buehlmann's credibility), plus the error of rounding. Clipping increases the mean of samples: the
    level is the mean of the normal distribution that has this mean when clipped. If 95 % of the samples or
    more are at the floor, the level is an upper bound, and its error is the noise of one sample.
    """
    return _level(moments, moments.mean, moments.lowest, moments.at_lowest, floor)


def level_below(moments: Moments, top: float | None) -> Level:
    """Estimate the level of samples that may be clipped at a top, counts: see `level_above`."""
    end = None if top is None else -top
    level = _level(moments, -moments.mean, -moments.highest, moments.at_highest, end)
    return level._replace(value=-level.value)


def _level(
    moments: Moments, mean: Floats, lowest: Floats, at_least: NDArray[np.int32], floor: float | None
) -> Level:
    """Estimate the level of samples, or of their negatives, from their mean and minimum."""
    variance = moments.variance
    clipped = np.zeros(mean.shape)
    if floor is not None:
        clipped = np.where(lowest == floor, at_least / np.maximum(moments.count, 1), 0.0)
        unclipped = _unclipped_variance(mean - floor, variance, moments.integer)
        variance = np.where(clipped < 1 - _UNCLIPPED, unclipped, np.nan)
    usual, shrunk = pool_variance(mean, variance, moments.count - 1)
    shrunk = np.where(clipped > 0, usual, shrunk)  # a clipped variance has no weight
    value, error = mean, shrunk / np.maximum(moments.count, 1)
    if floor is not None:
        value, error = _unclipped_mean(mean - floor, shrunk, error, moments.integer)
        value = value + floor
    error = error + rounding_error(usual) if moments.integer else error
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.where(variance > 0, variance / usual, 0.0)
    return Level(value, np.sqrt(error), np.sqrt(usual), excess, clipped)


def rounding_error(variance: Floats) -> Floats:
    """Return the variance due to rounding of a mean of samples with a variance, counts^2.

    It is not reduced by averaging: without noise, the level may be anywhere within half a count of the mean.
    """
    sigma, bias, observed = _rounding_tables()
    return np.asarray(np.interp(np.interp(variance, observed, sigma), sigma, bias))


def pool_variance(level: Floats, variance: Floats, freedom: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Estimate the noise of pixels from all pixels of about the same level.

    Return the mean variance at that level without outliers, and the best linear estimate of the pixel's own
    variance (Buehlmann): a value between both, which depends on how much pixels differ beyond chance.
    Outliers keep their variance. ``freedom`` are the degrees of freedom of the variances.
    """
    valid = np.isfinite(level) & np.isfinite(variance)
    if not valid.any():
        zeros = np.where(np.isfinite(level), 0.0, np.nan)
        return zeros, zeros
    degrees = float(np.median(freedom[valid]))
    limit = rare_ratio(degrees)
    curve = _binned_variance(level[valid], variance[valid], limit)
    usual = np.where(np.isfinite(level), np.interp(level, *curve), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(variance > 0, variance / usual, 0.0)
    common = ratio[valid & (ratio <= limit)]
    spread = float(np.var(common)) if common.size else 0.0
    credibility = max(0.0, (spread - 2 / degrees) / (1 + 2 / degrees)) / max(spread, 1e-30)
    best = np.where(ratio > limit, variance, usual * (1 - credibility) + credibility * variance)
    return usual, np.where(np.isfinite(best), best, usual)


def rare_ratio(freedom: float) -> float:
    """Return the ratio of a variance to its mean beyond which it is an outlier (Wilson and Hilferty)."""
    part = 2 / (9 * freedom)
    return float((1 - part + _RARE * math.sqrt(part)) ** 3)


def _binned_variance(level: Floats, variance: Floats, limit: float) -> tuple[Floats, Floats]:
    """Return mean levels and mean variances of pixels in bins of equal numbers, without outliers."""
    bins = min(max(level.size // _BIN, 1), _BINS)
    edges = np.unique(np.quantile(level, np.linspace(0, 1, bins + 1)[1:-1]))
    number = np.searchsorted(edges, level, side="right")
    present = np.flatnonzero(np.bincount(number))
    means = [_mean_without_outliers(variance[number == k], limit) for k in present]
    return np.array([level[number == k].mean() for k in present]), np.array(means)


def _mean_without_outliers(variance: Floats, limit: float) -> float:
    mean = float(variance.mean())
    for _ in range(50):
        before, mean = mean, float(variance[variance <= limit * mean].mean())
        if mean == before:
            break
    return mean


class _ClippedNormal(NamedTuple):
    """Mean and variance of a normal variate of mean u and variance 1, clipped at 0, and P(variate > 0)."""

    u: Floats
    mean: Floats
    variance: Floats
    unclipped: Floats


@functools.cache
def _clipped_normal() -> _ClippedNormal:
    from scipy.special import ndtr, ndtri

    u = np.linspace(float(ndtri(_UNCLIPPED)), _FAR, 4096)
    density, unclipped = np.exp(-(u**2) / 2) / math.sqrt(math.tau), ndtr(u)
    mean = u * unclipped + density
    return _ClippedNormal(u, mean, (u**2 + 1) * unclipped + u * density - mean**2, unclipped)


@functools.cache
def _rounding_tables() -> tuple[Floats, Floats, Floats]:
    """Return standard deviations, and for each the mean square bias and the variance of rounded samples.

    From the Fourier series of the sawtooth; the bias is averaged over all levels.
    """
    sigma, order = np.linspace(0.0, 2.0, 1001), np.arange(1, 61)[:, np.newaxis]
    bias = np.sum(np.exp(-((math.tau * order * sigma) ** 2)) / (2 * (math.pi * order) ** 2), axis=0)
    bias[0] = ROUNDING
    return sigma, bias, sigma**2 + ROUNDING - bias


def _unclipped_variance(distance: Floats, variance: Floats, integer: bool) -> Floats:
    """Return the variance of samples before they were clipped at a distance below their mean."""
    from scipy.special import ndtr

    table = _clipped_normal()
    near = distance < _FAR * np.sqrt(variance)
    mean, observed = distance[near], variance[near]
    exact, spread = mean, observed
    for _ in range(_NEWTON_STEPS):
        ratio = exact / np.sqrt(np.maximum(spread, _TINY))
        u = np.interp(ratio, table.mean / np.sqrt(table.variance), table.u)
        noise = np.sqrt(np.maximum(spread / np.interp(u, table.u, table.variance), _TINY))
        if not integer:
            break
        exact = mean + _lost_by_rounding(u, noise)
        spread = observed + mean**2 - ROUNDING * ndtr(u) - exact**2
    unclipped = variance.copy()
    unclipped[near] = noise**2 + (ROUNDING if integer else 0.0)
    return unclipped


def _unclipped_mean(
    distance: Floats, variance: Floats, error: Floats, integer: bool
) -> tuple[Floats, Floats]:
    """Return the mean of samples before clipping, and its squared standard error."""
    table = _clipped_normal()
    noise = np.sqrt(np.maximum(variance - (ROUNDING if integer else 0.0), _TINY))
    near = distance < _FAR * noise
    mean, scale = distance[near], noise[near]
    u = np.interp(mean / scale, table.mean, table.u)
    for _ in range(_NEWTON_STEPS if integer else 0):
        u = np.interp((mean + _lost_by_rounding(u, scale)) / scale, table.mean, table.u)
    value, error = distance.copy(), error.copy()
    value[near] = u * scale
    estimated = error[near] * np.interp(u, table.u, table.variance / table.unclipped**2)
    error[near] = np.where(u > table.u[0], estimated, variance[near])
    return value, error


def _lost_by_rounding(u: Floats, noise: Floats) -> Floats:
    """Return the decrease of the mean of samples clipped at 0 by rounding (Euler-Maclaurin)."""
    smallest = math.sqrt(ROUNDING)  # the formula fails below it; `rounding_error` covers that
    return np.asarray(np.exp(-(u**2) / 2) / (math.sqrt(math.tau) * 24 * np.maximum(noise, smallest)))


# --- full light under a rolled ball -------------------------------------------------------------------------

_BRIGHTEST = 3  # rank by brightness of the sample used as the initial level, which ignores glints
_LIT = 0.75  # share of that light above which samples may be in full light
_WIDTH = 3.0  # standard deviations to either side that count as full light
_BELOW = 6.0  # standard deviations below full light within which the number in half light is estimated
_MAX_ITERATIONS = 30  # maximum number of iterations
_CONVERGED = 1e-3  # standard deviations: change of the level in the last iteration
_PLATEAU_BIN, _PLATEAU_BINS = 256, 16  # as _BIN and _BINS


@dataclass(frozen=True, slots=True, eq=False)
class Plateau:
    """The upper plateau of pixels' samples, (P,), counts; NaN if it has fewer than five samples."""

    value: Floats
    sigma: Floats
    noise: Floats
    count: NDArray[np.int64]


def find_plateau(samples: Floats, dark: Floats, integer: bool) -> Plateau:
    """Find the mean of the samples in full light; others, of (T, P), may be in half light or dark.

    The plateau is the mean that is at the centre of its own window of three standard deviations to either
    side. The window excludes as much above as below, so unlike the mean of the brightest samples this mean is
    unbiased. The standard deviation is estimated from the samples above the mean, of all pixels of similar
    level, because none of these is in half light. The number of samples in half light within the window is
    estimated from the samples just below it, and their contribution to the mean is subtracted.
    """
    rank = max(len(samples) - _BRIGHTEST, 0)
    rough = np.partition(np.where(np.isfinite(samples), samples, -np.inf), rank, axis=0)[rank]
    lit = samples >= dark + _LIT * (np.where(np.isfinite(rough), rough, np.nan) - dark)
    value = _masked_mean(samples, lit)
    noise = _noise_above(samples, value, np.full(value.shape, np.inf))
    for _ in range(_MAX_ITERATIONS):
        before = value
        value = _masked_mean(samples, np.abs(samples - value) <= _WIDTH * noise)
        noise = _noise_above(samples, value, _BELOW * noise)
        if not np.any(np.abs(value - before) > _CONVERGED * noise):
            break
    count = np.count_nonzero(np.abs(samples - value) <= _WIDTH * noise, axis=0)
    value, error = _without_half_light(samples, value, noise, count)
    error += rounding_error(noise**2) if integer else 0.0
    enough = count >= FEWEST
    return Plateau(np.where(enough, value, np.nan), np.where(enough, np.sqrt(error), np.nan), noise, count)


def _masked_mean(samples: Floats, mask: Mask) -> Floats:
    total, count = np.where(mask, samples, 0.0).sum(axis=0), mask.sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _noise_above(samples: Floats, value: Floats, reach: Floats) -> Floats:
    """Estimate the standard deviation from samples above the level, of all pixels of about that level."""
    with np.errstate(invalid="ignore"):
        above = (samples > value) & (samples <= value + reach)
    count = above.sum(axis=0)
    squares = np.where(above, (samples - value) ** 2, 0.0).sum(axis=0)
    freedom = np.maximum(1 - 1 / np.maximum(2 * count, 1), 0.5)  # the level is a mean of these samples, too
    occupied = np.flatnonzero(count > 0)
    if not occupied.size:
        return np.where(np.isfinite(value), 0.0, np.nan)
    order = occupied[np.argsort(value[occupied], kind="stable")]
    parts = np.array_split(order, min(max(order.size // _PLATEAU_BIN, 1), _PLATEAU_BINS))
    level = [value[part].mean() for part in parts]
    pooled = [math.sqrt(squares[part].sum() / (count[part] * freedom[part]).sum()) for part in parts]
    return np.where(np.isfinite(value), np.interp(value, level, pooled), np.nan)


def _without_half_light(
    samples: Floats, value: Floats, noise: Floats, count: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Subtract the contribution of samples in half light; return the mean and its squared standard error."""
    below = value - samples
    half = ((below > _WIDTH * noise) & (below <= _BELOW * noise)).sum(axis=0)
    half = half * _WIDTH / (_BELOW - _WIDTH)  # their density continues into the window's lower half
    lever = _WIDTH * noise / 2
    full = np.maximum(count - half, 1)
    # The mean over a window about itself scatters more than the mean of all samples.
    inside = math.erf(_WIDTH / math.sqrt(2))
    kept = inside - 2 * _WIDTH * math.exp(-(_WIDTH**2) / 2) / math.sqrt(math.tau)
    # Both the number in half light and their position in the lower half are uncertain.
    error = inside / kept * noise**2 / full + half * (lever**2 + (_WIDTH * noise) ** 2 / 3) / full**2
    return value + half * lever / full, error
