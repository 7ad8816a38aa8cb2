"""What a lens that blurs does to the heights of a press."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.footprint import with_curvature
from mirrorskin.engine.method import Context, Step
from mirrorskin.engine.options import option
from mirrorskin.engine.press.changepoint import ChangePoint
from mirrorskin.engine.press.crossing import PressOperation
from mirrorskin.engine.press.strokes import Strokes
from mirrorskin.io import Result
from mirrorskin.io.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles

_SHARES = 0.16, 0.84  # of the way from dark to bright, two standard deviations of a blurred edge apart
_STEEPEST = 0.75  # quantile of the slopes of those pixels that show the blur
_STEEPER = 1.5  # ratio of the square slopes of these pixels to those of the flattest ones
_FEWEST = 16  # of these pixels
_INTERPOLATED = 0.34**2  # square steps: what interpolation adds to the variance of an edge within one step
_PIXEL = 1 / 12  # square pixels: variance of a pixel's area
_SHARP = 0.2  # square pixels: variance of a footprint that is hardly larger than the pixel
_BLURRED = 9.0  # square pixels: what is larger is no lens
_LEAST_FRAMES = 8
_RESOLVED = 0.35  # steps of the travel within a standard deviation of the footprint on a slope


class LensBlur(Step):
    """Add to the standard deviation of heights what a lens that blurs may have moved.

    A pixel sees the surface through a footprint, of variance v in square pixels, and shows the median of its
    heights. On a slope g it turns light over a travel with the standard deviation g sqrt(v), so that steep
    and flat parts of the surface show v.
    Where the surface is curved, by H in each direction, the median differs from the height in the middle by
    up to v H / 2. If the footprint is hardly larger than the pixel, or if the steps of the travel do not
    resolve it, nothing is added to thresholds, and what the pixel's own area moves to change-points, which
    resolve more.
    """

    blur: float | None = option(
        default=None,
        within=(0, 100),
        help="standard deviation of the lens's point spread, pixels, which makes heights of curved surfaces"
        " less certain; 0 adds nothing",
        shown_default="estimated from the frames of a recording, if its steps show it",
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights with larger standard deviations, and the blur in ``process``."""
        variance = self._variance(result, context)
        if variance is None:
            return result
        blur = {"blur": round(math.sqrt(variance - _PIXEL), 2)} if variance >= _SHARP else {}
        return result.assign(
            height_sigma=with_curvature(result.height, result.height_sigma, variance),
            process={**result.process, **blur},
        )

    def _variance(self, result: Result, context: Context) -> float | None:
        """Return the variance of a pixel's footprint, square pixels; None if nothing is to be added."""
        if self.blur is not None:
            return self.blur**2 + _PIXEL if self.blur else None
        operation = context.operation
        if not isinstance(operation, PressOperation) or isinstance(operation, Strokes):
            return None
        samples, travel = operation.seen, context.pushed("travel")
        if samples is None or samples.count != len(travel) or len(travel) < _LEAST_FRAMES:
            return None
        found = _footprint(samples, travel, operation, result.height)
        return _PIXEL if found is None and isinstance(operation, ChangePoint) else found


def _footprint(
    samples: FrameSamples, travel: Doubles, operation: PressOperation, height: NDArray[Any]
) -> float | None:
    """Return the variance of a pixel's footprint, square pixels; None if it is sharp or not resolved."""
    rows, columns = samples.rows, samples.columns
    inner = np.ix_((rows > 0) & (rows < height.shape[0] - 1), (columns > 0) & (columns < height.shape[1] - 1))
    row, column = (part[inner].ravel() for part in np.meshgrid(rows, columns, indexing="ij"))
    if not row.size:
        return None
    across = (height[row, column + 1] - height[row, column - 1]) / 2
    along = (height[row + 1, column] - height[row - 1, column]) / 2
    slope = np.hypot(across, along).astype(np.float64)
    values = samples.values[:, *inner].reshape(len(travel), -1).astype(np.float32)
    order = np.argsort(travel, kind="stable")  # of a release, the travel falls
    values, travel = values[order], travel[order]
    few = max(1, len(travel) // 10)
    ends = values[:few].mean(axis=0), values[-few:].mean(axis=0)
    dark, bright = (
        end if level is None else np.broadcast_to(np.asarray(level, np.float32), height.shape)[row, column]
        for level, end in zip((operation.dark, operation.bright), ends, strict=True)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = (values - dark) / (bright - dark)
    spread = (_first(shares, travel, _SHARES[1]) - _first(shares, travel, _SHARES[0])) / 2
    usable = np.isfinite(spread) & np.isfinite(slope) & (slope > 0)
    if np.count_nonzero(usable) < _FEWEST:
        return None
    spread, slope = spread[usable], slope[usable]
    step, squares = float(np.median(np.diff(travel))), spread**2
    flat, steep = (
        (float(np.median(squares[part])), float(np.median(slope[part] ** 2)))
        for part in (slope <= np.quantile(slope, 1 - _STEEPEST), slope >= np.quantile(slope, _STEEPEST))
    )
    if steep[1] < _STEEPER * flat[1]:
        return None
    # What flat parts show as well is no footprint: interpolation, or a skin that touches slowly.
    interpolated = _INTERPOLATED * step**2
    variance = (steep[0] - interpolated - max(flat[0] - interpolated, 0.0)) / (steep[1] - flat[1])
    if not _SHARP <= variance <= _BLURRED or math.sqrt(variance * steep[1]) < _RESOLVED * step:
        return None
    return variance


def _first(shares: NDArray[Any], travel: Doubles, level: float) -> Doubles:
    """Return the travel at which each share first reaches a level, NaN where it does not."""
    reached = shares >= level
    after = np.argmax(reached, axis=0)
    crossed, after = after > 0, np.maximum(after, 1)
    each = np.arange(shares.shape[1])
    low, high = shares[after - 1, each], shares[after, each]
    with np.errstate(divide="ignore", invalid="ignore"):
        where = travel[after - 1] + (travel[after] - travel[after - 1]) * (level - low) / (high - low)
    return np.where(crossed, where, np.nan)
