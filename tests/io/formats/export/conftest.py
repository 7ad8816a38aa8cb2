"""Results to export: small, with oblong pixels, and without symmetry."""

from __future__ import annotations

import numpy as np
import pytest

from mirrorskin import io

SIZE = 0.5, 0.25  # mm along x and y
PEAK = 1, 6  # row and column: up and to the right
HOLE = 4, 2
PROCESS = {
    "program": "mirrorskin",
    "version": "1.2.3",
    "date": "2026-01-02T03:04:05+00:00",
    "source": "Münze 五円.h5",
    "hold": 2,
}


@pytest.fixture
def slope():
    """A slope of 6 x 9 pixels with a peak, a hole, and one height that was filled; its normals are known."""
    x, y = io.pixel_axes((6, 9), SIZE)
    height = (0.1 * x - 0.3 * y[:, None] - 1).astype(np.float32)
    height[PEAK] += 1
    height[HOLE] = np.nan
    normal = np.array([-0.1, 0.3, 1]) / np.sqrt(1.1)
    normals = np.broadcast_to(normal, (6, 9, 3)).astype(np.float32)
    normals[0, 0] = np.nan
    filled = np.zeros((6, 9), np.uint8)
    filled[2, 3] = 1
    sigma = np.where(filled, np.nan, 0.01 + 0.001 * np.arange(54).reshape(6, 9)).astype(np.float32)
    component = np.where(np.isnan(height), -1, 0).astype(np.int32)
    return io.Result(
        height=height,
        height_sigma=sigma,
        normals=normals,
        filled=filled,
        component=component,
        offset_unknown=np.zeros(1, np.uint8),
        x=x,
        y=y,
        process=PROCESS,
    )
