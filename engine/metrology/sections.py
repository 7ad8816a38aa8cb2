"""Cross-sections of height maps: lengths, slope, and the height of a step as ISO 5436-1 has it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.inputs import Maps, as_result, spacing
from mirrorskin.engine.metrology.fitting import covariance
from mirrorskin.engine.metrology.patch import heights_of
from mirrorskin.engine.metrology.quantity import Quantity
from mirrorskin.engine.resample import SamplePoints
from mirrorskin.io import InputError, Result, pixel_axes

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]
Point = tuple[float, float]

_ROUNDING = 1e-6  # of a pixel
_LEVEL = 0.01  # of the range of heights: what is as high as the highest point
_WINDOW = 3  # pixels a side of the median that removes spikes
_LEAST = 4  # samples on either side of a step
_LEFT_OUT = 1 / 3  # of either side, next to the step: it may be rounded or a ramp


@dataclass(frozen=True, slots=True, eq=False)
class Section:
    """Heights along a straight line across the picture.

    Attributes
    ----------
    distance : ndarray, (n,), float64
        From its start, in ``unit``; samples are one pixel apart.
    x, y : ndarray, (n,), float64
        Where it runs, from the picture's centre, in ``unit``.
    height, sigma : ndarray, (n,), float64
        Millimetres: heights between four pixels, NaN next to a hole and between components; and their
        standard deviations, NaN where they are unknown or a height was filled.
    filled : ndarray, (n,), bool
        Where a height was filled, not measured.
    unit : {"mm", "px"}
        Millimetres, or pixels where their size is not known.
    """

    distance: Doubles
    x: Doubles
    y: Doubles
    height: Doubles
    sigma: Doubles
    filled: Mask
    unit: str = "mm"


def section(
    result: Maps,
    start: Point | None = None,
    end: Point | None = None,
    *,
    pixel_size: ArrayLike | None = None,
) -> Section:
    """Cut through the height map of a result.

    Parameters
    ----------
    result : Result, mapping, xarray.Dataset, path or array_like, (H, W)
        Heights of one picture, mm, with their standard deviation, if available. An array is the height.
    start, end : (float, float), optional
        Millimetres from the picture's centre, x to the right and y up. Without them, the row of the highest
        point is taken, from the picture's left to its right; the highest after a median over 3 x 3
        pixels, which leaves spikes out, measured or filled. Of a flat top it is the row in its middle.
    pixel_size : float or (float, float), optional
        Millimetres along x and y; by default that of the result.

    Returns
    -------
    Section
        NaN as well where the line runs outside of the outermost pixel centres.

    Raises
    ------
    InputError
        No heights, one map for each turn, only one end, both ends in one point, ends where the pixel size
        is not known, or one further outside of the picture than that is large.

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
        (x, y), unit = pixel_axes((height.shape[0], height.shape[1]), (1.0, 1.0)), "px"
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
    values = _between(maps, height, SamplePoints.at(column, row_of, (height.shape[0], height.shape[1])))
    return Section(distance, along[0], along[1], *values, unit)


def apex(height: NDArray[np.floating]) -> tuple[int, int]:
    """Return row and column of the highest point, after a median that leaves spikes out.

    The median treats NaN as lower than everything. InputError if there is no height.
    """
    import cv2

    known = np.isfinite(height)
    if not known.any():
        raise InputError("there is no height to look for the highest point")
    lowest = float(np.min(height[known]))
    below = np.nextafter(np.float32(lowest), np.float32(-np.inf)) - np.float32(1)
    smooth = cv2.medianBlur(np.where(known, height, below).astype(np.float32), _WINDOW)
    smooth[~known] = below
    # Where all that is known is thinner than the window, the median is undefined.
    chosen = smooth if np.any(smooth > below) else np.where(known, height, below)
    row, column = np.unravel_index(int(np.argmax(chosen)), height.shape)
    return int(row), int(column)


def _top_row(height: NDArray[np.float32]) -> int:
    """Return the row of the highest point, or the one nearest to the middle of all that is as high."""
    top = height[apex(height)]
    rows, _ = np.nonzero((height <= top) & (height >= top - _LEVEL * (top - np.nanmin(height))))
    return int(rows[np.argmin(abs(rows - rows.mean()))])


def _check_near(ends: tuple[Point, Point], x: Doubles, y: Doubles, size: tuple[float, float]) -> None:
    """Raise InputError if an end is further outside of the picture than that is large."""
    reach = size[0] * len(x), size[1] * len(y)
    if np.any(abs(np.subtract(ends, (x.mean(), y.mean()))) > reach):
        raise InputError("the section ends far outside of the picture: give mm from its centre")


def _samples(start: Point, end: Point, size: tuple[float, float]) -> tuple[Doubles, Doubles]:
    """Return evenly spaced points from end to end, (2, n), about a pixel apart, and their distances, (n,)."""
    step = np.subtract(end, start)
    length = math.hypot(*step)
    pixels = math.hypot(step[0] / size[0], step[1] / size[1])
    share = np.linspace(0, 1, max(round(pixels), 1) + 1) if length > 0 else np.zeros(1)
    return np.add.outer(np.asarray(start), 0 * share) + np.multiply.outer(step, share), length * share


def _between(
    result: Result, height: NDArray[np.float32], points: SamplePoints
) -> tuple[Doubles, Doubles, Mask]:
    """Return heights, their standard deviations and whether they were filled, (n,), at places."""
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
        # Errors of neighbours are correlated, so those of a mean are no smaller.
        sigma = _mean(result.height_sigma, points, counts)
    there = inside & np.isfinite(values)
    return np.where(there, values, np.nan), np.where(there & ~filled, sigma, np.nan), filled & there


def _mean(values: NDArray[np.float32], points: SamplePoints, counts: Mask) -> Doubles:
    """Return weighted means of four pixels, NaN where one that counts is."""
    around = np.where(counts, values.ravel()[points.pixels], 0).astype(np.float64)
    return np.asarray(np.sum(np.where(counts, points.shares, 0) * around, axis=0))


@dataclass(frozen=True, slots=True)
class Step:
    """Two levels along a section.

    Attributes
    ----------
    height : Quantity
        Distance of the two parallel lines, mm; positive where the section goes up.
    place : Quantity
        Distance of the step from the section's start, mm; it lies within one sample.
    slope : Quantity
        Of both lines, degrees; positive upwards.
    """

    height: Quantity
    place: Quantity
    slope: Quantity


def step_height(section: Section) -> Step:
    """Measure the step along a section in millimetres.

    The step is where two parallel lines fit the measured samples before and after it best. Then the third of
    either side that lies nearest to it is left out, and the lines are fitted once more: the step's
    height is their distance, at right angles to them. Uncertainties are those of `covariance`, with curves of
    either side as smooth shapes.

    Examples
    --------
    >>> s = 0.1 * np.arange(16)
    >>> stair = Section(s, s, 0 * s, 0.2 * (s > 0.75), 0 * s, s < 0)
    >>> round(step_height(stair).height.value, 6)
    0.2
    """
    known = _measured(section)
    distance, height = section.distance[known], section.height[known]
    if distance.size < 2 * _LEAST:
        raise InputError(
            f"a step needs at least {2 * _LEAST} measured samples along the section: cut elsewhere"
        )
    split = _split(distance, height)
    place = (distance[split - 1] + distance[split]) / 2
    half = (distance[split] - distance[split - 1]) / 2
    kept = _away(distance, split)
    found, spread, rest = _lines(distance[kept] - place, height[kept])
    if _curve(distance[kept] - place, height[kept]) < rest:
        raise InputError("there is no step along the section: a smooth curve fits it better than two levels")
    slope, rise = float(found[1]), float(found[2])
    across = math.sqrt(1 + slope**2)
    return Step(
        Quantity(rise / across, math.sqrt(spread[2, 2]) / across, "mm"),
        Quantity(float(place), float(half) / math.sqrt(3), "mm"),
        Quantity(math.degrees(math.atan(slope)), math.degrees(math.sqrt(spread[1, 1]) / across**2), "deg"),
    )


def _measured(section: Section) -> Mask:
    """Return which samples of a section in millimetres were measured."""
    if section.unit != "mm":
        raise InputError("the result has no pixel size: reconstruct it again with --pixel-size")
    return np.isfinite(section.height) & ~section.filled


def _split(distance: Doubles, height: Doubles) -> int:
    """Return the number of the first sample after the step: where two parallel lines fit best."""
    x = distance - np.mean(distance)
    x /= np.linalg.norm(x)
    residual = height - np.mean(height)
    residual = residual - x * (x @ residual)
    # Of a step before each sample, what a line does not take in: its length, and its share in the residual.
    count = height.size
    after = count - np.arange(count)
    share = np.cumsum(x[::-1])[::-1]
    length = after * (count - after) / count - share**2
    gain = np.cumsum(residual[::-1])[::-1] ** 2 / np.where(length > 0, length, np.inf)
    return _LEAST + int(np.argmax(gain[_LEAST : count - _LEAST + 1]))


def _away(distance: Doubles, split: int) -> Mask:
    """Return the samples that are not in the third of their side that lies next to the step."""
    start, end = distance[0], distance[-1]
    before = distance[split - 1] - _LEFT_OUT * (distance[split - 1] - start)
    after = distance[split] + _LEFT_OUT * (end - distance[split])
    return np.asarray((distance <= before) | (distance >= after))


def _lines(x: Doubles, z: Doubles) -> tuple[Doubles, Doubles, float]:
    """Fit parallel lines to samples before and after 0.

    Return offset, slope and step, their covariance, and the sum of squares of the residual.
    """
    up = (x > 0).astype(np.float64)
    rows = np.stack([np.ones_like(x), x, up])
    found, *_ = np.linalg.lstsq(rows.T, z, rcond=None)
    own = x / np.abs(x).max()
    shapes = np.stack([up * own, own**2, up * own**2, own**3, up * own**3])
    every = np.concatenate([rows, shapes, [z - found @ rows]])
    gram = every @ every.T
    return np.asarray(found), covariance(gram, len(rows), z.size), float(gram[-1, -1])


def _curve(x: Doubles, z: Doubles) -> float:
    """Return the sum of squares of a cubic's residual."""
    rows = np.vander(x / np.abs(x).max(), 4).T
    found, *_ = np.linalg.lstsq(rows.T, z, rcond=None)
    return float(np.sum((z - found @ rows) ** 2))


def along(section: Section) -> dict[str, Quantity]:
    """Return the length of a section, and difference, distance and slope between its outermost heights.

    Errors of the two heights are taken to be independent. InputError where fewer than two were measured.
    """
    known = np.flatnonzero(_measured(section))
    if known.size < 2:
        raise InputError(
            "the section has fewer than two measured heights that can be compared: cut elsewhere"
        )
    first, last = known[0], known[-1]
    run = float(section.distance[last] - section.distance[first])
    rise = float(section.height[last] - section.height[first])
    rise_sigma = math.hypot(section.sigma[first], section.sigma[last])
    length = math.hypot(run, rise)
    return {
        "section length": Quantity(float(section.distance[-1]), 0.0, "mm"),
        "height difference": Quantity(rise, rise_sigma, "mm"),
        "distance in space": Quantity(length, abs(rise) / length * rise_sigma, "mm"),
        "slope": Quantity(
            math.degrees(math.atan2(rise, run)), math.degrees(rise_sigma * run / length**2), "deg"
        ),
    }
