"""The upper side of a triangle mesh: its height at each place of a grid, seen from above."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from mirrorskin.io.types import Floats

_Indices = NDArray[np.intp]

# By so much of a sample a triangle is widened, so that rounding leaves no gap between neighbours.
_MARGIN = 1e-9
# Samples (or rows of triangles) that are worked on at a time: bounds the memory.
_PART = 300_000


def top_surface(triangles: Floats, shape: tuple[int, int], pixel_size: tuple[float, float]) -> Floats:
    """Return the height of the highest triangle at each sample of a grid about the origin.

    Each triangle is cut along the grid's rows; a cut is a straight line between two edges, on which the
    height is linear. Where triangles overlap the highest counts (a depth buffer).

    Parameters
    ----------
    triangles : ndarray, (N, 3, 3), float64
        x, y and z of the corners, mm; both sides of a triangle can be seen.
    shape : (int, int)
        Rows and columns of the grid.
    pixel_size : (float, float)
        Millimetres between its samples along x and y; its centre is the origin.

    Returns
    -------
    ndarray, (H, W), float64
        Millimetres; row 0 is the upper edge; NaN where no triangle is.
    """
    rows, columns = shape
    x = triangles[..., 0] / pixel_size[0] + (columns - 1) / 2
    y = (rows - 1) / 2 - triangles[..., 1] / pixel_size[1]
    z = triangles[..., 2]
    top = np.full(rows * columns, -np.inf)
    low, high = y.min(axis=1), y.max(axis=1)
    first, count = _samples_between(low, high, rows)
    count[low == high] = 0  # only neighbours have area there
    for part in _parts(count):
        triangle, row = _expand(first[part], count[part])
        start, end = _cut(x[part][triangle], y[part][triangle], z[part][triangle], row)
        _fill(top.reshape(shape), row, start, end)
    top[np.isneginf(top)] = np.nan
    return top.reshape(shape)


def _cut(x: Floats, y: Floats, z: Floats, row: _Indices) -> tuple[Floats, Floats]:
    """Return the left and the right end, (x, z), of each triangle's cut along its row."""
    ends = np.full((2, 3, len(row)), np.nan)
    for edge, (a, b) in enumerate(((0, 1), (1, 2), (2, 0))):
        low, high = np.minimum(y[:, a], y[:, b]), np.maximum(y[:, a], y[:, b])
        crosses = (low < high) & (row >= low - _MARGIN) & (row <= high + _MARGIN)
        rise = np.where(crosses, y[:, b] - y[:, a], 1.0)
        share = np.where(crosses, np.clip((row - y[:, a]) / rise, 0.0, 1.0), np.nan)
        ends[0, edge] = x[:, a] + share * (x[:, b] - x[:, a])
        ends[1, edge] = z[:, a] + share * (z[:, b] - z[:, a])
    # At a corner three edges cross, anywhere else two.
    every = np.arange(len(row))
    left, right = np.nanargmin(ends[0], axis=0), np.nanargmax(ends[0], axis=0)
    return ends[:, left, every], ends[:, right, every]


def _fill(top: Floats, rows: _Indices, start: Floats, end: Floats) -> None:
    """Raise the samples between the ends of each cut to it."""
    first, count = _samples_between(start[0], end[0], top.shape[1])
    for part in _parts(count):
        cut, column = _expand(first[part], count[part])
        (x0, z0), (x1, z1) = start[:, part][:, cut], end[:, part][:, cut]
        length = np.where(x1 > x0, x1 - x0, 1.0)
        z = z0 + np.clip((column - x0) / length, 0.0, 1.0) * (z1 - z0)
        np.maximum.at(top, (rows[part][cut], column), z)


def _samples_between(start: Floats, end: Floats, samples: int) -> tuple[_Indices, _Indices]:
    """Return the first sample from start to end, and how many of them there are."""
    first = np.clip(np.ceil(start - _MARGIN), 0, samples).astype(np.intp)
    stop = np.clip(np.floor(end + _MARGIN) + 1, 0, samples).astype(np.intp)
    return first, np.maximum(stop - first, 0)


def _parts(count: _Indices) -> Iterator[slice]:
    """Divide counts into runs whose sums stay below a part, if single counts do."""
    sums = np.cumsum(count)
    start = 0
    while start < len(count):
        done = sums[start - 1] if start else 0
        stop = max(start + 1, int(np.searchsorted(sums, done + _PART, side="right")))
        yield slice(start, stop)
        start = stop


def _expand(first: _Indices, count: _Indices) -> tuple[_Indices, _Indices]:
    """Return for all members of all runs, end to end, the number of the run and the member."""
    run = np.repeat(np.arange(len(count)), count)
    return run, np.arange(len(run)) + (first - np.cumsum(count) + count)[run]
