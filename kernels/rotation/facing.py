"""Slopes from normals that are seen along z, and their weights: ``facing.cl`` in NumPy.

See `mirrorskin.engine.integration.camera.find_slopes` for the derivation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


def facing_slopes(normals: Array, edge_on: float, unit: float) -> tuple[Array, Array, Array]:
    """Return slopes along x and y, (H, W), and their weights, from normals, (H, W, 3) of any length.

    Slopes are NaN, and the weight is ``unit``, where the squared cosine to z is at most ``edge_on``, or z is
    not above 0.
    """
    x, y, z = np.moveaxis(normals.astype(np.float64), -1, 0)
    with np.errstate(all="ignore"):
        cosine_square = z * z / (x * x + y * y + z * z)
        visible = (z > 0) & (cosine_square > edge_on)
        factor = np.where(visible, -1 / z, np.nan)
        return x * factor, y * factor, unit * np.where(visible, cosine_square, 1)


def facing_clip(lowest: float, highest: float, weight: Array) -> Array:
    """Return weights within limits; 0 where they are not above 0."""
    return np.where(weight > 0, np.clip(weight, lowest, highest), 0)
