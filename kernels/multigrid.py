"""Heights on a graph of pixels: what ``multigrid.cl`` computes, in plain NumPy with float64 inside.

The heights x of a graph minimise sum w (x_j - x_i - d)^2 over its links and sum a (x_i - k)^2 over known
heights k: A x = b with A = D - W, where W holds the links' weights and D, the diagonal, their sums and the
anchors a. A V-cycle solves it nearly:

- *begin*, *smooth*: x += omega D^-1 (b - A x), Jacobi's method; with two steps after Chebyshev it takes out
  what changes from node to node. It works in differences of neighbours, so that float32 heights are enough.
- *restrict*: the coarse level, of a node for each block of two by two, has the right side P^T (b - A x).
- *prolong*: x += P e, the coarse answer e brought to each block's nodes and spread by a step of Jacobi's
  method, so P = D^-1 W I, where I gives a node what its block has.
- *even*, *returns*, *local*: what a node's variance, an element of A's inverse, has beyond that of the coarse
  nodes that it is prolonged from, by six numbers c. With w the weights of its links, scaled so that those
  along x and y have the same mean (over those that there are), d one over their sum and the anchor, and
  r = d sum w^2 d_j, how likely a walk along these links is back after two steps, that is
  d (c0 + c1 r + c2 d sum w r_j + c5 o) + d sum w d_j (c3 + c4 r_j),
  o one less the geometric over the arithmetic mean of both axes' mean weights.
- *coarsen*: a coarse link's weight is the sum over those that it stands for of 1 / (1/w + r + s), where r and
  s are the ways from the link to the middles of both blocks: 1 / (w + b), half a link, if one of weight b
  goes on behind it; else 1 / c, where the block's other row or column has a link c, and a link leads there;
  else 1 / 2 w (0 for parts of split blocks). Of links that are all alike that is the mean of two.

All arrays are flat. A level's picture of `rows` by `stride` nodes lies at `base`, with a row of none before
and behind it. Arguments are those of the kernels; of functions for extra nodes, rows `at` to `at` + `count`
of a sparse matrix: row k is of ``node[k]``, its entries are those from ``start[k]`` to ``start[k + 1]`` of
``column`` and ``weight``. ``anchor`` is an array of zeros where there is none. The passes that do several of
these in one go (*descend*, *ascend*, *tail_cycle*, *tail_full*) have no functions of their own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Array = NDArray[Any]
Table = tuple[Array, Array, Array, Array]

INDEPENDENT = 1e-4  # share of the products' determinant from which on two directions are two


def _picture(base: int, rows: int, stride: int) -> slice:
    return slice(base + stride, base + stride * (rows + 1))


def _moved(part: slice, by: int) -> slice:
    return slice(part.start + by, part.stop + by)


def _double(values: Array, part: slice) -> Doubles:
    return values[part].astype(np.float64)


def _inverse(diagonal: Doubles) -> Doubles:
    return np.where(diagonal > 0, 1 / np.where(diagonal > 0, diagonal, 1), 0)


def _sides(part: slice, stride: int, right: Array, down: Array) -> list[tuple[Doubles, slice]]:
    """Return the weights of a picture's links, and the nodes that they lead to."""
    return [
        (_double(right, part), _moved(part, 1)),
        (_double(right, _moved(part, -1)), _moved(part, -1)),
        (_double(down, part), _moved(part, stride)),
        (_double(down, _moved(part, -stride)), _moved(part, -stride)),
    ]


def _diagonal(part: slice, stride: int, right: Array, down: Array, anchor: Array) -> Doubles:
    whole: Doubles = sum((w for w, _ in _sides(part, stride, right, down)), np.zeros(1))
    return whole + anchor[part]


def _flow(part: slice, stride: int, right: Array, down: Array, anchor: Array, x: Array) -> Doubles:
    """Return -A x."""
    here = _double(x, part)
    flow = -anchor[part] * here
    for w, other in _sides(part, stride, right, down):
        flow = flow + w * (x[other] - here)
    return flow


def multigrid_invert(
    base: int, rows: int, stride: int, right: Array, down: Array, anchor: Array, inverse: Array
) -> None:
    """Write one over the diagonal."""
    part = _picture(base, rows, stride)
    inverse[part] = _inverse(_diagonal(part, stride, right, down, anchor))


def multigrid_begin(base: int, rows: int, stride: int, omega: float, then: float, right: Array, down: Array,
                    anchor: Array, inverse: Array, b: Array, x: Array) -> None:  # fmt: skip
    """Do two steps of Jacobi's method from heights of zero."""
    part = _picture(base, rows, stride)
    first = np.zeros(part.stop + stride)
    first[part] = omega * _double(b, part) * inverse[part]
    residual = b[part] + _flow(part, stride, right, down, anchor, first)
    x[part] = first[part] + then * inverse[part] * residual


def multigrid_smooth(base: int, rows: int, stride: int, omega: float, right: Array, down: Array,
                     anchor: Array, b: Array, x: Array, smoother: Array) -> None:  # fmt: skip
    """Do a step of Jacobi's method."""
    part = _picture(base, rows, stride)
    residual = b[part] + _flow(part, stride, right, down, anchor, x)
    smoother[part] = x[part] + omega * residual * _inverse(_diagonal(part, stride, right, down, anchor))


def multigrid_residual(base: int, rows: int, stride: int, right: Array, down: Array, anchor: Array,
                       b: Array, x: Array, residual: Array) -> None:  # fmt: skip
    """Write the residual."""
    part = _picture(base, rows, stride)
    residual[part] = b[part] + _flow(part, stride, right, down, anchor, x)


def multigrid_scaled_residual(base: int, rows: int, stride: int, right: Array, down: Array, anchor: Array,
                              b: Array, x: Array, residual: Array) -> None:  # fmt: skip
    """Write the residual over the diagonal."""
    part = _picture(base, rows, stride)
    rest = b[part] + _flow(part, stride, right, down, anchor, x)
    residual[part] = rest * _inverse(_diagonal(part, stride, right, down, anchor))


def _evened(part: slice, stride: int, right: Array, down: Array) -> tuple[list[Doubles], Doubles]:
    """Return the weights of `_sides`, scaled to the same mean along both axes, and how uneven these were."""
    links = [w for w, _ in _sides(part, stride, right, down)]
    x, y = ((one + two) * np.where((one > 0) & (two > 0), 0.5, 1) for one, two in (links[:2], links[2:]))
    both = np.sqrt(x * y)
    by_x, by_y = (np.where(both > 0, both * _inverse(mean), 1) for mean in (x, y))
    uneven = np.where(both > 0, 1 - 2 * both * _inverse(x + y), 0)
    return [links[0] * by_x, links[1] * by_x, links[2] * by_y, links[3] * by_y], uneven


def multigrid_even(
    base: int, rows: int, stride: int, right: Array, down: Array, anchor: Array, evened: Array
) -> None:
    """Write one over the diagonal of evened links."""
    part = _picture(base, rows, stride)
    links, _ = _evened(part, stride, right, down)
    evened[part] = _inverse(sum(links) + _double(anchor, part))


def multigrid_returns(
    base: int, rows: int, stride: int, right: Array, down: Array, evened: Array, returns: Array
) -> None:
    """Write how likely a walk along evened links is back after two steps."""
    part = _picture(base, rows, stride)
    links, _ = _evened(part, stride, right, down)
    others = (other for _, other in _sides(part, stride, right, down))
    returns[part] = evened[part] * sum(w**2 * evened[other] for w, other in zip(links, others, strict=True))


def multigrid_local(base: int, rows: int, stride: int, right: Array, down: Array, evened: Array,
                    returns: Array, c: Array, local_part: Array) -> None:  # fmt: skip
    """Write what a node's variance has that the coarse one does not."""
    part = _picture(base, rows, stride)
    links, uneven = _evened(part, stride, right, down)
    here, whole = _double(evened, part), c[0] + c[1] * _double(returns, part) + c[5] * uneven
    for w, (_, other) in zip(links, _sides(part, stride, right, down), strict=True):
        beside, back = _double(evened, other), _double(returns, other)
        whole = whole + w * (beside * (c[3] + c[4] * back) + c[2] * here * back)
    local_part[part] = here * whole


def multigrid_keep(
    base: int, rows: int, stride: int, residual: Array, x: Array, b: Array, kept: Array
) -> None:
    """Make the residual the right side, and keep the heights so far."""
    part = _picture(base, rows, stride)
    b[part], kept[part] = residual[part], x[part]


def multigrid_scale(base: int, rows: int, stride: int, inverse: Array, b: Array, residual: Array) -> None:
    """Write the residual of heights of zero, over the diagonal."""
    part = _picture(base, rows, stride)
    residual[part] = inverse[part] * _double(b, part)


def multigrid_clear(base: int, rows: int, stride: int, x: Array) -> None:
    """Write 0."""
    x[_picture(base, rows, stride)] = 0


def multigrid_add(base: int, rows: int, stride: int, other: Array, x: Array) -> None:
    """Add heights to others."""
    part = _picture(base, rows, stride)
    x[part] = _double(x, part) + other[part]


def _blocks(base: int, stride: int, coarse_rows: int) -> tuple[Array, Array]:
    """Return the top left nodes of blocks, (rows, blocks), and of each picture row the step to the next."""
    row, column = np.arange(coarse_rows)[:, np.newaxis], np.arange(0, stride, 2)
    return base + stride * (2 * row + 1) + column, np.array([0, 1, stride, stride + 1])


def _coarse(coarse_base: int, coarse_rows: int, coarse_stride: int, count: int) -> Array:
    row = np.arange(coarse_rows)[:, np.newaxis]
    nodes: Array = coarse_base + coarse_stride * (row + 1) + np.arange(count)
    return nodes


def _neighbours(node: Array, stride: int, right: Array, down: Array) -> list[tuple[Doubles, Array]]:
    """Return weights and nodes at the other ends of nodes' links."""
    links = (right, node, 1), (right, node - 1, -1), (down, node, stride), (down, node - stride, -stride)
    return [(weights[at].astype(np.float64), node + step) for weights, at, step in links]


def multigrid_restrict(base: int, stride: int, coarse_base: int, coarse_rows: int, coarse_stride: int,
                       right: Array, down: Array, residual: Array, b: Array) -> None:  # fmt: skip
    """Write the coarse right side: the residual, spread by a step of Jacobi's method, of each block."""
    corner, steps = _blocks(base, stride, coarse_rows)
    whole = np.zeros(corner.shape)
    for step in steps:
        for w, other in _neighbours(corner + step, stride, right, down):
            whole += w * residual[other]
    b[_coarse(coarse_base, coarse_rows, coarse_stride, stride // 2)] = whole


def multigrid_gather(
    base: int, stride: int, coarse_base: int, coarse_rows: int, coarse_stride: int, fine: Array, b: Array
) -> None:
    """Write the coarse right side of full multigrid where no block is split: the sum of each block."""
    corner, steps = _blocks(base, stride, coarse_rows)
    whole = sum(fine[corner + step].astype(np.float64) for step in steps)
    b[_coarse(coarse_base, coarse_rows, coarse_stride, stride // 2)] = whole


def multigrid_prolong(base: int, stride: int, coarse_base: int, coarse_rows: int, coarse_stride: int,
                      keep: float, right: Array, down: Array, inverse: Array, e: Array, x: Array,
                      corrected: Array) -> None:  # fmt: skip
    """Add the coarse answer, spread by a step of Jacobi's method, to so much of heights."""
    corner, steps = _blocks(base, stride, coarse_rows)
    for step in steps:
        node = corner + step
        correction = np.zeros(node.shape)
        for w, other in _neighbours(node, stride, right, down):
            row, column = np.divmod(other - base - stride, stride)
            correction += w * e[coarse_base + coarse_stride * (row // 2 + 1) + column // 2]
        corrected[node] = keep * x[node].astype(np.float64) + inverse[node] * correction


def multigrid_coarsen(base: int, stride: int, coarse_base: int, coarse_rows: int, coarse_stride: int,
                      strength: float, right: Array, down: Array, anchor: Array, coarse_right: Array,
                      coarse_down: Array, coarse_anchor: Array, split: Array) -> None:  # fmt: skip
    """Write the coarse links and anchors, and 1 where a block does not hang together by strong links."""
    corner, _ = _blocks(base, stride, coarse_rows)
    a, b, c, d = corner, corner + 1, corner + stride, corner + stride + 1

    def greatest(node: Array) -> Doubles:
        most: Doubles = np.max([w for w, _ in _neighbours(node, stride, right, down)], axis=0)
        return most

    def go_on(w: Doubles, behind: Doubles, across: Doubles, beside: Doubles) -> Doubles:
        around = np.where((across > 0) & (beside > 0), _inverse(beside), 0.5 * _inverse(w))
        return np.where(behind > 0, _inverse(w + behind), around)

    def joint(along: Array, across: Array, node: Array, step: int, aside: int) -> Doubles:
        """Return what the link of a node to that a step on stands for; aside lies the block's other line."""
        w, link = along.astype(np.float64)[node], np.minimum(node, node + aside)
        before = go_on(w, along[node - step], across[link], along[node - step + aside])
        after = go_on(w, along[node + step], across[link + step], along[node + step + aside])
        return np.where(w > 0, _inverse(_inverse(w) + before + after), 0)

    def strong(weights: Array, node: Array, other: Array) -> Array:
        w = weights[node].astype(np.float64)
        bound: Array = w >= strength * np.sqrt(greatest(node) * greatest(other))
        return (w > 0) & bound

    to = _coarse(coarse_base, coarse_rows, coarse_stride, stride // 2)
    coarse_right[to] = joint(right, down, b, 1, stride) + joint(right, down, d, 1, -stride)
    coarse_down[to] = joint(down, right, c, stride, 1) + joint(down, right, d, stride, -1)
    coarse_anchor[to] = sum(np.where(greatest(node) > 0, anchor[node], 0) for node in (a, b, c, d))
    live = sum((greatest(node) > 0).astype(int) for node in (a, b, c, d))
    links = (right, a, b), (right, c, d), (down, a, c), (down, b, d)
    split[to] = sum(strong(*link).astype(int) for link in links) < live - 1


def _rows(
    at: int, count: int, table: Table, values: Array | None = None, own: Array | None = None
) -> Doubles:
    """Return each row's sum of its weights, times values there, less its own node's."""
    node, start, column, weight = table
    sums = np.zeros(count)
    for k in range(at, at + count):
        entries = slice(start[k], start[k + 1])
        term = np.ones(entries.stop - entries.start) if values is None else values[column[entries]]
        less = 0.0 if own is None else own[node[k]]
        sums[k - at] = np.sum(weight[entries].astype(np.float64) * (term.astype(np.float64) - less))
    return sums


def multigrid_invert_extra(at: int, count: int, node: Array, start: Array, column: Array, weight: Array,
                           anchor: Array, inverse: Array) -> None:  # fmt: skip
    """Write one over the diagonal of extra nodes."""
    i = node[at : at + count]
    inverse[i] = _inverse(_rows(at, count, (node, start, column, weight)) + anchor[i])


def multigrid_begin_extra(at: int, count: int, node: Array, start: Array, column: Array, weight: Array,
                          omega: float, then: float, anchor: Array, inverse: Array, b: Array,
                          x: Array) -> None:  # fmt: skip
    """Do two steps of Jacobi's method from heights of zero, at extra nodes."""
    i, first = node[at : at + count], omega * b.astype(np.float64) * inverse
    flow = _rows(at, count, (node, start, column, weight), first, first) - anchor[i] * first[i]
    x[i] = first[i] + then * inverse[i] * (b[i] + flow)


def multigrid_smooth_extra(at: int, count: int, node: Array, start: Array, column: Array, weight: Array,
                           omega: float, anchor: Array, inverse: Array, b: Array, x: Array,
                           smoother: Array) -> None:  # fmt: skip
    """Do a step of Jacobi's method at extra nodes."""
    i = node[at : at + count]
    flow = _rows(at, count, (node, start, column, weight), x, x) - anchor[i] * x[i].astype(np.float64)
    smoother[i] = x[i] + omega * inverse[i] * (b[i] + flow)


def multigrid_residual_extra(at: int, count: int, node: Array, start: Array, column: Array, weight: Array,
                             divide: int, anchor: Array, inverse: Array, b: Array, x: Array,
                             residual: Array) -> None:  # fmt: skip
    """Write the residual at extra nodes, over the diagonal or not."""
    i = node[at : at + count]
    flow = _rows(at, count, (node, start, column, weight), x, x) - anchor[i] * x[i].astype(np.float64)
    residual[i] = (b[i] + flow) * (inverse[i] if divide else 1)


def multigrid_restrict_extra(
    at: int, count: int, node: Array, start: Array, column: Array, weight: Array, residual: Array, b: Array
) -> None:
    """Write the right side of nodes that stand for parts of split blocks."""
    b[node[at : at + count]] = _rows(at, count, (node, start, column, weight), residual)


def multigrid_prolong_extra(at: int, count: int, node: Array, start: Array, column: Array, weight: Array,
                            keep: float, inverse: Array, e: Array, x: Array,
                            corrected: Array) -> None:  # fmt: skip
    """Add the coarse answer to heights of nodes whose blocks are split."""
    i = node[at : at + count]
    correction = _rows(at, count, (node, start, column, weight), e)
    corrected[i] = keep * x[i].astype(np.float64) + inverse[i] * correction


def multigrid_returns_extra(at: int, count: int, node: Array, start: Array, column: Array, weight: Array,
                            evened: Array, returns: Array) -> None:  # fmt: skip
    """Write how likely a walk from extra nodes is back after two steps."""
    i = node[at : at + count]
    returns[i] = evened[i] * _rows(at, count, (node, start, column, weight**2), evened)


def multigrid_local_extra(at: int, count: int, node: Array, start: Array, column: Array, weight: Array,
                          evened: Array, returns: Array, c: Array, local_part: Array) -> None:  # fmt: skip
    """Write what extra nodes' variance has that the coarse one does not."""
    i, table = node[at : at + count], (node, start, column, weight)
    beside = _rows(at, count, table, evened * (c[3] + c[4] * returns))
    around = c[2] * evened[i] * _rows(at, count, table, returns)
    local_part[i] = evened[i] * (c[0] + c[1] * returns[i] + beside + around)


def multigrid_solve(count: int, bottom: Array, matrix: Array, b: Array, x: Array) -> None:
    """Solve the coarsest level by its pseudo-inverse, (count, count)."""
    nodes = bottom[:count]
    x[nodes] = matrix.reshape(-1)[: count**2].reshape(count, count).astype(np.float64) @ b[nodes]


def multigrid_direct(base: int, rows: int, stride: int, beta: float, right: Array, down: Array,
                     anchor: Array, z: Array, before: Array, direction: Array, image: Array,
                     parts: Array) -> None:  # fmt: skip
    """Write the next direction of conjugate gradients, the matrix times it, and their product."""
    part = _picture(base, rows, stride)
    whole = slice(part.start - stride, part.stop + stride)
    p = np.zeros(len(direction))
    p[whole] = _double(z, whole) + beta * before[whole]
    direction[part] = p[part]
    image[part] = -_flow(part, stride, right, down, anchor, p)
    parts[...] = 0
    parts[0] = np.sum(p[part] * image[part])


def multigrid_advance(base: int, rows: int, stride: int, alpha: float, direction: Array, image: Array,
                      b: Array, x: Array, parts: Array) -> None:  # fmt: skip
    """Take a step along it; write the square of the residual in the first part."""
    part = _picture(base, rows, stride)
    x[part] = _double(x, part) + alpha * direction[part]
    b[part] = _double(b, part) - alpha * image[part]
    parts[...] = 0
    parts[0] = np.sum(_double(b, part) ** 2)


def multigrid_curve(base: int, rows: int, stride: int, right: Array, down: Array, anchor: Array, b: Array,
                    z: Array, p: Array, count: int, parts: Array) -> None:  # fmt: skip
    """Write, of two directions, z A z, z A p, p A p and b p, each in the first of its parts."""
    part = _picture(base, rows, stride)
    z_image, p_image = (-_flow(part, stride, right, down, anchor, one) for one in (z, p))
    products = _double(z, part) * z_image, _double(z, part) * p_image, _double(p, part) * p_image
    parts[...] = 0
    parts[::count] = [np.sum(one) for one in (*products, _double(b, part) * _double(p, part))]


def multigrid_follow(base: int, rows: int, stride: int, products: int, product: Array, count: int,
                     parts: Array, z: Array, p: Array, x: Array) -> None:  # fmt: skip
    """Take the best step in the plane of z and p, or along z where both are nearly one; p becomes it."""
    part = _picture(base, rows, stride)
    bz = np.sum(_double(product, slice(products)))
    zz, zp, pp, bp = _double(parts, slice(None)).reshape(4, count).sum(axis=1)
    along, again = bz / zz if zz > 0 else 0.0, 0.0
    if zz * pp > 0 and zz * pp - zp**2 > INDEPENDENT * zz * pp:
        along, again = np.linalg.solve([[zz, zp], [zp, pp]], [bz, bp])
    step = along * _double(z, part) + again * _double(p, part)
    p[part] = step
    x[part] = _double(x, part) + step


def multigrid_dot(base: int, rows: int, stride: int, one: Array, other: Array, parts: Array) -> None:
    """Write the product of two, in the first part."""
    part = _picture(base, rows, stride)
    parts[...] = 0
    parts[0] = np.sum(_double(one, part) * other[part])


def multigrid_weigh(base: int, rows: int, stride: int, anchor: Array, x: Array, parts: Array) -> None:
    """Write what the anchors weigh of heights, in the first part."""
    part = _picture(base, rows, stride)
    parts[...] = 0
    parts[0] = np.sum(_double(anchor, part) * _double(x, part) ** 2)


def multigrid_admit(rows: int, columns: int, stride: int, map_: Array, level: Array) -> None:
    """Copy a picture to the finest level."""
    level[stride : stride * (rows + 1)].reshape(rows, stride)[:, :columns] = map_.reshape(rows, columns)


def multigrid_release(rows: int, columns: int, stride: int, level: Array, map_: Array) -> None:
    """Copy the finest level to a picture."""
    map_.reshape(rows, columns)[...] = level[stride : stride * (rows + 1)].reshape(rows, stride)[:, :columns]


def multigrid_deviation(rows: int, columns: int, stride: int, least: float, wanted: int,
                        flags: Array, inverse: Array, variance: Array, map_: Array) -> None:  # fmt: skip
    """Write the roots of variances, at least that share of one over the diagonal, where a flag is wanted."""
    part = _picture(0, rows, stride)
    found = np.maximum(_double(variance, part), least * _double(inverse, part))
    map_.reshape(rows, columns)[...] = np.where(
        flags.reshape(rows, columns) & wanted, np.sqrt(found).reshape(rows, stride)[:, :columns], np.nan
    )
