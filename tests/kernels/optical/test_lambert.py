"""Least squares over lamps: the reference compared with the normal equations."""

import numpy as np

from mirrorskin.kernels.optical.lambert import lambert_add

PIXELS = 1100
GENERATOR = np.random.default_rng(0)
LIGHTS = GENERATOR.normal(size=(9, 3)).astype(np.float32)
FRAMES = GENERATOR.integers(0, 256, (9, PIXELS))


def test_the_triangle_holds_the_normal_equations():
    triangle = np.zeros((11, PIXELS))
    for first in (0, 4):
        part = slice(first, first + 5 if first else 4)
        lambert_add(FRAMES[part], LIGHTS[part], np.array([3.0]), first, 10.0, 255.0, triangle)
    squares, above = triangle[[0, 1, 2, 9], 7], np.eye(4)
    above[[0, 0, 1, 0, 1, 2], [1, 2, 2, 3, 3, 3]] = triangle[3:9, 7]  # divided by the diagonal
    unclipped = (FRAMES[:, 7] > 13) & (FRAMES[:, 7] < 255)
    rows = np.column_stack([LIGHTS, FRAMES[:, 7] - 3.0])[unclipped]
    np.testing.assert_allclose((above.T * squares) @ above, rows.T @ rows, atol=1e-8)
    assert triangle[10, 7] == unclipped.sum()
