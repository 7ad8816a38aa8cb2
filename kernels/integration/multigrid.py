r"""Heights on a graph of pixels: ``multigrid.cl`` in plain NumPy with float64.

The heights x of a graph minimise sum w (x_j - x_i - d)^2 over its links and sum a (x_i - k)^2 over known
heights k: A x = b with A = D - W, where W contains the links' weights and D, the diagonal, their sums plus
the anchors a. A cycle solves it approximately, on grids with half the rows and columns of the preceding one:

- Three Jacobi steps, x <- x + omega D^-1 (b - A x), remove what changes from node to node.
- A coarse node represents an aggregate of fine ones. With the injection I, which gives each node the value of
  its aggregate, the coarse right-hand side is I^T (b - A x), and the coarse solution e is added as x + I e.
  Then the three steps follow in reverse order, so that a cycle is symmetric.
- A coarse link has half the summed weight of its fine links, because the centres of aggregates are twice as
  far apart: with I^T A I heights would follow slopes only half as far.
- Sums and injection are coarser than A requires, so levels from the third on are visited twice. The first
  visit may overestimate up to twofold where parts are connected by few links; the second one corrects that,
  and a cycle is positive definite. This must be done on all of these levels, or the overestimate accumulates.
  Where launches are expensive, only small levels are visited twice: a cycle visited once over a positive
  definite one is positive definite, whatever the overestimate.
- The coarsest level is solved by the inverse of its matrix.

*Aggregates* are usually blocks of two by two. Across a cut, a block would connect what A separates, and the
coarse solution would be wrong on both sides. If strong links do not connect a block's nodes, only its largest
part stays, and other parts move to aggregates of neighbouring blocks, along their links. A coarse node has
links to its eight neighbours only. A part whose move would create links to others stays where it is: if a
link were dropped, the coarse operator would be too weak there, its solution more than twice the correct one,
and a level visited twice not positive definite.

*Variances*: the variance of a node, an element of A's inverse, in excess of that of its coarse node is, with
six coefficients c, d (c0 + c1 r + c2 d sum w r_j + c5 o) + d sum w d_j (c3 + c4 r_j). Here w are the weights
of its links, scaled so that those along x and y have the same mean (over existing links), d is the inverse of
their sum plus the anchor, r = d sum w^2 d_j the probability that a random walk along these links returns
after two steps, and o one minus the ratio of the geometric to the arithmetic mean of both axes' mean weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
Way = tuple[int, int]  # rows down and columns to the right

WAYS = (0, 1), (1, 0), (1, 1), (1, -1)
"""Directions of a node's links in ``Level.links``; the other four are its neighbours'."""
STEPS = 1.3896, 0.5617, 1.0
"""Chebyshev's polynomial over the upper half of the spectrum, and a step for the remainder of block sums."""
LARGE_STEPS = 3.2, 0.53, 1.0, 0.9
"""Found by experiment for large levels that are visited once, where launches cost more than arithmetic."""
COARSEST = 64
"""Maximum number of nodes of the coarsest level, in rows whose length is a multiple of 16."""
ROUNDS = 4
"""Number of rounds in which parts of blocks are assigned to other aggregates."""
NEAR = 3
"""Rows and columns from which nodes that enter a graph get their heights."""
INDEPENDENT = 1e-4
"""Minimum share of the products' determinant for which two directions are used."""


@dataclass(frozen=True)
class Level:
    """A grid of nodes.

    Attributes
    ----------
    links : (4, rows, columns) array
        Weights of each node's links to the right and down, and down to the right and to the left.
    anchor : (rows, columns) array
        Weights of known heights.
    to : (rows, columns) array
        Of nodes that belong to another block's aggregate, 3 (rows down + 1) + columns right + 2, else 0.
    """

    links: Doubles
    anchor: Doubles
    to: Ints

    def sides(self) -> Iterator[tuple[Way, Doubles]]:
        """Yield all directions of links, and for each node the weight of its link there."""
        for (down, right), weights in zip(WAYS, self.links, strict=True):
            yield (down, right), weights
            yield (-down, -right), shifted(weights, -down, -right)

    @property
    def diagonal(self) -> Doubles:
        """Diagonal of A."""
        whole: Doubles = sum((weights for _, weights in self.sides()), self.anchor)
        return whole

    @property
    def aggregate(self) -> tuple[Ints, Ints]:
        """Row and column of each node's coarse node."""
        row, column = np.indices(self.to.shape) // 2
        down, right = step_of(self.to)
        return row + down, column + right

    @property
    def coarse_shape(self) -> tuple[int, int]:
        """Shape of the next level."""
        rows, columns = self.to.shape
        return -(-rows // 2), -(-columns // 2)


def shifted(values: Any, down: int, right: int) -> NDArray[Any]:
    """Return the value of each node's neighbour in a direction, 0 where there is none."""
    (rows, columns), margin = values.shape, max(abs(down), abs(right))
    first_row, first_column = margin + down, margin + right
    return np.pad(values, margin)[first_row : first_row + rows, first_column : first_column + columns]


def step_of(to: Any) -> tuple[Any, Any]:
    """Return the rows and columns from a node's block to its aggregate."""
    return np.where(to > 0, (to - 1) // 3 - 1, 0), np.where(to > 0, (to - 1) % 3 - 1, 0)


def inverse_of(diagonal: Doubles) -> Doubles:
    """Return the inverse of the diagonal, 0 for a node without links and anchor."""
    return np.where(diagonal > 0, 1 / np.where(diagonal > 0, diagonal, 1), 0)


# --- Levels ---


def parts(level: Level, strength: float) -> tuple[Ints, Flags]:
    """Return for each node the first node of its part of the block, and whether its part is the largest.

    The nodes of a block have numbers from 0 to 3; those without links along the axes have -1.
    """
    place: Any = np.indices(level.to.shape)
    (y, x), (right, down) = place, level.links[:2]
    along_x, along_y = np.maximum(right, shifted(right, 0, -1)), np.maximum(down, shifted(down, -1, 0))
    greatest_of_both = np.maximum(along_x, along_y)
    label: Ints = 2 * (y % 2) + x % 2
    for _ in range(3):
        for (v, u), w in level.sides():
            greatest = along_x if v == 0 else along_y if u == 0 else greatest_of_both
            strong = (w > 0) & (w**2 >= strength**2 * greatest * shifted(greatest, v, u))
            inside = ((y + v) // 2 == y // 2) & ((x + u) // 2 == x // 2)
            label = np.where(strong & inside, np.minimum(label, shifted(label, v, u)), label)
    live = greatest_of_both > 0
    block = y // 2 * level.coarse_shape[1] + x // 2
    size = np.bincount((4 * block + label)[live], minlength=4 * block.max() + 4).reshape(-1, 4)
    return np.where(live, label, -1), live & (label == size.argmax(axis=1)[block])


def moves(level: Level, label: Ints, largest: Flags) -> Ints:
    """Return ``Level.to``: unassigned parts are assigned in rounds, based on the preceding round."""
    groups: dict[tuple[int, ...], list[Way]] = {}
    for y, x in np.argwhere((label >= 0) & ~largest).tolist():
        groups.setdefault((y // 2, x // 2, int(label[y, x])), []).append((y, x))
    sides, to = list(level.sides()), np.zeros_like(label)
    for number in range(ROUNDS if groups else 0):
        targets = np.zeros_like(to)
        for nodes in groups.values():
            target = _place(nodes, sides, largest, to, last=number == ROUNDS - 1)
            targets[tuple(np.transpose(nodes))] = target
        to = targets
    return to


def _place(
    nodes: Sequence[Way], sides: Sequence[tuple[Way, Doubles]], largest: Flags, to: Ints, *, last: bool
) -> int:
    """Return the aggregate of a part; in the last round only the one chosen before, or it stays."""
    aggregate, old = np.array(nodes[0]) // 2, int(to[nodes[0]])
    sums, lowest, highest = np.zeros((3, 3)), np.full(2, -2), np.full(2, 2)
    for y, x in nodes:
        for (v, u), weights in sides:
            other = y + v, x + u
            if weights[y, x] == 0 or other in nodes:
                continue
            apart = np.array(other) // 2 - aggregate
            at = apart + step_of(to[other])
            lowest, highest = np.maximum(lowest, at - 1), np.minimum(highest, at + 1)
            if (to[other] or largest[other]) and apart.any() and abs(at).max() <= 1:
                sums[tuple(at + 1)] += weights[y, x]
    ways = np.indices((3, 3)) - 1
    near = (ways >= lowest[:, np.newaxis, np.newaxis]) & (ways <= highest[:, np.newaxis, np.newaxis])
    sums *= near.all(axis=0)
    if old and sums.flat[old - 1] > 0:
        return 0 if last and old == 5 else old
    return 0 if last or not sums.any() else 1 + int(sums.argmax())


def coarsen(level: Level) -> Level:
    """Return the next level; links further than to the next aggregate are dropped."""
    links, row, column = np.zeros((4, *level.coarse_shape)), *level.aggregate
    for (v, u), weights in level.sides():
        y, x = np.nonzero(weights)
        at = row[y, x], column[y, x]
        steps = row[y + v, x + u] - at[0], column[y + v, x + u] - at[1]
        for coarse, step in zip(links, WAYS, strict=True):
            np.add.at(coarse, at, weights[y, x] / 2 * ((steps[0] == step[0]) & (steps[1] == step[1])))
    return Level(links, gathered(level, level.anchor), np.zeros(level.coarse_shape, np.int64))


def build(right: Doubles, down: Doubles, anchor: Doubles | None, strength: float | None) -> list[Level]:
    """Return all levels of a graph, the finest first; without a strength from blocks only."""
    none = np.zeros(right.shape)
    links = np.stack([right, down, none, none]).astype(np.float64)
    levels = [Level(links, none if anchor is None else anchor.astype(np.float64), none.astype(np.int64))]
    while len(levels[-1].to) * -(-levels[-1].to.shape[1] // 16) * 16 > COARSEST:
        if strength is not None:
            level = levels.pop()
            to = moves(level, *parts(level, strength))
            levels.append(Level(level.links, level.anchor, to))
        levels.append(coarsen(levels[-1]))
    return levels


# --- Cycles ---


def around(level: Level, x: Doubles) -> Doubles:
    """Return W x."""
    return sum((w * shifted(x, *step) for step, w in level.sides()), np.zeros(x.shape))


def residual(level: Level, b: Doubles, x: Doubles) -> Doubles:
    """Return b - A x."""
    return b - level.diagonal * x + around(level, x)


def smooth(level: Level, b: Doubles, x: Doubles, steps: Sequence[float] = STEPS) -> Doubles:
    """Return the heights after Jacobi steps; nodes without links become 0."""
    inverse = inverse_of(level.diagonal)
    for omega in steps:
        x = (1 - omega) * x + omega * inverse * (b + around(level, x))
    return x


def gathered(level: Level, values: Doubles) -> Doubles:
    """Return I^T of values: sums over aggregates."""
    whole = np.zeros(level.coarse_shape)
    np.add.at(whole, level.aggregate, values)
    return whole


def injected(level: Level, values: Doubles) -> Doubles:
    """Return I of values: each node gets the value of its aggregate."""
    return np.asarray(values[level.aggregate])


def inverse_matrix(level: Level) -> Doubles:
    """Return the inverse of A, with the last node of each component without anchors fixed at 0."""
    index: Any = np.arange(level.to.size).reshape(level.to.shape)
    w, held = np.zeros((index.size, index.size)), level.anchor.ravel().copy()
    for step, weights in level.sides():
        w[index[weights > 0], shifted(index, *step)[weights > 0]] = weights[weights > 0]
    pivots = np.zeros(index.size)
    for k in range(index.size):
        links = w[k, k + 1 :].copy()
        pivots[k] = inverse_of(np.array(held[k] + links.sum()))
        w[k, k + 1 :] *= pivots[k]
        w[k + 1 :, k + 1 :] += np.outer(links, w[k, k + 1 :])
        held[k + 1 :] += w[k, k + 1 :] * held[k]
    for k in reversed(range(index.size)):
        u = w[k, k + 1 :]
        row = u @ w[k + 1 :, k + 1 :]
        w[k, k] = pivots[k] + u @ row
        w[k, k + 1 :] = w[k + 1 :, k] = row
    return w


def cycle(
    levels: Sequence[Level],
    b: Doubles,
    x: Doubles | None = None,
    number: int = 0,
    *,
    twice_from: int = 2,
    large: Sequence[float] = STEPS,
) -> Doubles:
    """Return the approximate solution for a right-hand side of a level, from heights x or from zero.

    Levels from `twice_from` on are visited twice; those before do `large` steps.
    """
    level = levels[number]
    if number == len(levels) - 1:
        return np.asarray((inverse_matrix(level) @ b.ravel()).reshape(b.shape))
    steps = large if number < twice_from else STEPS
    x = smooth(level, b, np.zeros(b.shape) if x is None else x, steps)
    coarse, e = gathered(level, residual(level, b, x)), None
    for _ in range(2 if number + 1 >= twice_from else 1):
        e = cycle(levels, coarse, e, number + 1, twice_from=twice_from, large=large)
    assert e is not None
    return smooth(level, b, x + injected(level, e), steps[::-1])


def best_step(bz: float, zz: float, zp: float, pp: float, bp: float) -> tuple[float, float]:
    """Return the step lengths along z and p that minimise the energy; along z only if they are parallel.

    Arguments are products: of the right-hand side with both, and of both with A times them.
    """
    if zz * pp > 0 and zz * pp - zp**2 > INDEPENDENT * zz * pp:
        along, again = np.linalg.solve([[zz, zp], [zp, pp]], [bz, bp])
        return float(along), float(again)
    return (bz / zz if zz > 0 else 0.0), 0.0


def enter(
    right: Doubles, down: Doubles, dz_dx: Doubles, dz_dy: Doubles, steps: tuple[float, float], x: Doubles
) -> Doubles:
    """Return heights, (rows, columns), with those of nodes that have slopes but had no link.

    They are means of the heights that nodes with a link, at most `NEAR` rows and columns away, imply with the
    mean of both slopes, weighted by the inverse of the squared distance. ``right`` and ``down`` are the links
    of the last graph, slopes are NaN where undefined, and ``steps`` the lengths from a column, and from a
    row, to the next, along x and y.
    """
    had = np.maximum(right, shifted(right, 0, -1)) + np.maximum(down, shifted(down, -1, 0)) > 0
    defined, sums, weights = np.isfinite(dz_dx), np.zeros(x.shape), np.zeros(x.shape)
    slopes = np.nan_to_num(dz_dx), np.nan_to_num(dz_dy)
    for v in range(-NEAR, NEAR + 1):
        for u in range(-NEAR, NEAR + 1):
            distances = u * steps[0], v * steps[1]
            rise = sum(
                d * (slope + shifted(slope, v, u)) / 2 for d, slope in zip(distances, slopes, strict=True)
            )
            weight = shifted(had & defined, v, u) / max(u * u + v * v, 1)
            sums += weight * (shifted(x, v, u) - rise)
            weights += weight
    return np.where(defined & ~had & (weights > 0), sums / np.where(weights > 0, weights, 1), x)


# --- Variances ---


def exact_variance(level: Level, masses: Doubles) -> Doubles:
    """Return the diagonal of A's inverse; without anchors, the mean of a component, by masses, is 0."""
    index: Any = np.arange(level.to.size).reshape(level.to.shape)
    matrix, label = np.diag(level.diagonal.ravel()), index.copy()
    for step, weights in level.sides():
        matrix[index[weights > 0], shifted(index, *step)[weights > 0]] -= weights[weights > 0]
    for _ in range(index.size):  # to the first node of each component
        for step, weights in level.sides():
            label = np.where(weights > 0, np.minimum(label, shifted(label, *step)), label)
    variance, mass = np.zeros(index.size), np.maximum(masses, 1).ravel()
    for first in np.unique(label):
        nodes = np.flatnonzero(label.ravel() == first)
        part, mass_fraction = matrix[np.ix_(nodes, nodes)], mass[nodes] / mass[nodes].sum()
        free = not level.anchor.ravel()[nodes].any()
        whole = np.linalg.inv(part + free * np.outer(mass_fraction, mass_fraction)) - free
        variance[nodes] = np.diag(whole)
    return variance.reshape(index.shape)


def evened_sides(level: Level) -> tuple[list[tuple[Way, Doubles]], Doubles]:
    """Return links along the axes, scaled to the same mean along both, and a measure of their unevenness."""
    links = list(level.sides())[:4]  # right, left, below, above
    x, y = (
        (first + second) * np.where((first > 0) & (second > 0), 0.5, 1)
        for (_, first), (_, second) in (links[:2], links[2:])
    )
    both = np.sqrt(x * y)
    by = [np.where(both > 0, both * inverse_of(mean), 1) for mean in (x, y)]
    uneven = np.where(both > 0, 1 - 2 * both * inverse_of(x + y), 0)
    return [(step, w * by[number // 2]) for number, (step, w) in enumerate(links)], uneven


def walk(level: Level) -> tuple[Doubles, Doubles]:
    """Return the inverse diagonal of scaled links, and the return probability of a walk of two steps."""
    links, _ = evened_sides(level)
    d = inverse_of(sum((w for _, w in links), level.anchor))
    return d, d * sum(w**2 * shifted(d, *step) for step, w in links)


def local_part(level: Level, c: Sequence[float]) -> Doubles:
    """Return the local part of each node's variance."""
    (links, uneven), (d, r) = evened_sides(level), walk(level)
    neighbours = sum(w * shifted(d * (c[3] + c[4] * r), *step) for step, w in links)
    back = sum(w * shifted(r, *step) for step, w in links)
    return np.asarray(d * (c[0] + c[1] * r + c[2] * d * back + c[5] * uneven + neighbours))


def spread(level: Level, coarse: Doubles, local: Doubles) -> Doubles:
    """Return the values of coarse nodes, smoothed by a Jacobi step, plus a local part."""
    brought = injected(level, coarse)
    return local + brought + inverse_of(level.diagonal) * residual(level, np.zeros(brought.shape), brought)
