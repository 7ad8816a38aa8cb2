"""Operations of a user's own, and a function that another process runs them with."""

from __future__ import annotations

from typing import Any

import numpy as np

from mirrorskin import engine, io


class Total(engine.Operation):
    """Sum of all frames: an operation without positions."""

    least: float = engine.option(default=0.0, unit="counts", help="counts below which a pixel is 0")
    total = io.Map("sum of the frames", "counts", dtype="float64")

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Begin with 0."""
        self.sum = np.zeros(shape, np.float64)

    def push(self, frames: Any) -> None:
        """Add one frame after the other, so that rounding does not depend on how they are divided."""
        for frame in frames:
            self.sum += frame

    def result(self) -> dict[str, Any]:
        """Return the sum, which may be the state itself."""
        return {"total": np.where(self.sum < self.least, 0, self.sum)}


class Covariance(engine.Operation):
    """Covariance of brightness and travel: an operation of two passes."""

    motions = ("vertical",)
    passes = 2
    covariance = io.Map("covariance with the travel", "counts mm", dtype="float64")

    def start(self, shape: tuple[int, int], dtype: np.dtype[Any]) -> None:
        """Begin with means."""
        self.sums: tuple[Any, float, int] = np.zeros(shape), 0.0, 0
        self.means: tuple[Any, float] | None = None
        self.covariances = np.zeros(shape)

    def start_second_pass(self) -> None:
        """Compute the means."""
        counts, travel, number = self.sums
        self.means = counts / number, travel / number

    def push(self, frames: Any, *, travel: Any) -> None:
        """Add to the means, then to the covariance."""
        for frame, place in zip(frames.astype(np.float64), np.asarray(travel).tolist(), strict=True):
            if self.means is None:
                counts, travels, number = self.sums
                self.sums = counts + frame, travels + place, number + 1
            else:
                self.covariances += (frame - self.means[0]) * (place - self.means[1])

    def result(self) -> dict[str, Any]:
        """Return the covariance."""
        return {"covariance": self.covariances / self.sums[2]}


class Depth(engine.Onset):
    """The built-in onset with a result of its own."""

    depth = io.Map("depth below the highest point", "mm")

    def result(self) -> dict[str, Any]:
        """Return the maps of the base, and a further one."""
        maps = super().result()
        depth = np.nanmax(maps["height"], initial=-np.inf) - maps["height"]
        return {**maps, "depth": depth.astype(np.float32)}


def run_elsewhere(
    operation: engine.Operation, frames: Any, positions: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """Return maps, process and fitted values of an operation that was pickled into this process."""
    result = engine.run(frames, operation, **positions)
    return dict(result), dict(result.process), getattr(result, "fitted", None)
