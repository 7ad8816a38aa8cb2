"""Heights from onsets near a predicted surface: intervals as likelihoods, and local paraboloids.

All heights between two frames have the same onset. The error of a single pixel is uniformly distributed over
the interval, but errors of neighbours are correlated: over each terrace they run from one end to the other.
Therefore the mean over many pixels is not more accurate. But if the shape of the surface is given, the lines
between terraces determine its height precisely.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

_MAX_SIGMA = 1.5  # greatest sigma of a height between two frames, in sigmas of the interval
_LEAST_SIGMA = 0.4  # least one over the distance to the nearer frame: docs/method/press.md, "Sub-frame onset"
_ROUNDED = 1e-3  # error of a height by its rounding, as a share of an interval
_LEAST_EXACT, _SHARED_BY = 0.25, 4  # least share of heights that are a middle; samples that show one
_ADJOIN = 0.6  # least distance of the middles of intervals, in their widths by sigma
_MIN_BLUR = 0.02  # minimum blur of an interval's ends, as a share of its half-width
_FAR = 6.0  # blurs outside an interval beyond which an onset is an outlier
_SPAN = 20.0  # half-widths: minimum range over which outliers are distributed
_MIN_OUTLIERS, _MAX_OUTLIERS = 1e-4, 0.5  # limits of the share of outliers
_SAMPLES = 8192  # maximum number of errors from which their distribution is estimated
_ITERATIONS = 12  # iterations of the share of outliers
_MIN_CURVATURE = 1e-4  # least curvature of the log-likelihood, relative to that of a single sharp end
_NEAR = 0.02  # tolerance of the logarithm of the blur
# Coefficients of a rational function, highest power first: Hart's algorithm 5666, see West (2005), "Better
# approximations to cumulative normal functions".
_ABOVE = (
    0.0352624965998911, 0.700383064443688, 6.37396220353165, 33.912866078383,
    112.079291497871, 221.213596169931, 220.206867912376,
)  # fmt: skip
_BELOW = (
    0.0883883476483184, 1.75566716318264, 16.064177579207, 86.7807322029461,
    296.564248779674, 637.333633378831, 793.826512519948, 440.413735824752,
)  # fmt: skip


class Evidence(NamedTuple):
    """A height, mm, and its weight, 1/mm^2, both (H, W) float64; the weight is 0 without evidence."""

    height: Doubles
    weight: Doubles


class Intervals(NamedTuple):
    """Middles and standard deviations of heights, mm, both (H, W) float64."""

    middle: Doubles
    sigma: Doubles


def heights_as_intervals(height: Doubles, sigma: Doubles, travel: Doubles) -> Intervals:
    """Return heights of a press, moved to the middles of their intervals between two frames.

    Where light from neighbours reaches a pixel, a sample near the threshold moves the height off the middle
    by up to a quarter of the interval, although its error is still the error of the interval. These shifts
    differ at both ends of an interval, so an interval around such a height would shift the surface. Heights
    whose sigma is that of samples on an edge are unchanged, and those whose sigma is larger.

    Parameters
    ----------
    height, sigma : ndarray, (H, W), float64
        Heights before any correction, and their standard deviations, mm; NaN where unknown.
    travel : ndarray, (T,), float64
        Travel of the frames, mm.
    """
    middle, usual, between = _between_frames(height, sigma, travel)
    return Intervals(np.where(between, middle, height), np.where(between, usual, sigma))


def stored_heights_as_intervals(height: Doubles, sigma: Doubles, travel: Doubles | None) -> Intervals:
    """Return heights of a result, moved to the middles of their intervals between two frames.

    As `heights_as_intervals`, for heights that may have been changed since. Most heights between two frames
    are their exact middle: if less than a quarter are, such as after a correction for the elastomer, all are
    unchanged. Their sigma shows by how much checks have enlarged that of an interval. Without a travel,
    middles are the heights that several pixels share.
    """
    finite = np.isfinite(height) & np.isfinite(sigma)
    if travel is None:
        travel = _estimated_travel(height[finite], sigma[finite])
    middle, usual, between = _between_frames(height, sigma, travel)
    exact = between & (np.abs(height - middle) < _ROUNDED * usual)
    if np.count_nonzero(exact) <= _LEAST_EXACT * np.count_nonzero(finite):
        return Intervals(height, sigma)
    larger = np.median(sigma[exact] / usual[exact])
    return Intervals(np.where(between, middle, height), np.where(between, larger * usual, sigma))


def _estimated_travel(height: Doubles, sigma: Doubles) -> Doubles:
    """Return the travel of frames between heights that several pixels share.

    It is empty if there are none, or if they are much nearer than intervals of their sigma.
    """
    values, count = np.unique(height[:: -(-height.size // _SAMPLES) or 1], return_counts=True)
    middles = -values[count >= _SHARED_BY][::-1]
    if middles.size < 2 or np.min(np.diff(middles)) < _ADJOIN * math.sqrt(12) * np.median(sigma):
        return np.empty(0)
    half = np.diff(middles) / 2
    return np.concatenate([middles[:1] - half[0], middles[:-1] + half, middles[-1:] + half[-1]])


def _between_frames(
    height: Doubles, sigma: Doubles, travel: Doubles
) -> tuple[Doubles, Doubles, NDArray[np.bool_]]:
    """Return middles and sigmas of the intervals between frames, and which heights are in one."""
    ends = np.unique(travel)
    if ends.size < 2:
        return height, sigma, np.zeros(height.shape, bool)
    # A crossing may be exactly at the later frame, and its height is rounded.
    earlier = -np.nan_to_num(height) - np.sign(travel[-1] - travel[0]) * _ROUNDED * np.min(np.diff(ends))
    place = np.clip(np.searchsorted(ends, earlier), 1, ends.size - 1)
    usual = (ends[place] - ends[place - 1]) / math.sqrt(12)
    nearer = np.minimum(np.abs(height + ends[place - 1]), np.abs(height + ends[place]))
    between = (sigma > _LEAST_SIGMA * nearer) & (sigma < _MAX_SIGMA * usual)
    between &= (-height >= ends[0]) & (-height <= ends[-1])
    return -(ends[place] + ends[place - 1]) / 2, usual, between


class IntervalScatter(NamedTuple):
    """Distribution of the errors of interval-valued heights."""

    blur: float  # standard deviation of the ends of intervals, mm
    outlier_density: float  # density of outliers, 1/mm, over the share of the other heights


def estimate_interval_scatter(error: Doubles, half: Doubles) -> IntervalScatter:
    """Estimate the blur of intervals' ends and the share of outliers, by maximum likelihood.

    With P(e) the probability of an error e for a blurred interval, and m the share of outliers, which are
    uniformly distributed over a span, the density of errors is (1 - m) P(e) / (2 half) + m / span. Outliers
    are on one side, such as late onsets; without this term they would be mistaken for blur.

    Parameters
    ----------
    error : ndarray, (n,), float64
        Middles of the intervals less the predicted heights, mm.
    half : ndarray, (n,), float64
        Half-widths of the intervals, mm. The blur is at least a fiftieth of their median.
    """
    thin = slice(None, None, -(-error.size // _SAMPLES))
    error, half = error[thin], half[thin]
    middle = float(np.median(half))
    span = max(float(np.ptp(error)), _SPAN * middle)

    def share(density: Doubles) -> float:
        outliers = _MAX_OUTLIERS / 2
        for _ in range(_ITERATIONS):
            outliers = float(np.mean(outliers / (outliers + (1 - outliers) * span * density)))
        return float(np.clip(outliers, _MIN_OUTLIERS, _MAX_OUTLIERS))

    def unlikely(size: float) -> float:
        density = _chance(error, half, float(np.exp(size))) / (2 * half)
        outliers = share(density)
        return -float(np.sum(np.log(outliers / span + (1 - outliers) * density)))

    lowest = np.log(_MIN_BLUR * middle)
    highest = np.log(max(float(np.max(np.abs(error))), middle)) + 1.0
    sizes = np.linspace(lowest, highest, 12)
    best = int(np.argmin([unlikely(size) for size in sizes]))
    low, high = sizes[max(best - 1, 0)], sizes[min(best + 1, sizes.size - 1)]
    size = min((lowest, _lowest(unlikely, low, high)), key=unlikely)
    outliers = share(_chance(error, half, float(np.exp(size))) / (2 * half))
    return IntervalScatter(float(np.exp(size)), outliers / (1 - outliers) / span)


def interval_evidence(height: Doubles, middle: Doubles, half: Doubles, spread: IntervalScatter) -> Evidence:
    """Return heights and weights that approximate the likelihood of intervals, by one Newton step.

    The likelihood of a height u is the probability that u plus an error of standard deviation ``blur`` is
    between the interval's ends a and b, P = Phi((b - u) / blur) - Phi((a - u) / blur). With the derivative g
    and the curvature -h of its logarithm at u, it is equivalent to a height u + g / h of weight h. The weight
    is multiplied by the probability that the onset is not an outlier; far outside its interval it is 0.

    Parameters
    ----------
    height : ndarray, (n,), float64
        Predicted heights, mm.
    middle, half : ndarray, (n,), float64
        Middles and half-widths of the intervals, mm.
    spread : IntervalScatter
    """
    at, weight = np.empty(height.shape), np.empty(height.shape)
    for first in range(0, height.size, _SAMPLES):  # few at a time, which stay in the cache
        part = slice(first, first + _SAMPLES)
        at[part], weight[part] = _evidence(height[part], middle[part], half[part], spread)
    return Evidence(at, weight)


def _evidence(height: Doubles, middle: Doubles, half: Doubles, spread: IntervalScatter) -> Evidence:
    blur, outlier_density = spread
    below, above = (middle - half - height) / blur, (middle + half - height) / blur
    near = (below < _FAR) & (above > -_FAR)
    below, above = np.where(near, below, -1.0), np.where(near, above, 1.0)
    bells = bell_below, bell_above = np.exp(-below * below / 2), np.exp(-above * above / 2)
    chance = _distribution(above, bell_above) - _distribution(below, bell_below)
    density_below, density_above = (bell / (math.sqrt(2 * math.pi) * chance) for bell in bells)
    pull = density_below - density_above
    weight = np.clip(pull**2 - (below * density_below - above * density_above), _MIN_CURVATURE, 1.0)
    sound = chance / (chance + 2 * half * outlier_density)
    return Evidence(height + blur * pull / weight, np.where(near, sound * weight / blur**2, 0.0))


def _chance(error: Doubles, half: Doubles, blur: float) -> Doubles:
    """Return the probability of an error for a blurred interval."""
    return normal_distribution((half - error) / blur) - normal_distribution((-half - error) / blur)


def normal_distribution(x: Doubles) -> Doubles:
    """Return the distribution function of a standard normal variable, with an error of 1e-15.

    Loading SciPy's function, which a fusion does not need otherwise, would take a fifth of a second.
    """
    return _distribution(x, np.exp(-x * x / 2))


def _distribution(x: Doubles, bell: Doubles) -> Doubles:
    """Return the distribution function at x, given exp(-x^2 / 2)."""
    distance = np.abs(x)
    tail: Doubles = bell * np.polyval(_ABOVE, distance) / np.polyval(_BELOW, distance)
    return np.where(x > 0, 1 - tail, tail)


def _lowest(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the minimum of a function with one minimum, by golden-section search.

    Loading SciPy's minimiser, which a fusion does not need otherwise, would take a quarter of a second.
    """
    golden = (math.sqrt(5) - 1) / 2
    first, second = high - golden * (high - low), low + golden * (high - low)
    firsts, seconds = function(first), function(second)
    while high - low > _NEAR:
        if firsts < seconds:
            high, second, seconds = second, first, firsts
            first = high - golden * (high - low)
            firsts = function(first)
        else:
            low, first, firsts = first, second, seconds
            second = low + golden * (high - low)
            seconds = function(second)
    return (low + high) / 2


_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of the column and row offsets
_REACH = 3.0  # half the size of the window, in its widths
_MIN_PIVOT = 1e-9  # least pivot of a scaled normal matrix that is inverted


class Paraboloids(NamedTuple):
    """Paraboloids at n pixels, (n,), float64."""

    height: Doubles  # mm
    along: Doubles  # (2, n): slopes along columns and rows, mm per pixel
    variance: Doubles  # (2, n): variances of the slopes
    misfit: Doubles  # mean squared residual in standard deviations; NaN with too few pixels for a paraboloid
    pixels: Doubles  # number of pixels with a height


def fit_paraboloids(height: Doubles, weight: Doubles, places: NDArray[np.bool_], width: float) -> Paraboloids:
    """Fit paraboloids by least squares in a Gaussian window around each of some pixels, a mask (H, W).

    Heights are in mm; weights are inverse variances, 0 without a height. ``width`` is the standard deviation
    of the window, pixels.
    """
    reach = math.ceil(_REACH * width)
    used = (np.flatnonzero(places.any(axis=axis)) for axis in (1, 0))
    box = tuple(
        slice(max(at[0] - reach, 0), at[-1] + reach + 1) if at.size else slice(None) for at in used
    )  # of all windows
    height, weight, places = height[box], weight[box], places[box]
    valid = weight > 0
    datum = float(np.average(height[valid], weights=weight[valid])) if valid.any() else 0.0
    relative = np.where(valid, height - datum, 0.0)
    window = _Window(places, width, reach)
    powers = [(i, j) for i, j in product(range(5), repeat=2) if i + j <= 4]
    moments = window.sums(weight, powers)
    right = np.stack(list(window.sums(weight * relative, list(_TERMS)).values()))
    matrix = np.stack([[moments[a + c, b + d] for c, d in _TERMS] for a, b in _TERMS])
    square = window.sums(weight * relative**2, [(0, 0)])[0, 0]
    pixels = window.sums(valid.astype(np.float64), [(0, 0)])[0, 0]
    terms, variance, sound = _solve(matrix, right)
    residual = np.maximum(square - np.sum(terms * right, axis=0), 0)
    enough = sound & (pixels > 2 * len(_TERMS))
    return Paraboloids(
        height=terms[0] + datum,
        along=terms[1:3],
        variance=variance[1:3],
        misfit=np.where(enough, residual / np.maximum(pixels - len(_TERMS), 1), np.nan),
        pixels=pixels,
    )


class _Window:
    """Moments over a Gaussian window around some pixels, with offsets in widths of the window."""

    def __init__(self, places: NDArray[np.bool_], width: float, reach: int) -> None:
        self._places = places
        offset = np.arange(-reach, reach + 1.0)
        self._kernels = [np.exp(-((offset / width) ** 2) / 2) * offset**power for power in range(5)]
        self._one = np.ones(1)

    def sums(self, values: Doubles, powers: list[tuple[int, int]]) -> dict[tuple[int, int], Doubles]:
        """Return sums of values times powers of the column and row offsets, at the pixels."""
        across: dict[int, Doubles] = {}
        sums = {}
        for i, j in powers:
            if i not in across:
                across[i] = self._correlate(values, self._kernels[i], self._one)
            sums[i, j] = self._correlate(across[i], self._one, self._kernels[j])[self._places]
        return sums

    def _correlate(self, values: Doubles, along: Doubles, down: Doubles) -> Doubles:
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, along, down, borderType=border), np.float64)


def _solve(matrix: Doubles, right: Doubles) -> tuple[Doubles, Doubles, NDArray[np.bool_]]:
    """Return the solutions of n systems, (K, n), the diagonals of the inverses, and which are regular.

    The matrices, (K, K, n), are symmetric. Cholesky's factor of each, scaled to a diagonal of 1, is inverted.
    """
    count = len(matrix)
    diagonal = matrix[range(count), range(count)]
    size = np.sqrt(np.maximum(diagonal, np.finfo(float).tiny))
    factor, inverse = np.zeros(matrix.shape), np.zeros(matrix.shape)
    sound: NDArray[np.bool_] = np.min(diagonal, axis=0) > 0
    for row in range(count):
        for column in range(row):
            known = np.sum(factor[row, :column] * factor[column, :column], axis=0)
            factor[row, column] = matrix[row, column] / (size[row] * size[column]) - known
            factor[row, column] /= factor[column, column]
        pivot = 1 - np.sum(factor[row, :row] ** 2, axis=0)
        sound &= pivot > _MIN_PIVOT
        root = factor[row, row] = np.sqrt(np.where(sound, pivot, 1.0))
        inverse[row, row] = 1 / root
        for column in range(row):
            known = np.sum(factor[row, column:row] * inverse[column:row, column], axis=0)
            inverse[row, column] = -known / root
    scaled = np.einsum("abn,bn->an", inverse, right / size)
    return np.einsum("abn,an->bn", inverse, scaled) / size, np.sum(inverse**2, axis=0) / size**2, sound
