"""What a press is seen through when its surface is looked for: coarse cells, and splines over them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.interpolate import BSpline

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CELLS = 32  # along a side of what turned light, were it square
_AROUND = 2  # cells beyond it
_BEYOND = 6  # cells beyond the picture's border, where the object goes on there
_SPLINES = 8  # along a side, were it square
_FEWEST = 3
_DEGREE, _ORDER = 3, 3  # cubic; third derivatives are kept small, so that a cap goes on as a cap
_SHARE = 0.5  # of a cell's pixels that must have turned light
_SMALL = 4  # cells of a gap that is no feature


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Blocks of pixels in the part of the picture that turned light, and a margin.

    Attributes
    ----------
    box : (slice, slice)
        The picture's rows and columns that are in cells.
    block : (int, int)
        A cell's rows and columns of pixels.
    before : (int, int)
        Cells above the box, and to its left, that lie beyond the picture.
    shape : (int, int)
        Rows and columns of cells, with those beyond the picture.
    """

    box: tuple[slice, slice]
    block: tuple[int, int]
    before: tuple[int, int]
    shape: tuple[int, int]

    def means(self, values: Doubles) -> Doubles:
        """Return the mean of each cell's finite pixels, NaN where less than half are finite."""
        blocks = self._blocks(values)
        finite = np.isfinite(blocks)
        count = finite.sum(axis=(1, 3))
        sums = np.where(finite, blocks, 0.0).sum(axis=(1, 3))
        enough = count >= max(1.0, _SHARE * self.block[0] * self.block[1])
        return self._with_margin(np.where(enough, sums / np.maximum(count, 1), np.nan))

    def share(self, mask: Mask) -> Doubles:
        """Return which share of each cell's pixels is True."""
        return self._with_margin(self._blocks(mask.astype(np.float64), 0.0).mean(axis=(1, 3)))

    def places(self, shape: tuple[int, int]) -> tuple[Doubles, Doubles]:
        """Return where the box's rows and columns of pixels lie, in cells from the first's centre."""
        rows, columns = (
            (np.arange(some.start, min(some.stop, size)) - some.start + 0.5) / block - 0.5 + before
            for some, size, block, before in zip(self.box, shape, self.block, self.before, strict=True)
        )
        return rows, columns

    def centres(self) -> tuple[Doubles, Doubles]:
        """Return how far rows and columns of cells lie from the picture's upper left corner, in cells."""
        rows, columns = (
            some.start / block + np.arange(count) - before + 0.5
            for some, block, count, before in zip(self.box, self.block, self.shape, self.before, strict=True)
        )
        return rows, columns

    def inside(self, values: NDArray[Any]) -> NDArray[Any]:
        """Cut off the cells beyond the picture."""
        (rows, columns), (top, left) = self._inner, self.before
        return values[top : top + rows, left : left + columns]

    def outward(self, mask: Mask) -> Mask:
        """Go on beyond the picture with what a map of the cells inside has at its border."""
        margins = [
            (ahead, whole - ahead - inner)
            for ahead, whole, inner in zip(self.before, self.shape, self._inner, strict=True)
        ]
        return np.pad(mask, margins, "edge")

    @property
    def _inner(self) -> tuple[int, int]:
        """Rows and columns of cells in the picture."""
        rows, columns = (
            (some.stop - some.start) // block for some, block in zip(self.box, self.block, strict=True)
        )
        return rows, columns

    def _blocks(self, values: Doubles, beyond: float = np.nan) -> Doubles:
        rows, columns = (some.stop - some.start for some in self.box)
        part = values[self.box]
        whole = np.full((rows, columns), beyond)
        whole[: part.shape[0], : part.shape[1]] = part
        down, across = self.block
        return whole.reshape(rows // down, down, columns // across, across)

    def _with_margin(self, values: Doubles) -> Doubles:
        whole = np.full(self.shape, np.nan)
        top, left = self.before
        whole[top : top + values.shape[0], left : left + values.shape[1]] = values
        return whole


def cut_into_cells(known: Mask, pixel_size: tuple[float, float]) -> Cells:
    """Cut what is known of a picture into cells that are about square; something must be known."""
    spacing = pixel_size[1], pixel_size[0]
    ends = [np.flatnonzero(known.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    spans = [(last - first + 1) * step for (first, last), step in zip(ends, spacing, strict=True)]
    cell = math.sqrt(spans[0] * spans[1]) / _CELLS
    box, block, before, shape = [], [], [], []
    for (first, last), step, size in zip(ends, spacing, known.shape, strict=True):
        pixels = max(1, round(cell / step))
        start = max(0, first - _AROUND * pixels)
        count = math.ceil((min(size, last + 1 + _AROUND * pixels) - start) / pixels)
        ahead = _BEYOND if first == 0 else 0
        behind = _BEYOND if last == size - 1 else 0
        box.append(slice(int(start), int(start + count * pixels)))
        block.append(pixels)
        before.append(ahead)
        shape.append(count + ahead + behind)
    return Cells((box[0], box[1]), (block[0], block[1]), (before[0], before[1]), (shape[0], shape[1]))


class Splines:
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
        self._shape, self._spacing = shape, spacing
        spans = [(count - 1) * step for count, step in zip(shape, spacing, strict=True)]
        size = math.sqrt(spans[0] * spans[1]) / _SPLINES
        self._pieces = [
            max(_FEWEST, min(round(span / size), count // 2))
            for span, count in zip(spans, shape, strict=True)
        ]
        rows, columns = (np.arange(count, dtype=np.float64) for count in shape)
        along = [
            [self._values(places, axis, order) for order in (0, 1)]
            for axis, places in enumerate((rows, columns))
        ]
        self.basis = sparse.csr_matrix(sparse.kron(along[0][0], along[1][0]))
        self.slopes = (
            sparse.csr_matrix(sparse.kron(along[0][1], along[1][0])) / spacing[0],
            sparse.csr_matrix(sparse.kron(along[0][0], along[1][1])) / spacing[1],
        )

    @property
    def count(self) -> int:
        """Of splines."""
        return int(self.basis.shape[1])

    def surface(self, factors: Doubles) -> Doubles:
        """Return a surface at the cells, (H, W), mm."""
        return np.asarray((self.basis @ factors).reshape(self._shape))

    def at(self, factors: Doubles, rows: Doubles, columns: Doubles) -> Doubles:
        """Return a surface on rows and columns that lie at places between the cells."""
        grid = factors.reshape(self._pieces[0] + _DEGREE, -1)
        return np.asarray((self._values(rows, 0) @ grid) @ self._values(columns, 1).T)

    def roughness(self) -> Doubles:
        """Return the form of the mean squared third derivatives, in all directions alike, 1/mm^4."""
        along = [[self._products(axis, order) for order in range(_ORDER + 1)] for axis in (0, 1)]
        parts = [
            math.comb(_ORDER, order) * np.kron(along[0][order], along[1][_ORDER - order])
            for order in range(_ORDER + 1)
        ]
        spans = [(count - 1) * step for count, step in zip(self._shape, self._spacing, strict=True)]
        return np.asarray(np.sum(parts, axis=0) / (spans[0] * spans[1]))

    def _knots(self, axis: int) -> Doubles:
        """Return the knots along an axis, in cells."""
        pieces = self._pieces[axis]
        return np.asarray(np.arange(-_DEGREE, pieces + _DEGREE + 1) * (self._shape[axis] - 1) / pieces)

    def _values(self, places: Doubles, axis: int, order: int = 0) -> sparse.csr_matrix:
        """Return an axis' splines, or their derivatives by the cell, at places."""
        inside = np.clip(places, 0, (self._shape[axis] - 1) * (1 - 1e-12))
        knots = self._knots(axis)
        splines = BSpline(knots, np.eye(len(knots) - _DEGREE - 1), _DEGREE)
        return sparse.csr_matrix(splines(inside, nu=order))

    def _products(self, axis: int, order: int) -> Doubles:
        """Return the integrals of products of two splines' derivatives along an axis."""
        step, knots = self._spacing[axis], self._knots(axis)
        ends = knots[_DEGREE:-_DEGREE]
        nodes, weights = np.polynomial.legendre.leggauss(_DEGREE + 1)
        width = ends[1] - ends[0]
        places = (ends[:-1, np.newaxis] + (nodes + 1) / 2 * width).ravel()
        splines = BSpline(knots, np.eye(len(ends) - 1 + _DEGREE), _DEGREE)
        values = splines(places, nu=order) / step**order
        share = np.tile(weights / 2 * width * step, len(ends) - 1)
        return np.asarray(np.einsum("ki,k,kj->ij", values, share, values))


def touched(height: Doubles, dark: Mask, hidden: Mask) -> Mask:
    """Tell which cells belong to the object's surface, by how the sheet around dark ones lies.

    Dark cells are part of it if what is around them rises towards them, as to a flat top; if it falls, they
    are the sheet that nothing touches. Small gaps are part of it.

    Parameters
    ----------
    height : ndarray, (H, W), float64
        Of cells that turned light; NaN elsewhere.
    dark : ndarray, (H, W), bool
        Cells that never turned light.
    hidden : ndarray, (H, W), bool
        Cells that were light before the first frame: surely part of it.
    """
    lit = np.isfinite(height)
    surface = lit | hidden
    groups, count = ndimage.label(~surface)
    sizes = np.bincount(groups.ravel(), minlength=count + 1)
    for number in range(1, count + 1):
        own = groups == number
        if sizes[number] <= _SMALL or (np.any(own & dark) and _rises_to(own, height)):
            surface |= own
    return surface


def _rises_to(own: Mask, height: Doubles) -> bool:
    """Tell whether the cells around some are higher than those a little farther off."""
    square = np.ones((3, 3), bool)
    near = ndimage.binary_dilation(own, square)
    far = ndimage.binary_dilation(own, square, iterations=3)
    lit = np.isfinite(height)
    rim, ring = height[near & lit], height[far & ~near & lit]
    return bool(rim.size and ring.size and rim.mean() > ring.mean())
