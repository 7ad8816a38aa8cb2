"""Errors of directions because of the blur of a lens: ``blur.cl`` in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

Array = NDArray[Any]


def blur_bend(first: Array, second: Array, reach: int) -> Array:
    """Return the squares of the parts of a direction's Laplacian across it, (H, W), per pixel^4.

    The vectors, of any length, are ``first``, (H, W, 3), or their components ``first`` and ``second``.
    Differences are over ``reach`` pixels; beyond the border, the direction is that of the border.
    """
    vectors = np.moveaxis(first, -1, 0) if first.ndim == 3 else np.stack([first, second])
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = vectors / np.sqrt(np.sum(vectors.astype(np.float64) ** 2, axis=0))
    padded = np.pad(direction, ((0, 0), (reach, reach), (reach, reach)), mode="edge")
    rows, columns = vectors.shape[1:]
    around = -4 * direction
    for down, right in ((0, reach), (2 * reach, reach), (reach, 0), (reach, 2 * reach)):
        around = around + padded[:, down : down + rows, right : right + columns]
    bent = around / reach**2
    across: Array = np.sum(bent**2, axis=0) - np.sum(bent * direction, axis=0) ** 2
    return np.maximum(across, 0)


def blur_add(
    first: Array, bend: Array, reach: int, factor: float, noise: float, base: float, rise: float, sigma: Array
) -> None:
    """Add the mean error of the pixels around each pixel to standard deviations, (H, W), in place.

    The mean is over windows of 2 ``reach`` + 1 pixels, without pixels whose ``bend`` is NaN and those beyond
    the border; ``factor`` is half of the variance of the point spread, pixels^2, and ``noise`` the variance
    of the bend because of noise, relative to that of a direction. A variance ``base`` is added, too, and
    ``rise`` times the square of the sine of the zenith of unit vectors ``first``, (H, W, 3).
    """
    size, border = (2 * reach + 1, 2 * reach + 1), reach
    finite = np.isfinite(bend)
    total, count = (
        sliding_window_view(np.pad(part.astype(np.float64), border), size).sum((2, 3))
        for part in (np.where(finite, bend, 0), finite)
    )
    upright = first[..., 2].astype(np.float64) if first.ndim == 3 else np.zeros(bend.shape)
    clear = np.fmax(total / np.maximum(count, 1) - noise * sigma.astype(np.float64) ** 2, 0)
    more = base + rise * np.maximum(1 - upright**2, 0)
    sigma[:] = np.sqrt(sigma**2 + factor**2 * clear + more)
