"""What a lens that blurs does to the heights of a press."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.base.options import option
from mirrorskin.engine.base.steps import Context, Step
from mirrorskin.engine.diagnosis.footprint import with_curvature
from mirrorskin.io import Result
from mirrorskin.io.watch.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import mad_sigma

if TYPE_CHECKING:
    from mirrorskin.engine.press.crossing import PressOperation

PIXEL = 1 / 12
"""Variance of a pixel's area, square pixels."""

_SHARES = 0.16, 0.84  # of the way from dark to bright, two standard deviations of a blurred edge apart
_STEEP_QUANTILE = 0.75  # quantile of the slopes of those pixels that show the blur
_STEEPER = 1.5  # ratio of the square slopes of these pixels to those of the flattest ones
_MIN_PIXELS = 16  # minimum number of these pixels
_INTERPOLATED = 0.34**2  # square steps: what interpolation adds to the variance of an edge within one step
_SHARP = 0.2  # square pixels: variance of a footprint that is hardly larger than the pixel
_BLURRED = 9.0  # square pixels: what is larger is no lens
_LEAST_FRAMES = 8
_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_UNSURE = 0.25, 1.0  # relative uncertainty of what interpolation adds: usual, and greatest
_CLEAR_Z_SCORE = 3.0  # standard errors: least difference of a blur from none
_RESOLVED = 0.35  # steps of the travel within a standard deviation of the footprint on a slope


class StatedBlur(Step):
    """Add to the standard deviation of heights what a lens that blurs may have moved.

    A pixel sees the surface through a footprint, of variance v in square pixels, and shows the median of its
    heights. Where the surface is curved, by H in each direction, the median differs from the height in the
    middle by up to v H / 2.
    """

    needs = ("height", "height_sigma")

    blur: float | None = option(
        default=None,
        within=(0, 100),
        help="standard deviation of the lens's point spread, pixels, which makes heights of curved surfaces"
        " less certain; 0 adds nothing",
        shown_default="estimated from the frames of a recording, if its steps show it",
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights with larger standard deviations, and the blur in ``process`` if it is clear."""
        footprint = self.footprint(result, context)
        if footprint is None:
            return result
        sigma = partial(_with_footprint, result, footprint.variance)
        if not footprint.clear:
            return result.assign(height_sigma=sigma)
        blur = {"blur": round(math.sqrt(footprint.variance - PIXEL), 2)}
        return result.assign(
            height_sigma=sigma,
            process={**result.process, **blur},
            fitted=replace(result.fitted, footprint=footprint.variance),
        )

    def footprint(self, result: Result, context: Context) -> Footprint | None:
        """Return a pixel's footprint; None if nothing is to be added."""
        return Footprint(self.blur**2 + PIXEL, True) if self.blur else None


class LensBlur(StatedBlur):
    """The same with a blur that is estimated, unless it is stated.

    On a slope g, a pixel turns light over a travel with the standard deviation g sqrt(v), so that steep and
    flat parts of the surface show v. If the footprint is hardly larger than the pixel, or if the steps of the
    travel do not resolve it, nothing is added.
    """

    def footprint(self, result: Result, context: Context) -> Footprint | None:
        """Return a pixel's footprint; None if nothing is to be added."""
        samples, travel = context.samples, context.positions("travel")
        if self.blur is not None:
            return super().footprint(result, context)
        if samples is None or len(travel) < _LEAST_FRAMES:
            return None
        operation, heights = cast("PressOperation", context.operation), context.neighbours(result)
        return _footprint(samples, travel, operation, heights)


class PixelBlur(LensBlur):
    """The same for change-points, which resolve more: at least what the pixel's own area moves is added."""

    def footprint(self, result: Result, context: Context) -> Footprint | None:
        """Return a pixel's footprint."""
        footprint = super().footprint(result, context)
        few = context.samples is None or context.samples.count < _LEAST_FRAMES
        return Footprint(PIXEL) if footprint is None and self.blur is None and not few else footprint


@dataclass(frozen=True)
class Footprint:
    """Variance of the area that a pixel sees, square pixels, and whether it clearly exceeds the pixel."""

    variance: float
    clear: bool = False


@dataclass(frozen=True)
class _Quarter:
    """Pixels of similar slopes: medians of their square slopes and of the square spreads of their edges.

    ``error`` is the standard error of the latter.
    """

    slope: float
    spread: float
    error: float
    count: int

    @classmethod
    def of(cls, slope: Doubles, spread: Doubles) -> _Quarter:
        """Return the medians over pixels with both."""
        usable = np.isfinite(spread)
        slope, spread = slope[usable] ** 2, spread[usable] ** 2
        if not spread.size:
            return cls(0.0, 0.0, 0.0, 0)
        middle = float(np.median(spread))
        error = _OF_MEDIAN * mad_sigma(spread - middle) / math.sqrt(spread.size)
        return cls(float(np.median(slope)), middle, error, spread.size)


def _with_footprint(result: Result, variance: float) -> NDArray[np.float32]:
    return with_curvature(result.height, result.height_sigma, variance)


def _footprint(
    samples: FrameSamples,
    travel: Doubles,
    operation: PressOperation,
    heights: list[NDArray[Any]],
) -> Footprint | None:
    """Return a pixel's footprint; None if it is sharp or not resolved."""
    rows, columns, shape = samples.rows, samples.columns, operation.shape
    inner = np.ix_((rows > 0) & (rows < shape[0] - 1), (columns > 0) & (columns < shape[1] - 1))
    row, column = (part[inner].ravel() for part in np.meshgrid(rows, columns, indexing="ij"))
    middle, before, after, above, below = (values[inner].ravel() for values in heights)
    slope = np.hypot((after - before) / 2, (below - above) / 2).astype(np.float64)
    sloped = np.isfinite(slope) & np.isfinite(middle) & (slope > 0)
    if np.count_nonzero(sloped) < _MIN_PIXELS:
        return None
    ordered = np.sort(slope[sloped])
    flattest, steepest = (
        ordered[round(fraction * (len(ordered) - 1))] for fraction in (1 - _STEEP_QUANTILE, _STEEP_QUANTILE)
    )
    sloped &= (slope <= flattest) | (slope >= steepest)  # the others show less
    row, column, slope = row[sloped], column[sloped], slope[sloped]
    values = samples.values[(slice(None), *inner)].reshape(len(travel), -1)[:, sloped].astype(np.float32)
    if travel[-1] < travel[0]:  # of a release
        values, travel = values[::-1], travel[::-1]
    few = max(1, len(travel) // 10)
    ends = values[:few].mean(axis=0), values[-few:].mean(axis=0)
    dark, bright = (
        end if level is None else np.broadcast_to(np.asarray(level, np.float32), shape)[row, column]
        for level, end in zip((operation.dark, operation.bright), ends, strict=True)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (values - dark) / (bright - dark)
    spread = (first_travel(shares, travel, _SHARES[1]) - first_travel(shares, travel, _SHARES[0])) / 2
    flat, steep = (_Quarter.of(slope[part], spread[part]) for part in (slope <= flattest, slope >= steepest))
    if min(flat.count, steep.count) < _MIN_PIXELS // 4 or steep.slope < _STEEPER * flat.slope:
        return None
    # What flat parts show as well is no footprint: interpolation, or a skin that touches slowly.
    step = float(np.median(np.diff(travel)))
    interpolated = _INTERPOLATED * step**2
    variance = (steep.spread - interpolated - max(flat.spread - interpolated, 0.0)) / (
        steep.slope - flat.slope
    )
    if not _SHARP <= variance <= _BLURRED or math.sqrt(variance * steep.slope) < _RESOLVED * step:
        return None
    usual, greatest = (
        math.hypot(steep.error, flat.error, unsure * interpolated) / (steep.slope - flat.slope)
        for unsure in _UNSURE
    )
    if variance - PIXEL <= _CLEAR_Z_SCORE * usual:
        return None
    return Footprint(math.hypot(variance, usual), variance - PIXEL > _CLEAR_Z_SCORE * greatest)


def first_travel(shares: NDArray[Any], travel: Doubles, level: float) -> Doubles:
    """Return the travel at which each share first reaches a level, NaN where it does not."""
    reached = shares >= level
    after = np.argmax(reached, axis=0)
    crossed, after = after > 0, np.maximum(after, 1)
    each = np.arange(shares.shape[1])
    low, high = shares[after - 1, each], shares[after, each]
    with np.errstate(divide="ignore", invalid="ignore"):
        where = travel[after - 1] + (travel[after] - travel[after - 1]) * (level - low) / (high - low)
    return np.where(crossed, where, np.nan)
