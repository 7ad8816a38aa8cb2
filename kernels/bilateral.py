"""Links that let go where the surface breaks: what ``bilateral.cl`` computes, in NumPy with float64 inside.

Along each axis a pixel has two links, and where the surface breaks it fits only one of them (bilateral
weights of BiNI, Cao et al., ECCV 2022). With s the pixel's slope along the axis, p the pixel size and a =
1 / sqrt(1 + s_x^2 + s_y^2) the z of its normal, ::

    r+ = a ((u_next - u) / p - s)        r- = a ((u - u_previous) / p - s)

are how badly its links fit, and heights u are sought that minimise ::

    E = sum over pixels and axes of c f  +  sum over known heights of h (u - known)^2
    f = -1/k ln((exp(-k r+^2) + exp(-k r-^2)) / 2)

or f = r^2 where a pixel has only one link along the axis; c and h are inverse variances. Shares exp(-k r+^2)
and exp(-k r-^2) over their sum, held while heights change, make of f the square share+ r+^2 + share- r-^2 and
a constant: it is nowhere below f and touches it, so that heights that lower it lower E. That is least squares
on the pixels' graph: a link from i to j has the weight (share+_i c_i a_i^2 + share-_j c_j a_j^2) / p^2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Flags = NDArray[np.uint8]

RIGHT, DOWN = 1, 2
"""Flags of a pixel: there is a link to the one on the right, to the one below."""
SHARE = 1e-6
"""A share below this is 0. Pieces of surface then come apart instead of hanging by links of no strength: such
equations are hard to solve, for an offset that means nothing. By it a link costs 1e-6 / k at most."""


def bilateral_curl(flags: Flags, slope_x: Floats, slope_y: Floats, width: float, height: float) -> Doubles:
    """Return by how much four links about a corner of pixels fail to close, in slopes.

    It is that of the corner right and below of each pixel; 0 where a link is missing. Slopes are to the right
    and *down* the picture; width and height are a pixel's, in units of their geometric mean.
    """
    curl = np.zeros(flags.shape)
    across = (slope_x[:, 1:].astype(np.float64) + slope_x[:, :-1]) / 2
    along = (slope_y[1:].astype(np.float64) + slope_y[:-1]) / 2
    right, down = flags[:, :-1] & RIGHT != 0, flags[:-1] & DOWN != 0
    closed = right[:-1] & right[1:] & down[:, 1:] & down[:, :-1]
    loop = width * (across[:-1] - across[1:]) + height * (along[:, 1:] - along[:, :-1])
    curl[:-1, :-1] = np.where(closed, loop, 0.0)
    return curl


def bilateral_shares(flags: Flags, slope_x: Floats, slope_y: Floats, steep: Floats, confidence_x: Floats,
                     confidence_y: Floats, anchor: Floats, known: Floats, heights: Floats, k: float,
                     width: float, height: float) -> tuple[Doubles, Doubles, float]:  # fmt: skip
    """Return the shares of the links to the right and down in what their pixels require, and the energy.

    Links to the left and up have what is missing to 1. ``steep`` is a^2, ``confidence_x`` and
    ``confidence_y`` are c, ``anchor`` is h, 0 where no height is known, and ``heights`` are u, finite
    everywhere; a ``k`` of 0 gives equal shares, plain least squares. The kernel writes an energy for each
    of its items, and may have no known heights.
    """
    u = heights.astype(np.float64)
    share_x, cost_x = _share(flags & RIGHT != 0, slope_x, steep, u, k, width)
    share_y, cost_y = _share((flags & DOWN != 0).T, slope_y.T, steep.T, u.T, k, height)
    energy = (
        np.sum(confidence_x * cost_x) + np.sum(confidence_y * cost_y.T) + np.sum(anchor * (u - known) ** 2)
    )
    return share_x, share_y.T, float(energy)


def _share(
    linked: NDArray[np.bool_], slope: Floats, steep: Floats, u: Doubles, k: float, size: float
) -> tuple[Doubles, Doubles]:
    after, before = linked, np.roll(linked, 1, axis=1)
    r_after = np.where(after, steep * ((np.roll(u, -1, axis=1) - u) / size - slope) ** 2, 0.0)
    r_before = np.where(before, steep * ((u - np.roll(u, 1, axis=1)) / size - slope) ** 2, 0.0)
    small = np.exp(-k * np.abs(r_after - r_before))
    minor = np.where(small / (1 + small) < SHARE, 0.0, small / (1 + small))
    share = np.where(r_after > r_before, minor, 1 - minor)
    both = after & before
    lone = r_after + r_before
    soft = np.minimum(r_after, r_before) + (np.log(2) - np.log1p(small)) / k if k else lone / 2
    return np.where(both, share, ~before), np.where(both, soft, lone)


def bilateral_links(flags: Flags, slope_x: Floats, slope_y: Floats, steep: Floats, confidence_x: Floats,
                    confidence_y: Floats, share_x: Array, share_y: Array, heights: Floats, width: float,
                    height: float) -> tuple[Doubles, Doubles, Doubles, Doubles]:  # fmt: skip
    """Return weights of the links to the right and down, by their shares, and how hard these pull.

    Weights are in units of one over a pixel's area, 0 without a link; a pull is the weight times what the
    difference of the two heights is too large by.
    """
    u = heights.astype(np.float64)
    right, pull_x = _link(flags & RIGHT != 0, slope_x, steep * confidence_x, share_x, u, width)
    down, pull_y = _link((flags & DOWN != 0).T, slope_y.T, (steep * confidence_y).T, share_y.T, u.T, height)
    return height / width * right, width / height * down.T, height * pull_x, width * pull_y.T


def _link(
    linked: NDArray[np.bool_], slope: Floats, weight: Floats, share: Array, u: Doubles, size: float
) -> tuple[Doubles, Doubles]:
    here, there = weight * share, np.roll(weight * (1 - share), -1, axis=1)
    rise = (np.roll(u, -1, axis=1) - u) / size
    pull = here * (rise - slope) + there * (rise - np.roll(slope, -1, axis=1))
    return np.where(linked, here + there, 0.0), np.where(linked, pull, 0.0)


def bilateral_open(
    curl: Floats, level: float, right: Doubles, down: Doubles, pull_x: Doubles, pull_y: Doubles
) -> tuple[Doubles, Doubles, Doubles, Doubles]:
    """Return weights and pulls of links that give way where the curl on one of their sides is high.

    A curl of ``level`` takes three quarters of a weight. The kernel changes the four in place.
    """
    kept = 1 / (1 + (curl.astype(np.float64) / level) ** 2) ** 2
    above, before = np.ones(curl.shape), np.ones(curl.shape)
    above[1:], before[:, 1:] = kept[:-1], kept[:, :-1]
    x, y = np.minimum(kept, above), np.minimum(kept, before)
    return x * right, y * down, x * pull_x, y * pull_y


def bilateral_residual(
    pull_x: Doubles, pull_y: Doubles, anchor: Floats, known: Floats, heights: Floats
) -> Doubles:
    """Return the residual of the equations, b - A u, with the anchors in the unit of the links' weights."""
    residual = pull_x - np.roll(pull_x, 1, axis=1) + pull_y - np.roll(pull_y, 1, axis=0)
    return np.asarray(residual + anchor * (known - heights.astype(np.float64)))


def bilateral_step(heights: Floats, step: Floats, part: float) -> Doubles:
    """Return heights that went a part of a step on."""
    return heights.astype(np.float64) + part * step
