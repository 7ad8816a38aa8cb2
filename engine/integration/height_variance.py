r"""The standard deviation of heights: the diagonal of an inverse, from coarse to fine, in closed form.

Heights of least squares whose weights are inverse variances have the covariance of the normal equations'
inverse, A^-1, but for what the averages along links take out of the slopes' noise. On a plane the variance
grows with the logarithm of the distance, by ln 2 / (2 pi w) from a grid of links of weight w to one with half
its spacing. So it is found

- on the first of the multigrid's levels that has at most `COARSE` nodes a side, exactly: the diagonal of the
  inverse of a block tridiagonal matrix, line by line (the recursive Green's function). What hangs together
  without a known height has its mean weight 0.
- from there on down, level by level, as what coarse nodes have, prolonged, and a local part. With w the
  weights of a node's links, scaled so that those along x weigh as much on average as those along y, d one
  over their sum and that of a known height, j the links' other ends, r = d sum w^2 d_j the probability that a
  walk along links is back after two steps, and o how uneven the axes were, that is ::

      d (c0 + c1 r + c2 d sum w r_j + c5 o) + d sum w d_j (c3 + c4 r_j).

  The numbers c are fitted to exact covariances; c0 is such that a plane has what it must. On the finest level
  they hold what the averages along links take out.

Levels for uneven weights join links that are too weak for a solver's: weights differ along x and y as a rule,
and that breaks no surface.

A full rectangle with even weights has cosine modes k, l that know nothing of each other: with m = 4 sin^2(pi
k / 2n) along each axis, and t the average of a link's slope as it acts on a mode ::

    var(row, column) = sum of (w_x m_x t_x^2 + w_y m_y t_y^2 + a) / (w_x m_x + w_y m_y + a)^2 (u_k v_l)^2,

u and v the modes of unit norm; of (u_k v_l)^2 the sum is a cosine transform again.

Where weights are relative, all slopes are as noisy as they fit worse than noise of variance 1 would: that
leaves a share of each loop of links (`expected_misfit`).

Exact variances over these, of pictures of 64 x 64 pixels, are 0.98 to 1.00 in the mean, and within 1.0 +- 0.1
for all of a rectangle's pixels, and all but 1 % of a disc's, 3 % of an annulus', 3 % around cuts, 2 % where
heights are known on one side. Where a fifth of the pixels are missing at random, the mean is 0.92, 35 % are
off by more than a tenth and 4 % by more than a fifth. The documentation has the table, in "Heights from
slopes".
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.hierarchy import Hierarchy, place_of_coarse
from mirrorskin.engine.integration.validation import Floats
from mirrorskin.kernels.array import Array

Ints = NDArray[np.int64]
Doubles = NDArray[np.float64]
Rooms = tuple[Array, Array, Array, Array, Array]

COARSE = 64
"""Nodes along a side of the level whose variance is found exactly, at most."""
LEAST = 0.12
"""Of one over the diagonal, which no variance is below."""

JOINED = 3e-3
"""Strength of links that make one coarse node of two: below, a surface is nearly broken."""

# The six numbers of the local part on the finest level, and on the others; c0 is such that on a plane, where
# r is 1/4, it is as it must be.
_FINEST = 0.0, 4.7682, -2.5894, -0.9665, -2.4153, 0.255
_COARSER = 0.0, -0.2621, -0.1186, -0.6233, 0.0, 0.0
_MODES = 64  # along each axis of the sums over all modes of a plane
_LOOSE = 1e-7  # of a node's links, which holds what has no known height
_BORDER = 0.12  # less of a loop is left for each that pixels have not, at the ends of the surface


def find_graph_variance(hierarchy: Hierarchy, answered: NDArray[np.bool_], rooms: Rooms) -> None:
    """Write the heights' variance to the finest level of the first of ``rooms``; the others are scratch.

    ``answered``, (H, W), are the pixels that have heights.
    """
    number = min(
        (k for k, one in enumerate(hierarchy.levels) if k > 0 and max(one.rows, one.columns) <= COARSE),
        default=0,
    )
    nodes, variance = _find_coarse(hierarchy, number, _masses(hierarchy, number, answered))
    _spread(hierarchy, nodes, variance, number, rooms)


def _spread(hierarchy: Hierarchy, nodes: Ints, coarse: Doubles, number: int, rooms: Rooms) -> None:
    """Bring the variance of a level's nodes to the finest, with what each level adds."""
    h = hierarchy
    variance, evened, returns, part, brought = rooms
    variance.claim()
    variance.host[...] = 0
    variance.host[nodes] = coarse
    variance.upload()
    links = {name: h.graph[name] for name in ("right", "down")}
    for fine in reversed(range(number)):
        level, places = h.levels[fine], place_of_coarse(h.levels[fine + 1])
        h.over("even", level, **h.graph, evened=evened)
        h.over("returns", level, **links, evened=evened, returns=returns)
        numbers = h.device.given("local", local_part(fine == 0))
        h.over("local", level, **links, evened=evened, returns=returns, c=numbers, local_part=part)
        h.over("inject", level, **places, e=variance, moved_nodes=h.moves[fine], to=h.to, t=brought)
        h.over("spread", level, **h.graph, inverse=h.inverse, t=brought, part=part, x=variance)


def local_part(finest: bool) -> Floats:
    """Return the six numbers of the local part."""
    numbers = np.array(_FINEST if finest else _COARSER)
    wanted = math.log(2) / (2 * math.pi)
    if finest:
        (m_x, t_x), (m_y, t_y) = _plane(1.0, 1), _plane(1.0, 0)
        wanted -= float(np.mean((m_x * (1 - t_x) + m_y * (1 - t_y)) / (m_x + m_y) ** 2))
    numbers[0] = 4 * wanted - numbers[1:5] @ [1 / 4, 1 / 4, 1, 1 / 4]
    return numbers.astype(np.float32)


def find_rectangle_variance(shape: tuple[int, int], weights: tuple[float, float], screening: float) -> Floats:
    """Return the heights' variance, (H, W), where all pixels and links are alike."""
    rows, columns = shape
    (m_y, t_y), (m_x, t_x) = _modes(rows), _modes(columns)
    across, along = (np.float32(one) for one in weights)
    held = np.float32(screening)
    m_x, m_y = across * m_x, (along * m_y)[:, np.newaxis]
    power = m_x * t_x + m_y * t_y[:, np.newaxis] + held
    diagonal = m_x + m_y + held
    if not screening:
        diagonal[0, 0] = 1
    power /= diagonal * diagonal
    quarter = _sum_squares(_sum_squares(power).T).T
    half = np.concatenate([quarter, quarter[: rows // 2][::-1]])
    return np.concatenate([half, half[:, : columns // 2][:, ::-1]], axis=1)


def _modes(length: int) -> tuple[Floats, Floats]:
    """Return what differences make of the squares of modes, and averages along links of those of noise."""
    half = np.pi * np.arange(length) / (2 * length)
    pairs, fours = np.cos(half) ** 2, ((13 * np.cos(half) - np.cos(3 * half)) / 12) ** 2
    share = max(0, length - 3) / max(1, length - 1)  # of links with two more pixels in line
    return (
        (4 * np.sin(half) ** 2).astype(np.float32),
        (pairs + share * (fours - pairs)).astype(np.float32),
    )


def _sum_squares(power: Floats) -> Floats:
    """Return sums of the squares of cosine modes times their power, (n, m), in the first half of n points."""
    length = len(power)
    half = (length + 1) // 2
    waves = np.zeros((length // 2 + 1, power.shape[1]), np.complex64)
    waves[0] = power.sum(axis=0)
    # The square of mode k is 1 and mode 2 k, which is less mode 2 (length - k).
    turns = np.exp(1j * np.pi / length * np.arange(1, half)).astype(np.complex64) / 2
    waves[1:half] = turns[:, np.newaxis] * (power[1:half] - power[:-half:-1])
    return np.asarray(np.fft.irfft(waves, length, axis=0)[:half], np.float32)


def _plane(weight: float, axis: int) -> tuple[Doubles, Doubles]:
    """Return what `_modes` does for a plane with links of a weight, along an axis."""
    half = np.pi * (np.arange(_MODES) + 0.5) / (2 * _MODES)
    fours = ((13 * np.cos(half) - np.cos(3 * half)) / 12) ** 2
    return np.expand_dims(4 * weight * np.sin(half) ** 2, 1 - axis), np.expand_dims(fours, 1 - axis)


def expected_misfit(links: int, pixels: int, known: int, free: int, weights: tuple[float, float]) -> float:
    """Return the sum that heights make least, as it is on average for noise of variance 1.

    Of ``pixels`` some are ``known``, and ``free`` components have none that is.
    """
    (m_x, t_x), (m_y, t_y) = _plane(weights[0], 1), _plane(weights[1], 0)
    square = (2 * 13**2 + 2) / 24**2  # of the average along a link
    left = 2 * square - float(np.mean((m_x * t_x + m_y * t_y) / (m_x + m_y)))
    loops = max(0, links - pixels + free)
    return (loops + known) * (left - _BORDER * max(0.0, 1 - loops / pixels))


def _masses(hierarchy: Hierarchy, number: int, answered: NDArray[np.bool_]) -> Floats:
    """Return how many pixels each node of a level stands for, by node."""
    mass, moved = np.zeros(hierarchy.nodes, np.float32), hierarchy.to.download()
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
    hierarchy.to.upload()
    level = hierarchy.levels[number]
    inside = mass[level.first : level.end - level.stride].reshape(level.rows, level.stride)
    inside[:, : level.columns] = picture
    return mass


def _find_coarse(hierarchy: Hierarchy, number: int, mass: Floats) -> tuple[Ints, Doubles]:
    """Return a level's nodes, and the diagonal of the inverse of its matrix."""
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
    parts, label = count, first_connected(count, a, b)
    diagonal = _add_up(a, weight, count) + _add_up(b, weight, count)
    free = np.bincount(label, pull, parts) <= 0
    share = np.maximum(mass[node], 1).astype(np.float64)
    whole, typical = np.bincount(label, share, parts), np.bincount(label, diagonal, parts)
    held = _LOOSE * typical / np.maximum(whole, 1)
    diagonal += pull + (held * free)[label] * share
    offset = np.where(free, 1 / np.where(held > 0, held * whole, 1), 0)
    return node, invert_diagonal(line, diagonal, a, b, weight) - offset[label]


def _add_up(at: Ints, values: Doubles, count: int) -> Doubles:
    return np.asarray(np.bincount(at, values, count), np.float64)


def invert_diagonal(line: Ints, diagonal: Doubles, a: Ints, b: Ints, weight: Doubles) -> Doubles:
    """Return the diagonal of the inverse of a matrix whose nodes have links within and between lines.

    The inverses of all lines so far make that of the next one; on the way back the rest is added.
    """
    order = np.argsort(line, kind="stable")
    sizes = np.bincount(line, minlength=1)
    begins = np.cumsum(sizes) - sizes
    place = np.empty(len(line), np.int64)
    place[order] = np.arange(len(line)) - begins[line[order]]
    most = int(sizes.max(initial=1))
    own, link = (np.zeros((len(sizes), most, most)) for _ in range(2))
    own[:, np.arange(most), np.arange(most)] = 1
    own[line, place, place] = diagonal
    within = line[a] == line[b]
    for first, second in ((a, b), (b, a)):
        own[line[first[within]], place[first[within]], place[second[within]]] = -weight[within]
    first, second = (np.where(line[a] > line[b], *ends)[~within] for ends in ((a, b), (b, a)))
    link[line[first], place[first], place[second]] = weight[~within]
    moved = np.empty_like(own)
    own[0] = np.linalg.inv(own[0])
    for k in range(1, len(sizes)):
        np.matmul(link[k], own[k - 1], out=moved[k])
        own[k] = np.linalg.inv(own[k] - moved[k] @ link[k].T)
    for k in range(len(sizes) - 1, 0, -1):
        own[k - 1] += moved[k].T @ own[k] @ moved[k]
    found: Doubles = own[line, place, place]
    return found


def first_connected(count: int, a: Ints, b: Ints) -> Ints:
    """Return of each node the first that it is connected with; quickly where chains of links are short."""
    label = np.arange(count)
    while True:
        lower = np.minimum(label[a], label[b])
        found = label.copy()
        np.minimum.at(found, a, lower)
        np.minimum.at(found, b, lower)
        found = found[found]
        if np.array_equal(found, label):
            return label
        label = found
