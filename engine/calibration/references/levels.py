"""The level behind a pixel's noisy, rounded and clipped samples, and how well it is known."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from mirrorskin.engine.calibration.references.moments import Moments
from mirrorskin.io.types import Floats

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
