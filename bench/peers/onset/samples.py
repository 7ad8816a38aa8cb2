"""From onsets to heights, sigma and status in NumPy, once some other way has found the onsets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.bench.peers.onset.peer import Heights, References
from mirrorskin.bench.peers.onset.suspects import INVALID

Indices = NDArray[np.intp]
Doubles = NDArray[np.float64]

PLATEAU = 3.0  # sigmas that a sample may be off the plateau it sits on
SURELY = 6.0  # sigmas below the level that are surely dark


def heights_of(
    frames: NDArray[Any], onset: NDArray[np.int32], travel: Doubles, known: References, noise: float
) -> Heights:
    """Return the maps of the full default; decision 2 says what they hold.

    Parameters
    ----------
    frames : ndarray, (T, H, W)
    onset : ndarray, (H, W), int32
        As a peer's `first_light` returns it.
    travel : ndarray, (T,), float64
        Millimetres.
    known : References
    noise : float
        Standard deviation of a sample, counts.
    """
    dead = np.isnan(known.level) | (onset == INVALID)
    status = np.select([dead, onset == -1, onset == 0], [0, 2, 3], 1).astype(np.uint8)
    height, sigma = (np.full(onset.shape, np.nan, np.float32) for _ in range(2))
    row, column = found = np.nonzero(status == 1)
    start = onset[found].astype(np.intp)
    level, light = known.level[found], known.light[found]

    below = _surely_dark(frames, start, row, column, light, level - np.float32(SURELY * noise))
    low, high = (frames[start - 1 + k, row, column].astype(np.float64) for k in (0, 1))
    last = len(frames) - 1
    after = frames[np.minimum(start + 1, last), row, column]
    after = np.fmin(after, frames[np.minimum(start + 2, last), row, column])

    sudden_step = PLATEAU * noise * np.sqrt(2)
    step = high - low
    share = (np.minimum(level, high) - low) / step
    width = travel[start] - travel[start - 1]
    from_dark, to_light = low <= known.dark[found] + PLATEAU * noise, high >= after - sudden_step
    hovers = (step <= sudden_step) | ((start - 2 - below) * step > 2.5 * sudden_step)
    interval = np.where(hovers, travel[start] - travel[below], width) / np.sqrt(12)
    told = width * noise * np.hypot(share, 1 - share) / step

    either, both = from_dark | to_light, from_dark & to_light
    height[found] = -(travel[start - 1] + width * np.where(both, 0.5, share))
    sigma[found] = np.where(both | hovers, interval, np.where(either, np.hypot(told, interval), told))
    return Heights(height, sigma, status)


def _surely_dark(
    frames: NDArray[Any],
    start: Indices,
    row: Indices,
    column: Indices,
    light: NDArray[Any],
    level: NDArray[np.float32],
) -> Indices:
    """Walk back from each onset to the last frame that was surely dark; the first frame passes for dark."""
    below = start - 1
    todo = np.arange(len(start))
    while len(todo := todo[below[todo] > 0]):
        sample = frames[below[todo], row[todo], column[todo]]
        todo = todo[~((sample < light[todo]) & (sample <= level[todo]))]
        below[todo] -= 1
    return below
