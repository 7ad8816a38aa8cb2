"""The pixels' graph from slopes: ``links.cl`` in plain NumPy with float64.

The heights u minimise, over the links from pixel i to its neighbour j on the right or below, ::

    sum of w (u_j - u_i - d)^2  +  sum of a (u_i - k_i)^2

with d = pixel size x slope of the link, k the known heights. The normal equations are A u = b; b is summed
per link, so its sum is 0 on every connected component without a known height.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Array = NDArray[Any]
Mask = NDArray[np.bool_]
Flags = NDArray[np.uint8]
Triple = tuple[float, float, float]

RIGHT, DOWN = 1, 2
"""Flags of a pixel: it is linked to the right, or down."""
SLOPE, KNOWN = 4, 8
"""Its slopes are valid; its height is known."""
LOST = 16
"""It was requested, but its slopes are NaN."""


def links_flags(dz_dx: Array, dz_dy: Array, mask: Array | None, weight_x: Array | None,
                weight_y: Array | None, heights: Array | None,
                height_weights: Array | None) -> Flags:  # fmt: skip
    """Return flags of the pixels, including their links, (H, W), a sum of the flags above.

    Neighbours are linked if both slopes along the link are valid. Invalid slopes and unknown heights are not
    finite; invalid weights and masked pixels are 0. All but the slopes may be None: without ``weight_x``
    weights are uniform, without ``weight_y`` it equals ``weight_x``.
    """
    selected = np.ones(dz_dx.shape, bool) if mask is None else mask != 0
    along_x = selected if weight_x is None else selected & (weight_x > 0)
    along_y = along_x if weight_y is None else selected & (weight_y > 0)
    finite = np.isfinite(dz_dx) & np.isfinite(dz_dy)
    flags = np.where((along_x | along_y) & finite, SLOPE, 0) | np.where(
        (along_x | along_y) & ~finite, LOST, 0
    )
    if heights is not None:
        with_height = selected & np.isfinite(heights)
        flags |= np.where(
            with_height if height_weights is None else with_height & (height_weights > 0), KNOWN, 0
        )
    right, down = np.zeros_like(finite), np.zeros_like(finite)
    right[:, :-1] = (along_x & finite)[:, :-1] & (along_x & finite)[:, 1:]
    down[:-1] = (along_y & finite)[:-1] & (along_y & finite)[1:]
    return np.asarray(flags + RIGHT * right + DOWN * down, np.uint8)


def links_cut(dz_dx: Array, dz_dy: Array, edges: Array, flags: Flags) -> Flags:
    """Return the flags without the links across edges.

    A pixel on an edge keeps one link, to the neighbour off the edge with the most similar slopes. If several
    are equal, the order is right, left, below, above.
    """
    kept, marked = flags.copy(), edges != 0
    for row, column in np.argwhere(marked):
        best = _most_alike(dz_dx, dz_dy, marked, flags, row, column)
        for (neighbour, below), (owner, bit) in _links_of(row, column, flags.shape).items():
            if (neighbour, below) != best:
                kept[owner] &= ~np.uint8(bit)
    return kept


def _links_of(
    row: int, column: int, shape: tuple[int, ...]
) -> dict[tuple[int, int], tuple[tuple[int, int], int]]:
    """Return the four neighbours in the picture, with the pixel and flag of the link."""
    links = {
        (row, column + 1): ((row, column), RIGHT),
        (row, column - 1): ((row, column - 1), RIGHT),
        (row + 1, column): ((row, column), DOWN),
        (row - 1, column): ((row - 1, column), DOWN),
    }
    return {
        neighbour: link
        for neighbour, link in links.items()
        if 0 <= neighbour[0] < shape[0] and 0 <= neighbour[1] < shape[1]
    }


def _most_alike(
    dz_dx: Array, dz_dy: Array, marked: Mask, flags: Flags, row: int, column: int
) -> tuple[int, int] | None:
    """Return the linked neighbour off the edge with the most similar slopes."""
    best, smallest = None, np.inf
    for neighbour, (owner, bit) in _links_of(row, column, flags.shape).items():
        far = math.hypot(*(float(s[neighbour]) - float(s[row, column]) for s in (dz_dx, dz_dy)))
        if flags[owner] & bit and not marked[neighbour] and far < smallest:
            best, smallest = neighbour, far
    return best


def links_join(dz_dx: Array, dz_dy: Array, flags: Flags, weight_x: Array | None, weight_y: Array | None,
               heights: Array | None, height_weights: Array | None, weights: Triple,
               size: tuple[float, float], plane: Triple, *,
               owned: bool = False) -> tuple[Doubles, Doubles, Doubles, Doubles]:  # fmt: skip
    """Return right, down, anchor and source of `mirrorskin.engine.integration.graph.Links`, (H, W) each.

    The slope of a link is (-s[-1] + 13 s[0] + 13 s[1] - s[2]) / 24 of four pixels in line if links connect
    all of them, otherwise the mean of two; its weight is the harmonic mean of two pixels' weights.

    Parameters
    ----------
    dz_dx, dz_dy, flags, heights, height_weights
        See ``links_flags``.
    weight_x, weight_y : ndarray, (H, W), float32, or None
        See ``links_flags``; if ``owned``, weights of the links to the right and down.
    weights : (float, float, float)
        Factors of the weights of links to the right and down, and of known heights.
    size : (float, float)
        Width and height of a pixel, mm.
    plane : (float, float, float)
        Reference plane of the relief: slopes along x and y, and height in the top left pixel.
    owned : bool
        Whether ``weight_x`` and ``weight_y`` are weights of links, not of pixels.
    """
    (right, across), (down, along) = _steps(
        dz_dx, dz_dy, flags, weight_x, weight_y, weights, size, plane, owned
    )
    source = np.zeros(flags.shape)
    source -= right * across + down * along
    source[:, 1:] += (right * across)[:, :-1]
    source[1:] += (down * along)[:-1]
    anchor, above = _anchors(flags, heights, height_weights, weights, size, plane)
    return right, down, anchor, source + anchor * above


def links_misfit(dz_dx: Array, dz_dy: Array, flags: Flags, weight_x: Array | None, weight_y: Array | None,
                 heights: Array | None, height_weights: Array | None, weights: Triple,
                 size: tuple[float, float], plane: Triple, relief: Array, *,
                 owned: bool = False) -> float:  # fmt: skip
    """Return the sum that the heights minimise, for ``relief``, (H, W), the heights above the plane.

    For the other parameters see ``links_join``. The kernel returns a sum for each of its items.
    """
    (right, across), (down, along) = _steps(
        dz_dx, dz_dy, flags, weight_x, weight_y, weights, size, plane, owned
    )
    anchor, above = _anchors(flags, heights, height_weights, weights, size, plane)
    u = relief.astype(np.float64)
    sums = [
        np.sum((right * (np.roll(u, -1, axis=1) - u - across) ** 2)[flags & RIGHT != 0]),
        np.sum((down * (np.roll(u, -1, axis=0) - u - along) ** 2)[flags & DOWN != 0]),
        np.sum((anchor * (u - above) ** 2)[flags & KNOWN != 0]),
    ]
    return float(sum(sums))


def _steps(dz_dx: Array, dz_dy: Array, flags: Flags, weight_x: Array | None, weight_y: Array | None,
           weights: Triple, size: tuple[float, float], plane: Triple,
           owned: bool) -> tuple[tuple[Doubles, Doubles], tuple[Doubles, Doubles]]:  # fmt: skip
    """Return the weight of each link and its rise; to the right, and down."""
    map_x = np.ones(flags.shape) if weight_x is None else weight_x.astype(np.float64)
    map_y = map_x if weight_y is None else weight_y.astype(np.float64)
    right, down = flags & RIGHT != 0, flags & DOWN != 0
    across, along = link_slopes(dz_dx, right), link_slopes(dz_dy.T, down.T).T
    wx, wy = (map_x, map_y) if owned else (_harmonic(map_x), _harmonic(map_y.T).T)
    return (
        (np.where(right, weights[0] * wx, 0.0), np.where(right, size[0] * (across - plane[0]), 0.0)),
        (np.where(down, weights[1] * wy, 0.0), np.where(down, -size[1] * (along - plane[1]), 0.0)),
    )


def link_slopes(slope: Array, linked: Mask) -> Doubles:
    """Return the slopes of the links to the next column: from four pixels in line, at the ends from two."""
    ends = linked | np.roll(linked, 1, axis=1)
    slopes, of_links = np.where(ends, slope, 0.0).astype(np.float64), np.zeros(slope.shape)
    of_links[:, :-1] = (slopes[:, :-1] + slopes[:, 1:]) / 2
    four = linked[:, :-3] & linked[:, 1:-2] & linked[:, 2:-1]
    wide = (13 * (slopes[:, 1:-2] + slopes[:, 2:-1]) - slopes[:, :-3] - slopes[:, 3:]) / 24
    of_links[:, 1:-2] = np.where(four, wide, of_links[:, 1:-2])
    return of_links


def _harmonic(weight: Doubles) -> Doubles:
    """Return the harmonic mean of the weights of each pixel and the next in its row; 0 where one is 0."""
    joined, near, far = np.zeros(weight.shape), weight[:, :-1], weight[:, 1:]
    both = (near > 0) & (far > 0)
    joined[:, :-1][both] = 2 / (1 / near[both] + 1 / far[both])
    return joined


def _anchors(flags: Flags, heights: Array | None, height_weights: Array | None, weights: Triple,
             size: tuple[float, float], plane: Triple) -> tuple[Doubles, Doubles]:  # fmt: skip
    """Return the weight of each known height, and its height above the plane."""
    is_known = flags & KNOWN != 0
    row, column = np.indices(flags.shape)
    level = plane[2] + plane[0] * size[0] * column - plane[1] * size[1] * row
    weight = np.ones(flags.shape) if height_weights is None else height_weights
    height = np.zeros(flags.shape) if heights is None else heights
    return np.where(is_known, weights[2] * weight, 0.0), np.where(is_known, height - level, 0.0)
