"""Heights from slopes, assembled and solved in float64 in the simplest way.

It shares no code with mirrorskin. A pixel is an unknown, a link joins two 4-neighbours, and a link wants the
difference of its ends to be its edge's slope times the pixel size, as strongly as its weight says. Matrices
are SciPy's, sparse, and solved directly; those of the statistics are dense, for pictures of some 30 pixels
across. Millimetres; x to the right, y up the picture, so that it falls with the row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

Map = NDArray[np.float64]
Mask = NDArray[np.bool_]
FOUR_POINTS = np.array([-1.0, 13.0, 13.0, -1.0]) / 24


@dataclass(frozen=True)
class Problem:
    """What `engine.integrate` is given, with its names; see `arguments`."""

    dz_dx: Map
    dz_dy: Map
    pixel_size: tuple[float, float] = (1.0, 1.0)
    mask: Mask | None = None
    slope_weights: ArrayLike | None = None
    edges: Mask | None = None
    known_heights: Map | None = None
    known_height_weights: ArrayLike | None = None

    @property
    def arguments(self) -> tuple[Map, Map, tuple[float, float]]:
        """What has no name."""
        return self.dz_dx, self.dz_dy, self.pixel_size

    @property
    def options(self) -> dict[str, object]:
        """What has a name, where it is given."""
        names = ("mask", "slope_weights", "edges", "known_heights", "known_height_weights")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}


class Graph(NamedTuple):
    """Unknowns, one a valid pixel in reading order, and links."""

    pixel: NDArray[np.intp]  # (H, W): number of the unknown, -1 where there is none
    difference: sparse.csr_array  # (links, n): u_j - u_i
    reading: sparse.csr_array  # (links, 2 H W): what a link wants, mm, of all dz_dx and then all dz_dy
    weight: Map  # (links,), 1/mm^2
    pull: Map  # (n,), 1/mm^2, of known heights
    known: Map  # (n,), mm, 0 where there is none
    label: NDArray[np.int32]  # (n,): component, in reading order
    free: Mask  # (components,): whether nothing is known of its offset


class Answer(NamedTuple):
    """Heights and components, (H, W), NaN and -1 without an answer; and which components float."""

    height: Map
    component: NDArray[np.int32]
    offset_unknown: Mask


def build(problem: Problem, whole: tuple[Mask, Mask] | None = None) -> Graph:
    """Assemble the graph of a problem from the definition of its energy.

    `whole` tells, better than a problem can, between which pixels the depth is continuous: to the next
    column, (H, W - 1), and to the next row, (H - 1, W).
    """
    slopes = np.stack([problem.dz_dx, problem.dz_dy]).astype(float)
    shape = slopes.shape[1:]
    mask = np.ones(shape, bool) if problem.mask is None else np.asarray(problem.mask) != 0
    weights = np.broadcast_to(
        np.asarray(1.0 if problem.slope_weights is None else problem.slope_weights, float), slopes.shape
    )
    has = mask & np.isfinite(slopes).all(axis=0) & (weights > 0)  # (2, H, W)
    heights, pull = _known_heights(problem, mask)
    valid = has.any(axis=0) | (pull > 0)
    pixel = np.where(valid, np.cumsum(valid.ravel()).reshape(shape) - 1, -1)
    across = has[0, :, :-1] & has[0, :, 1:]
    down = has[1, :-1] & has[1, 1:]
    if whole is not None:
        across, down = across & whole[0], down & whole[1]
    if problem.edges is not None:
        _cut(np.asarray(problem.edges) != 0, slopes, across, down)
    parts = [
        _links(pixel, across, weights[0], problem.pixel_size[0], np.arange(pixel.size).reshape(shape)),
        _links(pixel.T, down.T, weights[1].T, -problem.pixel_size[1], np.arange(pixel.size).reshape(shape).T),
    ]
    count = int(valid.sum())
    difference = sparse.csr_array(sparse.vstack([_resized(part[0], count) for part in parts]))
    reading = sparse.csr_array(sparse.block_diag([_resized(part[1], pixel.size) for part in parts]))
    label, free = _components(difference, pull[valid])
    weight = np.concatenate([part[2] for part in parts])
    return Graph(pixel, difference, reading, weight, pull[valid], heights[valid], label, free)


def solve(problem: Problem, whole: tuple[Mask, Mask] | None = None) -> Answer:
    """Return the heights of least energy; the mean of a component with an unknown offset is 0."""
    graph = build(problem, whole)
    rises = graph.reading @ np.nan_to_num(np.concatenate([problem.dz_dx, problem.dz_dy], axis=None))
    return spread_out(graph, minimise(graph, graph.weight, rises))


def minimise(graph: Graph, weight: Map, rises: Map) -> Map:
    """Return the heights (n,) of least energy for weights and wants of the links, mm."""
    matrix = graph.difference.T @ sparse.diags_array(weight) @ graph.difference
    matrix = sparse.csr_array(matrix + sparse.diags_array(graph.pull))
    source = graph.difference.T @ (weight * rises) + graph.pull * graph.known
    kept = np.ones(len(source), bool)
    _, first = np.unique(graph.label, return_index=True)
    kept[first[graph.free]] = False  # one pixel of each floating component stays at 0 for now
    height = np.zeros(len(source))
    if kept.any():
        factors = splu(matrix[kept][:, kept].tocsc(), permc_spec="COLAMD", diag_pivot_thresh=0.0)
        height[kept] = factors.solve(source[kept])
    return centred(graph, height)


def centred(graph: Graph, height: Map) -> Map:
    """Take from heights (n, ...) the mean of each component that floats."""
    members = sparse.csr_array((np.ones(len(graph.label)), (graph.label, np.arange(len(graph.label)))))
    size = np.asarray(members.sum(axis=1)).reshape(-1, *[1] * (height.ndim - 1))
    mean = np.asarray(members @ height) / size
    mean[~graph.free] = 0
    return np.asarray(height - mean[graph.label])


def spread_out(graph: Graph, height: Map) -> Answer:
    """Put the unknowns back where they are in the picture."""
    answered = graph.pixel >= 0
    picture = np.full(answered.shape, np.nan)
    picture[answered] = height
    component = np.full(answered.shape, -1, np.int32)
    component[answered] = graph.label
    return Answer(picture, component, graph.free)


def propagation(problem: Problem, best: bool = False) -> Map:
    """Return how the pixels' slopes move the heights, (n, 2 H W), dense.

    Parameters
    ----------
    problem : Problem
        Its weights are the inverse variances of the slopes.
    best : bool
        Whether by the best linear unbiased estimate from the edges' slopes, which knows that links in line
        share pixels and so noise; else by the least energy.

    Returns
    -------
    ndarray, (n, 2 H W)
        Times the slopes' noise it is the heights' error, mm; about the mean of a component that floats.
    """
    graph = build(problem)
    difference = graph.difference.toarray()
    reading = graph.reading.toarray()
    if best:
        covariance = (reading * variance(problem)) @ reading.T
        rest = np.linalg.solve(covariance, np.hstack([difference, reading]))
        weighed, pulled = rest[:, : difference.shape[1]], rest[:, difference.shape[1] :]
    else:
        weighed, pulled = (graph.weight[:, np.newaxis] * matrix for matrix in (difference, reading))
    matrix = difference.T @ weighed + np.diag(graph.pull)
    for label in np.flatnonzero(graph.free):
        member = (graph.label == label).astype(float)
        matrix += np.outer(member, member) * np.trace(matrix) / len(matrix) / member.sum()
    return centred(graph, np.linalg.solve(matrix, difference.T @ pulled))


def variance(problem: Problem) -> Map:
    """Return the variances of all dz_dx and then all dz_dy, (2 H W,); 1 where there is no slope."""
    weights = np.asarray(1.0 if problem.slope_weights is None else problem.slope_weights, float)
    weights = np.broadcast_to(weights, (2, *problem.dz_dx.shape)).reshape(-1)
    return np.where(weights > 0, 1 / np.where(weights > 0, weights, 1), 1.0)


def height_variance(problem: Problem, best: bool = False) -> Map:
    """Return the variance of the heights that the slopes' noise makes, (n,), mm^2."""
    moves = propagation(problem, best)
    return np.asarray((moves**2) @ variance(problem))


def _known_heights(problem: Problem, mask: Mask) -> tuple[Map, Map]:
    """Return known heights, 0 where there are none, and their weights, 0 where there are none."""
    if problem.known_heights is None:
        return np.zeros(mask.shape), np.zeros(mask.shape)
    weights = np.asarray(1.0 if problem.known_height_weights is None else problem.known_height_weights, float)
    pull = np.where(mask & np.isfinite(problem.known_heights), np.broadcast_to(weights, mask.shape), 0.0)
    return np.where(pull > 0, problem.known_heights, 0.0).astype(float), pull


def _cut(marked: Mask, slopes: Map, across: Mask, down: Mask) -> None:
    """Leave a marked pixel only its link to the unmarked neighbour that is most like it; one by one."""
    rows, columns = marked.shape
    before = across.copy(), down.copy()
    across[marked[:, :-1] | marked[:, 1:]] = False
    down[marked[:-1] | marked[1:]] = False
    for row, column in np.argwhere(marked):
        links = []
        for y, x in ((row, column - 1), (row, column + 1), (row - 1, column), (row + 1, column)):
            if not (0 <= y < rows and 0 <= x < columns) or marked[y, x]:
                continue
            number, link = (0, (row, min(x, column))) if y == row else (1, (min(y, row), column))
            if before[number][link]:
                apart = np.sum((slopes[:, y, x] - slopes[:, row, column]) ** 2)
                links.append((apart, len(links), number, link))
        if links:
            _, _, number, link = min(links)
            (across, down)[number][link] = True


def _links(
    pixel: NDArray[np.intp], joined: Mask, weights: Map, size: float, place: NDArray[np.intp]
) -> tuple[sparse.coo_array, sparse.coo_array, Map]:
    """Return differences, readings and weights of the links along the last axis, of which `joined` tells.

    `size` is from a pixel to the next in mm, negative where that is against the axis.
    """
    line, start = np.nonzero(joined)
    number = np.arange(len(line))
    ends = np.stack([pixel[line, start], pixel[line, start + 1]])
    sign = np.repeat([-1.0, 1.0], len(line))
    difference = sparse.coo_array((sign, (np.tile(number, 2), ends.ravel())))
    ringed = np.pad(joined, ((0, 0), (1, 1)))
    wide = ringed[line, start] & ringed[line, start + 2]
    factors = np.where(wide[:, np.newaxis], FOUR_POINTS, [0, 0.5, 0.5, 0])
    at = np.clip(start[:, np.newaxis] + np.arange(-1, 3), 0, place.shape[1] - 1)
    reading = sparse.coo_array(
        ((size * factors).ravel(), (np.repeat(number, 4), place[line[:, np.newaxis], at].ravel()))
    )
    here, beyond = weights[line, start], weights[line, start + 1]
    return difference, reading, 2 / (1 / here + 1 / beyond) / size**2


def _resized(matrix: sparse.coo_array, columns: int) -> sparse.csr_array:
    """Give a matrix all its columns, the empty ones too."""
    rows = int(matrix.row.max()) + 1 if matrix.nnz else 0
    return sparse.csr_array((matrix.data, (matrix.row, matrix.col)), shape=(rows, columns))


def _components(difference: sparse.csr_array, pull: Map) -> tuple[NDArray[np.int32], Mask]:
    """Number the components in reading order, and tell which have no known height."""
    _, label = connected_components(difference.T @ difference, directed=False)
    _, first, label = np.unique(label, return_index=True, return_inverse=True)
    order = np.argsort(np.argsort(first))
    label = order[label].astype(np.int32)
    held = np.bincount(label, pull) > 0
    return label, ~held
