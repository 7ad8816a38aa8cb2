"""Means of blocks of pixels, and their errors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, toeplitz

from mirrorskin.engine.base.resample import fill_with_nearest
from mirrorskin.engine.force.halfspace import HalfSpace
from mirrorskin.io import Result, pixel_axes
from mirrorskin.kernels.array_types import Doubles

Singles = NDArray[np.float32]
Window = tuple[slice, slice]

_SQUARES = 2**14  # pixels that are squared at a time
_NEGLIGIBLE, _JITTER = 1e-8, 1e-6  # covariances relative to the variance: left out; added to it


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
        """Return the means of blocks, (H, W) or (H, W, n), NaN where most of a block is undefined."""
        step = self.binning
        rows, columns = values.shape[0] // step, values.shape[1] // step
        values = values[: rows * step, : columns * step]
        if step == 1:
            return np.array(values, np.float32)
        if min(values.strides) <= 0 or values.dtype not in (np.float32, np.float64):
            values = np.ascontiguousarray(values, np.float64)
        means = cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA).astype(
            np.float32, copy=False
        )
        gaps = ~np.isfinite(means)
        if gaps.any():
            gaps = np.any(gaps.reshape(rows, columns, -1), axis=-1)
            parts = values.reshape(rows, step, columns, step, *values.shape[2:]).swapaxes(1, 2)[gaps]
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
        factor = means.dtype.type((1 - 1 / self.binning**2) / 24)
        if not factor:
            return means
        values, is_whole = means.copy(), bool(np.isfinite(means).all())
        for source, target in ((means, values), (means.swapaxes(-1, -2), values.swapaxes(-1, -2))):
            bend = source[..., 2:] + source[..., :-2]
            bend -= 2 * source[..., 1:-1]
            if not is_whole:
                if extended:
                    for ahead, behind in ((slice(1, None), slice(-1)), (slice(-1), slice(1, None))):
                        one, other = bend[..., ahead], bend[..., behind]
                        np.copyto(one, other, where=np.isnan(one))
                bend[~np.isfinite(bend)] = 0
            bend *= factor
            target[..., 1:-1] -= bend
        return values

    def alike(self, length: float, boxes: bool = False) -> tuple[Doubles, Doubles]:
        """Return the covariances of means along a column and along a row, by distance in blocks, from 0.

        Pixels have the variance 1. Their errors are correlated over a Gaussian ``length``, mm, or are those
        of overlapping ``boxes``, whose length is in pixels. Covariances that are negligible are left out.
        """
        (rows, columns), (width, height) = self.space.shape, self.pixel_size
        along_rows, along_columns = (length, length) if boxes else (length / height, length / width)
        step = self.binning
        return _alike(rows, step, along_rows, boxes), _alike(columns, step, along_columns, boxes)


@lru_cache(maxsize=16)
def _alike(count: int, binning: int, length: float, boxes: bool) -> Doubles:
    """Return the covariance of means along an axis, by distance, for a variance of 1; see `Blocks.alike`."""
    inside = np.arange(binning)
    lag = np.abs(np.arange(count)[:, np.newaxis, np.newaxis] * binning + inside[:, np.newaxis] - inside)
    if boxes:
        near = np.maximum(1 - lag / length, 0)
    else:
        near = np.exp(-0.5 * (lag / length) ** 2) if length else (lag == 0).astype(np.float64)
    alike = near.mean(axis=(1, 2))
    return np.asarray(alike[: np.flatnonzero(alike > _NEGLIGIBLE * alike[0])[-1] + 1])


class BlockErrors:
    """Errors of means, given standard deviations of pixels, (H, W) or (H, W, n); see `Blocks.alike`."""

    def __init__(
        self, sigma: NDArray[Any] | None, blocks: Blocks, length: float, boxes: bool = False
    ) -> None:
        self._sigma, self._blocks, self._alike = sigma, blocks, blocks.alike(length, boxes)
        self._found: tuple[Window, Doubles] | None = None

    def usual(self, window: Window) -> float:
        """Return the usual standard deviation of a mean in a window."""
        rows, columns = self._alike
        spread = self._spread(window).ravel()
        return float(np.partition(spread, spread.size // 2)[spread.size // 2]) * math.sqrt(
            rows[0] * columns[0]
        )

    def variance(self, weights: Doubles, window: Window) -> Doubles:
        """Return the variances of sums of means, weighted by (..., n, H, W) in a window.

        Of errors of n kinds, each has its own weights.
        """
        rows, columns = (np.concatenate([part[:0:-1], part]) for part in self._alike)
        spread = self._spread(window)
        shares = weights * (spread if spread.ndim == 2 else spread.transpose(2, 0, 1))
        if rows.size == columns.size == 1:
            return np.asarray(np.einsum("...ij,...ij->...", shares, shares) * (rows[0] * columns[0]))
        alike, shape = np.empty_like(shares), (-1, *shares.shape[-2:])
        for part, out in zip(shares.reshape(shape), alike.reshape(shape), strict=True):
            cv2.sepFilter2D(part, -1, columns, rows, dst=out, borderType=cv2.BORDER_CONSTANT)
        return np.asarray(np.maximum(np.einsum("...ij,...ij->...", shares, alike), 0))

    def drawn(self, window: Window) -> Singles:
        """Return random errors of means, (H, W), 0 outside a window."""
        errors = np.zeros(self._blocks.space.shape, np.float32)
        roots = []
        for part, inner in zip(self._alike, window, strict=True):
            size = inner.stop - inner.start
            column = np.pad(part[:size], (0, max(size - part.size, 0)))
            column[0] *= 1 + _JITTER
            roots.append(cholesky(toeplitz(column), lower=True))
        spread = self._spread(window)
        rows, columns = roots
        errors[window] = spread * (rows @ np.random.default_rng(0).normal(size=spread.shape) @ columns.T)
        return errors

    def _spread(self, window: Window) -> Doubles:
        """Return the RMS standard deviation of a block's pixels, in a window; where unknown, the nearest."""
        if self._sigma is None:
            return np.zeros([part.stop - part.start for part in window])
        if self._found is None or self._found[0] != window:
            square = self._squares(self._sigma[self._blocks.pixels(window)])
            if not np.isfinite(square).all():
                layers = square.reshape(*square.shape[:2], -1)
                for n in range(layers.shape[2]):
                    layer = layers[..., n]
                    layer[...] = fill_with_nearest(layer) if np.isfinite(layer).any() else 0
            self._found = window, np.sqrt(square, dtype=np.float64)
        return self._found[1]

    def _squares(self, sigma: NDArray[Any]) -> Singles:
        """Return the means of squares, of some rows at a time: there is no new array of a frame's size."""
        step = self._blocks.binning
        row = sigma[:step].size
        size = step * max(1, _SQUARES // max(row, 1))
        strips = (sigma[start : start + size] for start in range(0, len(sigma), size))
        parts = [self._blocks.means(strip * strip) for strip in strips]
        return parts[0] if len(parts) == 1 else np.concatenate(parts)
