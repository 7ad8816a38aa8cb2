"""The contrast around each pixel, and its peak over the frames: what ``focus.cl`` computes, in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[Any]


def focus_scan(frames: Array, first: int, radius: int, reach: int, best: Array, peak: Array,
               recent: Array) -> None:  # fmt: skip
    """Go through a block of frames; the maps are the state, changed in place.

    Parameters
    ----------
    frames : (n, H, W), uint8, uint16 or float32
    first : number of the block's first frame in the stack
    radius : pixels of the window on each side; at the border it has those that there are
    reach : frames that are kept on each side of the peak
    best : (H, W), frame of the greatest sum of squares of a window's samples less their mean
    peak : (2 reach + 1, H, W), that sum in the frames around the best; NaN where there is none
    recent : (reach, H, W), the sum in the last frames: frame t in plane t % reach
    """
    for t, frame in enumerate(frames.astype(np.float64), first):
        size, border = (2 * radius + 1, 2 * radius + 1), radius
        inside = sliding_window_view(np.pad(np.ones(frame.shape), border), size)
        samples = sliding_window_view(np.pad(frame, border), size)
        mean = samples.sum((2, 3)) / inside.sum((2, 3))
        sharp = np.sum(inside * (samples - mean[..., None, None]) ** 2, (2, 3))

        better = (sharp > peak[reach]) | np.isnan(peak[reach]) | (t == 0)
        since = t - best
        for k in range(1, reach + 1):
            peak[reach + k][since == k] = sharp[since == k]
            peak[reach - k][better] = recent[(t - k) % reach][better] if k <= t else np.nan
            peak[reach + k][better] = np.nan
        peak[reach][better] = sharp[better]
        best[better] = t
        recent[t % reach] = sharp
