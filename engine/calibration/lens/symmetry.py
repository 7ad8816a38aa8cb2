"""Where a picture is most symmetric: the middle of a dot, and the corner where four squares meet."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Doubles = NDArray[np.float64]

_BLUR = 1.0  # pixels
_STEPS = 20
_STILL = 1e-4  # pixels by which a place may move in the last step
_STEP = 0.25  # of the radius: the longest step
_WAY = 0.6  # of the radius: the longest way
_SPACING = 1.5  # pixels between samples,
_FEWEST, _MOST = 6, 24  # of which there are so many along a radius at least and at most
_UNLIKE = 0.3  # share of the picture's variance that may be asymmetric
_FAINT = 3.0  # counts, of a contrast of 255: the least standard deviation near a mark


def centre_marks(picture: NDArray[Any], starts: Doubles, radius: float) -> tuple[Doubles, NDArray[np.bool_]]:
    """Move places to where the picture around does not change when it is turned by half.

    A corner of a chessboard and a dot are such places, whatever symmetric blur there is, so this has no bias:
    I(q + d) = I(q - d). Solved for q by Gauss-Newton over the offsets d in a circle, weighed by
    (1 - d^2 / radius^2)^2, with the picture interpolated by cubic splines, after a slight blur: between the
    pixels of a sharp edge, splines swing.

    Parameters
    ----------
    picture : ndarray, (H, W)
        Of a contrast of about 255.
    starts : ndarray, (n, 2), float64
        Columns and rows.
    radius : float
        Pixels around a mark that are its own and symmetric.

    Returns
    -------
    places : ndarray, (n, 2), float64
    found : ndarray, (n,), bool
        Whether there is such a place near the start, all around it in the picture.
    """
    blurred = ndimage.gaussian_filter(np.asarray(picture, np.float64), _BLUR, mode="mirror")
    smooth = ndimage.spline_filter(blurred, order=3)
    offsets, weights = _circle(radius)
    places = np.array(starts, np.float64)
    step = np.full_like(places, np.inf)
    for _ in range(_STEPS):
        step = _step(smooth, places, offsets, weights, radius)
        places += step
        if np.abs(step).max(initial=0) < _STILL:
            break
    still = np.abs(step).max(axis=1) < 10 * _STILL
    near = np.hypot(*(places - starts).T) <= _WAY * radius
    inside = np.all((places >= radius) & (places <= np.array(picture.shape[::-1]) - 1 - radius), axis=1)
    return places, still & near & inside & _symmetric(smooth, places, offsets, weights)


def _circle(radius: float) -> tuple[Doubles, Doubles]:
    """Return offsets, (m, 2), in half a circle, and their weights; the other half is their mirror image."""
    count = min(max(math.ceil(radius / _SPACING), _FEWEST), _MOST)
    grid = np.arange(-count, count + 1) / count
    across, down = (one.ravel() for one in np.meshgrid(grid, grid))
    square = across**2 + down**2
    half = (square < 1) & ((down > 0) | ((down == 0) & (across > 0)))
    return np.stack([across, down], axis=1)[half] * radius, (1 - square[half]) ** 2


def _step(smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles, radius: float) -> Doubles:
    """Return the Gauss-Newton step of each place, at most so long."""
    ahead, behind = places[:, np.newaxis] + offsets, places[:, np.newaxis] - offsets
    unlike = _look(smooth, ahead) - _look(smooth, behind)
    slope = _slopes(smooth, ahead) - _slopes(smooth, behind)
    normal = np.einsum("m,nmi,nmj->nij", weights, slope, slope) + 1e-9 * np.eye(2)
    pull = np.einsum("m,nmi,nm->ni", weights, slope, unlike)
    step = -np.linalg.solve(normal, pull[..., np.newaxis])[..., 0]
    length = np.hypot(*step.T)[:, np.newaxis]
    return np.asarray(step * np.minimum(1, _STEP * radius / np.maximum(length, 1e-12)))


def _symmetric(smooth: Doubles, places: Doubles, offsets: Doubles, weights: Doubles) -> NDArray[np.bool_]:
    """Tell around which places there is something to see, and how it is the same turned by half."""
    one, other = (_look(smooth, places[:, np.newaxis] + way * offsets) for way in (1, -1))
    share = weights / weights.sum()
    even, odd = (one + other) / 2, (one - other) / 2
    signal = (even - (even @ share)[:, np.newaxis]) ** 2 @ share
    return np.asarray((signal > _FAINT**2) & (odd**2 @ share < _UNLIKE * signal))


def _look(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture at places, (..., 2)."""
    at = np.moveaxis(places, -1, 0)[::-1]
    return np.asarray(ndimage.map_coordinates(smooth, at, order=3, prefilter=False, mode="mirror"))


def _slopes(smooth: Doubles, places: Doubles) -> Doubles:
    """Return the picture's slopes along columns and rows, (..., 2), by differences over half a pixel."""
    ways = np.eye(2) / 4
    return np.stack(
        [2 * (_look(smooth, places + way) - _look(smooth, places - way)) for way in ways], axis=-1
    )
