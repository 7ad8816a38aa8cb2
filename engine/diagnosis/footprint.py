"""What the area that a height is measured over does to it, where the surface is curved."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

PIXEL = 1 / 12
"""Variance of a pixel's area, square pixels."""

LEAST_BLUR = 0.3
"""Pixels: the blur of a lens at best, see `mirrorskin.io.Header.blur_sigma`."""

_AT_ONCE = 64  # rows processed at once


def with_curvature(height: NDArray[Any], sigma: NDArray[Any], variance: float) -> NDArray[np.float32]:
    """Return standard deviations, mm, with what a footprint may move where the surface is curved.

    It is v / 2 times the root of h_xx^2 + h_yy^2 + 2 h_xy^2 + 2 max(h_xx h_yy, 0), for a footprint of
    variance v, square pixels: of a dome, v / 2 times the sum of both curvatures. The derivatives
    are differences between pixels that are its standard deviation apart, rounded up, and their squares are
    averaged over 3 x 3 of these.
    """
    import cv2  # slow to import, and unneeded by most presses

    reach, (rows, columns) = math.ceil(math.sqrt(variance)), height.shape
    padded = cv2.copyMakeBorder(height[::reach, ::reach].astype(np.float32), 2, 2, 2, 2, cv2.BORDER_REPLICATE)
    combined, factor = np.empty(height.shape, np.float32), np.float32((variance / (2 * reach**2)) ** 2)
    coarse_rows, coarse_columns = (size - 4 for size in padded.shape)
    for start in range(0, coarse_rows, _AT_ONCE):  # parts that stay in the cache
        stop = min(start + _AT_ONCE, coarse_rows)
        squares: NDArray[Any] = _curvature(padded[start : stop + 4]) * factor
        if reach > 1:
            size = reach * coarse_columns, reach * (stop - start)
            squares = np.asarray(cv2.resize(squares, size, interpolation=cv2.INTER_NEAREST))
        part = slice(reach * start, min(reach * stop, rows))
        squares = squares[: part.stop - part.start, :columns]
        squares += np.square(sigma[part])
        np.sqrt(squares, out=combined[part])
    return combined


_ACROSS, _MIXED = np.zeros((2, 3, 3), np.float32)
_ACROSS[1] = 1, -2, 1
_MIXED[[0, 0, 2, 2], [0, 2, 0, 2]] = np.array([-1, 1, 1, -1]) / math.sqrt(8)  # 2 (h_xy)^2
_ALONG = _ACROSS.T.copy()


def _curvature(height: NDArray[Any]) -> NDArray[Any]:
    """Return the mean of square second differences, without the outer 2 rows and columns."""
    import cv2

    across, along = (cv2.filter2D(height, -1, kernel) for kernel in (_ACROSS, _ALONG))
    squares = np.maximum(cv2.multiply(across, along, scale=2), np.float32(0))
    for differences in (across, along, cv2.filter2D(height, -1, _MIXED)):
        cv2.accumulateSquare(differences, squares)
    squares, inside = squares[1:-1, 1:-1], (slice(1, -1),) * 2
    finite = np.isfinite(squares)
    if finite.all():
        return np.asarray(cv2.blur(squares, (3, 3)))[inside]
    total, coverage = (
        np.asarray(cv2.blur(part, (3, 3)))[inside]
        for part in (np.where(finite, squares, np.float32(0)), finite.astype(np.float32))
    )
    mean: NDArray[Any] = np.divide(total, coverage, out=np.zeros_like(total), where=coverage > 0)
    return mean
