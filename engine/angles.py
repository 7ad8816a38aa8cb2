"""Angles between normals, as exact for small ones as for large ones."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.io import Truth


def true_normals(truth: Truth) -> NDArray[np.float64]:
    """Return the normals that a simulation knows, (H, W, 3) float64; NaN where there is no object."""
    zenith = truth.zenith.astype(np.float64)
    azimuth = np.where(zenith == 0, 0.0, truth.azimuth.astype(np.float64))  # a level one has none
    return np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], axis=-1
    )


def angle_between(first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.float64]:
    """Return the angles between vectors, (..., 3), radians."""
    across = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.asarray(np.arctan2(across, np.sum(first * second, axis=-1)))
