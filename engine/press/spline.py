"""Smooth surfaces over a box of pixels: products of cubic B-splines with evenly spaced knots."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles
from mirrorskin.kernels.numerics.least_squares import huber

if TYPE_CHECKING:
    from scipy import sparse


# Coefficients of t^0 to t^3 of the four splines that overlap a cell; t is 0 to 1 across the cell.
_PIECES = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6
_ORDER = 3  # order of the penalised derivatives; those of a paraboloid are 0
_PULL = 1e-3  # weight of the middle of an interval, relative to that of its ends
_ITERATIONS = 20  # maximum number of iterations
_HEAVIEST = 1e4  # largest weight of a pixel, relative to a typical one
_LAST_CHANGE = 0.01  # half-widths: changes of the surface below this end the iterations
_LARGEST = 2.0  # half-widths: limit of a pixel's excess in the misfit
_FAR, _PATIENCE = (
    1.0,
    3,
)  # misfit above which the iterations are stopped, and number of the first iteration to be tested
_SPLINES = 8  # along each side of the grid, if it were square
_FEWEST_PIECES = 3
_RIDGE = 1e-13  # share of the diagonal that is added to keep matrices regular


class Fit(NamedTuple):
    """A smooth surface: its heights at the samples, its splines' factors, and its misfit.

    The misfit is the RMS distance from the intervals, in half-widths.
    """

    height: Doubles
    factors: Doubles
    misfit: float


class _Axis:
    """Cubic B-splines with evenly spaced knots, from the first to the last of some equidistant places."""

    def __init__(self, places: int, spacing: float, pieces: int) -> None:
        self._places, self._span, self._pieces = places, (places - 1) * spacing, pieces

    def values(self, places: Doubles | None = None, order: int = 0) -> Doubles:
        """Return the splines, (n, pieces + 3), or their derivatives, at fractional places; or at all."""
        if places is None:
            places = np.arange(float(self._places))
        places = np.clip(places * (self._pieces / (self._places - 1)), 0, self._pieces)
        piece = np.minimum(places.astype(np.intp), self._pieces - 1)
        powers = np.zeros((len(places), 4))
        for power in range(order, 4):
            powers[:, power] = math.perm(power, order) * (places - piece) ** (power - order)
        values = np.zeros((len(places), self._pieces + 3))
        first = piece[:, np.newaxis]
        values[np.arange(len(places))[:, np.newaxis], first + np.arange(4)] = powers @ _PIECES.T
        return values * (self._pieces / self._span) ** order

    def products(self, order: int) -> Doubles:
        """Return the integrals of the products of two splines' derivatives, (pieces + 3, pieces + 3)."""
        powers = np.arange(4 - order)
        parts = _PIECES[:, order:] * [math.perm(int(power) + order, order) for power in powers]
        block = parts @ (1 / (powers[:, np.newaxis] + powers + 1)) @ parts.T
        matrix = np.zeros((self._pieces + 3, self._pieces + 3))
        for piece in range(self._pieces):
            matrix[piece : piece + 4, piece : piece + 4] += block
        return matrix * (self._pieces / self._span) ** (2 * order - 1)


def _roughness(axes: list[_Axis], multiply: Callable[..., Doubles]) -> Doubles:
    """Return the quadratic form of the integral of the squared third derivatives, over all directions.

    ``multiply`` combines the forms of both axes.
    """
    y, x = axes
    parts = [
        math.comb(_ORDER, order) * multiply(y.products(order), x.products(_ORDER - order))
        for order in range(_ORDER + 1)
    ]
    return np.asarray(np.sum(parts, axis=0))


class Spline:
    """Cubic splines over a box of pixels, from the centre of its first pixel to that of its last.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    spacing : (float, float)
        Distances of rows and of columns, in any unit.
    cells : (int, int)
        Numbers of cells between knots, along y and x.
    strides : (int, int)
        Rows and columns from one sample to the next, starting with the first pixel.
    """

    def __init__(
        self,
        shape: tuple[int, int],
        spacing: tuple[float, float],
        cells: tuple[int, int],
        strides: tuple[int, int] = (1, 1),
    ) -> None:
        self._axes = [_Axis(*axis) for axis in zip(shape, spacing, cells, strict=True)]
        self._all = [axis.values() for axis in self._axes]
        self._y, self._x = (values[::stride] for values, stride in zip(self._all, strides, strict=True))
        self._down, self._across = (
            np.nonzero(np.triu(np.tri(values.shape[1], k=3), -3)) for values in (self._y, self._x)
        )  # pairs of splines that share a cell
        self._pairs_y, self._pairs_x = (
            values[:, first] * values[:, second]
            for values, (first, second) in ((self._y, self._down), (self._x, self._across))
        )
        columns = self._x.shape[1]
        self._entries = tuple(
            np.add.outer(down * columns, across)
            for down, across in zip(self._down, self._across, strict=True)
        )

    def roughness(self) -> Doubles:
        """Return the quadratic form of the integral of the squared third derivatives, over all directions."""
        return _roughness(self._axes, lambda y, x: np.outer(y[self._down], x[self._across]))

    def squares(self, weights: Doubles) -> Doubles:
        """Return the quadratic form of the sum over the samples of weights times the squared surface."""
        return _product(self._pairs_y.T, _product(weights, self._pairs_x))

    def lowest(self, form: Doubles, values: Doubles) -> Doubles:
        """Return the factors that minimise half a quadratic form less the sum of values times the surface."""
        right = _product(self._y.T, _product(values, self._x))
        matrix = np.zeros((right.size,) * 2)
        matrix[self._entries] = form
        matrix[np.diag_indices_from(matrix)] *= 1 + _RIDGE
        return _solve_banded(matrix, right.ravel(), _ORDER * right.shape[1]).reshape(right.shape)

    def at_samples(self, factors: Doubles) -> Doubles:
        """Return the surface at the samples."""
        return _product(_product(self._y, factors), self._x.T)

    def over(self, factors: Doubles, part: tuple[slice, slice]) -> Doubles:
        """Return the surface at all pixels of a part of the box."""
        return _product(_product(self._all[0][part[0]], factors), self._all[1][part[1]].T)


class CellSplines:
    """Cubic splines over cells, from the centre of the first cell to that of the last.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of cells, 2 or more of each.
    spacing : (float, float)
        Distances of rows and of columns, mm.

    Attributes
    ----------
    basis : csr_matrix, (H W, m)
        Values of the splines at the cells.
    slopes : (csr_matrix, csr_matrix)
        Derivatives of the splines down the picture and across it, 1/mm.
    """

    def __init__(self, shape: tuple[int, int], spacing: tuple[float, float]) -> None:
        from scipy import sparse

        self._shape = shape
        spans = [(count - 1) * step for count, step in zip(shape, spacing, strict=True)]
        self._area = spans[0] * spans[1]
        self._axes = [
            _Axis(count, step, max(_FEWEST_PIECES, min(round(span * _SPLINES / self._area**0.5), count // 2)))
            for count, step, span in zip(shape, spacing, spans, strict=True)
        ]
        (y, down), (x, across) = (
            [sparse.csr_matrix(axis.values(order=order)) for order in (0, 1)] for axis in self._axes
        )
        self.basis: sparse.csr_matrix = sparse.csr_matrix(sparse.kron(y, x))
        self.slopes: tuple[sparse.csr_matrix, sparse.csr_matrix] = (
            sparse.csr_matrix(sparse.kron(down, x)),
            sparse.csr_matrix(sparse.kron(y, across)),
        )

    def surface(self, factors: Doubles) -> Doubles:
        """Return a surface at the cells, (H, W), mm."""
        return np.asarray((self.basis @ factors).reshape(self._shape))

    def at(self, factors: Doubles, rows: Doubles, columns: Doubles) -> Doubles:
        """Return a surface at fractional rows and columns of cells."""
        y, x = (axis.values(places) for axis, places in zip(self._axes, (rows, columns), strict=True))
        return _product(_product(y, factors.reshape(y.shape[1], -1)), x.T)

    def roughness(self) -> Doubles:
        """Return the quadratic form of the mean squared third derivatives, over all directions, 1/mm^4."""
        return _roughness(self._axes, lambda y, x: np.asarray(np.kron(y, x))) / self._area


def fit_within(spline: Spline, low: Doubles, high: Doubles, stiffness: float) -> Fit:
    """Fit the smoothest surface that stays within the pixels' intervals.

    The excess beyond an interval is penalised by Huber's loss with a limit of one half-width, so that wrong
    heights do not bend the surface: iteratively reweighted least squares, with the violated ends as targets.

    Intervals end at ``low`` and ``high``, (H, W), mm; both are NaN without a height, and ``high`` is infinite
    if only a lower bound is given. At least one pixel has both. ``stiffness`` is the weight of the squared
    third derivatives relative to that of the mean squared excess.
    """
    bounded, both = np.isfinite(low), np.isfinite(low) & np.isfinite(high)
    half = np.where(both, (high - low) / 2, np.nan)
    typical = float(np.median(half[both]))
    half = np.where(both, half, typical)
    datum = float(np.mean(low[both] + half[both]))
    low, high = np.where(bounded, low - datum, -np.inf), np.where(both, high - datum, np.inf)
    middle = np.where(both, low + half, 0.0)
    weights = np.where(bounded, np.minimum((typical / half) ** 2, _HEAVIEST), 0.0)
    rough = spline.roughness() * (stiffness * np.sum(weights[both]))
    height, excess = middle, np.zeros_like(half)
    pull = np.where(both, weights, 0.0)  # in the first iteration, the middles are fitted
    for step in range(_ITERATIONS):
        draw = np.where(excess > 0, weights * huber(1.0).weights(excess), 0.0)
        ends = np.where(excess > 0, np.clip(height, low, high), 0.0)
        before = height
        factors = spline.lowest(rough + spline.squares(pull + draw), pull * middle + draw * ends)
        height = spline.at_samples(factors)
        excess = np.abs(np.clip(height, low, high) - height) / half
        misfit = float(np.sqrt(np.mean(np.minimum(excess[bounded], _LARGEST) ** 2)))
        moved = np.max(np.abs(height - before)[bounded]) / typical
        if step and (moved < _LAST_CHANGE or (step >= _PATIENCE and misfit > _FAR)):
            break
        pull = np.where(both, _PULL * weights, 0.0)
    return Fit(height + datum, factors + datum, misfit)  # the splines sum to 1


def _solve_banded(matrix: Doubles, right: Doubles, size: int) -> Doubles:
    """Solve a block-tridiagonal system with blocks of a size."""
    blocks = [slice(start, start + size) for start in range(0, len(right), size)]
    pivot, rest = matrix[blocks[0], blocks[0]], right[blocks[0]]
    reduced = []
    for block, following in pairwise([*blocks, slice(0, 0)]):
        reduced.append(np.linalg.solve(pivot, np.column_stack([matrix[block, following], rest])))
        if following.stop:
            below = _product(matrix[following, block], reduced[-1])
            pivot, rest = matrix[following, following] - below[:, :-1], right[following] - below[:, -1]
    parts = [reduced[-1][:, -1]]
    for part in reduced[-2::-1]:
        parts.append(part[:, -1] - part[:, :-1] @ parts[-1])
    return np.concatenate(parts[::-1])


def _product(first: NDArray[Any], second: NDArray[Any]) -> Doubles:
    """Return a matrix product, computed by one thread: at this size, threads cost more than they save."""
    nothing: Any = None
    return np.asarray(cv2.gemm(first, second, 1.0, nothing, 0.0))
