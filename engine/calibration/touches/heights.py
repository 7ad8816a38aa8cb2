"""Heights of a window of a touch: slopes, splines, and the system of equations that eliminates heights.

Heights of pixels are combinations of splines, of the coarsest that follow the surface: noise that a surface
cannot have would look like relief, and relief determines the sensor.
"""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

_STENCIL = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60.0  # first derivative at the middle
_SHORTER = np.array([0, 1, -8, 0, 8, -1, 0]) / 12.0  # the same, exact for polynomials of fourth degree
MARGIN = 3
"""Pixels at the edge of a window whose slopes are not used."""

PRODUCTS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
"""Pairs of what a pixel has: the slopes along x and y, and the height."""

SPACINGS = (1, 2, 4, 8, 16, 48)
"""Pixels between knots of splines; heights of pixels are independent of each other with 1."""

_DEGREE = 5  # of splines
_REACH = 2 * MARGIN  # rows of pixels that a row depends on
_SMOOTH = 1e-6  # weight of second differences of heights, relative to that of slopes: where nothing is seen
_LEAST = 1e-9  # weight of heights, in the same way


@functools.lru_cache(maxsize=4)
def slope_matrix(size: int, pixel_size: tuple[float, float]) -> Any:
    """Return the matrix from S x S heights to slopes along x and y of inner pixels, (2 n, S * S)."""
    return _slopes(size, pixel_size, tuple(_STENCIL))


@functools.lru_cache(maxsize=4)
def shortening_matrix(size: int, pixel_size: tuple[float, float]) -> Any:
    """Return the matrix from S x S heights to what slopes over five pixels differ from those over seven."""
    return _slopes(size, pixel_size, tuple(_SHORTER - _STENCIL))


@functools.lru_cache(maxsize=4)
def local_matrix(size: int, pixel_size: tuple[float, float]) -> Any:
    """Return the matrix from S x S heights to slopes along x and y and heights of inner pixels."""
    from scipy.sparse import vstack

    return vstack([slope_matrix(size, pixel_size), _inner(size)]).tocsr()


@functools.cache
def _inner(size: int) -> Any:
    """Return the matrix from S x S heights to those of inner pixels, (n, S * S)."""
    from scipy.sparse import csr_matrix, kron

    inner = size - 2 * MARGIN
    keep = csr_matrix((np.ones(inner), (np.arange(inner), np.arange(inner) + MARGIN)), (inner, size))
    return kron(keep, keep).tocsr()


def _slopes(size: int, pixel_size: tuple[float, float], stencil: tuple[float, ...]) -> Any:
    """Return the matrix from S x S heights to slopes by a stencil."""
    from scipy.sparse import csr_matrix, diags, kron, vstack

    inner = size - 2 * MARGIN
    first = diags(list(stencil), list(range(2 * MARGIN + 1)), shape=(inner, size))
    keep = csr_matrix((np.ones(inner), (np.arange(inner), np.arange(inner) + MARGIN)), (inner, size))
    along_x, along_y = kron(keep, first), kron(first, keep)
    return vstack([along_x / pixel_size[0], along_y / -pixel_size[1]]).tocsr()


@functools.cache
def _smoothness(size: int) -> Any:
    """Return the matrix of the sum of squares of second differences of S x S heights."""
    from scipy.sparse import diags, identity, kron

    second = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(size - 2, size))
    square, eye = second.T @ second, identity(size)
    return (kron(square, eye) + kron(eye, square) + 1e-3 * identity(size * size)).tocsc()


class _Band(NamedTuple):
    """Where the entries of the system of S x S heights are, and how they follow from weights of pixels."""

    places: NDArray[np.intp]  # (m,): in the blocks of `HeightSystem`
    of_pixels: Any  # (m, 6 n): from the weights of `PRODUCTS` of slopes and heights of inner pixels
    smooth: Doubles  # (m,): entries of second differences
    diagonal: NDArray[np.intp]  # (S * S,): which entries are on the diagonal


@functools.lru_cache(maxsize=4)
def _band(size: int, pixel_size: tuple[float, float]) -> _Band:
    from scipy.sparse import coo_matrix

    slopes, inner = slope_matrix(size, pixel_size), _inner(size)
    count = inner.shape[0]
    places_of = [*slopes.indices.reshape(2, count, -1), inner.indices.reshape(count, 1)]
    factors = [*slopes.data.reshape(2, count, -1), inner.data.reshape(count, 1)]
    parts = []
    for kind, pair in enumerate(PRODUCTS):
        for first, second in {pair, pair[::-1]}:
            products = factors[first][:, :, np.newaxis] * factors[second][:, np.newaxis]
            weight = np.broadcast_to(
                np.arange(count)[:, np.newaxis, np.newaxis] + kind * count, products.shape
            )
            row = np.broadcast_to(places_of[first][:, :, np.newaxis], products.shape)
            column = np.broadcast_to(places_of[second][:, np.newaxis], products.shape)
            parts.append([values.ravel() for values in (row, column, products, weight)])
    smooth = _smoothness(size).tocoo()
    parts.append([smooth.row, smooth.col, smooth.data, np.full(smooth.nnz, len(PRODUCTS) * count)])
    row, column, values, weight = (np.concatenate(each) for each in zip(*parts, strict=True))
    kept = (row >= column) & (values != 0)
    row, column, values, weight = (each[kept] for each in (row, column, values, weight))
    above = row // size - column // size
    places = ((column // size * (1 + _REACH) + above) * size + row % size) * size + column % size
    places, entry = np.unique(places, return_inverse=True)
    entries = coo_matrix((values, (entry, weight)), (len(places), len(PRODUCTS) * count + 1)).tocsc()
    on_diagonal = row == column
    diagonal = np.zeros(size * size, np.intp)
    diagonal[row[on_diagonal]] = entry[on_diagonal]
    return _Band(places, entries[:, :-1].tocsr(), entries[:, -1].toarray()[:, 0], diagonal)


@functools.cache
def _splines(size: int, spacing: int) -> Doubles:
    """Return the values of splines at pixels, (S, n)."""
    if spacing == 1:
        return np.eye(size)
    from scipy.interpolate import BSpline

    pieces = -(-size // spacing)
    knots = np.arange(-_DEGREE, pieces + _DEGREE + 1) * ((size - 1) / pieces)
    inside = np.minimum(np.arange(size), (size - 1) * (1 - 1e-12))
    return np.asarray(BSpline.design_matrix(inside, knots, _DEGREE).toarray())


class HeightSystem:
    """Symmetric system of the S x S heights of a window, with weights of inner pixels and of heights.

    It consists of blocks of S x S, one for each row of the window and each of the rows that depend on it, of
    which only those below the diagonal are kept.
    """

    def __init__(self, pixel_size: tuple[float, float], of_pixels: Doubles, of_heights: Doubles) -> None:
        """Take the weights of inner pixels by `PRODUCTS`, (6, n), and of heights, (S * S,)."""
        size = self._size = math.isqrt(len(of_heights))
        band = _band(size, pixel_size)
        entries = band.of_pixels @ of_pixels.ravel()
        usual = float(np.mean(entries[band.diagonal]))
        entries[band.diagonal] += of_heights + _LEAST * usual
        self._solvers = dict[int, HeightSolver]()
        self._blocks = np.zeros((size, 1 + _REACH, size, size))
        self._blocks.ravel()[band.places] = entries + _SMOOTH * usual * band.smooth

    def solver(self, spacing: int) -> HeightSolver:
        """Return the solver for heights that are splines, which is decomposed once."""
        if spacing not in self._solvers:
            splines = _splines(self._size, spacing)
            blocks = self._blocks if spacing == 1 else self._projected(splines, spacing)
            self._solvers[spacing] = HeightSolver(splines, blocks)
        return self._solvers[spacing]

    def _projected(self, splines: Doubles, spacing: int) -> Doubles:
        """Return the blocks of the system of splines."""
        blocks = self._blocks.copy()
        blocks[:, 0] += np.swapaxes(np.tril(blocks[:, 0], -1), 1, 2)
        blocks = np.matmul(splines.T, np.matmul(blocks, splines))  # of columns
        blocks = _of_rows(splines, blocks, -(-_REACH // spacing) + _DEGREE)
        diagonal = np.einsum("nii->ni", blocks[:, 0])
        diagonal += _LEAST * np.mean(diagonal)  # splines that hardly any pixel shows
        return blocks


def _of_rows(splines: Doubles, blocks: Doubles, reach: int) -> Doubles:
    """Return the blocks of a system of splines from those of rows of pixels, (S, 1 + _REACH, n, n)."""
    size, count = splines.shape
    reach = min(reach, count - 1)
    found = np.zeros((count, 1 + reach, count, count))
    padded = np.pad(splines, ((0, 0), (0, reach)))
    for number in range(count):
        share = padded[:, number : number + 1 + reach]  # of this spline and those below it
        for below in range(1 + _REACH):
            upper, lower = slice(0, size - below), slice(below, size)
            turns = ((upper, lower, False), (lower, upper, True)) if below else ((upper, upper, False),)
            for here, there, transposed in turns:
                used = np.flatnonzero(splines[here, number])
                if not used.size:
                    continue
                weight = share[there][used] * splines[here, number][used, np.newaxis]
                part = blocks[used, below]
                part = np.swapaxes(part, 1, 2) if transposed else part
                found[number] += (weight.T @ part.reshape(len(used), -1)).reshape(found[number].shape)
    return found


class HeightSolver:
    """Cholesky factor L of the system of the coefficients of heights.

    It consists of blocks, one for each row of coefficients, that are too small for linear algebra to start
    threads, which would wait for those of other users and of OpenCL.
    """

    def __init__(self, splines: Doubles, blocks: Doubles) -> None:
        """Decompose the blocks of a system, (n, 1 + R, n, n)."""
        self._splines = splines
        count, self._reach = len(blocks), blocks.shape[1] - 1
        blocks = np.concatenate([blocks, np.zeros((self._reach, *blocks.shape[1:]))])
        self._inverse = np.empty((count, count, count))  # of blocks of L on the diagonal
        self._below = np.empty((count, self._reach, count, count))
        for number in range(count):
            self._inverse[number] = np.linalg.inv(np.linalg.cholesky(blocks[number, 0]))
            below = np.matmul(blocks[number, 1:], self._inverse[number].T, out=self._below[number])
            for further in range(self._reach):
                blocks[number + 1 + further, : self._reach - further] -= below[further:] @ below[further].T

    def forward(self, right: Doubles) -> Doubles:
        """Return L^-1 times right sides of heights, (S * S, k)."""
        size = len(self._splines)
        rows = right.reshape(size, size, -1)
        if size != len(self._inverse):
            rows = np.einsum("rR,rck->Rck", self._splines, rows, optimize=True)
            rows = np.matmul(self._splines.T, rows)
        rows = self._rows(rows)
        for number, inverse in enumerate(self._inverse):
            rows[number] = inverse @ rows[number]
            rows[number + 1 : number + 1 + self._reach] -= self._below[number] @ rows[number]
        return rows[: len(self._inverse)].reshape(-1, right.shape[1])

    def backward(self, right: Doubles) -> Doubles:
        """Return the heights, (S * S, k), of L^-T times right sides."""
        count, size = len(self._inverse), len(self._splines)
        rows = self._rows(right.reshape(count, count, -1))
        for number in reversed(range(count)):
            further = rows[number + 1 : number + 1 + self._reach]
            rows[number] -= np.sum(self._below[number].transpose(0, 2, 1) @ further, axis=0)
            rows[number] = self._inverse[number].T @ rows[number]
        rows = rows[:count]
        if size != count:
            rows = np.matmul(self._splines, rows)
            rows = np.einsum("rR,Rck->rck", self._splines, rows, optimize=True)
        return rows.reshape(size * size, -1)

    def _rows(self, right: Doubles) -> Doubles:
        return np.concatenate([right, np.zeros((self._reach, *right.shape[1:]))])
