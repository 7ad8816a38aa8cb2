"""Parts of a surface that breaks separate: which pixels belong together, and how high each part is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mirrorskin.engine.integration.graph import Components, Labels
from mirrorskin.engine.integration.validation import Floats
from mirrorskin.kernels.array_types import Doubles

_HOLDS = 1e-3  # confidence of a link that holds two pixels together
_BORDER = 3e-4  # least confidence of all links of a part to another, over the square root of its pixels
_FRAGMENT = 25  # pixels below which a part is none
_BREAK = 12  # connected pixels of edges that are a break; outliers of normals mark fewer
_PRIOR = 3e-4  # confidence of the plain surface about the height of a component

Ties = tuple[NDArray[np.intp], NDArray[np.intp], Doubles]
"""Pairs of different parts with links between them, and the sum of the confidences of these."""


def find_parts(right: Floats, down: Floats, answered: NDArray[np.bool_]) -> Labels:
    """Return the part of each pixel, (H, W), numbered from 0; -1 without an answer.

    ``right`` and ``down``, (H, W), are the confidences of links to the next pixels, 0 without a link. The
    pixels of a part are connected by confident links. Two parts become one where the sum of the confidences
    of the links between them is large for the size of the smaller one: its border is about as long as the
    square root of its pixels.
    """
    import cv2

    rows, columns = answered.shape
    grid = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
    grid[::2, ::2] = answered
    grid[::2, 1::2], grid[1::2, ::2] = right[:, :-1] > _HOLDS, down[:-1] > _HOLDS
    _, numbers = cv2.connectedComponents(grid, connectivity=4)
    labels = np.where(answered, numbers[::2, ::2] - 1, -1).astype(np.int32)
    return _join(labels, find_ties(labels, right, down), _hold)


def join_fragments(labels: Labels, ties: Ties) -> Labels:
    """Return parts without fragments of a few pixels, such as those of an outline.

    A fragment joins the part to which its most confident links lead. Fragments without links stay.
    """
    return _join(labels, ties, _are_best_of_fragments)


def largest_within(labels: Labels, joined: Labels) -> Labels:
    """Return for each pixel the largest of the parts that its joined part consists of; -1 without one."""
    answered = labels >= 0
    sizes = np.bincount(labels[answered])
    order = np.argsort(sizes[labels[answered]], kind="stable")
    largest = np.full(int(joined.max(initial=-1)) + 2, -1, np.int32)
    largest[joined[answered][order]] = labels[answered][order]
    return largest[joined]


def _join(
    labels: Labels, ties: Ties, choose: Callable[[Ties, NDArray[np.intp]], NDArray[np.bool_]]
) -> Labels:
    """Return parts that are joined by chosen ties until none is chosen, numbered from 0."""
    answered = labels >= 0
    sizes = np.bincount(labels[answered])
    parts = np.arange(len(sizes))
    while ties[0].size and (joins := choose(ties, sizes)).any():
        first, second, confidence = ties
        merged = _connect(len(sizes), first[joins], second[joins])
        parts, sizes = merged[parts], np.bincount(merged, sizes).astype(np.intp)
        ties = _sum_ties(merged[first], merged[second], confidence, len(sizes))
    return np.where(answered, parts[labels], -1).astype(np.int32) if parts.size else labels


def _hold(ties: Ties, sizes: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which ties hold two parts together."""
    first, second, confidence = ties
    return np.asarray(confidence > _BORDER * np.sqrt(np.minimum(sizes[first], sizes[second])))


def _are_best_of_fragments(ties: Ties, sizes: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which ties are the most confident one of a fragment."""
    first, second, confidence = ties
    ends, order = np.concatenate([first, second]), np.argsort(np.tile(confidence, 2), kind="stable")
    best = np.full(len(sizes), -1)
    best[ends[order]] = order % len(first)  # the last one stays: the most confident
    joins = np.zeros(len(first), bool)
    joins[best[(sizes < _FRAGMENT) & (best >= 0)]] = True
    return joins


def has_breaks(edges: NDArray[np.uint8]) -> bool:
    """Return whether pixels of edges, (H, W), are connected as those of a break are."""
    import cv2

    if not edges.any():
        return False
    _, _, stats, _ = cv2.connectedComponentsWithStats(edges, connectivity=8)
    return bool(stats[1:, cv2.CC_STAT_AREA].max() >= _BREAK)


def find_doubt(difference: Floats, labels: Labels) -> Floats:
    """Return the variance of heights about the mean of their part because of breaks that are not certain.

    With d the ``difference`` of two explanations of a surface about its mean in a part, it is half of d^2,
    and half of the mean of d^2 in the part, as two wrong explanations may cross.
    """
    answered = labels >= 0
    part, values = labels[answered], difference[answered].astype(np.float64)
    count = np.maximum(np.bincount(part), 1)
    squares = (values - (np.bincount(part, values) / count)[part]) ** 2
    doubt = np.zeros_like(difference)
    doubt[answered] = (squares + (np.bincount(part, squares) / count)[part]) / 2
    return doubt


def place_parts(
    labels: Labels, ties: Ties, difference: Floats, components: Components, known_heights: Floats
) -> Floats:
    """Return by how much each part has to be lifted.

    ``difference`` is the plain surface less the robust one, and ``known_heights`` the weight of known
    heights. The lifts d of the parts minimise ::

        sum of g (d_a - d_b)^2  over the ties between parts, of confidence g
        + sum of c n / N (d_a - m_a)^2  +  sum of k d_a^2  over parts of n of the N pixels of a component

    where m is the mean difference, c the confidence of the plain surface, and k the weight of the known
    heights of the part. So parts that links hold keep their height, and the plain surface decides where
    they do not.
    """
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    answered = labels >= 0
    part, count = labels[answered], int(labels.max(initial=-1)) + 1
    component = components.labels[answered]
    pixels = np.bincount(component, minlength=components.count)
    mean = np.bincount(component, difference[answered], components.count) / np.maximum(pixels, 1)
    centred = difference[answered] - np.where(components.offset_unknown, mean, 0.0)[component]
    prior = np.bincount(part, _PRIOR / pixels[component], count)
    pull = np.bincount(part, _PRIOR / pixels[component] * centred, count)
    first, second, confidence = ties
    rows = np.concatenate([first, second, first, second])
    ends = np.concatenate([second, first, first, second])
    weights = np.concatenate([-confidence, -confidence, confidence, confidence])
    matrix = sparse.coo_array((weights, (rows, ends)), (count, count)).tocsc()
    matrix += sparse.diags_array(prior + np.bincount(part, known_heights[answered], count), format="csc")
    return np.atleast_1d(spsolve(matrix, pull)).astype(np.float32)


def find_ties(labels: Labels, right: Floats, down: Floats) -> Ties:
    """Return the ties between different parts, from the confidences of links to the right and down."""
    pairs = (labels[:, :-1], labels[:, 1:], right[:, :-1]), (labels[:-1], labels[1:], down[:-1])
    ends: list[list[NDArray[Any]]] = []
    for first, second, confidence in pairs:
        between = (first != second) & (confidence > 0) & (first >= 0) & (second >= 0)
        ends.append([first[between], second[between], confidence[between]])
    first, second, confidence = (np.concatenate(ends_of_all) for ends_of_all in zip(*ends, strict=True))
    return _sum_ties(first, second, confidence, int(labels.max(initial=-1)) + 1)


def _sum_ties(first: NDArray[Any], second: NDArray[Any], confidence: NDArray[Any], count: int) -> Ties:
    from scipy import sparse

    apart = first != second
    low, high = np.minimum(first, second)[apart], np.maximum(first, second)[apart]
    total = sparse.coo_array((confidence[apart].astype(np.float64), (low, high)), (count, count))
    total.sum_duplicates()
    return total.row, total.col, total.data


def _connect(count: int, first: NDArray[Any], second: NDArray[Any]) -> NDArray[np.intp]:
    """Return the number of the connected component of each node."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    graph = sparse.coo_array((np.ones(len(first), np.int8), (first, second)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.intp)
