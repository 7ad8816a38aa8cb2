"""Maps at other places than their pixels: resampled, and filled with the nearest value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mirrorskin.kernels.array_types import Doubles

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

_ROUNDING = 1e-6  # distance from a pixel's centre, in pixels, below which a point is the pixel itself


@dataclass(frozen=True, slots=True, eq=False)
class SamplePoints:
    """Points in a picture, and the four pixels around each."""

    pixels: NDArray[np.intp]  # (4, n): flat indices of the pixels; arbitrary if the share is 0
    shares: Doubles  # (4, n), float64: bilinear weights; 0 for pixels outside the picture
    nearest: NDArray[np.intp]  # (n,): flat index of the nearest pixel; arbitrary if it is outside
    closest: NDArray[np.intp]  # (n,): index of the nearest pixel among the four
    inside: Mask  # (n,), bool: whether the nearest pixel is in the picture
    all_inside: Mask  # (n,), bool: whether all four are

    @classmethod
    def at(cls, column: ArrayLike, row: ArrayLike, shape: tuple[int, int]) -> SamplePoints:
        """Return points, (n,), at distances in pixels from the first pixel's centre; NaN for none."""
        (rows, along_rows, i), (columns, along_columns, j) = _pair(row, shape[0]), _pair(column, shape[1])
        pixels = np.stack([y * shape[1] + x for y in rows for x in columns])
        shares = np.stack([v * w for v in along_rows for w in along_columns])
        closest = np.argmax(shares, axis=0)
        nearest = np.take_along_axis(pixels, closest[np.newaxis], axis=0)[0]
        inside = i & j
        whole = inside & (shares.sum(axis=0) > 1 - _ROUNDING)
        return cls(pixels, shares, nearest, closest, inside, whole)

    @property
    def on_pixel(self) -> Mask:
        """Whether a point is at a pixel's centre, (n,)."""
        return np.asarray(self.shares.max(axis=0) == 1)

    def same_label(self, labels: NDArray[Any]) -> Mask:
        """Return which of the four pixels have the label of the nearest one, (4, n), in a map (H, W)."""
        flat = labels.ravel()
        return np.asarray(flat[self.pixels] == flat[self.nearest])

    def nearest_values(self, values: NDArray[Any], outside: int | float) -> NDArray[Any]:
        """Return the values of the nearest pixels, (n,), of a map (H, W), or ``outside``."""
        return np.where(self.inside, values.ravel()[self.nearest], np.asarray(outside, values.dtype))

    def interpolate(self, values: Floats, count: Mask | None = None) -> Floats:
        """Interpolate a map, (H, W), to values, (n,); NaN where the nearest pixel has no answer.

        ``count``, (4, n), are the pixels to use, always including the nearest; by default all.
        """
        mean = self._mean([values.ravel()[self.pixels]], count)[0].astype(np.float32)
        return np.where(self.on_pixel, self.nearest_values(values, np.nan), mean)

    def interpolate_vectors(self, values: Floats, count: Mask | None = None) -> Floats:
        """Interpolate unit vectors, (H, W, 3), to unit vectors, (n, 3); see `interpolate`."""
        flat = values.reshape(-1, 3)
        mean = np.stack(self._mean(list(np.moveaxis(flat[self.pixels], -1, 0)), count))
        unit = (mean / np.sqrt(np.sum(mean * mean, axis=0))).astype(np.float32)
        unmoved = self.inside & self.on_pixel
        return np.where(unmoved[:, np.newaxis], flat[self.nearest], unit.T)

    def interpolate_angles(self, values: Floats, count: Mask | None = None) -> Floats:
        """Interpolate angles, (H, W), radians, along the shorter arc; see `interpolate`."""
        around = values.ravel()[self.pixels]
        cosine, sine = self._mean([np.cos(around), np.sin(around)], count)
        mean = np.arctan2(sine, cosine).astype(np.float32)
        return np.where(self.on_pixel, self.nearest_values(values, np.nan), mean)

    def _mean(self, around: list[Floats], count: Mask | None) -> list[Doubles]:
        """Return weighted means, (n,) each, of values, (4, n), that are undefined at the same pixels."""
        means = [np.einsum("kn,kn->n", self.shares, values) for values in around]
        nearest = np.take_along_axis(around[0], self.closest[np.newaxis], axis=0)[0]
        nearest = np.where(self.inside, nearest, np.nan)
        complete = np.isfinite(means[0]) & self.all_inside
        if count is not None:
            complete &= count.all(axis=0)
        partial = np.flatnonzero(~complete & np.isfinite(nearest))
        shares = np.where(np.isfinite(around[0][:, partial]), self.shares[:, partial], 0.0)
        if count is not None:
            shares = np.where(count[:, partial], shares, 0.0)
        shares /= shares.sum(axis=0)
        for mean, values in zip(means, around, strict=True):
            mean[partial] = np.sum(np.where(shares > 0, shares * values[:, partial], 0), axis=0)
            mean[np.isnan(nearest)] = np.nan
        return means


def _pair(place: ArrayLike, size: int) -> tuple[list[NDArray[np.intp]], list[Doubles], Mask]:
    """Return, along one axis, both adjacent pixels, their shares, and whether the nearest one exists."""
    place = np.asarray(place, np.float64)
    inside = (place >= -0.5) & (place <= size - 0.5)
    place = np.where(inside, place, 0.0)
    whole = np.rint(place)
    place = np.where(abs(place - whole) < _ROUNDING, whole, place)
    low = np.floor(place).astype(np.intp)
    fraction = place - low
    shares = [np.where(low >= 0, 1 - fraction, 0.0), np.where(low + 1 < size, fraction, 0.0)]
    return [np.maximum(low, 0), np.minimum(low + 1, size - 1)], shares, inside


def fill_with_nearest(values: NDArray[Any]) -> NDArray[Any]:
    """Return a map, (H, W), with NaN replaced by the nearest number; distances are accurate to 2 %."""
    import cv2

    finite = np.isfinite(values)
    if finite.all():
        return values
    gaps = (~finite).view(np.uint8)
    _, label = cv2.distanceTransformWithLabels(gaps, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    numbers = np.full(label.max() + 1, np.nan, values.dtype)
    numbers[label[finite]] = values[finite]
    return np.asarray(numbers[label])
