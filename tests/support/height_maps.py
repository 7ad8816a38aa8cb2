"""Surfaces with measures in closed form, as results."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin import io

Map = NDArray[np.float64]


def places(shape: tuple[int, int], pixel_size: tuple[float, float]) -> tuple[Map, Map]:
    """Return x, to the right, and y, upwards, of all pixel centres, mm from the picture's centre."""
    rows, columns = np.indices(shape)
    x = (columns - (shape[1] - 1) / 2) * pixel_size[0]
    y = ((shape[0] - 1) / 2 - rows) * pixel_size[1]
    return x, y


def cap(
    shape: tuple[int, int],
    pixel_size: tuple[float, float],
    radius: float,
    width: float,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Map:
    """Return a ball's cap, NaN around it; the centre's z is that of its top, the width half of the cap's."""
    x, y = places(shape, pixel_size)
    square = (x - centre[0]) ** 2 + (y - centre[1]) ** 2
    height = np.sqrt(np.maximum(radius**2 - square, 0)) - radius + centre[2]
    return np.where(square < width**2, height, np.nan)


def result_of(
    height: ArrayLike, pixel_size: tuple[float, float] = (0.1, 0.1), sigma: float | None = None, **more: Any
) -> io.Result:
    """Return a result with such heights, which are all as sure."""
    heights = np.asarray(height, np.float32)
    x, y = io.pixel_axes((heights.shape[0], heights.shape[1]), pixel_size)
    sigmas = None if sigma is None else np.where(np.isfinite(heights), np.float32(sigma), np.float32(np.nan))
    return io.Result(**{"height": heights, "height_sigma": sigmas, "x": x, "y": y, **more})
