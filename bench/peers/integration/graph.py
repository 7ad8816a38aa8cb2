"""The graph of the pixels from slopes, in plain arrays: links of weight 1 between square pixels."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]  # float32, or float64 where an exact answer is wanted
Mask = NDArray[np.bool_]
Flags = NDArray[np.uint8]

_AROUND = ((0, 1), (0, -1), (1, 0), (-1, 0))  # right, left, below and above


class Graph(NamedTuple):
    """Heights u with u_j - u_i = d on every link, as nearly as may be.

    `right`, (H, W - 1), and `down`, (H - 1, W), are the links; `source`, (H, W), is of each pixel the sum of
    d over links that end in it, less that over links that begin there, in float64.
    """

    right: Mask
    down: Mask
    source: Floats


def link(slopes: Floats, size: float, mask: Flags | None = None, edges: Flags | None = None) -> Graph:
    """Return the graph of the slopes.

    Parameters
    ----------
    slopes : ndarray, (2, H, W)
        Slopes dz/dx and dz/dy; y runs up the picture.
    size : float
        Of a pixel.
    mask, edges : ndarray, (H, W), uint8, optional
        Not 0 where heights are wanted, and on depth discontinuities.
    """
    known = np.isfinite(slopes[0]) & np.isfinite(slopes[1])
    if mask is not None:
        known &= mask != 0
    right, down = known[:, :-1] & known[:, 1:], known[:-1] & known[1:]
    if edges is not None:
        _cut(right, down, known, edges != 0, slopes)
    source = np.zeros(known.shape)  # sums to 0, as nothing in single precision would
    across, up = _rises(slopes[0], right, size), _rises(slopes[1].T, down.T, size).T
    source[:, :-1] -= across
    source[:, 1:] += across
    source[:-1] += up
    source[1:] -= up
    return Graph(right, down, source)


def _cut(right: Mask, down: Mask, known: Mask, edges: Mask, slopes: Floats) -> None:
    """Leave each pixel on an edge only its link to the neighbour that is the most alike and on none."""
    right &= ~(edges[:, :-1] | edges[:, 1:])
    down &= ~(edges[:-1] | edges[1:])
    free, values = np.pad(known & ~edges, 1), np.pad(slopes, ((0, 0), (1, 1), (1, 1)))
    row, column = np.nonzero(known & edges)
    here = values[:, row + 1, column + 1].astype(np.float64)
    unlike = np.empty((4, len(row)))
    for far, (below, beside) in zip(unlike, _AROUND, strict=True):
        there = np.s_[row + 1 + below, column + 1 + beside]
        far[:] = np.where(free[there], np.sum(np.square(values[:, *there] - here), axis=0), np.inf)
    nearest = np.where(np.isfinite(unlike).any(axis=0), unlike.argmin(axis=0), -1)
    for number, links, before in (
        (0, right, (0, 0)),
        (1, right, (0, 1)),
        (2, down, (0, 0)),
        (3, down, (1, 0)),
    ):
        chosen = nearest == number
        links[row[chosen] - before[0], column[chosen] - before[1]] = True


def _rises(slope: Floats, linked: Mask, size: float) -> Floats:
    """Return the rise that is asked for along each link to the next column; 0 where there is none."""
    half, inner, outer = (slope.dtype.type(share * size) for share in (1 / 2, 13 / 24, 1 / 24))
    rises: Floats = half * (slope[:, :-1] + slope[:, 1:])
    wide = inner * (slope[:, 1:-2] + slope[:, 2:-1]) - outer * (slope[:, :-3] + slope[:, 3:])
    four = linked[:, :-2] & linked[:, 1:-1] & linked[:, 2:]
    np.copyto(rises[:, 1:-1], wide, where=four)
    rises[~linked] = 0
    return rises
