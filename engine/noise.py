"""How noisy a stack is: told from its first two frames."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

SAMPLES = 65536
_CLIP = 4.0
_MEDIAN = 0.6745  # of the magnitude of a normal variate
QUANTUM = 1 / math.sqrt(12)
"""The least noise of whole counts: that of their rounding."""


def thinning(shape: tuple[int, ...]) -> int:
    """Return which so-manieth pixel of a frame to take for evenly spread samples."""
    return max(1, math.prod(shape) // SAMPLES)


def thin_out(frame: NDArray[Any]) -> NDArray[np.float64]:
    """Take evenly spread samples of a frame, enough to know its noise within half a per cent."""
    return frame.reshape(-1)[:: thinning(frame.shape)].astype(np.float64)


def estimate_noise(first: NDArray[np.float64], second: NDArray[np.float64], integer: bool) -> float:
    """Estimate the standard deviation of a sample from two looks at the same pixels.

    Clipping at four sigma, until it settles, leaves out the pixels that changed in between, as long as they
    are fewer than half.

    Parameters
    ----------
    first, second : ndarray, (n,), float64
        Counts of the same pixels in two frames.
    integer : bool
        Whether counts are whole numbers; their rounding is then the least noise there is.

    Returns
    -------
    float
        Counts.
    """
    usable = np.isfinite(first) & np.isfinite(second)
    difference = second[usable] - first[usable]
    if difference.size == 0:
        return QUANTUM if integer else 0.0
    spread = max(np.median(np.abs(difference)) / _MEDIAN, 1.0 if integer else 0.0)
    for _ in range(10):
        kept = difference[np.abs(difference) <= _CLIP * spread]
        if spread == (spread := float(np.sqrt(np.mean(kept**2)))):
            break
    noise = spread / np.sqrt(2)
    return float(max(noise, QUANTUM) if integer else noise)
