"""What the area that a height is measured over does to it, where the surface is curved."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_AT_ONCE = 64  # rows processed at once


def with_curvature(
    height: NDArray[Any], sigma: NDArray[Any], variance: float, reach: int | None = None
) -> NDArray[np.float32]:
    """Return standard deviations, mm, with what a footprint may move where the surface is curved.

    It is v / 2 times the root of the sum of all squared second derivatives, for a footprint of variance v,
    square pixels. They are differences over ``reach`` pixels on each side, by default its standard deviation,
    and their squares are averaged over as much.
    """
    if reach is None:
        reach = max(1, round(math.sqrt(variance)))
    rows = height.shape[0]
    edge = 2 * reach
    padded = cv2.copyMakeBorder(height.astype(np.float32), edge, edge, edge, edge, cv2.BORDER_REPLICATE)
    found, factor = np.empty(height.shape, np.float32), np.float32((variance / (2 * reach**2)) ** 2)
    for start in range(0, rows, _AT_ONCE):  # parts that stay in the cache
        stop = min(start + _AT_ONCE, rows)
        squares = _curvature(padded[start : stop + 4 * reach], reach) * factor
        squares += np.square(sigma[start:stop])
        np.sqrt(squares, out=found[start:stop])
    return found


def _curvature(height: NDArray[Any], reach: int) -> NDArray[Any]:
    """Return the mean square second differences, without the outer 2 ``reach`` rows and columns."""
    across, mixed = np.zeros((2, 2 * reach + 1, 2 * reach + 1), np.float32)
    across[reach, [0, reach, -1]] = 1, -2, 1
    mixed[[0, 0, -1, -1], [0, -1, 0, -1]] = np.array([-1, 1, 1, -1]) / math.sqrt(8)  # 2 (mixed / 4)^2
    squares = np.zeros(height.shape, np.float32)
    for kernel in (across, across.T.copy(), mixed):
        cv2.accumulateSquare(cv2.filter2D(height, -1, kernel), squares)
    squares = squares[reach:-reach, reach:-reach]
    there = np.isfinite(squares)
    window, inside = (2 * reach + 1, 2 * reach + 1), (slice(reach, -reach),) * 2
    if there.all():
        return np.asarray(cv2.blur(squares, window))[inside]
    total, share = (
        np.asarray(cv2.blur(part, window))[inside]
        for part in (np.where(there, squares, np.float32(0)), there.astype(np.float32))
    )
    mean: NDArray[Any] = np.divide(total, share, out=np.zeros_like(total), where=share > 0)
    return mean
