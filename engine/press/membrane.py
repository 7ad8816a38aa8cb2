"""A membrane stretched over what is not known: as flat as what it is fixed to allows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_DIRECT = 10_000  # unknowns that a direct solution is quick for
_TOLERANCE = 1e-5  # of the right side
_ITERATIONS = 200


def stretch(height: Doubles, known: Mask, unknown: Mask, spacing: tuple[float, float]) -> Doubles:
    """Solve Laplace's equation: each unknown pixel is the mean of its four neighbours.

    It repeats planes, and never leaves the range of the known heights.

    Parameters
    ----------
    height : ndarray, (H, W), float64
        Of any unit where known.
    known, unknown : ndarray, (H, W), bool
        Pixels to be fixed to, and pixels to be found, of which each group touches a known one. At what is
        neither the membrane is free.
    spacing : (float, float)
        Distance of rows, and of columns, in one unit.

    Returns
    -------
    ndarray, (H, W), float64
        The heights, with the unknown ones found.
    """
    if not unknown.any():
        return height
    datum = float(np.mean(height[known]))
    matrix, right = _equations(np.where(known, height - datum, 0.0), known, unknown, spacing)
    if len(right) <= _DIRECT:
        found = spsolve(matrix.tocsc(), right, permc_spec="MMD_AT_PLUS_A")
    else:
        start = _coarse(height - datum, known, unknown, spacing)[unknown]
        found = _iterate(matrix, right, start)
    stretched = height.copy()
    stretched[unknown] = found + datum
    return stretched


def _equations(
    height: Doubles, known: Mask, unknown: Mask, spacing: tuple[float, float]
) -> tuple[sparse.csr_matrix, Doubles]:
    """Return the matrix and the right side for the unknown pixels, in reading order."""
    count = int(np.count_nonzero(unknown))
    number = np.full(unknown.shape, -1)
    number[unknown] = np.arange(count)
    diagonal, right = np.zeros(count), np.zeros(count)
    rows, columns, values = [np.arange(count)], [np.arange(count)], [diagonal]
    links = (np.s_[:-1], np.s_[1:], spacing[0] ** -2), (np.s_[:, :-1], np.s_[:, 1:], spacing[1] ** -2)
    for one, other, weight in links:
        for here, there in ((one, other), (other, one)):
            fixed = unknown[here] & known[there]
            free = unknown[here] & unknown[there]
            np.add.at(diagonal, number[here][fixed | free], weight)
            np.add.at(right, number[here][fixed], weight * height[there][fixed])
            rows.append(number[here][free])
            columns.append(number[there][free])
            values.append(np.full(len(rows[-1]), -weight))
    places = np.concatenate(rows), np.concatenate(columns)
    return sparse.csr_matrix((np.concatenate(values), places), shape=(count, count)), right


def _coarse(height: Doubles, known: Mask, unknown: Mask, spacing: tuple[float, float]) -> Doubles:
    """Return a first guess: the membrane on pixels of twice the size, which are known if any part is."""
    rows, columns = height.shape
    blocks = -(-rows // 2), 2, -(-columns // 2), 2
    border = ((0, -rows % 2), (0, -columns % 2))
    parts = np.pad(known, border).reshape(blocks).sum(axis=(1, 3))
    sums = np.pad(np.where(known, height, 0.0), border).reshape(blocks).sum(axis=(1, 3))
    wanted = np.pad(unknown, border).reshape(blocks).any(axis=(1, 3)) & (parts == 0)
    large = stretch(sums / np.maximum(parts, 1), parts > 0, wanted, (2 * spacing[0], 2 * spacing[1]))
    return np.repeat(np.repeat(large, 2, axis=0), 2, axis=1)[:rows, :columns]


def _iterate(matrix: sparse.csr_matrix, right: Doubles, start: Doubles) -> Doubles:
    """Solve by conjugate gradients; SciPy's own use BLAS, whose threads wait for each other."""
    found, rest = start, right - matrix @ start
    direction, square = rest, float(np.sum(rest * rest))
    enough = _TOLERANCE**2 * float(np.sum(right * right))
    for _ in range(_ITERATIONS):
        if square <= enough:
            break
        image = matrix @ direction
        length = square / float(np.sum(direction * image))
        found, rest = found + length * direction, rest - length * image
        before, square = square, float(np.sum(rest * rest))
        direction = rest + square / before * direction
    return found
