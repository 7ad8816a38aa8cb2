"""Errors of slopes that are not independent: correlated from pixel to pixel, or a common gain."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.device_arrays import on_host
from mirrorskin.engine.integration.validation import Inputs
from mirrorskin.io import Result
from mirrorskin.io.base.types import ProcessValue
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma

_SIDES = 8, 16  # of the loops whose curl is compared with that of single corners, pixels
_CROP = 128  # largest side of the part of a picture that is examined, pixels
_MIN_LOOPS = 6  # loops that do not overlap, below which a correlation is not estimated
_CHANCE = 4.0  # ratio of an estimated variance to the true one, up to which chance explains it
_CLEAR_Z_SCORE = 5.0  # standard errors of the ratio of curls above which slopes count as correlated


def correlation_of(inputs: Inputs, length: float | None) -> tuple[float, dict[str, ProcessValue]]:
    """Return the factor of the variance of heights because errors of slopes are correlated, and a note of it.

    If the correlation of errors at a distance d is exp(-(d / l)^2), a mean over a large area has pi l^2 times
    the variance of that of independent errors, and so have heights. Without a length it is estimated.
    """
    note: dict[str, ProcessValue] = {}
    if length is None:
        length = 0.0 if inputs.weights_given else find_correlation(inputs)
        if length:
            note["slope_correlation"] = round(length, 2)
    return max(1.0, math.pi * length**2), note


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


def find_correlation(inputs: Inputs) -> float:
    """Return the distance, pixels, at which the correlation of errors is 1/e; 0 if it is not clear.

    Errors make the sum of the slopes around a loop differ from 0. Around b x b pixels its variance is
    (4 b - 2) s^2 for independent errors of variance s^2. For errors that are correlated over a distance l it
    is about 4 b l pi^(1/2) s^2 for a large loop, and 4 s^2 / l^2 for a single corner. Medians are used, so
    that breaks and outliers do not count. Slopes on a device are not examined.

    The sum around a loop is that of its b^2 corners, so correlated errors increase its variance by at most
    b^4. A larger increase has another cause: slopes with little noise, or none, are contradictory only at
    creases, which most corners do not touch but most loops do.
    """
    if isinstance(inputs.dz_dx, Array):
        return 0.0
    box = tuple(slice(max(0, (n - _CROP) // 2), (n + _CROP) // 2) for n in inputs.shape)
    first, (width, height) = inputs.each()[0], inputs.pixel_size
    x, y = first.dz_dx[box], first.dz_dy[box]
    missing = ~(np.isfinite(x) & np.isfinite(y))
    if inputs.mask is not None:
        missing |= inputs.mask[box] == 0
    maps = [np.where(missing, np.float32(0), slope) for slope in (x, y)] if missing.any() else [x, y]
    rises = _sums_to(maps[0], width, 1), _sums_to(maps[1], height, 0)
    gaps = (_sums_to(missing, 1.0, 1), _sums_to(missing, 1.0, 0)) if missing.any() else None
    corner, longest = mad_sigma(_curls(rises, gaps, 1)), 0.0
    for side in _SIDES:
        curls = _curls(rises, gaps, side)
        loops = curls.size * (_step(side) / side) ** 2
        if loops < _MIN_LOOPS or not corner:
            break
        increase = (mad_sigma(curls) / corner) ** 2
        ratio = increase * 2 / (4 * side - 2)
        if increase <= _CHANCE * side**4 and ratio > 1 + _CLEAR_Z_SCORE * math.sqrt(3 / loops):
            longest = max(longest, (2 * ratio / math.sqrt(math.pi)) ** (1 / 3))
    return longest


def _sums_to(map_: NDArray[Any], length: float, axis: int) -> Doubles:
    """Return sums of means of two neighbours times a length, from the first pixel to each along an axis."""
    rows = np.moveaxis(map_, axis, 0)
    sums = np.zeros(rows.shape)
    np.cumsum(rows[1:], axis=0, dtype=np.float64, out=sums[1:])
    sums[1:] += (rows[0] * 0.5 - rows[1:] * 0.5).astype(np.float64)
    return np.moveaxis(sums * length, 0, axis)


def _step(side: int) -> int:
    """Return the distance of the loops that are looked at, pixels."""
    return max(2, side // 2)


def _curls(sums: tuple[Doubles, Doubles], gaps: tuple[Doubles, Doubles] | None, side: int) -> Doubles:
    """Return the sums around squares of side x side links where all slopes exist, (loops,)."""
    if min(sums[0].shape) <= side:
        return np.zeros(0)
    sides = [_around(values, side) for values in (sums, gaps) if values is not None]
    top, bottom, before, after = sides[0]
    curl = bottom - top + after - before
    return curl.ravel() if gaps is None else curl[np.sum(sides[1], axis=0) == 0]


def _around(sums: tuple[Doubles, Doubles], side: int) -> list[Doubles]:
    """Return the sums along the four sides of squares: top, bottom, left, right."""
    along, down = sums
    step = _step(side)
    first, last = slice(None, -side, step), slice(side, None, step)
    return [
        along[first, last] - along[first, first],
        along[last, last] - along[last, first],
        down[last, first] - down[first, first],
        down[last, last] - down[first, last],
    ]
