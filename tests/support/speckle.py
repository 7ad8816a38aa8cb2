"""A texture of cosines, known between the pixels and after any movement."""

from __future__ import annotations

import numpy as np

WAVES = 300


class Speckle:
    """Counts of a texture at any place, pixels: waves no shorter than 4.5 pixels, and RMS of 20 counts."""

    def __init__(self, seed=0, contrast=20.0, shortest=4.5, longest=16.0):
        generator = np.random.default_rng(seed)
        # Evenly spread over the disc of wave vectors.
        size = np.sqrt(generator.uniform((2 * np.pi / longest) ** 2, (2 * np.pi / shortest) ** 2, WAVES))
        angle = generator.uniform(0, 2 * np.pi, WAVES)
        self._x, self._y = size * np.cos(angle), size * np.sin(angle)
        self._phase = generator.uniform(0, 2 * np.pi, WAVES)
        self._amplitude = contrast * np.sqrt(2 / WAVES)

    def __call__(self, column, row):
        total = np.zeros(np.broadcast(column, row).shape)
        for x, y, phase in zip(self._x, self._y, self._phase, strict=True):
            total += np.cos(x * column + y * row + phase)
        return 120 + self._amplitude * total

    def frame(self, shape, right, down, noise=0.0, seed=0):
        """A frame whose points have gone so many pixels, numbers or functions of where they were."""
        row, column = np.mgrid[: shape[0], : shape[1]].astype(float)
        x, y = column, row
        for _ in range(40 if callable(right) else 1):  # where the point was that is seen here
            x, y = (
                column - (right(x, y) if callable(right) else right),
                row - (down(x, y) if callable(down) else down),
            )
        noise = np.random.default_rng(seed).normal(0, noise, shape) if noise else 0
        return (self(x, y) + noise).astype(np.float32)
