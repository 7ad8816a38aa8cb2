"""Slopes from normals that are seen along z, and their weights: ``facing.cl`` in NumPy.

See `mirrorskin.engine.integration.camera.find_slopes` for the derivation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.integration.slopes import sum_around

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


def facing_weigh(dz_dx: Array, dz_dy: Array, variance: float, unit: float, mask: Array | None = None
                 ) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return slopes without the bias by noise, and their weights, for unit normals of a weight and variance.

    Pixels where the ``mask`` is 0 do not count.
    """
    x, y = dz_dx.astype(np.float64), dz_dy.astype(np.float64)
    defined = np.isfinite(x) & np.isfinite(y) & (True if mask is None else mask != 0)
    along_x, along_y, slant = mean_variances(x, y, (0.0, 0.0), defined)
    shorter = 1 / (1 + variance * slant)
    return x * shorter, y * shorter, unit / along_x, unit / along_y


def mean_variances(x: Array, y: Array, sight: tuple[Any, Any], defined: Array) -> tuple[Array, ...]:
    """Return the variances of slopes for unit normals of variance 1, and 1 / (n . v)^2, near each pixel.

    They are means over 5 x 5 pixels: weights that depended on the noise of the pixel itself would bias the
    surface. x and y are n_x / (n . v) and n_y / (n . v) with v = (``sight``, 1); the signs do not matter if
    the line of sight is along z. 1 where no pixel is ``defined``.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        square = sight[0] * sight[0] + sight[1] * sight[1] + 1
        slant = x * x + y * y + np.square(1 - x * sight[0] - y * sight[1])
        across, up = ((1 - 2 * s * v + s * s * square) * slant for s, v in zip((x, y), sight, strict=True))
        count = sum_around(defined.astype(x.dtype))
        sums = (sum_around(np.where(defined, values, x.dtype.type(0))) for values in (across, up, slant))
        return tuple(np.where(count > 0, total / np.maximum(count, 1), 1) for total in sums)


def facing_clip(lowest: float, highest: float, weight: Array) -> Array:
    """Return weights within limits; 0 where they are not above 0."""
    return np.where(weight > 0, np.clip(weight, lowest, highest), 0)
