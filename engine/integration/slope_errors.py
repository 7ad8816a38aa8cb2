"""Errors of slopes that are not independent: correlated from pixel to pixel, or a common gain."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import on_host
from mirrorskin.engine.integration.validation import Inputs
from mirrorskin.io import Result
from mirrorskin.io.base.findings import Finding, in_process
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma
from mirrorskin.kernels.numerics.samples import Grid, take_grids

_SIDES = 2, 4, 8, 16  # of the loops whose curl is compared with that of single corners, pixels
_CROP = 128  # largest side of the part of a picture that is examined, pixels
_MIN_PAIRS = 24  # pairs of corners at a distance, below which their covariance is unknown
_DENSE = 0.9  # corners for each pixel with slopes, from which on little is missing
_MIN_CORNERS = 60  # corners below which nothing is estimated
_OUTLIER = 4.0  # standard deviations of the curl beyond which a corner does not count
_CHANCE = 4.0  # ratio of an estimated variance to the true one, up to which chance explains it
_CLEAR_Z_SCORE = 5.0  # standard errors above which slopes count as correlated, or their errors as understated
_UNDERSTATED = 2.0  # factor of the variance of heights above which stated weights are reported
_LENGTHS = 48  # lengths of correlation that are tried for each side
_UNDERSTATED_TEXT = (
    "slopes contradict each other more than their stated errors allow: height_sigma is {:.2g} times what"
    " follows from these"
)
_UNEXAMINED_TEXT = (
    "too few neighbouring slopes to show how their errors are correlated: they are assumed to be independent"
)


@dataclass(frozen=True, slots=True)
class SlopeErrors:
    """What the curl of slopes shows about their errors."""

    length: float = 0.0  # pixels at which the correlation is 1/e; 0 if it is not clear
    variance: float = 1.0  # over the stated one
    examined: bool = True  # whether there were enough pairs of corners
    sparse: bool = False  # whether many corners are missing between pixels


def correlation_of(
    inputs: Inputs, length: float | None, respond: Callable[[float], float] | None = None
) -> tuple[float, dict[str, ProcessValue]]:
    """Return the factor of the variance of heights because of the errors of slopes, and notes of it.

    If the correlation of errors at a distance d is exp(-(d / l)^2), a mean over a large area has pi l^2 times
    the variance of that of independent errors, and so have heights where little is missing; ``respond``
    returns the factor otherwise. Without a length it is estimated, and stated variances are compared with the
    curl.
    """
    if length is not None:
        return max(1.0, math.pi * length**2), {}
    errors, note, findings = find_errors(inputs), dict[str, ProcessValue](), []
    factor = 1.0
    if errors.length:
        note["slope_correlation"] = round(errors.length, 2)
        factor = max(1.0, respond(errors.length) if respond and errors.sparse else math.pi * errors.length**2)
    if inputs.weights_given:
        factor = max(1.0, factor * errors.variance)
        if factor > _UNDERSTATED:
            findings.append(Finding("understated slopes", _UNDERSTATED_TEXT.format(math.sqrt(factor))))
    if not errors.examined:
        findings.append(Finding("unexamined slopes", _UNEXAMINED_TEXT, warning=False))
    return factor, {**note, **in_process(findings, note)}


def draw_errors(inputs: Inputs, length: float, count: int) -> Inputs:
    """Return inputs of surfaces whose slopes are errors of stated variances, correlated over a length."""
    from scipy import fft

    margin = math.ceil(2 * length)
    rows, columns = shape = [fft.next_fast_len(n + margin, real=True) for n in inputs.shape]
    waves = np.add.outer(np.square(fft.fftfreq(rows)), np.square(fft.rfftfreq(columns)))
    gain = np.exp(-waves * (math.pi * length) ** 2 / 2)
    gain /= math.sqrt(float(np.sum(fft.irfft2(gain, shape) ** 2)))
    white = np.random.default_rng(0).standard_normal((2, count, *shape), np.float32)
    drawn = fft.irfft2(fft.rfft2(white) * gain, shape)[..., : inputs.shape[0], : inputs.shape[1]]
    planes = inputs.weight_x, inputs.weight_x if inputs.weight_y is None else inputs.weight_y
    slopes = []
    for values, plane in zip(drawn, map(on_host, planes), strict=True):
        weight = np.float32(inputs.typical_weight) if plane is None else np.where(plane > 0, plane, 1)
        slopes.append((values / np.sqrt(weight)).astype(np.float32))
    known = inputs.known_heights
    return replace(
        inputs,
        dz_dx=slopes[0],
        dz_dy=slopes[1],
        known_heights=None if known is None else np.where(np.isfinite(known), np.float32(0), known),
        datum=0.0,
    )


def add_gain(result: Result, gain: float) -> Result:
    """Return a surface whose standard deviation contains a common gain of the slopes.

    A gain of standard deviation g adds g^2 (u - m)^2 with m the mean height of the component.
    """
    if result.height_sigma is None or not gain:
        return result
    sigma = result.height_sigma
    heights = np.asarray(on_host(result.height), np.float64).reshape(-1, *sigma.shape)
    above = np.max([np.abs(_about_means(height, result.component)) for height in heights], axis=0)
    return result.assign(height_sigma=np.hypot(sigma, np.float32(gain) * above.astype(np.float32)))


def _about_means(height: NDArray[Any], component: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return heights above the mean of their component."""
    answered = component >= 0
    part = component[answered]
    means = np.bincount(part, height[answered]) / np.maximum(np.bincount(part), 1)
    above = np.zeros(height.shape)
    above[answered] = height[answered] - means[part]
    return above


def find_errors(inputs: Inputs) -> SlopeErrors:
    """Estimate how slopes are wrong, from their curl.

    Errors make the sum of the slopes around a loop differ from 0. Around b x b pixels its variance is
    (4 b - 2) s^2 for independent errors of variance s^2. For errors that are correlated over a distance l it
    is about 4 b l pi^(1/2) s^2 for a large loop, and 4 s^2 / l^2 for a single corner. The sum around a loop
    is that of its b^2 corners, so its variance follows from the covariances of corners at each distance,
    which any pairs of corners show, whatever is missing between them. Corners beyond four standard deviations
    do not count, such as those at breaks and outliers.

    Correlated errors increase the variance of a loop over that of a corner by at most b^4. A larger increase
    has another cause: slopes with little noise, or none, are contradictory only at creases, which most
    corners do not touch but most loops do.
    """
    curl, valid, share = _curl(inputs.each()[0].weighted())
    if np.count_nonzero(valid) < _MIN_CORNERS:
        return SlopeErrors(examined=False)
    noise = mad_sigma(curl[valid])
    if not noise:
        return SlopeErrors()
    valid &= np.abs(curl) <= _OUTLIER * noise
    covariance, pairs = _covariances(np.where(valid, curl, 0).astype(np.float32), valid)
    if pairs[:_NEAR].min() < _MIN_PAIRS:
        return SlopeErrors(examined=False)
    corner, sparse = covariance[0], share < _DENSE
    length, variance = 0.0, corner
    understated = corner - 1 > _CLEAR_Z_SCORE * math.sqrt(_SPREAD * 2 / pairs[0])
    for side in _SIDES:
        weights, lengths, increases, variances = _loop_model(side)
        if np.any(pairs[weights != 0] < _MIN_PAIRS):
            break
        increase, independent = float(weights @ covariance) / corner, 2 * side - 1
        spread = math.sqrt(float(weights**2 @ (2 * _SPREAD / np.maximum(pairs, 1))))
        if increase - independent > _CLEAR_Z_SCORE * spread and increase <= _CHANCE * side**4:
            length = max(length, float(np.interp(increase, increases, lengths)))
            variance = corner * float(np.interp(length, lengths, variances))
        elif not length:  # contradictions that cancel around loops are no errors of heights
            variance = min(variance, corner * (increase + 2 * spread) / independent)
    if not (length or understated):
        variance = 1.0
    return SlopeErrors(length, variance, sparse=sparse)


def _curl(inputs: Inputs) -> tuple[NDArray[Any], NDArray[np.bool_], float]:
    """Return sums around corners of a part of the picture, over their stated sigma, and where they exist.

    Also the number of corners over that of pixels with slopes.
    """
    width, height = inputs.pixel_size
    wanted = np.ones(inputs.shape, bool) if inputs.mask is None else inputs.mask != 0
    if isinstance(inputs.dz_dx, np.ndarray):
        wanted &= np.isfinite(inputs.dz_dx) & np.isfinite(inputs.dz_dy)
    box = _fullest(wanted)
    maps = [
        map_ for map_ in (inputs.dz_dx, inputs.dz_dy, inputs.weight_x, inputs.weight_y) if map_ is not None
    ]
    x, y, *planes = _parts(maps, box)
    defined = np.logical_and.reduce([wanted[box], np.isfinite(x), np.isfinite(y), *(w > 0 for w in planes)])
    x, y = (np.where(defined, slope, np.float32(0)) for slope in (x, y))
    curl = width / 2 * np.diff(x[:, 1:] + x[:, :-1], axis=0) + height / 2 * np.diff(y[1:] + y[:-1], axis=1)
    closed = defined[1:] & defined[:-1]
    closed = closed[:, 1:] & closed[:, :-1]
    share = float(np.count_nonzero(closed)) / max(1.0, float(np.count_nonzero(defined)))
    if not planes:
        return curl / math.sqrt((width**2 + height**2) / inputs.typical_weight), closed, share
    variance = np.zeros(curl.shape, np.float32)
    for size, plane in zip((width, height), (planes[0], planes[-1]), strict=True):
        each = size**2 / 4 / np.where(defined, plane, np.inf)
        lines = each[1:] + each[:-1]
        variance += lines[:, 1:] + lines[:, :-1]
    return curl / np.sqrt(np.where(closed, variance, 1)), closed, share


def _parts(maps: list[NDArray[np.float32]], box: tuple[slice, slice]) -> list[NDArray[np.float32]]:
    """Return a part of maps that may be on a device."""
    if not isinstance(maps[0], Array):
        return [map_[box] for map_ in maps]
    (top, left), (tall, wide) = zip(*((side.start, side.stop - side.start) for side in box), strict=True)
    columns = maps[0].shape[1]
    grids = [Grid(map_, top * columns + left, (0, columns, 1), (1, tall, wide)) for map_ in maps]
    return [values[0, 0] for values in take_grids(*grids)]


def _fullest(defined: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the part of at most 128 x 128 pixels in the middle, or among tiles, with the most slopes."""
    rows, columns = (max(1, n // _CROP) for n in defined.shape)
    tall, wide = (min(n, _CROP) for n in defined.shape)
    top, left = ((n - min(n, _CROP)) // 2 for n in defined.shape)
    best, most = (slice(top, top + tall), slice(left, left + wide)), -1
    for number in range(-1, rows * columns):
        if number >= 0:
            top, left = number // columns * tall, number % columns * wide
        box = slice(top, top + tall), slice(left, left + wide)
        count = int(np.count_nonzero(defined[box]))
        if count > most:
            best, most = box, count
        if most == tall * wide:
            break
    return best


_REACH = max(_SIDES)
_NEAR = 5  # bins of the nearest distances
_SPREAD = 1.25  # sum of squares of the covariances of corners for independent errors, over that of one


def _bin_numbers() -> NDArray[np.intp]:
    """Return the bin of each shift: opposite near ones are one bin, others those of about one distance."""
    down, right = np.indices((2 * _REACH - 1, 2 * _REACH - 1)) - (_REACH - 1)
    numbers = _NEAR - 2 + np.rint(np.hypot(down, right)).astype(np.intp)
    near = np.maximum(np.abs(down), np.abs(right)) <= 1
    numbers[near] = (np.abs(down) + 2 * np.abs(right) + (down * right < 0))[near]
    return numbers


_NUMBERS = _bin_numbers()


def _covariances(curl: NDArray[np.float32], valid: NDArray[np.bool_]) -> tuple[Doubles, Doubles]:
    """Return for each bin of `_bin_numbers` the mean product of two corners, and the number of pairs."""
    shape = [cv2.getOptimalDFTSize(n + _REACH) for n in curl.shape]
    sums = []
    for values in (curl, valid.astype(np.float32)):
        power = np.fft.irfft2(np.abs(np.fft.rfft2(values, shape)) ** 2, shape)
        shifts = [np.arange(1 - _REACH, _REACH) % n for n in shape]
        inside = [np.abs(np.arange(1 - _REACH, _REACH)) < n for n in curl.shape]
        total = np.where(inside[0][:, np.newaxis] & inside[1], power[np.ix_(*shifts)], 0.0)
        sums.append(np.bincount(_NUMBERS.ravel(), total.ravel()))
    pairs = np.rint(sums[1])
    return sums[0] / np.maximum(pairs, 1), pairs


@functools.cache
def _loop_model(side: int) -> tuple[Doubles, Doubles, Doubles, Doubles]:
    """Return the weights of bins in the variance around a loop, and how it depends on the correlation.

    The latter are lengths l, and the variances around a loop and of a slope, over that of a corner. The
    covariance of corners is the convolution of exp(-(d / l)^2) with that of independent errors; their
    variance is then twice that of slopes.
    """
    line = np.maximum(side - np.abs(np.arange(1 - _REACH, _REACH)), 0.0)
    weights = np.multiply.outer(line, line)
    shift = np.arange(-_REACH, _REACH + 1.0)
    lengths = np.geomspace(0.4, side, _LENGTHS)
    increases, variances = np.empty((2, _LENGTHS))
    for number, length in enumerate(lengths):
        covariance = np.exp(-np.square(shift / length))
        means = (covariance[2:] + 2 * covariance[1:-1] + covariance[:-2]) / 4
        differences = 2 * covariance[1:-1] - covariance[2:] - covariance[:-2]
        corners = np.multiply.outer(means, differences)
        corners = corners + corners.T
        corner = float(corners[_REACH - 1, _REACH - 1])
        increases[number], variances[number] = float(np.sum(weights * corners)) / corner, 2 / corner
    binned = np.bincount(_NUMBERS.ravel(), weights.ravel()).astype(np.float64)
    return binned, lengths, increases, variances
