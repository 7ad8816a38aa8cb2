"""Which way a map of uncertain heights goes: paraboloids fitted around each pixel."""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Doubles = NDArray[np.float64]

_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of the offsets along columns and rows
_REACH = 3.0  # widths of the window, to either side
_FLAT = 1e-9  # least share of a fit's information that is worth inverting


class Trend(NamedTuple):
    """Paraboloids at n pixels, (n,), float64.

    Attributes
    ----------
    height : ndarray
        Millimetres.
    along : ndarray, (2, n)
        Slopes along columns and rows, mm per pixel.
    variance : ndarray, (2, n)
        Of these.
    misfit : ndarray
        Mean squared error in standard deviations; NaN where too little is known for a paraboloid.
    pixels : ndarray
        How many told.
    """

    height: Doubles
    along: Doubles
    variance: Doubles
    misfit: Doubles
    pixels: Doubles


def find_trend(height: Doubles, weight: Doubles, places: NDArray[np.bool_], width: float) -> Trend:
    """Fit paraboloids by least squares in a Gaussian window around pixels.

    Parameters
    ----------
    height : ndarray, (H, W), float64
        Millimetres; of any value where the weight is 0.
    weight : ndarray, (H, W), float64
        Inverse variances.
    places : ndarray, (H, W), bool
        Where to fit.
    width : float
        Standard deviation of the window, pixels.

    Returns
    -------
    Trend
    """
    known = weight > 0
    datum = float(np.average(height[known], weights=weight[known])) if known.any() else 0.0
    relative = np.where(known, height - datum, 0.0)
    window = _Window(places, width)
    powers = [(i, j) for i, j in product(range(5), repeat=2) if i + j <= 4]
    moments = window.sums(weight, powers)
    right = np.stack(list(window.sums(weight * relative, list(_TERMS)).values()), axis=-1)
    matrix = np.stack(
        [np.stack([moments[a + c, b + d] for c, d in _TERMS], axis=-1) for a, b in _TERMS], axis=-2
    )
    square = window.sums(weight * relative**2, [(0, 0)])[0, 0]
    pixels = window.sums(known.astype(np.float64), [(0, 0)])[0, 0]
    inverse, sound = _invert(matrix)
    found = np.einsum("nij,nj->ni", inverse, right)
    left = np.maximum(square - np.sum(found * right, axis=-1), 0)
    enough = sound & (pixels > 2 * len(_TERMS))
    return Trend(
        height=found[:, 0] + datum,
        along=found[:, 1:3].T,
        variance=np.stack([inverse[:, 1, 1], inverse[:, 2, 2]]),
        misfit=np.where(enough, left / np.maximum(pixels - len(_TERMS), 1), np.nan),
        pixels=pixels,
    )


class _Window:
    """Sums over a window around some pixels, times powers of the distance in windows' widths."""

    def __init__(self, places: NDArray[np.bool_], width: float) -> None:
        self._places = places
        reach = math.ceil(_REACH * width)
        offset = np.arange(-reach, reach + 1.0)
        self._kernels = [np.exp(-((offset / width) ** 2) / 2) * offset**power for power in range(5)]

    def sums(self, values: Doubles, powers: list[tuple[int, int]]) -> dict[tuple[int, int], Doubles]:
        """Return sums of values times column offsets and row offsets to the powers, at the pixels."""
        across: dict[int, Doubles] = {}
        found = {}
        for i, j in powers:
            if i not in across:
                across[i] = ndimage.correlate1d(values, self._kernels[i], axis=1, mode="constant")
            both = ndimage.correlate1d(across[i], self._kernels[j], axis=0, mode="constant")
            found[i, j] = both[self._places]
        return found


def _invert(matrix: Doubles) -> tuple[Doubles, NDArray[np.bool_]]:
    """Return inverses of matrices, and which of them there are; the others are those of the identity."""
    size = np.sqrt(np.maximum(np.einsum("nii->ni", matrix), np.finfo(float).tiny))
    scaled = matrix / (size[:, :, np.newaxis] * size[:, np.newaxis, :])
    sound = np.linalg.eigvalsh(scaled)[:, 0] > _FLAT
    scaled[~sound] = np.eye(matrix.shape[-1])
    return np.linalg.inv(scaled) / (size[:, :, np.newaxis] * size[:, np.newaxis, :]), sound
