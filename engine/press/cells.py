"""A press in cells of many pixels, as the search for the elastomer's correction sees it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Doubles = NDArray[np.float64]
Mask = NDArray[np.bool_]

_CELLS = 32  # along a side of what turned light, were it square
_AROUND = 2  # cells beyond it
_MARGIN = 6  # cells beyond the picture's border, where the object reaches it
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

    def places(self, shape: tuple[int, ...]) -> tuple[Doubles, Doubles]:
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
        (top, bottom), (left, right) = self._margins
        return values[top : self.shape[0] - bottom, left : self.shape[1] - right]

    def outward(self, mask: Mask) -> Mask:
        """Go on beyond the picture with what a map of the cells inside has at its border."""
        return np.pad(mask, self._margins, "edge")

    @property
    def _margins(self) -> list[tuple[int, int]]:
        """Cells beyond the picture, before and behind it."""
        return [
            (ahead, count - ahead - (some.stop - some.start) // block)
            for some, block, ahead, count in zip(self.box, self.block, self.before, self.shape, strict=True)
        ]

    def _blocks(self, values: Doubles, beyond: float = np.nan) -> Doubles:
        """Return the box's pixels as (rows of cells, rows, columns of cells, columns)."""
        (rows, columns), (down, across) = (some.stop - some.start for some in self.box), self.block
        part = values[self.box]
        missing = (0, rows - part.shape[0]), (0, columns - part.shape[1])
        full = np.pad(part, missing, constant_values=beyond)
        return full.reshape(rows // down, down, columns // across, across)

    def _with_margin(self, values: Doubles) -> Doubles:
        return np.pad(values, self._margins, constant_values=np.nan)


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
        ahead = _MARGIN if first == 0 else 0
        behind = _MARGIN if last == size - 1 else 0
        box.append(slice(int(start), int(start + count * pixels)))
        block.append(pixels)
        before.append(ahead)
        shape.append(count + ahead + behind)
    return Cells((box[0], box[1]), (block[0], block[1]), (before[0], before[1]), (shape[0], shape[1]))


def touched(height: Doubles, dark: Mask, hidden: Mask) -> Mask:
    """Return which cells belong to the object's surface, by how the sheet around dark ones lies.

    Dark cells are part of it if what is around them rises towards them, as to a flat top; if it falls, they
    are the sheet that nothing touches. Small gaps are part of it, and cells that were light before the first
    frame.
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
