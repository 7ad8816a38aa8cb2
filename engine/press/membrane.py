"""Membranes: Laplace's equation over the free pixels of a map, by multigrid."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SQUARE = np.ones((3, 3), np.uint8)
_STEPS = tuple(1 / (1.25 + sign * 0.75 * math.sqrt(0.5)) for sign in (-1, 1))  # Jacobi steps, Chebyshev roots
_LONGER = 1.5  # aspect ratio of pixels from which only the shorter side is doubled
_MIN_SIDE = 4  # pixels along the sides of the coarsest level
_LAST_CHANGE = 3e-4  # RMS change that ends the cycles, as a share of the range of heights at the rim
_CYCLES = 8  # maximum number of cycles


def stretch(height: NDArray[np.floating], fixed: Mask, free: Mask, spacing: tuple[float, float]) -> Floats:
    """Solve Laplace's equation: each free pixel is the mean of its four neighbours.

    Planes are reproduced to about a thousandth of the range of heights at the rim. Each group of free pixels
    touches a fixed one; at other pixels the membrane's border is free.
    """
    height = height.astype(np.float32)
    level = _Level(free.astype(np.float32), fixed.astype(np.float32), spacing)
    rim = cv2.dilate(free.view(np.uint8), _SQUARE) * fixed
    lowest, highest, _, _ = cv2.minMaxLoc(height, mask=rim)
    middle = np.float32((lowest + highest) / 2)
    heights = level.solve(np.where(fixed, height - middle, np.float32(0)))
    tolerance = _LAST_CHANGE * (highest - lowest) * math.sqrt(np.count_nonzero(free))
    for _ in range(_CYCLES):
        before = heights.copy()
        level.improve(heights)
        if cv2.norm(heights, before, cv2.NORM_L2) <= tolerance:
            break
    return np.where(free, np.clip(heights + middle, lowest, highest), height)


class _Level:
    """One grid of the multigrid: free and fixed pixels, 1 or 0, and the next coarser grid."""

    def __init__(self, free: Floats, fixed: Floats, spacing: tuple[float, float]) -> None:
        self._free = free
        down, across = (step**-2 for step in spacing)
        self._stiffness = 2 * (down + across)
        kernel = np.array([[0, down, 0], [across, 0, across], [0, down, 0]])
        self._kernel = (kernel / self._stiffness).astype(np.float32)
        around = cv2.filter2D(free + fixed, -1, self._kernel, borderType=cv2.BORDER_CONSTANT)
        self._share = np.divide(free, around, out=np.zeros_like(free), where=around > 0)
        self._buffers = np.empty_like(free), np.empty_like(free)
        self._coarse: _Level | None = None
        if max(free.shape) > _MIN_SIDE and free.any():
            steps = [
                step if length > 1 else math.inf for step, length in zip(spacing, free.shape, strict=True)
            ]
            self._factors = tuple(2 if step < _LONGER * min(steps) else 1 for step in steps)
            self._fixed = self._reduce(fixed)  # share of fixed pixels in large ones
            large_fixed = (self._fixed > 0).astype(np.float32)
            large_free = (self._reduce(free) > 0).astype(np.float32) * (1 - large_fixed)
            double = spacing[0] * self._factors[0], spacing[1] * self._factors[1]
            self._coarse = _Level(large_free, large_fixed, double)

    def solve(self, heights: Floats) -> Floats:
        """Return an approximate solution from the fixed heights, 0 elsewhere: full multigrid."""
        solution = heights.copy()
        if self._coarse is not None:
            large = self._reduce(heights)
            np.divide(large, self._fixed, out=large, where=self._fixed > 0)
            solution += self._free * self._enlarge(self._coarse.solve(large))
        self.improve(solution)
        return solution

    def improve(self, heights: Floats, source: Floats | None = None) -> None:
        """Improve heights by one V-cycle; each is the mean of its neighbours plus a source."""
        self._smooth(heights, source)
        if self._coarse is None:
            for _ in range(_MIN_SIDE):
                self._smooth(heights, source)
            return
        residual = self._reduce(self._residual(heights, source))
        residual *= self._coarse._free * np.float32(self._stiffness / self._coarse._stiffness)
        error = np.zeros_like(residual)
        self._coarse.improve(error, residual)
        heights += self._free * self._enlarge(error)
        self._smooth(heights, source)

    def _smooth(self, heights: Floats, source: Floats | None) -> None:
        for step in _STEPS:
            cv2.scaleAdd(self._residual(heights, source), step, heights, heights)

    def _residual(self, heights: Floats, source: Floats | None) -> Floats:
        """Return the residual of free pixels, in a buffer that the next call overwrites."""
        residual, product = self._buffers
        cv2.filter2D(heights, -1, self._kernel, residual, borderType=cv2.BORDER_CONSTANT)
        np.multiply(residual, self._share, out=residual)
        np.multiply(self._free, heights, out=product)
        np.subtract(residual, product, out=residual)
        if source is not None:
            np.add(residual, source, out=residual)
        return residual

    def _reduce(self, values: Floats) -> Floats:
        """Return the means over large pixels; values beyond the border are 0."""
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
        return np.asarray(large[: self._free.shape[0], : self._free.shape[1]], np.float32)
