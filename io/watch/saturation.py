"""The end of the scale of samples, where a camera cuts off light: what samples show of it.

It is 2^n - 1 for a camera of n bits, also if these are in the upper bits of a sample, or were divided. Any
other end, as of a sensor that is full before its converter, or after a dark frame was subtracted, shows as a
pile of samples at one value: noise is missing there, or the samples below do not approach it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.base.types import Floats

REACHED = 0.1
"""Tolerated share of pixels that reach the end of the scale."""

_FULL = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 16))  # highest samples of cameras
_FEWEST = 64  # samples at least of a pile, and for other estimates
_PILED = 3.0  # samples at the end over those just below it, from which they are a pile
_STUCK, _STUCK_COARSE = 4, 6  # samples of a pixel at its own end; if noise is coarser than a quarter of steps
_NOISY, _FINE = 0.5, 4.0  # noise in steps of the samples from which it is seen, and from which it is fine
_DARK = 0.05  # share of a pixel's range
_SMOOTH = 0.03  # share of steps with another sign than the one before, below which there is no noise
_ALTERNATING = 0.5  # share of differences with another sign than the one before, above which they are noise
_COARSE = 1024  # samples below which noise is a few steps
_LIGHT, _MOST = 0.9, 0.5  # share of a pixel's range; share of its samples above it that are at its end
_NEAR_NOISE = 4.0  # distance from a pixel's end within which noise would spread its samples, sigmas
_NEAR, _NEXT = 1 / 16, 1 / 4  # distances from the end that are compared, share of the span
_PARTS, _SPREAD = 12, 6.0  # of the further distance; least number of them that contain samples
_APPROACHED = 0.5  # ratio of their samples from which the end is approached; even samples have 1/3
_EDGE = 0.02  # share of samples at the lowest one, from which brightness may start with an edge
_QUANTIZED = 0.05  # deviation from whole numbers, steps

MAD = 1.4826
"""Standard deviation over median absolute deviation, of a normal distribution."""


def scale_top(highest: float, integer: bool) -> float | None:
    """Return the largest sample if it is the top of a camera's scale, else None.

    The top is 1 for floats. For integers it is eight or more binary ones followed by any number of zeros, as
    for a 12-bit camera in 16-bit frames.

    Examples
    --------
    >>> scale_top(65520, integer=True), scale_top(65500, integer=True)
    (65520, None)
    """
    if highest == 1 and not integer:
        return highest
    if highest < _FULL[0] or highest % 1 or highest >= 2**32:
        return None
    ones = int(highest) // (int(highest) & -int(highest))
    return highest if ones & (ones + 1) == 0 and ones >= _FULL[0] else None


def scale_ends(stored: NDArray[Any], counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the end of the scale at each pixel, infinite where it is unknown or not reached.

    Parameters
    ----------
    stored : ndarray, (T, n)
        Samples as stored; all pixels.
    counts : ndarray, (T, n), float32
        The pixels without NaN.
    """
    highest = counts.max(axis=0)
    top = highest.max()
    ends = np.full(len(highest), np.inf, np.float32)
    if stored.dtype.kind == "u" and float(top) in _FULL:
        ends[:] = top
        return ends
    common = float(np.mean(highest == top)) > REACHED
    at_end = np.count_nonzero(counts == highest, axis=0)
    lowest = counts.min(axis=0)
    light = np.count_nonzero(counts >= lowest + _LIGHT * (highest - lowest), axis=0)
    coarse = stored.dtype.kind == "u" and top < _COARSE
    stuck = (at_end >= (_STUCK_COARSE if coarse else _STUCK)) & (at_end > _MOST * light)
    if not common and np.mean(stuck) <= REACHED:
        return ends
    step = _step_of(stored if stored.dtype.kind == "u" else counts)
    if common and _is_full_scale(counts, step, float(top), stored.dtype.kind == "u"):
        ends[:] = top
        return ends
    noise = _noise_of(counts, highest)
    if common and (
        _is_pile(counts, float(top), step, noise)
        if noise > 0 and noise >= _NOISY * step
        else _is_cut(counts, float(top))
    ):
        ends[:] = top
        return ends
    if noise > 0 and noise >= 2 * _NOISY * step:
        near = np.count_nonzero((counts < highest) & (counts >= highest - _NEAR_NOISE * noise), axis=0)
        stuck &= at_end >= (_STUCK if noise >= _FINE * step else _STUCK_COARSE)
        stuck &= (at_end > _PILED * near) & (highest - lowest > 2 * _NEAR_NOISE * noise)
        if np.mean(stuck) > REACHED:
            ends[stuck] = highest[stuck]
    return ends


def _step_of(samples: NDArray[Any]) -> float:
    """Return the step between the levels of samples; about 0 if they are continuous."""
    if samples.dtype.kind == "u":
        return float(max(1, np.gcd.reduce(samples, axis=None)))
    levels = np.unique(samples.reshape(-1)[:: max(1, samples.size >> 16)])
    return float(np.diff(levels).min()) if len(levels) > 1 else 0.0


def _is_full_scale(counts: NDArray[np.float32], step: float, top: float, integer: bool) -> bool:
    """Return whether the highest sample is the last of 2^n levels, in the upper bits or after a division."""
    if integer:
        return step > 1 and top / step in _FULL
    if top <= 0 or step <= 0:
        return False
    part = counts.reshape(-1)[:: max(1, counts.size >> 16)].astype(np.float64)
    for full in _FULL:
        levels = part * (full / top)
        whole = np.rint(levels)
        if np.max(np.abs(levels - whole)) < _QUANTIZED:
            return full // int(np.gcd.reduce(whole.astype(np.int64))) in _FULL
    return False


def _noise_of(counts: NDArray[np.float32], highest: NDArray[np.float32]) -> float:
    """Return the noise of samples below the end of the scale and above its start; 0 if there is none.

    Differences of noise change their sign from one to the next more often than not, those of a smooth signal
    seldom. Dark samples may be the only ones that change by noise alone.
    """
    lowest = counts.min(axis=0)
    inside = (counts < highest) & (counts > lowest.min())
    least = math.inf
    for used in (inside, inside & (counts < lowest + _DARK * (highest - lowest))):
        differences = counts
        for order in range(1, min(4, len(counts) - 1)):
            differences, used = np.diff(differences, axis=0), used[1:] & used[:-1]
            turns = (differences[1:] * differences[:-1])[used[1:] & used[:-1]]
            turns = turns[turns != 0]
            alternating = np.mean(turns < 0) if turns.size >= _FEWEST else 0.0
            if order == 1 and alternating < _SMOOTH:
                break  # higher differences of a step alternate, too
            if alternating > _ALTERNATING:
                spread = math.sqrt(math.comb(2 * order, order))
                noise = MAD * float(np.median(np.abs(differences[used]))) / spread
                least = min(least, noise) if noise > 0 else least
    return least if least < math.inf else 0.0


def _is_pile(counts: NDArray[np.float32], top: float, step: float, noise: float) -> bool:
    """Return whether noisy samples pile up at the highest one; noise makes the highest ones the fewest."""
    width = step if step > noise / 64 else noise / 8
    at_top = int(np.count_nonzero(counts == top))
    below = int(np.count_nonzero((counts < top - 0.5 * step) & (counts > top - 0.5 * step - width)))
    return at_top > max(_FEWEST, _PILED * below)


def _is_cut(counts: NDArray[np.float32], top: float) -> bool:
    """Return whether samples without noise reach the highest one at a slope, unless they start so, too."""
    start = float(counts.min())
    distance = (counts.ravel() - start) / max(top - start, 1e-30)
    at_top = _approach(1 - distance)
    if at_top >= _APPROACHED:
        return False
    # Otherwise brightness itself may have two edges.
    return bool(np.mean(distance == 0) <= _EDGE) or _approach(distance) >= 2 * at_top


def _approach(distance: Floats | NDArray[np.float32]) -> float:
    """Return the ratio of the samples close to a level to those further away; infinite if unknown.

    ``distance`` is a share of the span. If brightness rises evenly up to the level, the ratio is 1/3; where
    it approaches the level more slowly, it is larger.
    """
    near = np.count_nonzero((distance > 1e-6) & (distance <= _NEAR))
    further = distance[(distance > _NEAR) & (distance <= _NEXT)]
    parts = np.histogram(further, _PARTS, (_NEAR, _NEXT))[0].astype(np.float64)
    if further.size < _FEWEST or parts.sum() ** 2 < _SPREAD * np.sum(parts**2):
        return math.inf
    return near / further.size
