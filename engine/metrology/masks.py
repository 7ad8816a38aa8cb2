"""Parts of a height map that are left out of measures: pictures, polygons, heights and defects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.io import InputError
from mirrorskin.io.files.arrays import read_map
from mirrorskin.kernels.array_types import Doubles

Kept = NDArray[np.bool_]

_GROWN = 3  # pixels per side of the square by which defects are extended


@dataclass(frozen=True, slots=True)
class Heights:
    """What a mask is made from: heights, (H, W) mm, pixel centres, mm, and their distances from the form.

    ``outliers`` fits the form and returns which heights, (H, W), are outliers of it.
    """

    height: Doubles
    x: Doubles
    y: Doubles
    outliers: Callable[[], Kept]


class Mask(Protocol):
    """A choice of pixels."""

    def kept(self, heights: Heights) -> Kept:
        """Return which pixels, (H, W), are measured."""


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture or an array of the size of the map, in a file: pixels of 0 are left out."""

    path: str | Path

    def kept(self, heights: Heights) -> Kept:
        """Return which pixels are measured."""
        return _of_shape(read_map(Path(self.path)) != 0, heights.height.shape, str(self.path))


def inside_polygon(x: Doubles, y: Doubles, corners: ArrayLike) -> Kept:
    """Return which points, x of the columns and y of the rows, are inside a polygon, (H, W)."""
    outline = np.asarray(corners, np.float64)
    if outline.ndim != 2 or outline.shape[1] != 2 or len(outline) < 3:
        raise InputError("a polygon needs at least three corners, x and y in mm")
    (left, bottom), (right, top) = outline.min(axis=0), outline.max(axis=0)
    rows, columns = np.flatnonzero((y >= bottom) & (y <= top)), np.flatnonzero((x >= left) & (x <= right))
    across, up = np.meshgrid(x[columns], y[rows])
    inside = np.zeros(across.shape, bool)
    # A ray to the right crosses the outline an odd number of times from inside.
    for (x0, y0), (x1, y1) in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if y0 != y1:
            crossed = (y0 > up) != (y1 > up)
            inside ^= crossed & (across < x0 + (up - y0) * (x1 - x0) / (y1 - y0))
    found = np.zeros((len(y), len(x)), bool)
    found[np.ix_(rows, columns)] = inside
    return found


@dataclass(frozen=True, slots=True)
class Polygon:
    """A polygon, by its corners, x and y in mm from the picture's centre.

    Pixels whose centre is inside are left out; with ``only``, those outside.
    """

    corners: Sequence[tuple[float, float]]
    only: bool = False

    def kept(self, heights: Heights) -> Kept:
        """Return which pixels are measured."""
        inside = inside_polygon(heights.x, heights.y, self.corners)
        return inside if self.only else ~inside


@dataclass(frozen=True, slots=True)
class Levels:
    """Heights below or above a level, mm, are left out."""

    below: float | None = None
    above: float | None = None

    def kept(self, heights: Heights) -> Kept:
        """Return which pixels are measured."""
        with np.errstate(invalid="ignore"):
            left_out = np.zeros(heights.height.shape, bool)
            if self.below is not None:
                left_out |= heights.height < self.below
            if self.above is not None:
                left_out |= heights.height > self.above
        return ~left_out


@dataclass(frozen=True, slots=True)
class Defects:
    """Outliers of the form, such as dust and scratches, and the pixels next to them, are left out.

    Outliers are farther from the form than five standard deviations, estimated from the median distance, and
    at most 15 % of the heights; see `PointCloud.fit`.
    """

    def kept(self, heights: Heights) -> Kept:
        """Return which pixels are measured."""
        import cv2

        near = np.ones((_GROWN, _GROWN), np.uint8)
        return np.asarray(cv2.dilate(heights.outliers().astype(np.uint8), near) == 0)


Masks = Mask | Sequence[Mask] | ArrayLike
"""One mask or several; an array, (H, W), is True, or not 0, where to measure."""


def kept_by(masks: Masks, heights: Heights) -> Kept:
    """Return which pixels, (H, W), all masks keep."""
    kept = np.ones(heights.height.shape, bool)
    several = masks if isinstance(masks, list | tuple) and all(map(_is_mask, masks)) else [masks]
    for mask in several:
        kept &= mask.kept(heights) if _is_mask(mask) else _of_shape(np.asarray(mask) != 0, kept.shape, "mask")
    return kept


def in_millimetres(masks: Masks) -> bool:
    """Return whether a mask is stated by lengths."""
    several = masks if isinstance(masks, list | tuple) else [masks]
    return any(isinstance(mask, Polygon | Levels) for mask in several)


def _is_mask(value: object) -> TypeGuard[Mask]:
    return hasattr(value, "kept")


def _of_shape(kept: Kept, shape: tuple[int, ...], name: str) -> Kept:
    if kept.shape != shape:
        raise InputError(
            f"{name}: a mask of {shape[0]} x {shape[1]} pixels is needed, not of shape {kept.shape}"
        )
    return np.asarray(kept)
