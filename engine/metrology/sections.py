"""Cross-sections of height maps, also averaged: lengths, slope, steps and grooves (ISO 5436-1, 25178-70)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.base.inputs import Maps, as_result, spacing
from mirrorskin.engine.base.resample import SamplePoints
from mirrorskin.engine.metrology.fitting import at_least, covariance
from mirrorskin.engine.metrology.noise import correlation
from mirrorskin.engine.metrology.patch import heights_of, independent_share, noise_length
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.io import InputError, Result
from mirrorskin.io.base.arguments import as_array, check_number, checked, in_unit
from mirrorskin.io.base.findings import findings_of
from mirrorskin.io.base.types import axes_with_unit
from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]
Point = tuple[float, float]

_ROUNDING = 1e-6  # share of a pixel that is neglected
_LEVEL = 0.01  # share of the range of heights within which points are as high as the highest one
_WINDOW = 3  # pixels per side of the median filter that removes spikes
_MIN_SAMPLES = 4  # smallest number of samples on either side of a step
_LEAST_SHARED = 1e-4  # smallest share of the variance that the mean of parallel profiles keeps
_CLEAR_DEPTH = 8.0  # smallest depth of a groove, in root mean squares of what it leaves of the section
_LEFT_OUT = 1 / 3  # share of either side that is ignored next to the step, which may be rounded or a ramp


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Heights along a straight line across the picture.

    Attributes
    ----------
    distance : ndarray, (n,), float64
        Distance from the start, in ``unit``; samples are one pixel apart.
    x, y : ndarray, (n,), float64
        Position relative to the picture's centre, in ``unit``.
    height, sigma : ndarray, (n,), float64
        Millimetres: heights interpolated between four pixels, NaN next to a hole and between components; and
        their standard deviations, NaN if unknown or if the height was filled.
    filled : ndarray, (n,), bool
        Whether the height was filled, not measured.
    unit : {"mm", "px"}
        Millimetres, or pixels if their size is unknown.
    notes : tuple of str
        Warnings and notes of the result.
    correlation : callable or None
        Returns the correlation of the errors of two heights at each distance, (n,), float64, which only
        steps need; None if errors are independent.
    common : ndarray, (n,), float64, or None
        Part of ``sigma``, mm, of the mean of several profiles that equal heights have in common.
    """

    distance: Doubles
    x: Doubles
    y: Doubles
    height: Doubles
    sigma: Doubles
    filled: Mask
    unit: str = "mm"
    notes: tuple[str, ...] = ()
    correlation: Callable[[], Doubles] | None = None
    common: Doubles | None = None


def as_point(name: str, value: Any) -> Point:
    """Return an argument as a point, x and y in mm."""
    place = as_array(name, value, "mm")
    if place.shape != (2,):
        raise InputError(f"{name} has shape {place.shape}: x and y, mm, are needed")
    x, y = place.tolist()
    return x, y


@checked(start=as_point, end=as_point, width=in_unit("mm", check_number))
def section(
    result: Maps,
    start: Point | None = None,
    end: Point | None = None,
    *,
    width: float = 0.0,
    pixel_size: ArrayLike | None = None,
) -> Section:
    """Cut through the height map of a result.

    Parameters
    ----------
    result : Result, mapping, xarray.Dataset, path or array_like, (H, W)
        Heights of one picture, mm, with their standard deviation, if available. An array is the height.
    start, end : (float, float), optional
        Millimetres from the picture's centre, x to the right and y up. By default the row of the highest
        point, measured or filled, after a 3 x 3 median filter against spikes, from left to right. On a flat
        top, the row in its middle.
    width : float
        Extent across the line, mm, over which heights are averaged: the mean of parallel profiles, a pixel
        apart. A sample is undefined if fewer than half of them are measured there.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the result.

    Returns
    -------
    Section
        Also NaN outside of the outermost pixel centres.

    Raises
    ------
    InputError
        No heights, one map for each turn, only one end, equal ends, ends without a pixel size, or an end
        further outside of the picture than its size.

    Examples
    --------
    >>> height = np.float32([[0, 1, 2], [0, 1, 2]])
    >>> result = Result(height=height, x=np.array([-0.1, 0.0, 0.1]), y=np.array([0.05, -0.05]))
    >>> section(result, (-0.1, 0.0), (0.1, 0.0)).height.round(6).tolist()
    [0.0, 1.0, 2.0]
    """
    maps = as_result(result, "result", pixel_size=pixel_size)
    height = heights_of(maps)
    if (start is None) != (end is None):
        raise InputError("a section needs both ends, or neither")
    x, y, unit = maps.x, maps.y, "mm"
    if x is None or y is None:
        if start is not None:
            raise InputError(
                "the result has no pixel size to place a section by: reconstruct it again with --pixel-size"
            )
        x, y, unit = axes_with_unit((height.shape[0], height.shape[1]), None)
    size = spacing(x, y) if height.size > 1 else (1.0, 1.0)
    if start is None or end is None:
        row = _top_row(height)
        start, end = (float(x[0]), float(y[row])), (float(x[-1]), float(y[row]))
    elif start == end:
        raise InputError("both ends of the section are one point: give two")
    else:
        _check_near((start, end), x, y, size)
    along, distance = _samples(start, end, size)
    column, row_of = (along[0] - x[0]) / size[0], (y[0] - along[1]) / size[1]
    shape = height.shape[0], height.shape[1]
    notes = tuple(finding.text for finding in findings_of("result", maps.process))
    length = noise_length(maps)
    related = None
    if length > 0 and maps.height_sigma is not None:
        related = partial(correlation, distance, shape, size, length)
    across = np.subtract(end, start)[::-1] * (-1, 1)
    reach = math.hypot(*(across / size))  # in pixels
    count = round(width / math.hypot(*across) * reach) if reach > 0 else 0
    if count < 2:
        values = _between(maps, height, SamplePoints.at(column, row_of, shape))
        return Section(distance, along[0], along[1], *values, unit, notes, related)
    offsets = np.linspace(-0.5, 0.5, count) * width * (1 - 1 / count)
    shifts = np.multiply.outer(offsets, across / math.hypot(*across) / size)
    lines = [
        _between(maps, height, SamplePoints.at(column + right, row_of - up, shape)) for right, up in shifts
    ]
    mean, sigma, filled = _averaged(lines)
    common = np.zeros_like(sigma)
    if related is not None:
        apart = np.abs(np.subtract.outer(offsets, offsets))
        shared = float(np.mean(correlation(apart, shape, size, length)))
        sigma = sigma * math.sqrt(max(shared, _LEAST_SHARED))
        related = partial(_averaged_correlation, distance, offsets, shape, size, length)
    elif maps.height_sigma is not None:
        alone = independent_share(height.astype(np.float64), maps.height_sigma.astype(np.float64))
        common = sigma * math.sqrt(1 - alone)
        sigma = np.hypot(sigma * math.sqrt(alone / count), common)
    return Section(distance, along[0], along[1], mean, sigma, filled, unit, notes, related, common)


def _averaged(lines: Sequence[tuple[Doubles, Doubles, Mask]]) -> tuple[Doubles, Doubles, Mask]:
    """Return the mean of the measured heights of parallel profiles, the mean sigma, and what is filled."""
    heights, sigmas, filled = (np.stack(values) for values in zip(*lines, strict=True))
    measured = np.isfinite(heights) & ~filled
    # If fewer than half were measured, filled heights count, too.
    some = np.count_nonzero(measured, axis=0) * 2 >= len(lines)
    counts = np.where(some, measured, np.isfinite(heights))
    number = np.count_nonzero(counts, axis=0)
    valid = number * 2 >= len(lines)
    divisor = np.where(valid, number, 1)
    mean, sigma = (np.sum(np.where(counts, values, 0.0), axis=0) / divisor for values in (heights, sigmas))
    return np.where(valid, mean, np.nan), np.where(valid & some, sigma, np.nan), valid & ~some


def _averaged_correlation(
    distance: Doubles, offsets: Doubles, shape: tuple[int, int], size: tuple[float, float], length: float
) -> Doubles:
    """Return the correlation of means over parallel profiles at each distance, (n,)."""
    lag = np.arange(offsets.size)
    share = np.where(lag > 0, 2.0, 1.0) * (offsets.size - lag) / offsets.size**2
    apart = np.hypot.outer(distance, lag * (offsets[1] - offsets[0]))
    shared = correlation(apart, shape, size, length) @ share
    return np.asarray(shared / max(float(shared[0]), _LEAST_SHARED))


def section_columns(result: Result, ends: tuple[Point, Point] | None = None) -> dict[str, NDArray[Any]]:
    """Return a section as the columns of a table; see `section` and `mirrorskin.io.export_result`.

    Raises
    ------
    mirrorskin.io.InputError
        No height is known along the section.
    """
    profile = section(result, *(ends or ()))
    if not np.isfinite(profile.height).any():
        raise InputError("no height is known along the section: choose other points, or leave it out")
    optional = {"sigma": result.height_sigma, "filled": result.filled}
    names = (
        "distance",
        "x",
        "y",
        "height",
        *(name for name, values in optional.items() if values is not None),
    )
    return {name: getattr(profile, name) for name in names}


def apex(height: NDArray[np.floating]) -> tuple[int, int]:
    """Return row and column of the highest point after a median filter against spikes.

    NaN counts as the lowest height. InputError without any height.
    """
    import cv2

    measured = np.isfinite(height)
    if not measured.any():
        raise InputError("there is no height to look for the highest point")
    lowest = float(np.min(height[measured]))
    below = np.nextafter(np.float32(lowest), np.float32(-np.inf)) - np.float32(1)
    smooth = cv2.medianBlur(np.where(measured, height, below).astype(np.float32), _WINDOW)
    smooth[~measured] = below
    # The median is undefined everywhere if all areas are narrower than the window.
    chosen = smooth if np.any(smooth > below) else np.where(measured, height, below)
    row, column = np.unravel_index(int(np.argmax(chosen)), height.shape)
    return int(row), int(column)


def _top_row(height: NDArray[np.float32]) -> int:
    """Return the row of the highest point; of a flat top, the row nearest to its middle."""
    top = height[apex(height)]
    rows, _ = np.nonzero((height <= top) & (height >= top - _LEVEL * (top - np.nanmin(height))))
    return int(rows[np.argmin(abs(rows - rows.mean()))])


def _check_near(ends: tuple[Point, Point], x: Doubles, y: Doubles, size: tuple[float, float]) -> None:
    """Raise InputError if an end is further outside of the picture than its size."""
    reach = size[0] * len(x), size[1] * len(y)
    if np.any(abs(np.subtract(ends, (x.mean(), y.mean()))) > reach):
        raise InputError("the section ends far outside of the picture: give mm from its centre")


def _samples(start: Point, end: Point, size: tuple[float, float]) -> tuple[Doubles, Doubles]:
    """Return points between both ends, (2, n), about a pixel apart, and their distances, (n,)."""
    step = np.subtract(end, start)
    length = math.hypot(*step)
    pixels = math.hypot(step[0] / size[0], step[1] / size[1])
    fraction = np.linspace(0, 1, max(round(pixels), 1) + 1) if length > 0 else np.zeros(1)
    return np.add.outer(np.asarray(start), 0 * fraction) + np.multiply.outer(
        step, fraction
    ), length * fraction


def _between(
    result: Result, height: NDArray[np.float32], points: SamplePoints
) -> tuple[Doubles, Doubles, Mask]:
    """Return heights, their standard deviations and whether they were filled, (n,), at points."""
    counts = points.shares > _ROUNDING
    inside = points.all_inside
    if result.component is not None:
        inside = inside & np.all(points.same_label(result.component) | ~counts, axis=0)
    values = _mean(height, points, counts)
    filled = np.zeros(values.shape, bool)
    if result.filled is not None:
        filled = np.any((result.filled.ravel()[points.pixels] != 0) & counts, axis=0)
    sigma = np.full(values.shape, np.nan)
    if result.height_sigma is not None:
        # Errors of neighbours are correlated, so the mean is as uncertain as they are.
        sigma = _mean(result.height_sigma, points, counts)
    valid = inside & np.isfinite(values)
    return np.where(valid, values, np.nan), np.where(valid & ~filled, sigma, np.nan), filled & valid


def _mean(values: NDArray[np.float32], points: SamplePoints, counts: Mask) -> Doubles:
    """Return weighted means of four pixels; NaN if one that counts is."""
    neighbours = np.where(counts, values.ravel()[points.pixels], 0).astype(np.float64)
    return np.asarray(np.sum(np.where(counts, points.shares, 0) * neighbours, axis=0))


@dataclass(frozen=True, slots=True)
class StepHeight:
    """Two levels along a section.

    Attributes
    ----------
    height : Quantity
        Distance of the two parallel lines, mm; positive for a step upwards.
    place : Quantity
        Distance of the step from the section's start, mm; known within one sample.
    slope : Quantity
        Of both lines, degrees; positive upwards.
    """

    height: Quantity
    place: Quantity
    slope: Quantity


def step_height(section: Section) -> StepHeight:
    """Measure the step along a section in millimetres.

    The step is where two parallel lines fit the measured samples before and after it best. Then the nearest
    third of either side is ignored, and the lines are fitted again: the height of the step is their
    orthogonal distance. Uncertainties are from `covariance`, with curves of either side as smooth shapes, and
    at least those that follow from correlated errors of heights.

    Examples
    --------
    >>> s = 0.1 * np.arange(16)
    >>> stair = Section(s, s, 0 * s, 0.2 * (s > 0.75), 0 * s, s < 0)
    >>> round(step_height(stair).height.value, 6)
    0.2
    """
    levels = _Levels.of(section, "step")
    distance = levels.distance
    split, _ = _split(distance, levels.height)
    place = (distance[split - 1] + distance[split]) / 2
    half = (distance[split] - distance[split - 1]) / 2
    before = distance[split - 1] - _LEFT_OUT * (distance[split - 1] - distance[0])
    after = distance[split] + _LEFT_OUT * (distance[-1] - distance[split])
    kept = (distance <= before) | (distance >= after)
    height, slope = levels.fit(kept, distance > place, place)
    return StepHeight(height, Quantity(float(place), float(half) / math.sqrt(3), "mm"), slope)


@dataclass(frozen=True, slots=True)
class Groove:
    """A groove, or a ridge, along a section, as ISO 5436-1 (type A1) has it.

    Attributes
    ----------
    depth : Quantity
        Distance of its bottom from the surface on both sides, mm; negative for a ridge.
    width : Quantity
        Between its walls, mm.
    place : Quantity
        Distance of its middle from the section's start, mm.
    slope : Quantity
        Of surface and bottom, degrees; positive upwards.
    """

    depth: Quantity
    width: Quantity
    place: Quantity
    slope: Quantity


def groove(section: Section) -> Groove:
    """Measure the groove along a section in millimetres.

    Its walls are where two lines, of the surface and of a parallel bottom, fit the measured samples best.
    Then they are fitted again, to the middle third of the bottom, and to the surface on either side from a
    third of the width from the wall to one width from it. Uncertainties are those of `step_height`.

    Examples
    --------
    >>> s = 0.1 * np.arange(30)
    >>> slot = Section(s, s, 0 * s, -0.2 * (abs(s - 1.45) < 0.5), 0 * s, s < 0)
    >>> round(groove(slot).depth.value, 6), round(groove(slot).width.value, 6)
    (0.2, 1.0)
    """
    levels = _Levels.of(section, "groove")
    distance = levels.distance
    (first, end), rest = _walls(distance, levels.height)
    if rest >= _split(distance, levels.height)[1]:
        raise InputError("there is no groove along the section: a step fits it better")
    walls = [(distance[at - 1] + distance[at]) / 2 for at in (first, end)]
    width, middle = walls[1] - walls[0], (walls[0] + walls[1]) / 2
    away = np.abs(distance - middle)
    inside = away <= width / 6
    kept = inside | ((away >= width * (0.5 + _LEFT_OUT)) & (away <= 1.5 * width))
    if (
        min(
            np.count_nonzero(inside),
            *(np.count_nonzero(kept & (s * (distance - middle) > width / 2)) for s in (-1, 1)),
        )
        < 2
    ):
        raise InputError(
            "the groove has too few samples, or the section too little of its sides: cut elsewhere"
        )
    height, slope = levels.fit(kept, inside, middle)
    if abs(height.value) < _CLEAR_DEPTH * math.sqrt(max(rest, 0.0) / distance.size):
        raise InputError("there is no groove along the section: nothing exceeds the unevenness beside it")
    step = float(np.median(np.diff(distance)))
    wall = step / math.sqrt(12)
    return Groove(
        replace(height, value=-height.value),
        Quantity(float(width), math.sqrt(2) * wall, "mm"),
        Quantity(float(middle), wall / math.sqrt(2), "mm"),
        slope,
    )


@dataclass(frozen=True, slots=True)
class _Levels:
    """The measured samples of a section, on two levels."""

    section: Section
    measured: Mask
    distance: Doubles
    height: Doubles

    @classmethod
    def of(cls, section: Section, what: str) -> _Levels:
        measured = _measured(section)
        if np.count_nonzero(measured) < 2 * _MIN_SAMPLES:
            raise InputError(
                f"a {what} needs at least {2 * _MIN_SAMPLES} measured samples along the section:"
                " cut elsewhere"
            )
        return cls(section, measured, section.distance[measured], section.height[measured])

    def fit(self, kept: Mask, upper: Mask, place: float) -> tuple[Quantity, Quantity]:
        """Return the height of the second level above the first one, mm, and the slope of both."""
        x, z, up = self.distance[kept] - place, self.height[kept], upper[kept].astype(np.float64)
        parameters, spread, rest = _lines(x, z, up)
        cubic = np.vander(x / np.abs(x).max(), 4)
        coefficients, *_ = np.linalg.lstsq(cubic, z, rcond=None)
        if np.sum((z - coefficients @ cubic.T) ** 2) < rest:
            raise InputError(
                "there is no step along the section: a smooth curve fits it better than two levels"
            )
        section = self.section
        number = np.flatnonzero(self.measured)[kept]
        if section.correlation is not None:
            related = section.correlation()[np.abs(np.subtract.outer(number, number))]
            errors = np.nan_to_num(section.sigma[number])
            influence = np.linalg.pinv(_line_rows(x, up).T) * errors
            spread = at_least(spread, influence @ related @ influence.T)
        common = 0.0
        if section.common is not None:  # independent of each other on both levels
            common = math.sqrt(2) * float(np.mean(np.nan_to_num(section.common[number])))
        slope, rise = float(parameters[1]), float(parameters[2])
        across = math.sqrt(1 + slope**2)
        return (
            Quantity(rise / across, math.hypot(math.sqrt(spread[2, 2]), common) / across, "mm"),
            Quantity(
                math.degrees(math.atan(slope)), math.degrees(math.sqrt(spread[1, 1]) / across**2), "deg"
            ),
        )


def _measured(section: Section) -> Mask:
    """Return the measured samples of a section in millimetres."""
    if section.unit != "mm":
        raise InputError("the result has no pixel size: reconstruct it again with --pixel-size")
    return np.isfinite(section.height) & ~section.filled


def _split(distance: Doubles, height: Doubles) -> tuple[int, float]:
    """Return the number of the first sample after the step, and the sum of squares that it leaves.

    The step is where two parallel lines fit best.
    """
    x, residual = _without_line(distance, height)
    # The part of a step before each sample that a line does not fit: its squared length, and its projection.
    count = height.size
    after = count - np.arange(count)
    tail_sum = np.cumsum(x[::-1])[::-1]
    length = after * (count - after) / count - tail_sum**2
    gain = np.cumsum(residual[::-1])[::-1] ** 2 / np.where(length > 0, length, np.inf)
    split = _MIN_SAMPLES + int(np.argmax(gain[_MIN_SAMPLES : count - _MIN_SAMPLES + 1]))
    return split, float(residual @ residual - gain[split])


def _walls(distance: Doubles, height: Doubles) -> tuple[tuple[int, int], float]:
    """Return the numbers of the first sample in the groove and after it, and the sum of squares left."""
    x, residual = _without_line(distance, height)
    count = height.size
    sums, places = (np.concatenate([[0.0], np.cumsum(values)]) for values in (residual, x))
    best, at, least = -1.0, (0, 0), 2
    for first in range(least, count - 2 * least + 1):
        end = np.arange(first + least, count - least + 1)
        inside = end - first
        length = inside * (count - inside) / count - (places[end] - places[first]) ** 2
        gain = (sums[end] - sums[first]) ** 2 / np.where(length > 0, length, np.inf)
        highest = int(np.argmax(gain))
        if gain[highest] > best:
            best, at = float(gain[highest]), (first, int(end[highest]))
    return at, float(residual @ residual - best)


def _without_line(distance: Doubles, height: Doubles) -> tuple[Doubles, Doubles]:
    """Return places of length 1 about their mean, and heights without their line."""
    x = distance - np.mean(distance)
    x = x / np.linalg.norm(x)
    residual = height - np.mean(height)
    return x, residual - x * (x @ residual)


def _lines(x: Doubles, z: Doubles, up: Doubles) -> tuple[Doubles, Doubles, float]:
    """Fit parallel lines to samples on two levels, the second one where ``up`` is 1.

    Return offset, slope and step, their covariance, and the sum of squares of the residual.
    """
    rows = _line_rows(x, up)
    parameters, *_ = np.linalg.lstsq(rows.T, z, rcond=None)
    t = x / np.abs(x).max()
    shapes = np.stack([up * t, t**2, up * t**2, t**3, up * t**3])
    columns = np.concatenate([rows, shapes, [z - parameters @ rows]])
    gram = columns @ columns.T
    return np.asarray(parameters), covariance(gram, len(rows), z.size), float(gram[-1, -1])


def _line_rows(x: Doubles, up: Doubles) -> Doubles:
    """Return the derivatives of two parallel lines, (3, n), with respect to offset, slope and step."""
    return np.stack([np.ones_like(x), x, up])


def along(section: Section) -> dict[str, Quantity]:
    """Return the length of a section, and difference, distance and slope between its outermost heights.

    Errors of both heights are assumed to be independent. A height is a mean over its pixel, so positions
    along the section are known within half a sample. InputError if fewer than two were measured.
    """
    measured = np.flatnonzero(_measured(section))
    if measured.size < 2:
        raise InputError(
            "the section has fewer than two measured heights that can be compared: cut elsewhere"
        )
    first, last = measured[0], measured[-1]
    run = float(section.distance[last] - section.distance[first])
    rise = float(section.height[last] - section.height[first])
    rise_sigma = math.hypot(section.sigma[first], section.sigma[last])
    length = math.hypot(run, rise)
    run_sigma = math.sqrt(2 / 12) * float(section.distance[1])
    return {
        "section length": Quantity(float(section.distance[-1]), 0.0, "mm"),
        "height difference": Quantity(rise, rise_sigma, "mm"),
        "distance in space": Quantity(length, math.hypot(rise * rise_sigma, run * run_sigma) / length, "mm"),
        "slope": Quantity(
            math.degrees(math.atan2(rise, run)),
            math.degrees(math.hypot(run * rise_sigma, rise * run_sigma) / length**2),
            "deg",
        ),
    }
