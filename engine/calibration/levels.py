"""The level behind a pixel's noisy, rounded and clipped samples, and how well it is known."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray
from scipy.special import ndtr, ndtri

from mirrorskin.io.types import Floats


class Moments:
    """Count, mean and variance of each pixel's samples, and how many of them lie at the ends of the scale.

    Samples that are no finite numbers are left out. Sums are of differences to the first frame, in float64:
    of whole numbers they are exact.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    dtype : dtype
        Of the frames.

    Attributes
    ----------
    count : ndarray, (H, W), int32
        Samples of each pixel.
    frames : int
        Frames that were pushed.
    at_lowest, at_highest : ndarray, (H, W), int32
        How many samples are equal to the extreme ones.
    """

    def __init__(self, shape: tuple[int, int], dtype: DTypeLike) -> None:
        kind = np.dtype(dtype)
        self.whole = kind.kind == "u"
        self.frames = 0
        self.count = np.zeros(shape, np.int32)
        low, high = (0, np.iinfo(kind).max) if self.whole else (-np.inf, np.inf)
        self._lowest, self._highest = np.full(shape, high, kind), np.full(shape, low, kind)
        self.at_lowest, self.at_highest = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        self._sum, self._squares = np.zeros(shape), np.zeros(shape)
        self._first: Floats | None = None

    @property
    def lowest(self) -> Floats:
        """The least samples, (H, W), counts; infinite without one."""
        return np.where(self.count > 0, self._lowest, np.inf)

    @property
    def highest(self) -> Floats:
        """The greatest samples, (H, W), counts; minus infinite without one."""
        return np.where(self.count > 0, self._highest, -np.inf)

    @property
    def mean(self) -> Floats:
        """Means, (H, W), counts; NaN without a sample."""
        first = np.zeros(self._sum.shape) if self._first is None else self._first
        return np.asarray(np.where(self.count > 0, first + self._sum / np.maximum(self.count, 1), np.nan))

    @property
    def variance(self) -> Floats:
        """Unbiased variances of a sample, (H, W), counts^2; NaN of fewer than two samples."""
        left = self._squares - self._sum**2 / np.maximum(self.count, 1)
        return np.asarray(
            np.where(self.count > 1, np.maximum(left, 0) / np.maximum(self.count - 1, 1), np.nan)
        )

    def push(self, frames: NDArray[Any]) -> None:
        """Take in frames, (n, H, W)."""
        for frame in frames:
            if self.whole:
                self._push(frame, frame, frame, 1)
            else:
                told = np.isfinite(frame)
                low, high = np.where(told, frame, np.inf), np.where(told, frame, -np.inf)
                self._push(np.where(told, frame, np.nan), low, high, told.astype(np.int32))
        self.frames += len(frames)

    def join(self, other: Self) -> None:
        """Take in what another has taken in."""
        if other._first is None:
            return
        if self._first is None:
            self._first = np.zeros(self.count.shape)
        step = other._first - self._first
        self._squares += other._squares + 2 * step * other._sum + other.count * step**2
        self._sum += other._sum + other.count * step
        self._extremes(other._lowest, other._highest, other.at_lowest, other.at_highest)
        self.count += other.count
        self.frames += other.frames

    def _push(
        self, frame: NDArray[Any], low: NDArray[Any], high: NDArray[Any], once: NDArray[np.int32] | int
    ) -> None:
        """Take in a frame, as it is and as it is for its extremes, with how often each sample counts."""
        if self._first is None:
            self._first = np.nan_to_num(frame.astype(np.float64))
        difference = frame - self._first
        if not self.whole:
            np.nan_to_num(difference, copy=False)
        self._sum += difference
        difference *= difference
        self._squares += difference
        self._extremes(low, high, once, once)
        self.count += once

    def _extremes(
        self,
        low: NDArray[Any],
        high: NDArray[Any],
        at_low: NDArray[np.int32] | int,
        at_high: NDArray[np.int32] | int,
    ) -> None:
        """Take in extreme samples, and how often they occur."""
        self.at_lowest *= self._lowest <= low
        self.at_lowest += at_low * (low <= self._lowest)
        np.minimum(self._lowest, low, out=self._lowest)
        self.at_highest *= self._highest >= high
        self.at_highest += at_high * (high >= self._highest)
        np.maximum(self._highest, high, out=self._highest)


ROUNDING = 1 / 12
"""Variance that rounding to whole numbers adds."""

_BIN, _BINS = 2048, 32  # pixels that tell a noise at least, and levels at which it is told at most
_RARE = 6.0  # standard deviations beyond which a variance is no usual one
_LEAST = 0.05  # of the samples that must be off the end of the scale, for a level to be told
_FAR = 6.0  # standard deviations from the end of the scale at which clipping is no matter any more
_STEPS = 4  # of iterations that settle at once
_TINY = 1e-30  # counts^2
_HARMONICS = 60

# The mean and the variance of a normal variate of mean u and variance 1 that is cut off at 0.
_U = np.linspace(float(ndtri(_LEAST)), _FAR, 4096)
_DENSITY = np.exp(-(_U**2) / 2) / math.sqrt(math.tau)
_CUT_MEAN = _U * ndtr(_U) + _DENSITY
_CUT_VARIANCE = (_U**2 + 1) * ndtr(_U) + _U * _DENSITY - _CUT_MEAN**2
_CUT_RATIO = _CUT_MEAN / np.sqrt(_CUT_VARIANCE)

# What rounding does to a sample of standard deviation s: the mean is off by an RMS over all levels of
# sqrt(_OFF), and the variance is _SEEN (Fourier's series of the sawtooth).
_S = np.linspace(0.0, 2.0, 1001)
_ORDER = np.arange(1, _HARMONICS + 1)[:, np.newaxis]
_OFF = np.sum(np.exp(-((math.tau * _ORDER * _S) ** 2)) / (2 * (math.pi * _ORDER) ** 2), axis=0)
_OFF[0] = ROUNDING
_SEEN = _S**2 + ROUNDING - _OFF


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """A level of each pixel.

    Attributes
    ----------
    value, sigma : ndarray, (H, W), float64
        Counts, and the standard error; NaN without an answer.
    noise : ndarray, (H, W), float64
        Standard deviation that a sample of a pixel of this level usually has, before it is clipped, counts.
    excess : ndarray, (H, W), float64
        The pixel's own variance in units of the usual one at its level.
    clipped : ndarray, (H, W), float64
        Share of the samples at the end of the scale.
    """

    value: Floats
    sigma: Floats
    noise: Floats
    excess: Floats
    clipped: Floats


def level_above(moments: Moments, floor: float | None) -> Level:
    """Tell the level of samples that are cut off at a floor, if there is one.

    The standard error is that of the mean, with the noise that pixels of about this level have in common (a
    pixel's own variance counts by how much pixels differ: credibility), and what rounding leaves. Where
    samples lie on the floor, their mean is too high: the level is that of the normal distribution which,
    cut off there, has this mean. Where 95 % of the samples or more lie on the floor, all that is known
    is that the level is not higher than that says; its error is then stated as one sample's noise.

    Parameters
    ----------
    moments : Moments
    floor : float or None
        Counts.
    """
    return _level(moments, moments.mean, moments.lowest, moments.at_lowest, floor)


def level_below(moments: Moments, top: float | None) -> Level:
    """Tell the level of samples that are cut off at a top, if there is one; see ``level_above``."""
    end = None if top is None else -top
    level = _level(moments, -moments.mean, -moments.highest, moments.at_highest, end)
    return Level(-level.value, level.sigma, level.noise, level.excess, level.clipped)


def _level(
    moments: Moments, mean: Floats, least: Floats, at_least: NDArray[np.int32], floor: float | None
) -> Level:
    """Tell the level of samples, or of their negatives, of this mean and with these extremes."""
    variance = moments.variance
    clipped = np.zeros(mean.shape)
    if floor is not None:
        clipped = np.where(least == floor, at_least / np.maximum(moments.count, 1), 0.0)
        variance = np.where(clipped < 1 - _LEAST, _uncut(mean - floor, variance, moments.whole), np.nan)
    usual, shrunk = pool_variance(mean, variance, moments.count - 1)
    shrunk = np.where(clipped > 0, usual, shrunk)  # what clipping leaves of a pixel's own tells little
    value, error = mean, shrunk / np.maximum(moments.count, 1)
    if floor is not None:
        value, error = _uncut_mean(mean - floor, shrunk, error, moments.whole)
        value = value + floor
    error = error + rounding_error(usual) if moments.whole else error
    with np.errstate(divide="ignore", invalid="ignore"):
        excess = np.where(variance > 0, variance / usual, 0.0)
    return Level(value, np.sqrt(error), np.sqrt(usual), excess, clipped)


def rounding_error(variance: Floats) -> Floats:
    """Return the variance that rounding leaves in a mean of samples of a variance, counts^2.

    It does not average out: without noise a level lies anywhere within half a count of what is seen.
    """
    return np.asarray(np.interp(np.interp(variance, _SEEN, _S), _S, _OFF))


def pool_variance(level: Floats, variance: Floats, freedom: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Tell the noise of pixels from all that have about the same level.

    Parameters
    ----------
    level, variance : ndarray, (H, W), float64
        Counts and counts^2, of each pixel alone; NaN where there is none.
    freedom : ndarray, (H, W), int32
        Degrees of freedom of the variances.

    Returns
    -------
    usual : ndarray, (H, W), float64
        The mean variance of pixels at that level, of which the outliers are left out.
    best : ndarray, (H, W), float64
        The best linear guess of the pixel's own (Buehlmann): between its variance and the usual one, by how
        much pixels differ beyond chance; its own where that is an outlier.
    """
    known = np.isfinite(level) & np.isfinite(variance)
    if not known.any():
        nothing = np.where(np.isfinite(level), 0.0, np.nan)
        return nothing, nothing
    degrees = float(np.median(freedom[known]))
    limit = rare_ratio(degrees)
    centres, means = _by_level(level[known], variance[known], limit)
    usual = np.where(np.isfinite(level), np.interp(level, centres, means), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(variance > 0, variance / usual, 0.0)
    common = ratio[known & (ratio <= limit)]
    spread = float(np.var(common)) if common.size else 0.0
    own = max(0.0, (spread - 2 / degrees) / (1 + 2 / degrees)) / max(spread, 1e-30)
    best = np.where(ratio > limit, variance, usual * (1 - own) + own * variance)
    return usual, np.where(np.isfinite(best), best, usual)


def rare_ratio(freedom: float) -> float:
    """Return which ratio of a variance to its mean is not to be expected of any pixel (Wilson, Hilferty)."""
    part = 2 / (9 * freedom)
    return float((1 - part + _RARE * math.sqrt(part)) ** 3)


def _by_level(level: Floats, variance: Floats, limit: float) -> tuple[Floats, Floats]:
    """Return mean levels and mean variances of pixels in bins of equal numbers, without outliers."""
    bins = min(max(level.size // _BIN, 1), _BINS)
    edges = np.unique(np.quantile(level, np.linspace(0, 1, bins + 1)[1:-1]))
    number = np.searchsorted(edges, level, side="right")
    present = np.flatnonzero(np.bincount(number))
    return (
        np.array([level[number == one].mean() for one in present]),
        np.array([_usual(variance[number == one], limit) for one in present]),
    )


def _usual(variance: Floats, limit: float) -> float:
    """Return the mean of variances but for outliers."""
    mean = float(variance.mean())
    for _ in range(50):
        before, mean = mean, float(variance[variance <= limit * mean].mean())
        if mean == before:
            break
    return mean


def _uncut(distance: Floats, variance: Floats, whole: bool) -> Floats:
    """Return the variance that samples would have, were they not cut off at a distance below their mean."""
    near = distance < _FAR * np.sqrt(variance)
    mean, seen = distance[near], variance[near]
    cut, wide = mean, seen
    for _ in range(_STEPS):
        u = np.interp(cut / np.sqrt(np.maximum(wide, _TINY)), _CUT_RATIO, _U)
        noise = np.sqrt(np.maximum(wide / np.interp(u, _U, _CUT_VARIANCE), _TINY))
        if not whole:
            break
        cut = mean + _lost(u, noise)
        wide = seen + mean**2 - ROUNDING * ndtr(u) - cut**2
    uncut = variance.copy()
    uncut[near] = noise**2 + (ROUNDING if whole else 0.0)
    return uncut


def _uncut_mean(distance: Floats, variance: Floats, error: Floats, whole: bool) -> tuple[Floats, Floats]:
    """Return the mean that samples would have, and its squared standard error."""
    noise = np.sqrt(np.maximum(variance - (ROUNDING if whole else 0.0), _TINY))
    near = distance < _FAR * noise
    mean, scale = distance[near], noise[near]
    u = np.interp(mean / scale, _CUT_MEAN, _U)
    for _ in range(_STEPS if whole else 0):
        u = np.interp((mean + _lost(u, scale)) / scale, _CUT_MEAN, _U)
    value, error = distance.copy(), error.copy()
    value[near] = u * scale
    known = error[near] * np.interp(u, _U, _CUT_VARIANCE / ndtr(_U) ** 2)
    error[near] = np.where(u > _U[0], known, variance[near])
    return value, error


def _lost(u: Floats, noise: Floats) -> Floats:
    """Return by how much rounding lowers the mean of what is cut off at 0 (Euler and Maclaurin's formula)."""
    least = math.sqrt(ROUNDING)  # below that the formula fails; rounding_error says what is not known then
    return np.asarray(np.exp(-(u**2) / 2) / (math.sqrt(math.tau) * 24 * np.maximum(noise, least)))


LEAST = 5
"""Samples in full light that a level needs."""

_BRIGHTEST = 3  # which sample, by brightness, tells roughly how bright full light is: no single glint
_LIT = 0.75  # of that light, for samples that full light is looked for among
_WIDTH = 3.0  # standard deviations to either side that belong to full light
_BELOW = 6.0  # and how far down samples tell how many others are among them
_PLATEAU_STEPS = 30
_SETTLED = 1e-3  # standard deviations
_BIN_WIDTH, _HISTOGRAM = 256, 16

# A mean of what lies within a symmetric window about itself scatters more than one of all.
_INSIDE = float(2 * ndtr(_WIDTH) - 1)
_KEPT = _INSIDE - 2 * _WIDTH * math.exp(-(_WIDTH**2) / 2) / math.sqrt(math.tau)
_WASTE = _INSIDE / _KEPT


@dataclass(frozen=True, slots=True, eq=False)
class Plateau:
    """The upper plateau of some pixels' samples.

    Attributes
    ----------
    value, sigma : ndarray, (P,), float64
        Counts, and the standard error; NaN of a pixel that has fewer than five samples there.
    noise : ndarray, (P,), float64
        Standard deviation of its samples.
    count : ndarray, (P,), int64
        How many samples it has.
    """

    value: Floats
    sigma: Floats
    noise: Floats
    count: NDArray[np.int64]


def find_plateau(samples: Floats, dark: Floats, whole: bool) -> Plateau:
    """Find the mean of the samples in full light among those in half light and in none.

    The plateau is where a mean of samples is in the middle of the window of three standard deviations to
    either side that it was taken from: the window cuts off as much above as below, and the mean is free of
    bias, as the mean of the brightest samples is not. The standard deviation is told from the samples
    above the mean, of all pixels of about that level, as none above it are in half light. How many in half
    light lie in the window is told from those just below it, and their share of the mean is taken off.

    Parameters
    ----------
    samples : ndarray, (T, P), float64
        Counts; NaN is no sample.
    dark : ndarray, (P,), float64
        Counts without light.
    whole : bool
        Whether samples are whole numbers.
    """
    lit = samples >= dark + _LIT * (_roughly(samples) - dark)
    value = _mean(samples, lit)
    noise = _noise(samples, value, np.full(value.shape, np.inf))
    for _ in range(_PLATEAU_STEPS):
        before = value
        value = _mean(samples, np.abs(samples - value) <= _WIDTH * noise)
        noise = _noise(samples, value, _BELOW * noise)
        if not np.any(np.abs(value - before) > _SETTLED * noise):
            break
    count = np.count_nonzero(np.abs(samples - value) <= _WIDTH * noise, axis=0)
    value, error = _without_half_light(samples, value, noise, count)
    error += rounding_error(noise**2) if whole else 0.0
    told = count >= LEAST
    return Plateau(np.where(told, value, np.nan), np.where(told, np.sqrt(error), np.nan), noise, count)


def _roughly(samples: Floats) -> Floats:
    """Return the third-brightest sample of each pixel, NaN without one."""
    known = np.where(np.isfinite(samples), samples, -np.inf)
    place = max(len(samples) - _BRIGHTEST, 0)
    rough = np.partition(known, place, axis=0)[place]
    return np.asarray(np.where(np.isfinite(rough), rough, np.nan))


def _mean(samples: Floats, chosen: NDArray[np.bool_]) -> Floats:
    total = np.where(chosen, samples, 0.0).sum(axis=0)
    count = chosen.sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _noise(samples: Floats, value: Floats, reach: Floats) -> Floats:
    """Tell the standard deviation from what lies above the level, from all pixels of about that level."""
    with np.errstate(invalid="ignore"):
        above = (samples > value) & (samples <= value + reach)
    count = above.sum(axis=0)
    squares = np.where(above, (samples - value) ** 2, 0.0).sum(axis=0)
    own = np.maximum(1 - 1 / np.maximum(2 * count, 1), 0.5)  # the level is a mean of these, too
    known = np.flatnonzero(count > 0)
    if not known.size:
        return np.where(np.isfinite(value), 0.0, np.nan)
    order = known[np.argsort(value[known], kind="stable")]
    parts = np.array_split(order, min(max(order.size // _BIN_WIDTH, 1), _HISTOGRAM))
    level = [value[part].mean() for part in parts]
    pooled = [math.sqrt(squares[part].sum() / (count[part] * own[part]).sum()) for part in parts]
    return np.where(np.isfinite(value), np.interp(value, level, pooled), np.nan)


def _without_half_light(
    samples: Floats, value: Floats, noise: Floats, count: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Take off what samples in half light add to the mean; return it and its squared standard error."""
    below = value - samples
    half = ((below > _WIDTH * noise) & (below <= _BELOW * noise)).sum(axis=0)
    half = half * _WIDTH / (_BELOW - _WIDTH)  # as many lie in the window's lower half
    lever = _WIDTH * noise / 2
    full = np.maximum(count - half, 1)
    # Neither how many they are nor where they lie in their half of the window is known.
    error = _WASTE * noise**2 / full + half * (lever**2 + (_WIDTH * noise) ** 2 / 3) / full**2
    return value + half * lever / full, error
