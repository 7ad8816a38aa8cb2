"""Where on the picture a camera with a distorting lens sees the points of the sheet."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import Lens

Doubles = NDArray[np.float64]


def picture_places(lens: Lens, x: ArrayLike, y: ArrayLike) -> tuple[Doubles, Doubles]:
    """Return the columns and rows of the picture at which points of the sheet are seen.

    Parameters
    ----------
    lens : Lens
    x, y : array_like, of one shape
        Millimetres from the middle of the undistorted map, y up.

    Returns
    -------
    column, row : ndarray, float64
        In pixels of the full picture, 0 in the first; NaN where no line of sight leads there.
    """
    across, up = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
    rays = _rays(lens, np.stack([across.ravel(), up.ravel(), np.ones(across.size)]))
    seen = lens.matrix @ distorted(rays, lens.distortion)
    # Not "at or above": a ray that is NaN stays so.
    seen[:, ~(rays[0] ** 2 + rays[1] ** 2 < _fold(lens.distortion))] = np.nan
    return seen[0].reshape(across.shape), seen[1].reshape(across.shape)


def distorted(rays: Doubles, distortion: ArrayLike) -> Doubles:
    """Bend rays as OpenCV's model does.

    Parameters
    ----------
    rays : ndarray, (..., 3, n), float64
        (x, y, 1) of a pinhole camera.
    distortion : array_like, (..., 5)
        k1, k2, p1, p2, k3. With r^2 = x^2 + y^2, x becomes
        ``x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)``, and y
        ``y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y``.

    Returns
    -------
    ndarray, (..., 3, n), float64
        Far out, where the model folds the picture back, they mean nothing.
    """
    k1, k2, p1, p2, k3 = np.moveaxis(np.asarray(distortion, np.float64), -1, 0)[..., np.newaxis]
    x, y = rays[..., 0, :], rays[..., 1, :]
    square = x * x + y * y
    radial = 1 + square * (k1 + square * (k2 + square * k3))
    bent = np.ones_like(rays)
    bent[..., 0, :] = x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x)
    bent[..., 1, :] = y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y
    return bent


def _fold(distortion: Doubles) -> float:
    """Return the squared radius at which the distorted radius stops growing."""
    k1, k2, _, _, k3 = distortion
    roots = np.roots([7 * k3, 5 * k2, 3 * k1, 1.0])
    ahead = roots.real[(abs(roots.imag) <= 1e-9 * abs(roots)) & (roots.real > 0)]
    return float(ahead.min(initial=math.inf))


def _rays(lens: Lens, points: Doubles) -> Doubles:
    """Return the rays, (3, n), by which points of the sheet are seen; NaN of those behind the camera."""
    whole = lens.camera @ lens.matrix
    seen = np.linalg.solve(whole, points)
    # In front is the side of the picture's centre.
    ahead = seen[2] * np.linalg.solve(whole, [0.0, 0.0, 1.0])[2] > 0
    return np.asarray(seen / np.where(ahead, seen[2], np.nan))
