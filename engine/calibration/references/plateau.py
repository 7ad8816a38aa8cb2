"""The level of full light of pixels that are lit now and then, under a ball that is rolled about."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from mirrorskin.engine.calibration.references.levels import rounding_error
from mirrorskin.io.types import Floats

LEAST = 5
"""Samples in full light that a level needs."""

_BRIGHTEST = 3  # which sample, by brightness, tells roughly how bright full light is: no single glint
_LIT = 0.75  # of that light, for samples that full light is looked for among
_WIDTH = 3.0  # standard deviations to either side that belong to full light
_BELOW = 6.0  # and how far down samples tell how many others are among them
_STEPS = 30
_SETTLED = 1e-3  # standard deviations
_BIN, _BINS = 256, 16

# A mean of what lies within a symmetric window about itself scatters more than one of all.
_INSIDE = float(2 * ndtr(_WIDTH) - 1)
_KEPT = _INSIDE - 2 * _WIDTH * math.exp(-(_WIDTH**2) / 2) / math.sqrt(math.tau)
_WASTE = _INSIDE / _KEPT


@dataclass(frozen=True, slots=True, eq=False)
class Plateau:
    """The upper plateau of some pixels' samples.

    Attributes
    ----------
    value, sigma : ndarray, (P,), float64
        Counts, and the standard error; NaN of a pixel that has fewer than five samples there.
    noise : ndarray, (P,), float64
        Standard deviation of its samples.
    count : ndarray, (P,), int64
        How many samples it has.
    """

    value: Floats
    sigma: Floats
    noise: Floats
    count: NDArray[np.int64]


def find_plateau(samples: Floats, dark: Floats, whole: bool) -> Plateau:
    """Find the mean of the samples in full light among those in half light and in none.

    The plateau is where a mean of samples is in the middle of the window of three standard deviations to
    either side that it was taken from: the window cuts off as much above as below, and the mean is free of
    bias, as the mean of the brightest samples is not. The standard deviation is told from the samples
    above the mean, of all pixels of about that level, as none above it are in half light. How many in half
    light lie in the window is told from those just below it, and their share of the mean is taken off.

    Parameters
    ----------
    samples : ndarray, (T, P), float64
        Counts; NaN is no sample.
    dark : ndarray, (P,), float64
        Counts without light.
    whole : bool
        Whether samples are whole numbers.
    """
    lit = samples >= dark + _LIT * (_roughly(samples) - dark)
    value = _mean(samples, lit)
    noise = _noise(samples, value, np.full(value.shape, np.inf))
    for _ in range(_STEPS):
        before = value
        value = _mean(samples, np.abs(samples - value) <= _WIDTH * noise)
        noise = _noise(samples, value, _BELOW * noise)
        if not np.any(np.abs(value - before) > _SETTLED * noise):
            break
    count = np.count_nonzero(np.abs(samples - value) <= _WIDTH * noise, axis=0)
    value, error = _without_half_light(samples, value, noise, count)
    error += rounding_error(noise**2) if whole else 0.0
    told = count >= LEAST
    return Plateau(np.where(told, value, np.nan), np.where(told, np.sqrt(error), np.nan), noise, count)


def _roughly(samples: Floats) -> Floats:
    """Return the third-brightest sample of each pixel, NaN without one."""
    known = np.where(np.isfinite(samples), samples, -np.inf)
    place = max(len(samples) - _BRIGHTEST, 0)
    rough = np.partition(known, place, axis=0)[place]
    return np.asarray(np.where(np.isfinite(rough), rough, np.nan))


def _mean(samples: Floats, chosen: NDArray[np.bool_]) -> Floats:
    total = np.where(chosen, samples, 0.0).sum(axis=0)
    count = chosen.sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _noise(samples: Floats, value: Floats, reach: Floats) -> Floats:
    """Tell the standard deviation from what lies above the level, from all pixels of about that level."""
    with np.errstate(invalid="ignore"):
        above = (samples > value) & (samples <= value + reach)
    count = above.sum(axis=0)
    squares = np.where(above, (samples - value) ** 2, 0.0).sum(axis=0)
    own = np.maximum(1 - 1 / np.maximum(2 * count, 1), 0.5)  # the level is a mean of these, too
    known = np.flatnonzero(count > 0)
    if not known.size:
        return np.where(np.isfinite(value), 0.0, np.nan)
    order = known[np.argsort(value[known], kind="stable")]
    parts = np.array_split(order, min(max(order.size // _BIN, 1), _BINS))
    level = [value[part].mean() for part in parts]
    pooled = [math.sqrt(squares[part].sum() / (count[part] * own[part]).sum()) for part in parts]
    return np.where(np.isfinite(value), np.interp(value, level, pooled), np.nan)


def _without_half_light(
    samples: Floats, value: Floats, noise: Floats, count: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """Take off what samples in half light add to the mean; return it and its squared standard error."""
    below = value - samples
    half = ((below > _WIDTH * noise) & (below <= _BELOW * noise)).sum(axis=0)
    half = half * _WIDTH / (_BELOW - _WIDTH)  # as many lie in the window's lower half
    lever = _WIDTH * noise / 2
    full = np.maximum(count - half, 1)
    # Neither how many they are nor where they lie in their half of the window is known.
    error = _WASTE * noise**2 / full + half * (lever**2 + (_WIDTH * noise) ** 2 / 3) / full**2
    return value + half * lever / full, error
