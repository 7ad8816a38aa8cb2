"""Uncertainty of heights because of the levels of dark and light."""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.options import option
from mirrorskin.engine.press.blur import first_travel
from mirrorskin.engine.press.crossing import PressOperation
from mirrorskin.engine.steps import Context, Step
from mirrorskin.io import Result
from mirrorskin.io.findings import Finding, with_findings
from mirrorskin.io.traces import FrameSamples
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.least_squares import mad_sigma, median

_PART = 0.1  # of the frames, at each end, in which levels are compared with the references
_AWAY = 0.3  # of the travel, least distance of these frames from the onset of a pixel
_FEWEST = 64  # pixels
_FLAT = 0.25  # share of the pixels: the flattest ones
_OF_MEDIAN = math.sqrt(math.pi / 2)  # standard error of a median over that of a mean
_CLEAR, _LEAST = 5.0, 0.01  # standard errors, and share of the rise to light, from which on a level differs
_COMMON = 2.0  # standard deviations of the pixels' own differences: a smaller one is not common to them


class LevelUncertainty(Step):
    """Add to the standard deviation of heights what uncertain levels of dark and light do.

    A level that is wrong by the share u of the rise to light moves the crossing by u times the travel in
    which the pixel turns light. This is the slope g, and more if the lens blurs or the skin touches slowly,
    which a grid of pixels shows. Levels of pixels scatter by `dark_sigma` and `bright_sigma`. They may also
    have changed: the darkness of the first frames and the light of the last ones are compared with the
    references, at pixels that turn light much later or earlier.
    """

    needs = ("height", "height_sigma")

    dark_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own dark levels about `dark`",
        python_only=True,
    )
    bright_sigma: float = option(
        default=0.0,
        unit="counts",
        within=(0, None),
        help="standard deviation of the pixels' own bright levels about `bright`",
        python_only=True,
    )

    def apply(self, result: Result, context: Context) -> Result:
        """Return heights with larger standard deviations, and a note if levels changed."""
        operation = cast("PressOperation", context.operation)
        dark, bright, samples = operation.dark, operation.bright, context.samples
        if dark is None or bright is None:
            return result
        share, threshold = 0.0, operation.lowest_threshold
        if self.dark_sigma or self.bright_sigma:
            scatter = math.hypot((1 - threshold) * self.dark_sigma, threshold * self.bright_sigma)
            rise = np.asarray(bright, np.float64) - np.asarray(dark, np.float64)
            share = scatter / float(np.nanmedian(rise))
        if samples is not None:
            seen = _Seen.of(samples, context.positions("travel"), dark, bright, operation.shape)
            height, *beside = context.neighbours(result)
            errors = _find_errors(seen, -height.astype(np.float64))
            share = math.hypot(share, *(error / math.sqrt(2) for error in errors))
            if any(errors):
                said = " and ".join(
                    f"{name} by {100 * error:+.2g} %"
                    for name, error in zip(("dark", "light"), errors, strict=True)
                    if error
                )
                text = f"levels differ from their references, {said} of the rise; height_sigma includes this"
                result = with_findings(result, Finding("levels", text, False))
        if not share:
            return result
        width = 0.0 if samples is None else _width(seen, _rise(*beside))
        return result.assign(height_sigma=partial(_with_levels, result, share, width))


class _Seen(NamedTuple):
    """What a grid of pixels shows from the least travel on, and their levels."""

    values: NDArray[Any]  # (T, rows, columns)
    travel: Doubles
    dark: NDArray[np.float32]
    bright: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        samples: FrameSamples,
        travel: Doubles,
        dark: ArrayLike,
        bright: ArrayLike,
        shape: tuple[int, ...],
    ) -> _Seen:
        """Return the samples of a press or a release."""
        low, high = (
            samples.of_map(np.broadcast_to(np.asarray(level, np.float32), shape)) for level in (dark, bright)
        )
        forward = slice(None, None, -1 if travel[-1] < travel[0] else 1)
        return cls(samples.values[forward], travel[forward], low, high)


def _find_errors(seen: _Seen, onset: Doubles) -> tuple[float, float]:
    """Return by how much dark and light differ from the references, in shares of the rise; 0 if hardly."""
    values, travel, low, high = seen
    few, least, most = max(1, round(_PART * len(travel))), float(travel.min()), float(travel.max())
    away = _AWAY * (most - least)
    found = []
    for frames, level, usable in (
        (values[:few], low, onset > least + away),
        (values[-few:], high, onset < most - away),
    ):
        error = ((frames.mean(axis=0) - level) / (high - low))[usable]
        error = error[np.isfinite(error)]
        if error.size < _FEWEST:
            found.append(0.0)
            continue
        middle = float(np.median(error))
        spread = mad_sigma(error - middle)
        clear = max(_LEAST, _COMMON * spread, _CLEAR * _OF_MEDIAN * spread / math.sqrt(error.size))
        found.append(middle if abs(middle) > clear else 0.0)
    return found[0], found[1]


def _width(seen: _Seen, slope: NDArray[np.float32]) -> float:
    """Return the travel in which the flattest pixels turn light in addition to their slopes, mm."""
    values, travel, low, high = seen
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = ((values - low) / (high - low)).reshape(len(travel), -1)
    width = 2 * (first_travel(shares, travel, 0.75) - first_travel(shares, travel, 0.25))
    slope = slope.ravel()
    known = np.isfinite(width) & np.isfinite(slope)
    if np.count_nonzero(known) < _FEWEST:
        return 0.0
    width, slope = width[known], slope[known]
    flat = slope <= np.quantile(slope, _FLAT)
    return math.sqrt(max(0.0, float(np.median(width[flat] ** 2 - slope[flat] ** 2))))


def _with_levels(result: Result, share: float, width: float) -> NDArray[np.float32]:
    """Return the standard deviations of heights with that of levels, a share of the rise to light."""
    height = np.pad(np.asarray(result.height, np.float32), 1, "edge")
    moved = _rise(height[1:-1, :-2], height[1:-1, 2:], height[:-2, 1:-1], height[2:, 1:-1])
    known = np.isfinite(moved)  # not at the border of the contact
    moved[~known] = median(moved[known]) if known.any() else 0
    np.hypot(moved, np.float32(width), out=moved)
    moved *= np.float32(share)
    return np.asarray(np.hypot(result.height_sigma, moved))


def _rise(
    left: NDArray[Any], right: NDArray[Any], above: NDArray[Any], below: NDArray[Any]
) -> NDArray[np.float32]:
    """Return by how much heights change over a pixel, from those next to it."""
    rise: NDArray[np.float32] = np.abs(right - left)
    rise += np.abs(below - above)
    rise /= 2
    return rise
