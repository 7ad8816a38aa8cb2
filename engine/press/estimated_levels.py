"""Counts of dark and light that nobody gave: estimated from a press's frames, and what that adds to sigma."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.engine.frames import estimate_noise, thin_out
from mirrorskin.io import Source

_FEWEST = 16  # pixels that must have turned light
_SURELY = 8.0  # sigmas by which they must have become brighter


@dataclass(frozen=True, slots=True)
class EstimatedLevels:
    """Counts without and with light, and the standard deviations of the pixels' own levels about them."""

    dark: float
    bright: float
    dark_sigma: float
    bright_sigma: float


def estimate_levels(
    source: Source, frames: range, dark: ArrayLike | None = None, bright: ArrayLike | None = None
) -> EstimatedLevels | None:
    """Estimate the counts of dark and light from the frames of least and greatest travel.

    The pixels of which these frames differ by more than half of the most that any 16 do have turned light;
    the levels are the medians of their counts, and the deviations what is left of the counts' own without
    the noise. A level that is given is kept, and is exact.

    Parameters
    ----------
    source : Source
        A recording whose frames can be read in any order; of integers.
    frames : range
        The press, or the release.
    dark, bright : array_like, scalar or (H, W), optional
        What is given.

    Returns
    -------
    EstimatedLevels or None
        None where the frames do not tell: nothing turns light, or the source must be read in order.
    """
    travel: NDArray[np.float64] | None = getattr(source, "travel", None)
    read = getattr(source, "frame", None)
    if travel is None or read is None or source.dtype.kind != "u" or len(frames) < 2:
        return None
    part = travel[frames.start : frames.stop]
    least, most = (frames.start + int(number) for number in (np.argmin(part), np.argmax(part)))
    beside = least + (1 if least + 1 < frames.stop else -1)
    first, second, last = (thin_out(read(number)) for number in (least, beside, most))
    rise = last - first
    if rise.size < _FEWEST:
        return None
    top = float(np.partition(rise, -_FEWEST)[-_FEWEST])
    noise = estimate_noise(first, second, integer=True)
    if top < _SURELY * noise:
        return None
    lit = rise >= top / 2
    low, low_sigma = _middle(first[lit], noise) if dark is None else (_median(dark), 0.0)
    high, high_sigma = _middle(last[lit], noise) if bright is None else (_median(bright), 0.0)
    return EstimatedLevels(low, high, low_sigma, high_sigma) if high > low else None


def _middle(counts: NDArray[np.float64], noise: float) -> tuple[float, float]:
    """Return the median of counts, and their standard deviation without the noise and without outliers."""
    middle = _median(counts)
    spread = math.sqrt(2) * estimate_noise(np.full_like(counts, middle), counts, integer=True)
    return middle, math.sqrt(max(0.0, spread**2 - noise**2) + noise**2 / counts.size)


def _median(counts: ArrayLike) -> float:
    return float(np.nanmedian(np.asarray(counts, np.float64)))
