"""Mean and spread of each pixel over many frames, in one pass."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mirrorskin.io.types import Floats


class Moments:
    """Count, mean and variance of each pixel's samples, and how many of them lie at the ends of the scale.

    Samples that are no finite numbers are left out. Sums are of differences to the first frame, in float64:
    of whole numbers they are exact.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    dtype : dtype
        Of the frames.

    Attributes
    ----------
    count : ndarray, (H, W), int32
        Samples of each pixel.
    frames : int
        Frames that were pushed.
    at_lowest, at_highest : ndarray, (H, W), int32
        How many samples are equal to the extreme ones.
    """

    def __init__(self, shape: tuple[int, int], dtype: DTypeLike) -> None:
        kind = np.dtype(dtype)
        self.whole = kind.kind == "u"
        self.frames = 0
        self.count = np.zeros(shape, np.int32)
        low, high = (0, np.iinfo(kind).max) if self.whole else (-np.inf, np.inf)
        self._lowest, self._highest = np.full(shape, high, kind), np.full(shape, low, kind)
        self.at_lowest, self.at_highest = np.zeros(shape, np.int32), np.zeros(shape, np.int32)
        self._sum, self._squares = np.zeros(shape), np.zeros(shape)
        self._first: Floats | None = None

    @property
    def lowest(self) -> Floats:
        """The least samples, (H, W), counts; infinite without one."""
        return np.where(self.count > 0, self._lowest, np.inf)

    @property
    def highest(self) -> Floats:
        """The greatest samples, (H, W), counts; minus infinite without one."""
        return np.where(self.count > 0, self._highest, -np.inf)

    @property
    def mean(self) -> Floats:
        """Means, (H, W), counts; NaN without a sample."""
        first = np.zeros(self._sum.shape) if self._first is None else self._first
        return np.asarray(np.where(self.count > 0, first + self._sum / np.maximum(self.count, 1), np.nan))

    @property
    def variance(self) -> Floats:
        """Unbiased variances of a sample, (H, W), counts^2; NaN of fewer than two samples."""
        left = self._squares - self._sum**2 / np.maximum(self.count, 1)
        return np.asarray(
            np.where(self.count > 1, np.maximum(left, 0) / np.maximum(self.count - 1, 1), np.nan)
        )

    def push(self, frames: NDArray[Any]) -> None:
        """Take in frames, (n, H, W)."""
        for frame in frames:
            if self.whole:
                self._push(frame, frame, frame, 1)
            else:
                told = np.isfinite(frame)
                low, high = np.where(told, frame, np.inf), np.where(told, frame, -np.inf)
                self._push(np.where(told, frame, np.nan), low, high, told.astype(np.int32))
        self.frames += len(frames)

    def join(self, other: Self) -> None:
        """Take in what another has taken in."""
        if other._first is None:
            return
        if self._first is None:
            self._first = np.zeros(self.count.shape)
        step = other._first - self._first
        self._squares += other._squares + 2 * step * other._sum + other.count * step**2
        self._sum += other._sum + other.count * step
        self._extremes(other._lowest, other._highest, other.at_lowest, other.at_highest)
        self.count += other.count
        self.frames += other.frames

    def _push(
        self, frame: NDArray[Any], low: NDArray[Any], high: NDArray[Any], once: NDArray[np.int32] | int
    ) -> None:
        """Take in a frame, as it is and as it is for its extremes, with how often each sample counts."""
        if self._first is None:
            self._first = np.nan_to_num(frame.astype(np.float64))
        difference = frame - self._first
        if not self.whole:
            np.nan_to_num(difference, copy=False)
        self._sum += difference
        difference *= difference
        self._squares += difference
        self._extremes(low, high, once, once)
        self.count += once

    def _extremes(
        self,
        low: NDArray[Any],
        high: NDArray[Any],
        at_low: NDArray[np.int32] | int,
        at_high: NDArray[np.int32] | int,
    ) -> None:
        """Take in extreme samples, and how often they occur."""
        self.at_lowest *= self._lowest <= low
        self.at_lowest += at_low * (low <= self._lowest)
        np.minimum(self._lowest, low, out=self._lowest)
        self.at_highest *= self._highest >= high
        self.at_highest += at_high * (high >= self._highest)
        np.maximum(self._highest, high, out=self._highest)
