"""The normal equations of a graph as a sparse matrix, and their exact answer."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from mirrorskin.bench.peers.integration.graph import Graph, Mask

Doubles = NDArray[np.float64]


class System(NamedTuple):
    """The equations of the N pixels that have a link: `matrix` u = `source`.

    `matrix` is (N, N), CSR, `source` (N,); `linked` is (H, W), true at those pixels.
    """

    matrix: Any
    source: Doubles
    linked: Mask


def assemble(graph: Graph) -> System:
    """Return the equations of a graph, row by row as a CSR matrix has them: no sort, no sum."""
    shape = graph.source.shape
    entries = np.zeros((5, *shape), np.int8)  # above, left, the pixel itself, right, below
    np.negative(graph.down, out=entries[0, 1:], dtype=np.int8, casting="unsafe")
    np.negative(graph.right, out=entries[1, :, 1:], dtype=np.int8, casting="unsafe")
    entries[3, :, :-1], entries[4, :-1] = entries[1, :, 1:], entries[0, 1:]
    np.negative(entries.sum(axis=0, dtype=np.int8), out=entries[2])
    linked = entries[2] != 0
    number = np.cumsum(linked, dtype=np.int32) - np.int32(1)
    place = np.flatnonzero(linked).astype(np.int32)
    values = entries.reshape(5, -1)[:, place].T
    columns = place[:, np.newaxis] + np.array([-shape[1], -1, 0, 1, shape[1]], np.int32)
    there = values != 0
    starts = np.concatenate([[0], np.cumsum(np.count_nonzero(there, axis=1))]).astype(np.int32)
    parts = values[there].astype(np.float64), number[columns[there]], starts
    matrix = sparse.csr_matrix(parts, (len(place), len(place)))
    return System(matrix, graph.source[linked].astype(np.float64), linked)


def solve_exactly(system: System) -> Doubles:
    """Return the answer of a direct solver, (N,); one pixel of each component is held at 0."""
    _, label = components(system)
    first = np.unique(label, return_index=True)[1]
    held = sparse.csc_matrix((np.ones(len(first)), (first, first)), system.matrix.shape)
    # The matrix is symmetric and positive, so its diagonal needs no search for a pivot.
    factors = splu(
        (system.matrix + held).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    values: Doubles = factors.solve(system.source)
    return values


def components(system: System) -> tuple[int, NDArray[np.int32]]:
    """Return how many components there are, and which one each pixel is in, (N,)."""
    count, label = connected_components(system.matrix, directed=False)
    return count, label


def centre(system: System, values: Doubles) -> Doubles:
    """Return heights whose mean is 0 in each component, (N,)."""
    count, label = components(system)
    means = np.bincount(label, values, count) / np.bincount(label, minlength=count)
    return values - means[label]


def as_map(system: System, values: Doubles, wanted: Mask) -> NDArray[np.float32]:
    """Return heights as a map: 0 at wanted pixels without a link, NaN where none is wanted."""
    heights = np.where(wanted, np.float32(0), np.float32(np.nan))
    heights[system.linked] = values
    return heights
