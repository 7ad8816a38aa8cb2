"""Means of blocks of pixels, and their errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, toeplitz

from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.force.halfspace import HalfSpace
from mirrorskin.io import Result, pixel_axes
from mirrorskin.kernels.array_types import Doubles

Singles = NDArray[np.float32]
Window = tuple[slice, slice]


@dataclass(frozen=True)
class Blocks:
    """Blocks of pixels, whose means are the maps of the tracker."""

    shape: tuple[int, int]  # of the pixels
    pixel_size: tuple[float, float]
    binning: int

    @cached_property
    def space(self) -> HalfSpace:
        """The half-space of the blocks."""
        rows, columns = (size // self.binning for size in self.shape)
        return HalfSpace(
            (rows, columns), (self.pixel_size[0] * self.binning, self.pixel_size[1] * self.binning)
        )

    @cached_property
    def forms(self) -> Singles:
        """The forms of a flat punch, and of those tilted along x and y, (3, H, W): 1, and -1 to 1."""
        rows, columns = self.space.shape
        flat = np.ones((rows, columns), np.float32)
        x, y = np.linspace(-1, 1, columns), np.linspace(1, -1, rows)
        return np.stack([flat, flat * x.astype(np.float32), flat * y[:, np.newaxis].astype(np.float32)])

    def axes(self, result: Result) -> tuple[Doubles, Doubles]:
        """Return x and y of the blocks' centres, mm."""
        x, y = result.x, result.y
        if x is None or y is None:
            x, y = pixel_axes(self.shape, self.pixel_size)
        rows, columns = self.space.shape
        first, last = 0, self.binning - 1
        x, y = (
            (axis[first :: self.binning][:n] + axis[last :: self.binning][:n]) / 2
            for axis, n in ((x, columns), (y, rows))
        )
        return x, y

    def scales(self, axes: tuple[Doubles, Doubles]) -> tuple[float, float]:
        """Return half of the lengths of the axes, along x and along y."""
        (x, y) = axes
        return float(x[-1] - x[0]) / 2, float(y[0] - y[-1]) / 2

    def pixels(self, window: Window) -> Window:
        """Return the pixels of the blocks in a window."""
        rows, columns = (slice(part.start * self.binning, part.stop * self.binning) for part in window)
        return rows, columns

    def means(self, values: NDArray[Any]) -> Singles:
        """Return the means of blocks, NaN where most of a block is undefined."""
        step = self.binning
        rows, columns = (size // step for size in values.shape)
        values = values[: rows * step, : columns * step]
        strips = sum((values[k::step] for k in range(1, step)), start=values[0::step])
        means = sum((strips[:, k::step] for k in range(1, step)), start=strips[:, 0::step])
        means = (means / step**2).astype(np.float32)
        gaps = ~np.isfinite(means)
        if step > 1 and gaps.any():
            parts = values.reshape(rows, step, columns, step).transpose(0, 2, 1, 3)[gaps]
            finite = np.isfinite(parts)
            count = np.count_nonzero(finite, axis=(1, 2))
            total = np.where(finite, parts, 0).sum(axis=(1, 2))
            means[gaps] = np.where(2 * count >= step**2, total / np.maximum(count, 1), np.nan)
        return means

    def at_centres(self, means: NDArray[Any], extended: bool = False) -> NDArray[Any]:
        """Return values at the centres of blocks, (..., H, W), from means, which are lower on a dome.

        The difference is 1/24 of the second differences of the means, less the same of pixels. The operator
        is symmetric inside a map, so it also converts weights of values to weights of means. Next to missing
        values the second difference is taken for 0, or ``extended``, for that of the next block inside.
        """
        values = means.copy()
        factor = means.dtype.type((1 - 1 / self.binning**2) / 24)
        for axis in (-2, -1):
            bend = np.diff(means, 2, axis=axis)
            if extended:
                for ahead, behind in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
                    one, other = (
                        (..., part, slice(None))[: 3 if axis == -2 else 2] for part in (ahead, behind)
                    )
                    bend[one] = np.where(np.isnan(bend[one]), bend[other], bend[one])
            inner = values[..., 1:-1, :] if axis == -2 else values[..., 1:-1]
            inner -= factor * np.where(np.isfinite(bend), bend, means.dtype.type(0))
        return values

    def alike(self, length: float, boxes: bool = False) -> tuple[Doubles, Doubles]:
        """Return the covariances of means along rows and along columns, if pixels have the variance 1.

        Errors of pixels are correlated over a Gaussian ``length``, mm, or are those of overlapping ``boxes``,
        whose length is in pixels.
        """
        (rows, columns), (width, height) = self.space.shape, self.pixel_size
        along_rows, along_columns = (length, length) if boxes else (length / height, length / width)
        step = self.binning
        return _alike(rows, step, along_rows, boxes), _alike(columns, step, along_columns, boxes)


@lru_cache(maxsize=16)
def _alike(count: int, binning: int, length: float, boxes: bool) -> Doubles:
    """Return the covariance of means along an axis, (n, n), for a variance of 1; see `Blocks.alike`."""
    inside = np.arange(binning)
    lag = np.abs(np.arange(count)[:, np.newaxis, np.newaxis] * binning + inside[:, np.newaxis] - inside)
    if boxes:
        near = np.maximum(1 - lag / length, 0)
    else:
        near = np.exp(-0.5 * (lag / length) ** 2) if length else (lag == 0).astype(np.float64)
    return np.asarray(toeplitz(near.mean(axis=(1, 2))))


class BlockErrors:
    """Errors of means, from standard deviations of pixels, (H, W), if known; see `Blocks.alike`."""

    def __init__(
        self, sigma: NDArray[Any] | None, blocks: Blocks, length: float, boxes: bool = False
    ) -> None:
        self._sigma, self._blocks, self._alike = sigma, blocks, blocks.alike(length, boxes)
        self._found: tuple[Window, Doubles] | None = None

    def usual(self, window: Window) -> float:
        """Return the usual standard deviation of a mean in a window."""
        rows, columns = self._alike
        return float(np.median(self._spread(window))) * math.sqrt(rows[0, 0] * columns[0, 0])

    def variance(self, weights: Doubles, window: Window) -> Doubles:
        """Return the variances of sums of means, weighted by (n, H, W) in a window."""
        rows, columns = self._inner(window)
        shares = weights * self._spread(window)
        return np.asarray(np.sum(shares * (rows @ shares @ columns), axis=(1, 2)))

    def drawn(self, window: Window) -> Singles:
        """Return random errors of means, (H, W), 0 outside a window."""
        errors = np.zeros(self._blocks.space.shape, np.float32)
        rows, columns = (
            cholesky(part + 1e-9 * part[0, 0] * np.eye(len(part)), lower=True) for part in self._inner(window)
        )
        spread = self._spread(window)
        errors[window] = spread * (rows @ np.random.default_rng(0).normal(size=spread.shape) @ columns.T)
        return errors

    def _inner(self, window: Window) -> tuple[Doubles, Doubles]:
        rows, columns = (
            part[: inner.stop - inner.start, : inner.stop - inner.start]
            for part, inner in zip(self._alike, window, strict=True)
        )
        return rows, columns

    def _spread(self, window: Window) -> Doubles:
        """Return the RMS standard deviation of a block's pixels, in a window; where unknown, the nearest."""
        if self._sigma is None:
            return np.zeros([part.stop - part.start for part in window])
        if self._found is None or self._found[0] != window:
            square = self._blocks.means(self._sigma[self._blocks.pixels(window)] ** 2)
            square = fill_with_nearest(square) if np.isfinite(square).any() else np.zeros_like(square)
            self._found = window, np.sqrt(square).astype(np.float64)
        return self._found[1]
