"""Estimation of the dark and bright levels from the frames of a press, and of their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import estimate_noise, thin_out
from mirrorskin.io import Source

_FEWEST = 16  # pixels that must have turned light
_RISE = 8.0  # standard deviations of the noise: least rise of brightness between dark and light


@dataclass(frozen=True, slots=True)
class EstimatedLevels:
    """Dark and bright levels, counts, and the standard deviations of the pixels' levels about them."""

    dark: float
    bright: float
    dark_sigma: float
    bright_sigma: float


def estimate_levels(
    source: Source, frames: range, dark: ArrayLike | None = None, bright: ArrayLike | None = None
) -> EstimatedLevels | None:
    """Estimate the dark and bright levels from the frames of least and greatest travel.

    Pixels turned light if their brightness differs between these frames by more than half of the 16th largest
    difference. The levels are the medians of these pixels; their standard deviations exclude the noise.
    Given levels are unchanged, with a standard deviation of 0.

    Parameters
    ----------
    source : Source
        A recording whose frames can be read in any order.
    frames : range
        The press, or the release.
    dark, bright : array_like, scalar or (H, W), optional
        Given levels.

    Returns
    -------
    EstimatedLevels or None
        None if nothing turns light, or the source can only be read in order.
    """
    travel: NDArray[np.float64] | None = getattr(source, "travel", None)
    read = getattr(source, "frame", None)
    if travel is None or read is None:
        return None
    return _estimate(read, travel, frames, dark, bright)


def estimate_levels_of(
    stack: NDArray[Any],
    travel: NDArray[np.float64],
    dark: ArrayLike | None = None,
    bright: ArrayLike | None = None,
) -> EstimatedLevels | None:
    """Return the result of `estimate_levels` for frames in memory, (T, H, W), and their travel, (T,), mm."""
    return _estimate(stack.__getitem__, travel, range(len(stack)), dark, bright)


def _estimate(
    read: Callable[[int], NDArray[Any]],
    travel: NDArray[np.float64],
    frames: range,
    dark: ArrayLike | None,
    bright: ArrayLike | None,
) -> EstimatedLevels | None:
    if len(frames) < 2:
        return None
    part = travel[frames.start : frames.stop]
    least, most = (frames.start + int(number) for number in (np.argmin(part), np.argmax(part)))
    neighbour = least + (1 if least + 1 < frames.stop else -1)
    pictures = [read(number) for number in (least, neighbour, most)]
    samples = np.stack([thin_out(picture) for picture in pictures])
    first, second, last = samples[:, np.isfinite(samples).all(axis=0)]
    integer = pictures[0].dtype.kind == "u"
    rise = last - first
    if rise.size < _FEWEST:
        return None
    top = float(np.partition(rise, -_FEWEST)[-_FEWEST])
    noise = estimate_noise(first, second, integer)
    if top < _RISE * noise:
        return None
    lit = rise >= top / 2
    low, low_sigma = _middle(first[lit], noise, integer) if dark is None else (_median(dark), 0.0)
    high, high_sigma = _middle(last[lit], noise, integer) if bright is None else (_median(bright), 0.0)
    return EstimatedLevels(low, high, low_sigma, high_sigma) if high > low else None


def _middle(counts: NDArray[np.float64], noise: float, integer: bool) -> tuple[float, float]:
    """Return the median of counts, and their robust standard deviation without the noise."""
    middle = _median(counts)
    spread = math.sqrt(2) * estimate_noise(np.full_like(counts, middle), counts, integer)
    return middle, math.sqrt(max(0.0, spread**2 - noise**2) + noise**2 / counts.size)


def _median(counts: ArrayLike) -> float:
    return float(np.nanmedian(np.asarray(counts, np.float64)))
