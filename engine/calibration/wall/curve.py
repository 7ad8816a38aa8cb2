"""How much light a printed pattern lets through, as a monotone curve, and what scatter makes of it.

The place on the wall is told by a share u: 0 at the rim and 1 at the rest plane, evenly in the elevation at
which the sheet's centre sees it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline

Doubles = NDArray[np.float64]

_PIECES = 8  # a gamma of 2.2 is met within 2e-4 of full light
_CUBIC = 3
COEFFICIENTS = _PIECES + _CUBIC
"""Of a curve, which is a cubic spline with evenly spaced knots on 0 to 1, and 0 beyond."""

_KNOTS = np.pad(np.linspace(0, 1, _PIECES + 1), _CUBIC, "edge")


def values(coefficients: ArrayLike, share: ArrayLike) -> Doubles:
    """Return the curve at shares u, (n,); 0 outside 0 to 1."""
    share = np.asarray(share, np.float64)
    spline = BSpline(_KNOTS, np.asarray(coefficients, np.float64), _CUBIC)
    return np.where((share >= 0) & (share <= 1), spline(np.clip(share, 0, 1)), 0.0)


def means(low: ArrayLike, high: ArrayLike) -> Doubles:
    """Return the matrix that makes of coefficients the curve's means over intervals, (n, COEFFICIENTS).

    With G, the antiderivative, they are ``(G(high) - G(low)) / (high - low)``: what a mirror shows that
    spreads each ray evenly over the interval.

    Parameters
    ----------
    low, high : array_like, (n,)
        Ends of the intervals, low < high, which may lie outside 0 to 1.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    grown = _antiderivatives(np.clip(high, 0, 1)) - _antiderivatives(np.clip(low, 0, 1))
    return np.asarray(grown / (high - low)[:, np.newaxis])


def from_steps(rising: bool) -> Doubles:
    """Return the square matrix that makes coefficients of steps.

    The first step is the lower end of the curve; if the others are at least 0, the coefficients never turn
    back, and so neither does the curve.

    Parameters
    ----------
    rising : bool
        Whether light grows from the rim down to the rest plane.
    """
    matrix = np.tril(np.ones((COEFFICIENTS, COEFFICIENTS)))
    return matrix if rising else matrix[::-1]


def roughness() -> Doubles:
    """Return the matrix of the coefficients' third differences, which are 0 for a parabola."""
    return np.diff(np.eye(COEFFICIENTS), 3, axis=0)


def _antiderivatives(share: Doubles) -> Doubles:
    """Return the antiderivative of each basis function, (n, COEFFICIENTS).

    That of a cubic spline of coefficients c is a spline of fourth degree, whose coefficients are the running
    sums of c_i (t[i+4] - t[i]) / 4 (de Boor, A Practical Guide to Splines, chapter X).
    """
    order = _CUBIC + 1
    widths = (_KNOTS[order:] - _KNOTS[:-order]) / order
    sums = np.vstack([np.zeros(COEFFICIENTS), np.tril(np.ones((COEFFICIENTS, COEFFICIENTS))) * widths])
    basis = BSpline.design_matrix(share, np.pad(_KNOTS, 1, "edge"), order)
    return np.asarray(basis @ sums)
