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

    @property
    def bend(self) -> float:
        """How much lower a mean is than the value at a block's centre, over the second difference of means.

        It is 1/24, less the same of pixels.
        """
        return (1 - 1 / self.binning**2) / 24

    def at_centres(self, means: Singles) -> Singles:
        """Return weights of means, (..., H, W), from those of values at centres, 0 outside the map.

        The operator from means to values at centres is symmetric.
        """
        values = means.copy()
        for source, target in ((means, values), (means.swapaxes(-1, -2), values.swapaxes(-1, -2))):
            second = source[..., 2:] - 2 * source[..., 1:-1] + source[..., :-2]
            target[..., 1:-1] -= np.float32(self.bend) * second
        return values

    def weights_of_means(self, weights: NDArray[Any], known: NDArray[np.bool_]) -> NDArray[Any]:
        """Return weights of means, (..., H, W), from those of values at centres, 0 where nothing is known.

        The values are those of `at_centres`, but next to an unknown block, the second difference is that of
        the next block inside.
        """
        weights, factor = weights.copy(), weights.dtype.type(self.bend)
        for values, mask in ((weights.copy(), known), (weights.swapaxes(-1, -2).copy(), known.T)):
            inside = np.zeros_like(mask)
            inside[:, 1:-1] = mask[:, 1:-1] & mask[:, 2:] & mask[:, :-2]
            ahead, behind = np.zeros_like(mask), np.zeros_like(mask)  # blocks that take the next one's
            ahead[:, :-1] = mask[:, :-1] & ~inside[:, :-1] & inside[:, 1:]
            behind[:, 1:] = mask[:, 1:] & ~inside[:, 1:] & inside[:, :-1] & ~ahead[:, 1:]
            bend = np.where(inside, values, 0)
            bend[..., 1:] += np.where(ahead, values, 0)[..., :-1]
            bend[..., :-1] += np.where(behind, values, 0)[..., 1:]
            bend *= factor
            target = weights if mask is known else weights.swapaxes(-1, -2)
            target += 2 * bend
            target[..., 1:] -= bend[..., :-1]
            target[..., :-1] -= bend[..., 1:]
        return weights

    def alike(self, length: float, boxes: bool = False) -> tuple[Doubles, Doubles]:
        """Return the covariances of means along a column and along a row, by distance in blocks, from 0.

        Pixels have the variance 1. Their errors are correlated over a Gaussian ``length``, mm, or are those
        of overlapping ``boxes``, whose length is in pixels. Covariances that are negligible are left out.
        """
        return _both_alike(self, length, boxes)


@lru_cache(maxsize=16)
def _both_alike(blocks: Blocks, length: float, boxes: bool) -> tuple[Doubles, Doubles]:
    """Return the covariances of `Blocks.alike`."""
    (rows, columns), (width, height) = blocks.space.shape, blocks.pixel_size
    along_rows, along_columns = (length, length) if boxes else (length / height, length / width)
    step = blocks.binning
    return _alike(rows, step, along_rows, boxes), _alike(columns, step, along_columns, boxes)


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
    """Errors of means in a window, given their variances without correlation, (H, W) or (n, H, W) of n kinds.

    Errors of pixels are correlated as in `Blocks.alike`. Where a variance is undefined, it is that of the
    nearest block, or 0 if there is none.
    """

    def __init__(self, variance: NDArray[Any], blocks: Blocks, length: float, boxes: bool = False) -> None:
        if not np.isfinite(variance).all():
            layers = variance.reshape(-1, *variance.shape[-2:])
            filled = [
                fill_with_nearest(layer) if np.isfinite(layer).any() else np.zeros_like(layer)
                for layer in layers
            ]
            variance = np.stack(filled).reshape(variance.shape)
        self._spread, self._alike = np.sqrt(variance), blocks.alike(length, boxes)

    def usual(self) -> float:
        """Return the usual standard deviation of a mean."""
        (rows, columns), spread = self._alike, self._spread.ravel()
        middle = float(np.partition(spread, spread.size // 2)[spread.size // 2])
        return middle * math.sqrt(rows[0] * columns[0])

    def covariance(self, weights: NDArray[Any]) -> Doubles:
        """Return the covariance, (n, n), of n sums of means.

        Weights are (n, H, W), or (n, k, H, W) for means of k kinds, whose errors are independent.
        """
        rows, columns = self._alike
        shares = weights * self._spread
        alike, shape = shares, (len(shares), -1)
        if rows.size == columns.size == 1:
            alike = shares * float(rows[0] * columns[0])
        else:
            across, down = (np.concatenate([part[:0:-1], part]) for part in (columns, rows))
            layers = shares.astype(np.float64).reshape(-1, *shares.shape[-2:])
            alike = np.stack(
                [cv2.sepFilter2D(layer, -1, across, down, borderType=cv2.BORDER_CONSTANT) for layer in layers]
            )
        return np.asarray(np.einsum("ni,mi->nm", shares.reshape(shape), alike.reshape(shape)), np.float64)

    def drawn(self) -> Singles:
        """Return random errors of means."""
        roots = []
        for part, size in zip(self._alike, self._spread.shape, strict=True):
            column = np.pad(part[:size], (0, max(size - part.size, 0)))
            column[0] *= 1 + _JITTER
            roots.append(cholesky(toeplitz(column), lower=True))
        rows, columns = roots
        random = np.random.default_rng(0).normal(size=self._spread.shape)
        return np.asarray(self._spread * (rows @ random @ columns.T), np.float32)
