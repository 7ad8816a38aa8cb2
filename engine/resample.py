"""Values between the pixels of a map, where some pixels have none or belong to something else."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_ROUNDING = 1e-6  # of a pixel: places nearer than that are the pixel's own


@dataclass(frozen=True, slots=True, eq=False)
class SamplePoints:
    """Places in a picture, and the four pixels around each."""

    pixels: NDArray[np.intp]  # (4, n), intp: numbers of the pixels, row by row; any where the share is 0
    shares: Doubles  # (4, n), float64: bilinear weights; 0 of pixels outside the picture
    nearest: NDArray[np.intp]  # (n,), intp: number of the nearest pixel; any where it is outside
    closest: NDArray[np.intp]  # (n,), intp: which of the four that is
    inside: Mask  # (n,), bool: whether the nearest pixel is in the picture
    all_inside: Mask  # (n,), bool: whether all four are

    @classmethod
    def at(cls, column: ArrayLike, row: ArrayLike, shape: tuple[int, int]) -> SamplePoints:
        """Take places, (n,), in pixels from the first one's centre, NaN where there is none."""
        (rows, low, i), (columns, left, j) = _pair(row, shape[0]), _pair(column, shape[1])
        pixels = np.stack([y * shape[1] + x for y in rows for x in columns])
        shares = np.stack([v * w for v in low for w in left])
        closest = np.argmax(shares, axis=0)
        nearest = np.take_along_axis(pixels, closest[np.newaxis], axis=0)[0]
        inside = i & j
        whole = inside & (shares.sum(axis=0) > 1 - _ROUNDING)
        return cls(pixels, shares, nearest, closest, inside, whole)

    @property
    def on_pixel(self) -> Mask:
        """Where a place is a pixel's own, (n,)."""
        return np.asarray(self.shares.max(axis=0) == 1)

    def same_label(self, labels: NDArray[Any]) -> Mask:
        """Tell which of the four pixels have the nearest one's label, (4, n), in a map (H, W)."""
        flat = labels.ravel()
        return np.asarray(flat[self.pixels] == flat[self.nearest])

    def nearest_values(self, values: NDArray[Any], outside: int | float) -> NDArray[Any]:
        """Return the nearest pixels' values, (n,), of a map (H, W), and another outside."""
        return np.where(self.inside, values.ravel()[self.nearest], np.asarray(outside, values.dtype))

    def interpolate(self, values: Floats, count: Mask | None = None) -> Floats:
        """Interpolate a map, (H, W), to values, (n,); NaN where the nearest pixel has no answer.

        ``count``, (4, n), are the pixels that count, the nearest always among them; by default all do.
        """
        mean = self._mean([values.ravel()[self.pixels]], count)[0].astype(np.float32)
        return np.where(self.on_pixel, self.nearest_values(values, np.nan), mean)

    def interpolate_vectors(self, values: Floats, count: Mask | None = None) -> Floats:
        """Interpolate unit vectors, (H, W, 3), to such vectors, (n, 3); see `interpolate`."""
        flat = values.reshape(-1, 3)
        mean = np.stack(self._mean(list(np.moveaxis(flat[self.pixels], -1, 0)), count))
        unit = (mean / np.sqrt(np.sum(mean * mean, axis=0))).astype(np.float32)
        own = self.inside & self.on_pixel
        return np.where(own[:, np.newaxis], flat[self.nearest], unit.T)

    def interpolate_angles(self, values: Floats, count: Mask | None = None) -> Floats:
        """Interpolate angles, (H, W), radians, the short way round the circle; see `interpolate`."""
        around = values.ravel()[self.pixels]
        cosine, sine = self._mean([np.cos(around), np.sin(around)], count)
        mean = np.arctan2(sine, cosine).astype(np.float32)
        return np.where(self.on_pixel, self.nearest_values(values, np.nan), mean)

    def _mean(self, around: list[Floats], count: Mask | None) -> list[Doubles]:
        """Return weighted means, (n,) each, of values around, (4, n), that are known or unknown together."""
        means = [np.einsum("kn,kn->n", self.shares, one) for one in around]
        own = np.where(
            self.inside, np.take_along_axis(around[0], self.closest[np.newaxis], axis=0)[0], np.nan
        )
        easy = np.isfinite(means[0]) & self.all_inside
        if count is not None:
            easy &= count.all(axis=0)
        few = np.flatnonzero(~easy & np.isfinite(own))
        shares = np.where(np.isfinite(around[0][:, few]), self.shares[:, few], 0.0)
        if count is not None:
            shares = np.where(count[:, few], shares, 0.0)
        shares /= shares.sum(axis=0)
        for mean, one in zip(means, around, strict=True):
            mean[few] = np.sum(np.where(shares > 0, shares * one[:, few], 0), axis=0)
            mean[np.isnan(own)] = np.nan
        return means


def _pair(place: ArrayLike, size: int) -> tuple[list[NDArray[np.intp]], list[Doubles], Mask]:
    """Return, along one axis, the pixels beside places, their shares, and whether the nearest is there."""
    place = np.asarray(place, np.float64)
    inside = (place >= -0.5) & (place <= size - 0.5)
    place = np.where(inside, place, 0.0)
    whole = np.rint(place)
    place = np.where(abs(place - whole) < _ROUNDING, whole, place)
    low = np.floor(place).astype(np.intp)
    share = place - low
    shares = [np.where(low >= 0, 1 - share, 0.0), np.where(low + 1 < size, share, 0.0)]
    return [np.maximum(low, 0), np.minimum(low + 1, size - 1)], shares, inside
