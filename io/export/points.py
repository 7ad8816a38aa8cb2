"""The known heights of a map as points, with what else is known there."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io.types import Floats, Result

NORMAL = "nx", "ny", "nz"
UNITS = dict.fromkeys(("x", "y", "z", "sigma"), "mm")
"""Of a point's columns; the others have none."""


def grid_of(result: Result) -> tuple[NDArray[np.float32], Floats, Floats]:
    """Return the heights and the places of a result that is known to have them."""
    assert result.height is not None
    assert result.x is not None
    assert result.y is not None
    return result.height, result.x, result.y


def points_of(result: Result, pixels: NDArray[np.int64] | None = None) -> dict[str, NDArray[Any]]:
    """Return columns, one value a point.

    Parameters
    ----------
    result : Result
        With heights, (H, W), and places.
    pixels : ndarray, (N,), int64, optional
        Which, as indices into the flattened map; by default all whose heights are known.

    Returns
    -------
    dict of ndarray
        ``x, y, z``, and of what the result has ``nx, ny, nz`` (unit normal), ``sigma`` (standard deviation of
        z), all float32, and ``filled`` (1 where z was not measured), uint8; NaN where there is no answer.
    """
    height, x, y = grid_of(result)
    chosen = np.flatnonzero(np.isfinite(height)) if pixels is None else pixels
    row, column = np.unravel_index(chosen, height.shape)
    columns: dict[str, NDArray[Any]] = {
        "x": x[column].astype(np.float32),
        "y": y[row].astype(np.float32),
        "z": height[row, column],
    }
    if result.normals is not None:
        columns |= dict(zip(NORMAL, result.normals[row, column].T, strict=True))
    if result.height_sigma is not None:
        columns["sigma"] = result.height_sigma[row, column]
    if result.filled is not None:
        columns["filled"] = (result.filled[row, column] > 0).astype(np.uint8)
    return columns
