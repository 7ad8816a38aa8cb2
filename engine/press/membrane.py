"""Membranes: Laplace's equation over the unknown pixels of a map, by multigrid on the picture's own grid."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SQUARE = np.ones((3, 3), np.uint8)
_STEPS = tuple(1 / (1.25 + sign * 0.75 * math.sqrt(0.5)) for sign in (-1, 1))  # of Jacobi, for short waves
_LONGER = 1.5  # times the shorter side of a pixel, from which the longer one is not doubled
_SMALLEST = 4  # pixels along the coarsest level's sides
_SETTLED = 3e-4  # of the range of heights around, RMS, by which a cycle may still change them
_CYCLES = 8


def stretch(height: NDArray[np.floating], known: Mask, unknown: Mask, spacing: tuple[float, float]) -> Floats:
    """Solve Laplace's equation: each unknown pixel is the mean of its four neighbours.

    It reproduces planes, to about a thousandth of the range of heights around. Each group of unknown pixels
    touches a known one; at pixels that are neither the membrane is free.
    """
    height = height.astype(np.float32)
    level = _Level(unknown.astype(np.float32), known.astype(np.float32), spacing)
    rim = cv2.dilate(unknown.view(np.uint8), _SQUARE) * known
    lowest, highest, _, _ = cv2.minMaxLoc(height, mask=rim)
    middle = np.float32((lowest + highest) / 2)
    found = level.solve(np.where(known, height - middle, np.float32(0)))
    enough = _SETTLED * (highest - lowest) * math.sqrt(np.count_nonzero(unknown))
    for _ in range(_CYCLES):
        before = found.copy()
        level.improve(found)
        if cv2.norm(found, before, cv2.NORM_L2) <= enough:
            break
    return np.where(unknown, np.clip(found + middle, lowest, highest), height)


class _Level:
    """Wanted and given pixels, 1 or 0, and the same in pixels of twice the size, down to a few."""

    def __init__(self, wanted: Floats, given: Floats, spacing: tuple[float, float]) -> None:
        self._wanted = wanted
        down, across = (step**-2 for step in spacing)
        self._stiffness = 2 * (down + across)
        kernel = np.array([[0, down, 0], [across, 0, across], [0, down, 0]])
        self._kernel = (kernel / self._stiffness).astype(np.float32)
        around = self._sum(wanted + given)
        self._share = np.divide(wanted, around, out=np.zeros_like(wanted), where=around > 0)
        self._room = np.empty_like(wanted), np.empty_like(wanted)
        self._coarse: _Level | None = None
        if max(wanted.shape) > _SMALLEST and wanted.any():
            steps = [
                step if length > 1 else math.inf for step, length in zip(spacing, wanted.shape, strict=True)
            ]
            self._factors = tuple(2 if step < _LONGER * min(steps) else 1 for step in steps)
            self._given = self._reduce(given)  # the given share of large pixels
            large = (self._given > 0).astype(np.float32)
            free = (self._reduce(wanted) > 0).astype(np.float32) * (1 - large)
            double = spacing[0] * self._factors[0], spacing[1] * self._factors[1]
            self._coarse = _Level(free, large, double)

    def solve(self, heights: Floats) -> Floats:
        """Return what is near the solution, from the given heights, 0 elsewhere: full multigrid."""
        found = heights.copy()
        if self._coarse is not None:
            large = self._reduce(heights)
            np.divide(large, self._given, out=large, where=self._given > 0)
            found += self._wanted * self._enlarge(self._coarse.solve(large))
        self.improve(found)
        return found

    def improve(self, heights: Floats, source: Floats | None = None) -> None:
        """Do a V-cycle for heights that are their neighbours' mean plus a source."""
        self._smooth(heights, source)
        if self._coarse is None:
            for _ in range(_SMALLEST):
                self._smooth(heights, source)
            return
        rest = self._reduce(self._rest(heights, source))
        rest *= self._coarse._wanted * np.float32(self._stiffness / self._coarse._stiffness)
        error = np.zeros_like(rest)
        self._coarse.improve(error, rest)
        heights += self._wanted * self._enlarge(error)
        self._smooth(heights, source)

    def _smooth(self, heights: Floats, source: Floats | None) -> None:
        for step in _STEPS:
            cv2.scaleAdd(self._rest(heights, source), step, heights, heights)

    def _rest(self, heights: Floats, source: Floats | None) -> Floats:
        """Return by how much wanted pixels are lower than they should be, until the next call."""
        rest, other = self._room
        cv2.filter2D(heights, -1, self._kernel, rest, borderType=cv2.BORDER_CONSTANT)
        np.multiply(rest, self._share, out=rest)
        np.multiply(self._wanted, heights, out=other)
        np.subtract(rest, other, out=rest)
        if source is not None:
            np.add(rest, source, out=rest)
        return rest

    def _sum(self, values: Floats) -> Floats:
        return np.asarray(cv2.filter2D(values, -1, self._kernel, borderType=cv2.BORDER_CONSTANT), np.float32)

    def _reduce(self, values: Floats) -> Floats:
        """Return the means over large pixels; what is beyond the border counts as 0."""
        (rows, columns), (down, across) = values.shape, self._factors
        if rows % down or columns % across:
            values = np.pad(values, ((0, rows % down), (0, columns % across)))
        size = values.shape[1] // across, values.shape[0] // down
        return np.asarray(cv2.resize(values, size, interpolation=cv2.INTER_AREA), np.float32)

    def _enlarge(self, values: Floats) -> Floats:
        """Return the small pixels' shares of large ones; smoothing follows."""
        (rows, columns), (down, across) = values.shape, self._factors
        size = columns * across, rows * down
        large = cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)
        return np.asarray(large[: self._wanted.shape[0], : self._wanted.shape[1]], np.float32)
