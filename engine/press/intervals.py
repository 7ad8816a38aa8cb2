"""Heights from onsets whose surroundings are known: intervals as likelihoods, and paraboloids through them.

All heights between two frames have one onset. Pixel by pixel their errors are spread evenly over the
interval, but on a surface they are correlated: over each terrace they run from one end to the other. So
their mean is not better for there being more pixels, as that of independent errors would be. But where the
shape of a surface is known, the lines at which one terrace meets the next give its height precisely.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]

_LEAST = 0.02  # of half an interval: what its ends are blurred by at least
_FAR = 6.0  # blurs beyond an end, from which on an onset is an outlier
_SPAN = 20.0  # half intervals that outliers are spread over at least
_FEWEST, _MOST = 1e-4, 0.5  # share of outliers
_SAMPLES = 8192  # of errors that their distribution is estimated from
_ROUNDS = 12  # until the share of outliers is found
_FAINT = 1e-4  # of an end's own weight, below which a weight is not taken to be more sure
_NEAR = 0.02  # by which the logarithm of a blur may be wrong
_END, _DENSE = 8, 64  # of the table of the normal distribution: standard deviations, and entries in one
_TABLE = np.array(
    [math.erfc(-x / _DENSE / math.sqrt(2)) / 2 for x in range(-_END * _DENSE, _END * _DENSE + 1)]
)


class Evidence(NamedTuple):
    """A known height and its weight, (H, W), float64, 1/mm^2; the weight is 0 where nothing is known."""

    height: Doubles
    weight: Doubles


class IntervalErrors(NamedTuple):
    """How errors of known heights are distributed."""

    blur: float  # standard deviation that the ends of intervals are blurred by, mm
    outlier_density: float  # of outliers, 1/mm, over the share of heights that are none


def estimate_interval_errors(error: Doubles, half: Doubles) -> IntervalErrors:
    """Estimate by maximum likelihood how sharp intervals' ends are, and how many onsets are outliers.

    An error e is from a blurred interval with the chance 1 - m, and an outlier, which may be anything, with
    the chance m: its density is (1 - m) P(e) / (2 half) + m / span. Outliers lie on one side, as late onsets
    do, and what is within intervals is no evidence against them: they must not count as blurred ends.

    Parameters
    ----------
    error : ndarray, (n,), float64
        Middles of intervals less the heights, mm.
    half : ndarray, (n,), float64
        Half the intervals' widths, mm. The blur is at least a fiftieth of it.
    """
    thin = slice(None, None, -(-error.size // _SAMPLES))
    error, half = error[thin], half[thin]
    middle = float(np.median(half))
    span = max(float(np.ptp(error)), _SPAN * middle)

    def share(density: Doubles) -> float:
        found = _MOST / 2
        for _ in range(_ROUNDS):
            found = float(np.mean(found / (found + (1 - found) * span * density)))
        return float(np.clip(found, _FEWEST, _MOST))

    def unlikely(size: float) -> float:
        density = _chance(error, half, float(np.exp(size))) / (2 * half)
        outliers = share(density)
        return -float(np.sum(np.log(outliers / span + (1 - outliers) * density)))

    least = np.log(_LEAST * middle)
    most = np.log(max(float(np.max(np.abs(error))), middle)) + 1.0
    sizes = np.linspace(least, most, 12)
    best = int(np.argmin([unlikely(size) for size in sizes]))
    low, high = sizes[max(best - 1, 0)], sizes[min(best + 1, sizes.size - 1)]
    size = min((least, _lowest(unlikely, low, high)), key=unlikely)
    outliers = share(_chance(error, half, float(np.exp(size))) / (2 * half))
    return IntervalErrors(float(np.exp(size)), outliers / (1 - outliers) / span)


def interval_evidence(height: Doubles, middle: Doubles, half: Doubles, spread: IntervalErrors) -> Evidence:
    """Return what intervals say of heights, by one Newton step on their likelihood.

    The likelihood of a height u is the chance that u and an error of the standard deviation ``blur`` lie
    between the interval's ends a and b, P = Phi((b - u) / blur) - Phi((a - u) / blur). Its logarithm has the
    derivative g and the curvature -h at u; the same have a known height u + g / h of the weight h, which is
    multiplied by the chance that it is no outlier. Far outside its interval the weight is 0.

    Parameters
    ----------
    height : ndarray, (n,), float64
        Where it is about, mm.
    middle, half : ndarray, (n,), float64
        Of the intervals, mm.
    spread : IntervalErrors
    """
    blur, outlier_density = spread
    below, above = (middle - half - height) / blur, (middle + half - height) / blur
    near = (below < _FAR) & (above > -_FAR)
    below, above = np.where(near, below, -1.0), np.where(near, above, 1.0)
    chance = _normal(above) - _normal(below)
    left, right = (np.exp(-(end**2) / 2) / np.sqrt(2 * np.pi) / chance for end in (below, above))
    pull = left - right
    weight = np.clip(pull**2 - (below * left - above * right), _FAINT, 1.0)
    sound = chance / (chance + 2 * half * outlier_density)
    return Evidence(height + blur * pull / weight, np.where(near, sound * weight / blur**2, 0.0))


def _chance(error: Doubles, half: Doubles, blur: float) -> Doubles:
    """Return the chance that a blurred height lies in an interval."""
    return _normal((half - error) / blur) - _normal((-half - error) / blur)


def _normal(places: Doubles) -> Doubles:
    """Return the normal distribution, to 1e-7 of it: a table's values and three terms of Taylor's series."""
    places = np.clip(places, -_END, _END)
    number = np.rint((places + _END) * _DENSE).astype(np.intp)
    node = number / _DENSE - _END
    off = places - node
    density = np.exp(-(node**2) / 2) / math.sqrt(2 * math.pi)
    return _TABLE[number] + density * off * (1 - off * (node / 2 - off * (node**2 - 1) / 6))


def _lowest(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function with one valley is lowest, by golden sections."""
    golden = (math.sqrt(5) - 1) / 2
    left, right = high - golden * (high - low), low + golden * (high - low)
    lefts, rights = function(left), function(right)
    while high - low > _NEAR:
        if lefts < rights:
            high, right, rights = right, left, lefts
            left = high - golden * (high - low)
            lefts = function(left)
        else:
            low, left, lefts = left, right, rights
            right = low + golden * (high - low)
            rights = function(right)
    return (low + high) / 2


_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of the offsets along columns and rows
_REACH = 3.0  # widths of the window, to either side
_FLAT = 1e-9  # least share of a fit's information that is worth inverting


class Paraboloids(NamedTuple):
    """Paraboloids at n pixels, (n,), float64."""

    height: Doubles  # mm
    along: Doubles  # (2, n): slopes along columns and rows, mm per pixel
    variance: Doubles  # (2, n): of these
    misfit: (
        Doubles  # mean squared error in standard deviations; NaN where too little is known for a paraboloid
    )
    pixels: Doubles  # with a known height


def fit_paraboloids(height: Doubles, weight: Doubles, places: NDArray[np.bool_], width: float) -> Paraboloids:
    """Fit paraboloids by least squares in a Gaussian window around some places, (H, W).

    Heights are in mm, of any value where the weight, an inverse variance, is 0. The window's width is a
    standard deviation in pixels.
    """
    known = weight > 0
    datum = float(np.average(height[known], weights=weight[known])) if known.any() else 0.0
    relative = np.where(known, height - datum, 0.0)
    window = _Window(places, width)
    powers = [(i, j) for i, j in product(range(5), repeat=2) if i + j <= 4]
    moments = window.sums(weight, powers)
    right = np.stack(list(window.sums(weight * relative, list(_TERMS)).values()), axis=-1)
    matrix = np.stack(
        [np.stack([moments[a + c, b + d] for c, d in _TERMS], axis=-1) for a, b in _TERMS], axis=-2
    )
    square = window.sums(weight * relative**2, [(0, 0)])[0, 0]
    pixels = window.sums(known.astype(np.float64), [(0, 0)])[0, 0]
    inverse, sound = _invert(matrix)
    found = np.einsum("nij,nj->ni", inverse, right)
    residual = np.maximum(square - np.sum(found * right, axis=-1), 0)
    enough = sound & (pixels > 2 * len(_TERMS))
    return Paraboloids(
        height=found[:, 0] + datum,
        along=found[:, 1:3].T,
        variance=np.stack([inverse[:, 1, 1], inverse[:, 2, 2]]),
        misfit=np.where(enough, residual / np.maximum(pixels - len(_TERMS), 1), np.nan),
        pixels=pixels,
    )


class _Window:
    """Sums over a window around some pixels, times powers of the distance in windows' widths."""

    def __init__(self, places: NDArray[np.bool_], width: float) -> None:
        self._places = places
        reach = math.ceil(_REACH * width)
        offset = np.arange(-reach, reach + 1.0)
        self._kernels = [np.exp(-((offset / width) ** 2) / 2) * offset**power for power in range(5)]
        self._one = np.ones(1)

    def sums(self, values: Doubles, powers: list[tuple[int, int]]) -> dict[tuple[int, int], Doubles]:
        """Return sums of values times column offsets and row offsets to the powers, at the pixels."""
        across: dict[int, Doubles] = {}
        found = {}
        for i, j in powers:
            if i not in across:
                across[i] = self._correlate(values, self._kernels[i], self._one)
            found[i, j] = self._correlate(across[i], self._one, self._kernels[j])[self._places]
        return found

    def _correlate(self, values: Doubles, along: Doubles, down: Doubles) -> Doubles:
        border = cv2.BORDER_CONSTANT
        return np.asarray(cv2.sepFilter2D(values, cv2.CV_64F, along, down, borderType=border), np.float64)


def _invert(matrix: Doubles) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return inverses of matrices, and which of them there are; the others are those of the identity."""
    size = np.sqrt(np.maximum(np.einsum("nii->ni", matrix), np.finfo(float).tiny))
    scaled = matrix / (size[:, :, np.newaxis] * size[:, np.newaxis, :])
    sound = np.linalg.eigvalsh(scaled)[:, 0] > _FLAT
    scaled[~sound] = np.eye(matrix.shape[-1])
    return np.linalg.inv(scaled) / (size[:, :, np.newaxis] * size[:, np.newaxis, :]), sound
