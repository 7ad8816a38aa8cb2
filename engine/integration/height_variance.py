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

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.hierarchy import Hierarchy, place_of_coarse
from mirrorskin.engine.integration.validation import Floats
from mirrorskin.kernels.array import Array
from mirrorskin.kernels.array_types import Doubles

Ints = NDArray[np.int64]

COARSE = 64
"""Largest number of nodes per side of the level whose variance is computed exactly."""
LEAST = 0.12
"""Lower bound of variances, relative to the inverse of the diagonal."""

JOINED = 3e-3
"""Strength from which links aggregate two nodes; weaker ones are nearly discontinuities."""

# Coefficients c of the local part on the finest level, and on coarser ones; see `local_part` for c0.
_FINEST = 0.0, 4.7682, -2.5894, -0.9665, -2.4153, 0.255
_COARSER = 0.0, -0.2621, -0.1186, -0.6233, 0.0, 0.0
_MODES = 64  # along each axis, for integrals over all modes of a plane
_ROWS = 64  # of modes that are transformed at once, and stay in a core's cache
_LOOSE = 1e-7  # regularisation of components without a known height, relative to their links
_BORDER = 0.12  # reduction of the misfit per loop, for each loop that a pixel lacks at the border


def find_graph_variance(
    hierarchy: Hierarchy, answered: NDArray[np.bool_], arrays: tuple[Array, Array, Array, Array, Array]
) -> None:
    """Write the heights' variance to the finest level of the first array; the others are scratch memory.

    ``answered``, (H, W), are the pixels that have heights.
    """
    h = hierarchy
    number = next(
        (k for k, level in enumerate(h.levels) if k > 0 and max(level.rows, level.columns) <= COARSE), 0
    )
    nodes, coarse = _find_coarse(h, number, _masses(h, number, answered))
    variance, evened, returns, part, prolonged = arrays
    known = np.zeros(variance.shape, np.float32)
    known[nodes] = coarse
    variance.write(known)
    links = {name: h.graph[name] for name in ("right", "down")}
    for fine in reversed(range(number)):
        level, places = h.levels[fine], place_of_coarse(h.levels[fine + 1])
        h.over("even", level, **h.graph, evened=evened)
        h.over("returns", level, **links, evened=evened, returns=returns)
        numbers = h.device.from_host("local", local_part(fine == 0))
        h.over("local", level, **links, evened=evened, returns=returns, c=numbers, local_part=part)
        h.over("inject", level, **places, e=variance, moved_nodes=h.moves[fine], to=h.to, t=prolonged)
        h.over("spread", level, **h.graph, inverse=h.inverse, t=prolonged, part=part, x=variance)


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
    share = max(0, length - 3) / max(1, length - 1)  # share of links with two more pixels in line
    return (
        (4 * np.sin(half) ** 2).astype(np.float32),
        (pairs + share * (fours - pairs)).astype(np.float32),
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


def expected_misfit(links: int, pixels: int, known: int, free: int, weights: tuple[float, float]) -> float:
    """Return the expected least-squares sum for noise of variance 1.

    ``known`` of the ``pixels`` have a known height, and ``free`` components have none.
    """
    (m_x, t_x), (m_y, t_y) = _plane(weights[0], 1), _plane(weights[1], 0)
    square = (2 * 13**2 + 2) / 24**2  # variance of the average along a link
    left = 2 * square - float(np.mean((m_x * t_x + m_y * t_y) / (m_x + m_y)))
    loops = max(0, links - pixels + free)
    return (loops + known) * (left - _BORDER * max(0.0, 1 - loops / pixels))


def _masses(hierarchy: Hierarchy, number: int, answered: NDArray[np.bool_]) -> Floats:
    """Return the number of pixels in each node of a level, (nodes,)."""
    mass, moved = np.zeros(hierarchy.nodes, np.float32), hierarchy.to.read()
    picture = answered.view(np.uint8).astype(np.float32)
    levels = zip(hierarchy.levels[:number], hierarchy.levels[1:], hierarchy.moves, strict=False)
    for fine, coarse, moves in levels:
        padded = np.zeros((2 * coarse.rows, 2 * coarse.columns), np.float32)
        padded[: fine.rows, : fine.columns] = picture
        picture = (padded[::2, ::2] + padded[1::2, ::2]) + (padded[::2, 1::2] + padded[1::2, 1::2])
        if moves:
            to = moved[fine.first : fine.end - fine.stride].reshape(fine.rows, fine.stride)
            row, column = np.nonzero(to)
            down, right = np.divmod(to[row, column].astype(np.int64) - 1, 3)
            share = padded[row, column]
            np.subtract.at(picture, (row // 2, column // 2), share)
            np.add.at(picture, (row // 2 + down - 1, column // 2 + right - 1), share)
    level = hierarchy.levels[number]
    inside = mass[level.first : level.end - level.stride].reshape(level.rows, level.stride)
    inside[:, : level.columns] = picture
    return mass


def _find_coarse(hierarchy: Hierarchy, number: int, mass: Floats) -> tuple[Ints, Doubles]:
    """Return a level's nodes, and the diagonal of the (pseudo)inverse of its matrix."""
    level = hierarchy.levels[number]
    node, a, b, weight, pull = hierarchy.equations(number)
    row, column = np.divmod(node - level.first, level.stride)
    used = np.zeros(hierarchy.nodes, bool)
    used[a] = used[b] = True
    chosen = used[node] | (pull > 0)
    node, pull = node[chosen], pull[chosen]
    line = (row if level.rows >= level.columns else column)[chosen]
    index = np.zeros(hierarchy.nodes, np.int64)
    index[node] = np.arange(len(node))
    a, b = index[a], index[b]
    count = len(node)
    label = _connected(count, a, b)
    diagonal = np.asarray(np.bincount(a, weight, count) + np.bincount(b, weight, count), np.float64)
    free = np.bincount(label, pull, count) <= 0
    pixels = np.maximum(mass[node], 1).astype(np.float64)
    total, typical = np.bincount(label, pixels, count), np.bincount(label, diagonal, count)
    extra = _LOOSE * typical / np.maximum(total, 1)
    diagonal += pull + (extra * free)[label] * pixels
    offset = np.where(free, 1 / np.where(extra > 0, extra * total, 1), 0)
    return node, _invert_diagonal(line, diagonal, a, b, weight) - offset[label]


def _invert_diagonal(line: Ints, diagonal: Doubles, a: Ints, b: Ints, weight: Doubles) -> Doubles:
    """Return the diagonal of the inverse of a block tridiagonal matrix: links within and between lines.

    A forward pass inverts each block given the previous ones; a backward pass adds the effect of later ones.
    """
    order = np.argsort(line, kind="stable")
    sizes = np.bincount(line, minlength=1)
    starts = np.cumsum(sizes) - sizes
    place = np.empty(len(line), np.int64)
    place[order] = np.arange(len(line)) - starts[line[order]]
    width = int(sizes.max(initial=1))
    block, link = (np.zeros((len(sizes), width, width)) for _ in range(2))
    block[:, np.arange(width), np.arange(width)] = 1
    block[line, place, place] = diagonal
    within = line[a] == line[b]
    for first, second in ((a, b), (b, a)):
        block[line[first[within]], place[first[within]], place[second[within]]] = -weight[within]
    first, second = (np.where(line[a] > line[b], *ends)[~within] for ends in ((a, b), (b, a)))
    link[line[first], place[first], place[second]] = weight[~within]
    product = np.empty_like(block)
    block[0] = np.linalg.inv(block[0])
    for k in range(1, len(sizes)):
        np.matmul(link[k], block[k - 1], out=product[k])
        block[k] = np.linalg.inv(block[k] - product[k] @ link[k].T)
    for k in range(len(sizes) - 1, 0, -1):
        block[k - 1] += product[k].T @ block[k] @ product[k]
    variance: Doubles = block[line, place, place]
    return variance


def _connected(count: int, a: Ints, b: Ints) -> Ints:
    """Return for each node the first node of its connected component; without the import of SciPy."""
    label = np.arange(count)
    while True:
        lower = np.minimum(label[a], label[b])
        merged = label.copy()
        np.minimum.at(merged, a, lower)
        np.minimum.at(merged, b, lower)
        merged = merged[merged]
        if np.array_equal(merged, label):
            return label
        label = merged
