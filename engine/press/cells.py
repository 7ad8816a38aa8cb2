"""Blocks of pixels, called cells: the resolution of the correction for the elastomer."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mirrorskin.kernels.array_types import Doubles

Mask = NDArray[np.bool_]

_CELLS = 32  # along each side of the lit area, if it were square
_LIT_MARGIN = 2  # cells around the lit area
_OUTER_CELLS = 6  # cells outside the picture, where the object reaches its border
_MIN_COVERAGE = 0.5  # minimum share of a cell's pixels with a height
_SMALL = 4  # cells: gaps up to this size belong to the surface


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Cells that cover the lit part of the picture, with a margin; pairs are rows and columns."""

    box: tuple[slice, slice]  # pixels that are covered by cells
    block: tuple[int, int]  # pixels per cell
    before: tuple[int, int]  # cells outside the picture, above and to the left of the box
    shape: tuple[int, int]  # number of cells, including those outside the picture

    def means(self, values: Doubles) -> Doubles:
        """Return the mean of each cell's finite pixels, NaN where less than half are finite."""
        blocks = self._blocks(values)
        finite = np.isfinite(blocks)
        count = finite.sum(axis=(1, 3))
        sums = np.where(finite, blocks, 0.0).sum(axis=(1, 3))
        enough = count >= max(1.0, _MIN_COVERAGE * self.block[0] * self.block[1])
        return self._with_margin(np.where(enough, sums / np.maximum(count, 1), np.nan))

    def share(self, mask: Mask) -> Doubles:
        """Return the share of True pixels in each cell."""
        return self._with_margin(self._blocks(mask.astype(np.float64), 0.0).mean(axis=(1, 3)))

    def places(self, shape: tuple[int, ...]) -> tuple[Doubles, Doubles]:
        """Return the box's rows and columns of pixels, in cells from the centre of the first cell."""
        rows, columns = (
            (np.arange(part.start, min(part.stop, size)) - part.start + 0.5) / block - 0.5 + before
            for part, size, block, before in zip(self.box, shape, self.block, self.before, strict=True)
        )
        return rows, columns

    def centres(self) -> tuple[Doubles, Doubles]:
        """Return the rows and columns of cells, in units of cells, from the picture's upper left corner."""
        rows, columns = (
            part.start / block + np.arange(count) - before + 0.5
            for part, block, count, before in zip(self.box, self.block, self.shape, self.before, strict=True)
        )
        return rows, columns

    def inside(self, values: NDArray[Any]) -> NDArray[Any]:
        """Remove the cells outside the picture."""
        (top, bottom), (left, right) = self._margins
        return values[top : self.shape[0] - bottom, left : self.shape[1] - right]

    def outward(self, mask: Mask) -> Mask:
        """Add cells outside the picture, with the value of the nearest cell inside."""
        return np.pad(mask, self._margins, "edge")

    @property
    def _margins(self) -> list[tuple[int, int]]:
        """Numbers of cells outside the picture, before and after the box along each axis."""
        return [
            (before, count - before - (part.stop - part.start) // block)
            for part, block, before, count in zip(self.box, self.block, self.before, self.shape, strict=True)
        ]

    def _blocks(self, values: Doubles, beyond: float = np.nan) -> Doubles:
        """Return the box's pixels as (rows of cells, rows, columns of cells, columns)."""
        (rows, columns), (down, across) = (part.stop - part.start for part in self.box), self.block
        values = values[self.box]
        missing = (0, rows - values.shape[0]), (0, columns - values.shape[1])
        values = np.pad(values, missing, constant_values=beyond)
        return values.reshape(rows // down, down, columns // across, across)

    def _with_margin(self, values: Doubles) -> Doubles:
        return np.pad(values, self._margins, constant_values=np.nan)


def split_into_cells(lit: Mask, pixel_size: tuple[float, float]) -> Cells:
    """Divide the lit part of a picture into nearly square cells; at least one pixel must be lit."""
    spacing = pixel_size[1], pixel_size[0]
    ends = [np.flatnonzero(lit.any(axis=axis))[[0, -1]] for axis in (1, 0)]
    spans = [(last - first + 1) * step for (first, last), step in zip(ends, spacing, strict=True)]
    cell = math.sqrt(spans[0] * spans[1]) / _CELLS
    axes = []
    for (first, last), step, size in zip(ends, spacing, lit.shape, strict=True):
        block = max(1, round(cell / step))
        start = max(0, first - _LIT_MARGIN * block)
        count = math.ceil((min(size, last + 1 + _LIT_MARGIN * block) - start) / block)
        before = _OUTER_CELLS if first == 0 else 0
        after = _OUTER_CELLS if last == size - 1 else 0
        axes.append((slice(int(start), int(start + count * block)), block, before, count + before + after))
    rows, columns = axes
    return Cells(*zip(rows, columns, strict=True))


def touched(height: Doubles, dark: Mask, hidden: Mask) -> Mask:
    """Return which cells belong to the object's surface.

    These are lit cells, and hidden cells, which were light before the first frame. A group of dark cells
    belongs to the surface if the heights around it increase towards it, as around a flat top; otherwise it is
    untouched sheet. Small gaps belong to the surface.
    """
    lit = np.isfinite(height)
    surface = lit | hidden
    count, groups = cv2.connectedComponents((~surface).view(np.uint8), connectivity=4)
    sizes = np.bincount(groups.ravel(), minlength=count)
    square = np.ones((3, 3), np.uint8)
    for number in range(1, count):
        group = groups == number
        near, far = (cv2.dilate(group.view(np.uint8), square, iterations=steps) > 0 for steps in (1, 3))
        rim, ring = height[near & lit], height[far & ~near & lit]
        rises = rim.size and ring.size and rim.mean() > ring.mean()
        if sizes[number] <= _SMALL or (np.any(group & dark) and rises):
            surface |= group
    return surface
