"""Smooth surfaces over a box of pixels: products of cubic B-splines with evenly spaced knots."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Doubles = NDArray[np.float64]

# Of the four splines that live in a cell: the factors of t^0 to t^3, t from 0 to 1 across the cell.
_PIECES = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
_ORDER = 3  # of the derivatives that are kept small: a quadratic cap costs nothing
_PULL = 1e-3  # weight of an interval's middle beside that of its ends
_ITERATIONS = 20
_HEAVIEST = 1e4  # weight of a pixel in units of the typical one's
_SETTLED = 0.01  # half-widths that the surface may still move
_LARGEST = 2.0  # half-widths that one pixel counts for in the misfit
_FAR, _PATIENCE = 1.0, 3  # a misfit that is not mended any more after so many steps
_SPLINES = 8  # along a side, were it square
_FEWEST_PIECES = 3
_RIDGE = 1e-13  # of the diagonal, so that rounding leaves no matrix singular


class Fit(NamedTuple):
    """A smooth surface, (H, W), and the RMS by which it leaves its intervals, in their half-widths."""

    height: Doubles
    misfit: float


class Spline:
    """Cubic splines over a box of pixels, from the centre of its first pixel to that of its last.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    spacing : (float, float)
        Distance of rows, and of columns, in any unit.
    cells : (int, int)
        Between knots, along y and x.
    """

    def __init__(self, shape: tuple[int, int], spacing: tuple[float, float], cells: tuple[int, int]) -> None:
        self._spans = [(length - 1) * step for length, step in zip(shape, spacing, strict=True)]
        self._cells = cells
        y, x = (
            spline_values(np.linspace(0, count, length), count)
            for length, count in zip(shape, cells, strict=True)
        )
        rows, columns = y.shape[1], x.shape[1]
        self._down, self._across = _overlapping(rows), _overlapping(columns)
        first, second = (
            np.add.outer(down * columns, across).ravel()
            for down, across in zip(self._down, self._across, strict=True)
        )
        self._order = np.lexsort((first, second))
        self._rows = first[self._order]
        self._starts = np.searchsorted(second[self._order], np.arange(rows * columns + 1))
        # All is sparse, also because that needs no BLAS, whose threads wait for each other on small tasks.
        self._y, self._x = sparse.csr_matrix(y), sparse.csr_matrix(x)
        self._pairs_y, self._pairs_x = (
            sparse.csr_matrix(values[:, first] * values[:, second])
            for values, (first, second) in ((y, self._down), (x, self._across))
        )

    def roughness(self) -> Doubles:
        """Return the form of the integral of the squared third derivatives, in all directions alike."""
        along = [
            [spline_products(count, order) * (count / span) ** (2 * order - 1) for order in range(_ORDER + 1)]
            for count, span in zip(self._cells, self._spans, strict=True)
        ]
        parts = [
            math.comb(_ORDER, order)
            * np.outer(along[0][order][self._down], along[1][_ORDER - order][self._across])
            for order in range(_ORDER + 1)
        ]
        return np.asarray(np.sum(parts, axis=0))

    def squares(self, weights: Doubles) -> Doubles:
        """Return the form of the sum over pixels of weights, (H, W), times the squared surface."""
        return np.asarray(self._pairs_y.T @ (weights @ self._pairs_x))

    def lowest(self, form: Doubles, values: Doubles) -> Doubles:
        """Return the surface u, (H, W), where half a form of it less the sum of values times u is lowest."""
        entries = np.ravel(form)[self._order], self._rows, self._starts
        matrix = sparse.csc_matrix(entries, shape=(len(self._starts) - 1,) * 2)
        matrix.setdiag((1 + _RIDGE) * matrix.diagonal())
        solver = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        factors = solver.solve(np.ravel(self._y.T @ (values @ self._x)))
        return np.asarray((self._y @ factors.reshape(self._y.shape[1], -1)) @ self._x.T)


class CellSplines:
    """Cubic splines over cells, from the first one's centre to the last one's.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of cells, 2 or more of each.
    spacing : (float, float)
        Distance of rows, and of columns, mm.

    Attributes
    ----------
    basis : csr_matrix, (H W, m)
        The splines at the cells.
    slopes : (csr_matrix, csr_matrix)
        Their derivatives down the picture and across it, 1/mm.
    """

    def __init__(self, shape: tuple[int, int], spacing: tuple[float, float]) -> None:
        self._shape = shape
        self._spans = [(count - 1) * step for count, step in zip(shape, spacing, strict=True)]
        size = math.sqrt(self._spans[0] * self._spans[1]) / _SPLINES
        self._pieces = [
            max(_FEWEST_PIECES, min(round(span / size), count // 2))
            for span, count in zip(self._spans, shape, strict=True)
        ]
        (y, down), (x, across) = (
            [self._values(np.arange(float(count)), axis, order) for order in (0, 1)]
            for axis, count in enumerate(shape)
        )
        self.basis = sparse.csr_matrix(sparse.kron(y, x))
        self.slopes = sparse.csr_matrix(sparse.kron(down, x)), sparse.csr_matrix(sparse.kron(y, across))

    def surface(self, factors: Doubles) -> Doubles:
        """Return a surface at the cells, (H, W), mm."""
        return np.asarray((self.basis @ factors).reshape(self._shape))

    def at(self, factors: Doubles, rows: Doubles, columns: Doubles) -> Doubles:
        """Return a surface on rows and columns that lie at places between the cells."""
        grid = factors.reshape(self._pieces[0] + 3, -1)
        return np.asarray((self._values(rows, 0) @ grid) @ self._values(columns, 1).T)

    def roughness(self) -> Doubles:
        """Return the form of the mean squared third derivatives, in all directions alike, 1/mm^4."""
        along = [
            [spline_products(count, order) * (count / span) ** (2 * order - 1) for order in range(4)]
            for count, span in zip(self._pieces, self._spans, strict=True)
        ]
        parts = [math.comb(3, order) * np.kron(along[0][order], along[1][3 - order]) for order in range(4)]
        return np.asarray(np.sum(parts, axis=0) / (self._spans[0] * self._spans[1]))

    def _values(self, places: Doubles, axis: int, order: int = 0) -> sparse.csr_matrix:
        """Return an axis' splines, or their derivatives, 1/mm, at places in cells."""
        count, pieces = self._shape[axis], self._pieces[axis]
        values = spline_values(places * pieces / (count - 1), pieces, order)
        return sparse.csr_matrix(values * (pieces / self._spans[axis]) ** order)


def fit_within(spline: Spline, low: Doubles, high: Doubles, stiffness: float) -> Fit:
    """Fit the smoothest surface that stays within the pixels' intervals.

    What leaves an interval costs its square, and beyond another half-width only its size (Huber), so that
    wrong heights do not bend the surface: iteratively reweighted least squares, in which the surface is drawn
    to the ends that it has passed. The intervals' ends, (H, W), mm, are NaN where nothing is known, and the
    upper one is infinite where only the lower one is; at least one pixel has both. Stiffness is the cost of
    the squared third derivatives beside that of the mean squared excess.
    """
    known, both = np.isfinite(low), np.isfinite(low) & np.isfinite(high)
    half = np.where(both, (high - low) / 2, np.nan)
    typical = float(np.median(half[both]))
    half = np.where(both, half, typical)
    datum = float(np.mean(low[both] + half[both]))
    low, high = np.where(known, low - datum, -np.inf), np.where(both, high - datum, np.inf)
    middle = np.where(both, low + half, 0.0)
    weights = np.where(known, np.minimum((typical / half) ** 2, _HEAVIEST), 0.0)
    rough = spline.roughness() * (stiffness * np.sum(weights[both]))
    height, excess = middle, np.zeros_like(half)
    pull = np.where(both, weights, 0.0)  # at first all intervals draw to their middles
    for step in range(_ITERATIONS):
        draw = np.where(excess > 0, weights / np.maximum(excess, 1.0), 0.0)
        ends = np.where(excess > 0, np.clip(height, low, high), 0.0)
        before = height
        height = spline.lowest(rough + spline.squares(pull + draw), pull * middle + draw * ends)
        excess = np.abs(np.clip(height, low, high) - height) / half
        moved = np.max(np.abs(height - before)[known]) / typical
        if step and (moved < _SETTLED or (step >= _PATIENCE and _misfit(excess[known]) > _FAR)):
            break
        pull = np.where(both, _PULL * weights, 0.0)
    return Fit(height + datum, _misfit(excess[known]))


def _misfit(excess: Doubles) -> float:
    """Return the RMS of excesses in half-widths, of which a few may be of any size."""
    return float(np.sqrt(np.mean(np.minimum(excess, _LARGEST) ** 2)))


def spline_values(places: Doubles, pieces: int, order: int = 0) -> Doubles:
    """Return an axis' splines, or their derivatives, at places from 0 to ``pieces``: (n, pieces + 3)."""
    places = np.clip(places, 0, pieces)
    piece = np.minimum(places.astype(np.intp), pieces - 1)
    powers = np.zeros((len(places), 4))
    for power in range(order, 4):
        powers[:, power] = math.perm(power, order) * (places - piece) ** (power - order)
    values = np.zeros((len(places), pieces + 3))
    values[np.arange(len(places))[:, np.newaxis], piece[:, np.newaxis] + np.arange(4)] = powers @ _PIECES.T
    return values


def spline_products(pieces: int, order: int) -> Doubles:
    """Return the integrals of products of two splines' derivatives, with pieces of length 1."""
    powers = np.arange(4 - order)
    factors = [math.perm(int(power) + order, order) for power in powers]
    parts = _PIECES[:, order:] * factors
    one = parts @ (1 / (powers[:, np.newaxis] + powers + 1)) @ parts.T
    matrix = np.zeros((pieces + 3, pieces + 3))
    for piece in range(pieces):
        matrix[piece : piece + 4, piece : piece + 4] += one
    return matrix


def _overlapping(count: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of splines, in any order, that share a cell."""
    first, second = np.nonzero(np.triu(np.tri(count, k=3), -3))
    return first, second
