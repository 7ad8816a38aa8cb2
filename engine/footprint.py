"""What the area that a height is measured over does to it, where the surface is curved."""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_AT_ONCE = 32  # rows processed at once


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
    rows, columns = (size - 2 * reach for size in height.shape)

    def at(down: int, right: int) -> NDArray[Any]:
        down, right = reach * (down + 1), reach * (right + 1)
        return height[down : down + rows, right : right + columns]

    middle = at(0, 0) * np.float32(2)
    squares = at(0, 1) + at(0, -1)
    squares -= middle
    squares *= squares
    along = at(1, 0) + at(-1, 0)
    along -= middle
    along *= along
    squares += along
    mixed = at(1, 1) - at(1, -1)
    mixed += at(-1, -1)
    mixed -= at(-1, 1)
    mixed *= mixed
    mixed *= np.float32(1 / 8)  # 2 (mixed / 4)^2
    squares += mixed
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
