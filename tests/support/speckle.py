"""A texture of cosines, known between the pixels and after any movement."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

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
        self._splines = {}

    def __call__(self, column, row):
        """Counts at any places, by a spline of samples at quarters of a pixel: within 1e-5."""
        corner, end = (_beyond(edge(column), edge(row), side) for edge, side in ((np.min, -1), (np.max, 1)))
        if (corner, end) not in self._splines:
            grid = [np.arange(4 * first, 4 * last) / 4 for first, last in zip(corner, end, strict=True)]
            self._splines[corner, end] = ndimage.spline_filter(self._on_grid(*grid), 5, mode="mirror")
        places = 4 * (row - corner[1]), 4 * (column - corner[0])
        return ndimage.map_coordinates(
            self._splines[corner, end], places, order=5, prefilter=False, mode="mirror"
        )

    def _on_grid(self, columns, rows):
        """Counts at columns and rows: cos(a + b) is a sum of products."""
        along, across = np.outer(self._x, columns), np.outer(rows, self._y) + self._phase
        cosines = np.concatenate([np.cos(across), -np.sin(across)], axis=1)
        return 120 + self._amplitude * (cosines @ np.concatenate([np.cos(along), np.sin(along)]))

    def frame(self, shape, right, down, noise=0.0, seed=0):
        """A frame whose points have gone so many pixels, numbers or functions of where they were."""
        row, column = np.mgrid[: shape[0], : shape[1]].astype(float)
        if callable(right) or callable(down):
            counts = self(*_origins(column, row, *map(_as_function, (right, down))))
        else:
            counts = self._on_grid(column[0] - right, row[:, 0] - down)
        noise = np.random.default_rng(seed).normal(0, noise, shape) if noise else 0
        return (counts + noise).astype(np.float32)


def _as_function(move):
    return move if callable(move) else lambda x, y: move


def _origins(column, row, right, down):
    """Return where the points were that are seen at columns and rows now."""
    x, y = column, row
    for _ in range(40):
        before = x, y
        x, y = column - right(x, y), row - down(x, y)
        if max(np.max(np.abs(x - before[0])), np.max(np.abs(y - before[1]))) < 1e-9:
            break
    return x, y


def _beyond(column, row, side):
    """Return whole pixels before or after a place, alike for places near each other."""
    return tuple(32 * int(np.floor(place / 32)) + (-8 if side < 0 else 40) for place in (column, row))
