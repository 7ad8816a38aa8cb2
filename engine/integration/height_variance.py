r"""The standard deviation of heights: the diagonal of an inverse, approximated from coarse to fine.

The covariance of weighted least-squares heights is the inverse of the normal equations' matrix, A^-1, reduced
by the averaging of the slopes' noise along links. On a plane the variance grows with the logarithm of the
distance: by ln 2 / (2 pi w) from a grid of links of weight w to one with half its spacing. It is computed

- exactly on the finest of the multigrid's levels that has at most `COARSE` nodes per side: the diagonal of
  the inverse of a block tridiagonal matrix, line by line (recursive Green's function). The weighted mean of
  a connected component without a known height is 0.
- on finer levels, from the prolonged variance of the next coarser level, plus a local part. With the weights
  w of a node's links, scaled so that both axes have the same mean, d the inverse of the sum of these and of
  the known height's weight, j the other ends of the links, r = d sum w^2 d_j the probability that a random
  walk returns after two steps, and o the anisotropy before scaling, it is ::

      d (c0 + c1 r + c2 d sum w r_j + c5 o) + d sum w d_j (c3 + c4 r_j).

  The coefficients c are fitted to exact covariances; c0 is determined by the exact result for a plane. On the
  finest level they include the averaging along links.

Levels for uneven weights also aggregate along links that a solver would not: weights usually differ between x
and y, which is no discontinuity.

On a full rectangle with uniform weights, cosine modes k, l are independent. With m = 4 sin^2(pi k / 2n)
along each axis, and t the response of the averaging along links ::

    var(row, column) = sum of (w_x m_x t_x^2 + w_y m_y t_y^2 + a) / (w_x m_x + w_y m_y + a)^2 (u_k v_l)^2,

where u and v are the modes of unit norm. The sum over (u_k v_l)^2 is a cosine transform again.

If weights are relative, the noise is estimated from the misfit, relative to that of noise of variance 1
(`expected_misfit`).

The ratio of exact variances to these, for pictures of 64 x 64 pixels, has a mean of 0.98 to 1.00. It is
within 1.0 +- 0.1 for all pixels of a rectangle, and for all but 1 % of a disc, 3 % of an annulus, 3 % around
cuts, and 2 % with known heights on one side. If a fifth of the pixels are missing at random, the mean is
0.92; 35 % differ by more than 0.1, and 4 % by more than 0.2. The documentation has the table, in "Heights
from slopes".
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mirrorskin.engine.integration.hierarchy import Hierarchy, place_of_coarse
from mirrorskin.engine.integration.validation import Floats
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.integration.links import KNOWN, SLOPE

COARSE = 64
"""Largest number of nodes per side of the level whose variance is computed exactly."""
LEAST = 0.12
"""Lower bound of variances, relative to the inverse of the diagonal."""

JOINED = 3e-3
"""Strength from which links aggregate two nodes; weaker ones are nearly discontinuities."""

# Coefficients c of the local part on the finest level, and on coarser ones; see `local_part` for c0.
_FINEST = 0.0, 4.7682, -2.5894, -0.9665, -2.4153, 0.255
_COARSER = 0.0, -0.2621, -0.1186, -0.6233, 0.0, 0.0
_MODES = 64  # number of modes along each axis in integrals over a plane
_ROWS = 64  # rows of modes that are transformed at once, so that they stay in the cache of a core
_BORDER = 0.12  # reduction of the misfit per loop, for each loop that a pixel lacks at the border


def find_graph_variance(
    hierarchy: Hierarchy, flags: Array, arrays: tuple[Array, Array, Array, Array, Array]
) -> None:
    """Write the heights' variance to the finest level of the first array; the others are scratch memory.

    ``flags``, (H, W), are the flags of the pixels; see ``mirrorskin.kernels.integration.links``.
    """
    h = hierarchy
    number = next(
        (k for k, level in enumerate(h.levels) if k > 0 and max(level.rows, level.columns) <= COARSE), 0
    )
    variance, evened, returns, prolonged, _ = arrays
    find_exact_variance(h, number, flags, *arrays)
    links = {name: h.graph[name] for name in ("right", "down")}
    for fine in reversed(range(number)):
        level, moves = h.levels[fine], {"moved_nodes": h.moves[fine], "to": h.to}
        walk: dict[str, Any] = {"evened": evened, "returns": returns, "t": prolonged}
        h.over("even", level, **h.graph, evened=evened)
        h.over("returns", level, **place_of_coarse(h.levels[fine + 1]), **links, **walk, **moves, e=variance)
        numbers = {f"c{k}": c for k, c in enumerate(local_part(fine == 0))}
        h.over("spread", level, **h.graph, inverse=h.inverse, **walk, **numbers, x=variance)


def local_part(finest: bool) -> Floats:
    """Return the coefficients of the local part; c0 makes it exact on a plane, where r = 1/4."""
    coefficients = np.array(_FINEST if finest else _COARSER)
    exact = math.log(2) / (2 * math.pi)
    if finest:
        (m_x, t_x), (m_y, t_y) = _plane(1.0, 1), _plane(1.0, 0)
        exact -= float(np.mean((m_x * (1 - t_x) + m_y * (1 - t_y)) / (m_x + m_y) ** 2))
    coefficients[0] = 4 * exact - coefficients[1:5] @ [1 / 4, 1 / 4, 1, 1 / 4]
    return coefficients.astype(np.float32)


def find_rectangle_variance(shape: tuple[int, int], weights: tuple[float, float], screening: float) -> Floats:
    """Return the heights' variance, (H, W), for uniform weights, with ``screening`` on the diagonal."""
    rows, columns = shape
    (m_y, t_y), (m_x, t_x) = _modes(rows), _modes(columns)
    w_x, w_y, a = (np.float32(number) for number in (*weights, screening))
    m_x, m_y = w_x * m_x, (w_y * m_y)[:, np.newaxis]
    power = m_x * t_x + m_y * t_y[:, np.newaxis] + a
    diagonal = m_x + m_y + a
    if not screening:
        diagonal[0, 0] = 1
    power /= diagonal * diagonal
    quarter = _sum_squares(_sum_squares(power).T).T
    half = np.concatenate([quarter, quarter[: rows // 2][::-1]])
    return np.concatenate([half, half[:, : columns // 2][:, ::-1]], axis=1)


def _modes(length: int) -> tuple[Floats, Floats]:
    """Return for each mode the squared responses m of differences, and t^2 of averages along links."""
    half = np.pi * np.arange(length) / (2 * length)
    pairs, fours = np.cos(half) ** 2, ((13 * np.cos(half) - np.cos(3 * half)) / 12) ** 2
    inner_fraction = max(0, length - 3) / max(1, length - 1)  # share of links with two more pixels in line
    return (
        (4 * np.sin(half) ** 2).astype(np.float32),
        (pairs + inner_fraction * (fours - pairs)).astype(np.float32),
    )


def _sum_squares(power: Floats) -> Floats:
    """Return sums over modes, (m, n), of their squares times their power, at the first half of n points."""
    count, length = power.shape
    half = (length + 1) // 2
    # The square of mode k is 1 plus mode 2 k, which equals minus mode 2 (length - k).
    turns = (np.exp(1j * np.pi / length * np.arange(1, half)) / 2).astype(np.complex64)
    sums = np.empty((count, half), np.float32)
    for start in range(0, count, _ROWS):
        rows = power[start : start + _ROWS]
        waves = np.zeros((len(rows), length // 2 + 1), np.complex64)
        waves[:, 0] = rows.sum(axis=1)
        waves[:, 1:half] = turns * (rows[:, 1:half] - rows[:, :-half:-1])
        sums[start : start + _ROWS] = np.fft.irfft(waves, length, axis=1)[:, :half]
    return sums


def _plane(weight: float, axis: int) -> tuple[Doubles, Doubles]:
    """Return the responses of `_modes` for an infinite plane with links of a weight, along an axis."""
    half = np.pi * (np.arange(_MODES) + 0.5) / (2 * _MODES)
    fours = ((13 * np.cos(half) - np.cos(3 * half)) / 12) ** 2
    return np.expand_dims(4 * weight * np.sin(half) ** 2, 1 - axis), np.expand_dims(fours, 1 - axis)


def expected_misfit(
    links: int, pixels: int, known_heights: int, free: int, weights: tuple[float, float]
) -> float:
    """Return the expected least-squares sum for noise of variance 1.

    ``known_heights`` of the ``pixels`` have a known height, and ``free`` components have none.
    """
    (m_x, t_x), (m_y, t_y) = _plane(weights[0], 1), _plane(weights[1], 0)
    square = (2 * 13**2 + 2) / 24**2  # variance of the average along a link
    residual = 2 * square - float(np.mean((m_x * t_x + m_y * t_y) / (m_x + m_y)))
    loops = max(0, links - pixels + free)
    return (loops + known_heights) * (residual - _BORDER * max(0.0, 1 - loops / pixels))


def find_exact_variance(
    hierarchy: Hierarchy,
    number: int,
    flags: Array,
    variance: Array,
    held: Array,
    swept_sum: Array,
    whole: Array,
    squares: Array,
) -> None:
    """Write the exact variance on a level of at most `COARSE` nodes per side; see ``multigrid_exact``."""
    h, level = hierarchy, hierarchy.levels[number]
    masses = h.array("masses", level.nodes + 2 * level.stride, dtype=np.int32)
    levels: dict[str, Any] = {"levels": h.table, "number": number, "changes": h.changes, "to": h.to}
    h.copy_picture("masses", masses, flags, flag=SLOPE | KNOWN, **levels)
    inverses = h.array("inverses", level.nodes * level.stride + 4 * COARSE)
    arrays: dict[str, Any] = {"masses": masses, "inverses": inverses, "variance": variance}
    arrays |= {"held": held, "swept_sum": swept_sum, "whole": whole, "squares": squares}
    h.alone("exact", level, **level.place, **h.graph, work=h.array("work", level.stride**2), **arrays)
