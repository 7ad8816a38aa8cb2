"""Least squares of brightness over the directions of the light: what ``lambert.cl`` computes, in NumPy.

The samples E_k of a pixel that are neither dark nor saturated, and the lamps' vectors l_k, are the rows
(l_k, E_k) of a matrix. The triangle R of its QR decomposition (Golub and Van Loan, Matrix Computations,
section 5.3) holds all that least squares needs, loses nothing by cancellation, and takes in further rows by
rotations.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

_PLACES = np.triu_indices(4)


def lambert_add(frames: Array, lights: Array, fresh: bool, darks: Array, shadow: float, bright: float,
                triangle: Array) -> None:  # fmt: skip
    """Take in frames, or begin anew where ``fresh``; the triangle is changed in place.

    Parameters
    ----------
    frames : (n, P), uint8, uint16 or float32
    lights : (n, 3)
    darks : (P,) or (1,), counts without light, which are subtracted
    shadow : counts above dark from which on, exclusively, a sample counts
    bright : counts up to which, exclusively, a sample counts
    triangle : (11, P), R by rows with a diagonal that is not negative, its last element squared, which is
        the sum of the squares that the fit leaves; and the number of samples that counted
    """
    if fresh:
        triangle[:] = 0
    light = frames.astype(np.float32) - darks
    seen = (light > shadow) & (frames < bright)
    rows = np.concatenate([np.broadcast_to(lights[:, None], (*seen.shape, 3)), light[..., None]], axis=2)
    before = np.zeros((frames.shape[1], 4, 4))
    before[:, *_PLACES] = triangle[:10].T
    before[:, 3, 3] = np.sqrt(before[:, 3, 3])
    lit = np.where(seen.T[..., None], rows.swapaxes(0, 1), 0)
    after: Array = np.linalg.qr(np.concatenate([before, lit], axis=1)).R
    after *= np.where(np.diagonal(after, axis1=1, axis2=2) < 0, -1, 1)[..., None]
    triangle[:10] = after[:, *_PLACES].T
    triangle[9] **= 2
    triangle[10] += seen.sum(axis=0)
